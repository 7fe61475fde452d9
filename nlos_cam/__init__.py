"""See around a corner with a consumer lidar."""

# As type checkers take it; `typing` costs a tenth of the time of `nlos-cam --version`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from nlos_cam.api import Stream
    from nlos_cam.api import open_stream as open  # noqa: A004  as gzip.open: always called as nlos_cam.open
    from nlos_cam.reconstruct import FrameResult

__version__ = "0.2.0"
__all__ = ["FrameResult", "Stream", "__version__", "open"]

LATE = {
    "FrameResult": ("nlos_cam.reconstruct", "FrameResult"),
    "Stream": ("nlos_cam.api", "Stream"),
    "open": ("nlos_cam.api", "open_stream"),
}
"""Public names, with the module and name of each, which is imported on first use."""


def __getattr__(name: str) -> object:
    if name not in LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module, attribute = LATE[name]
    return getattr(import_module(module), attribute)
