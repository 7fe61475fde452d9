"""Late import of pyrealsense2, librealsense's Python wheel, the only one in the project."""

import ctypes
import platform
import sys
from functools import cache
from typing import Any

from nlos_cam.errors import CameraError

WHEEL = "pyrealsense2==2.54.2.5684"
MAC_WHEEL = "pyrealsense2-macosx==2.54.2"
"""The last wheels that support the L515; that for macOS is a community build."""


def wheel_for(python: tuple[int, int], system: str, machine: str) -> str | None:
    """Return the wheel to install, by `sys.platform` and `platform.machine()`; None where none
    supports the L515.
    """
    if system == "darwin":
        return MAC_WHEEL if python < (3, 13) else None
    return (
        WHEEL
        if python < (3, 12) and (system, machine) in {("linux", "x86_64"), ("win32", "AMD64")}
        else None
    )


def sdk_serial(serial: str) -> str:
    """Return a serial number as the SDK writes it: lower case, without leading zeros."""
    return serial.strip().lower().lstrip("0")


@cache
def load_sdk() -> Any:
    """Return the pyrealsense2 module. Raises CameraError where it cannot be loaded."""
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
        f"no wheel that supports the L515 exists for Python {major}.{minor} on {system} {machine};"
        " use Python 3.11 on Windows or Linux (x86_64) for cameras, simulated ones too; recordings"
        " can be replayed here"
    )


def _preload_libusb() -> None:
    """Load libusb from its own wheel: librealsense's Linux wheel needs it and does not include
    it.
    """
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
