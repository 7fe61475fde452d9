"""The one import of pyrealsense2, librealsense's Python wheel; done when a camera is first opened, not before."""

import ctypes
import platform
import sys
from functools import cache
from typing import Any

from nlos_cam.errors import CameraError

WHEEL, MAC_WHEEL = "pyrealsense2==2.54.2.5684", "pyrealsense2-macosx==2.54.2"
"""The last wheels that know the L515; macOS has one from the community."""


def wheel_for(python: tuple[int, int], system: str, machine: str) -> str | None:
    """The wheel to install, by `sys.platform` and `platform.machine()`; None where none knows the L515."""
    if system == "darwin":
        return MAC_WHEEL if python < (3, 13) else None
    return WHEEL if python < (3, 12) and (system, machine) in {("linux", "x86_64"), ("win32", "AMD64")} else None


@cache
def load_sdk() -> Any:
    """The pyrealsense2 module. Raises CameraError where it cannot be loaded."""
    try:
        if sys.platform == "linux":
            _preload_libusb()
        import pyrealsense2
    except (ImportError, OSError) as error:
        raise CameraError(f"librealsense cannot be loaded ({error}): {_advice()}") from error
    return pyrealsense2


def _advice() -> str:
    here = sys.version_info[:2], sys.platform, platform.machine()
    if wheel := wheel_for(*here):
        return f"run `pip install {wheel} libusb-package`"
    (major, minor), system, machine = here
    return (
        f"no wheel of it that knows the L515 is for Python {major}.{minor} on {system} {machine}; use Python 3.11 on "
        "Windows or Linux (x86_64) for cameras, simulated ones too; recordings can be replayed here"
    )


def _preload_libusb() -> None:
    """Load libusb from its own wheel: the Linux wheel of librealsense asks for it and does not bring it."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
