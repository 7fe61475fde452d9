"""The one import of pyrealsense2, librealsense's Python wheel; done when a camera is first opened, not before."""

import ctypes
import sys
from functools import cache
from typing import Any

from nlos_cam.errors import CameraError

WHEEL = "pyrealsense2==2.54.2.5684"
"""The last wheel that knows the L515."""


@cache
def load_sdk() -> Any:
    """The pyrealsense2 module. Raises CameraError where it cannot be loaded."""
    try:
        if sys.platform == "linux":
            _preload_libusb()
        import pyrealsense2
    except (ImportError, OSError) as error:
        raise CameraError(
            f"librealsense cannot be loaded ({error}): run `pip install {WHEEL} libusb-package`"
        ) from error
    return pyrealsense2


def _preload_libusb() -> None:
    """Load libusb from its own wheel: the Linux wheel of librealsense asks for it and does not bring it."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
