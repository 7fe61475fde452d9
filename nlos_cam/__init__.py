"""See around a corner with a consumer lidar."""

TYPE_CHECKING = (
    False  # as type checkers take it; `typing` costs a tenth of the time of `nlos-cam --version`
)
if TYPE_CHECKING:
    from nlos_cam.api import Glimpse, Stream
    from nlos_cam.api import open_stream as open  # noqa: A004  as gzip.open: always called as nlos_cam.open

__version__ = "0.1.0"
__all__ = ["Glimpse", "Stream", "__version__", "open"]

LATE = {"Glimpse": "Glimpse", "Stream": "Stream", "open": "open_stream"}
"""Public names and their names in `nlos_cam.api`, which is imported on first use."""


def __getattr__(name: str) -> object:
    if name not in LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("nlos_cam.api"), LATE[name])
