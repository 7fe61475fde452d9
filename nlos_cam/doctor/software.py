"""Checks of what is installed: Python, the system, librealsense and libusb."""

import re

from nlos_cam.camera.sdk import WHEEL
from nlos_cam.doctor.check import Finding, failed, ok, skipped, warning
from nlos_cam.doctor.facts import Facts

MACOS_WHEEL = "pyrealsense2-macosx==2.54.2"
FROM_SOURCE = "build librealsense 2.54.2 from source with -DBUILD_PYTHON_BINDINGS=ON"
NEWEST_PYTHON = {"linux x86_64": (3, 11), "windows amd64": (3, 11), "darwin": (3, 12)}
"""The last Python that a wheel with the L515's driver exists for; macOS has a community's."""
TESTED = (2, 54, 2)
REMOVED = (2, 55)
"""librealsense from here on does not know the L515, and says nothing of it."""
SYSTEM_LIBRARIES = {"libusb-1.0": "libusb-1.0-0", "libudev": "libudev1", "libstdc++": "libstdc++6"}
"""Shared libraries that the Linux wheel asks for, and the Debian packages that bring them."""
VC_RUNTIME = "install Microsoft's Visual C++ runtime: https://aka.ms/vs/17/release/vc_redist.x64.exe"


def _wheel(on: str) -> str:
    return MACOS_WHEEL if on == "darwin" else WHEEL


def numbers(version: str) -> tuple[int, ...]:
    """A version as numbers: 01.05.08.01 is (1, 5, 8, 1)."""
    return tuple(int(part) for part in re.findall(r"\d+", version))


def python(facts: Facts) -> Finding:
    """Whether librealsense has a wheel for this Python on this system."""
    on = facts.host.platform
    here = f"Python {on.python[0]}.{on.python[1]} on {on.system} {on.machine}"
    if not facts.sdk.load_error:
        return ok(f"{here}: librealsense runs here")
    if on.is_musl:
        return failed(
            f"{here} with musl: librealsense's wheels are for glibc", "use a system with glibc (Debian, Ubuntu, Fedora)"
        )
    newest = NEWEST_PYTHON.get(f"{on.system} {on.machine}") or NEWEST_PYTHON.get(on.system)
    if newest is None:
        return failed(f"{here}: there is no wheel of librealsense 2.54.2 for it", FROM_SOURCE)
    if on.python > newest:
        last = f"{newest[0]}.{newest[1]}"
        return failed(
            f"{here}: the last librealsense that knows the L515 has wheels up to Python {last}",
            f"use Python {last} (`python{last} -m venv .venv`), or {FROM_SOURCE}",
        )
    return ok(f"{here}: a wheel of librealsense exists")


def system(facts: Facts) -> Finding:
    """Whether a camera can be used on this operating system."""
    if facts.host.platform.system == "darwin":
        return _macos(facts)
    if facts.host.is_wsl:
        return _wsl(facts)
    return ok(f"a camera can be used on {facts.host.platform.system}")


def _macos(facts: Facts) -> Finding:
    tell = warning if facts.sdk.lidars else failed
    return tell(
        "macOS: simulation and recordings only; since macOS 12 librealsense reaches a camera as root at most, and "
        "often not even then",
        "use the camera on Linux or Windows; to try it here all the same: "
        f"`pip install {MACOS_WHEEL}`, and run with sudo",
    )


def _wsl(facts: Facts) -> Finding:
    tell = warning if facts.pairs else failed
    return tell(
        "WSL: a virtual machine that sees only the USB devices handed to it, with a kernel that may lack uvcvideo and "
        "the HID sensors",
        "run nlos-cam on Windows itself; or, in PowerShell as administrator: `usbipd list`, "
        "`usbipd bind --busid B`, `usbipd attach --wsl --busid B` with the camera's B from the list",
    )


def sdk(facts: Facts) -> Finding:
    """Whether librealsense can be loaded and asked."""
    if error := facts.sdk.load_error:
        return failed(error, _load_fix(error, facts.host.platform.system))
    if error := facts.sdk.query_error:
        return failed(f"librealsense is there, but cannot list devices: {error}", _query_fix(error))
    return ok(f"librealsense {facts.sdk.version or 'of unknown version'} is loaded")


def _load_fix(error: str, on: str) -> str:
    """What to install, by what the loader missed."""
    if "DLL" in error:
        return VC_RUNTIME
    if "GLIBC" in error:
        return (
            "the system's C library is too old for the wheel: use a newer release of the system (glibc 2.17 or later)"
        )
    for library, package in SYSTEM_LIBRARIES.items():
        if library in error:
            return f"sudo apt install {package}" + (", or `pip install libusb-package`" if "usb" in library else "")
    return f"pip install {_wheel(on)} libusb-package"


def _query_fix(error: str) -> str:
    if "attribute" in error:  # a folder or file called pyrealsense2 stands before the wheel
        return f"remove any folder or file of your own called pyrealsense2; `pip install --force-reinstall {WHEEL}`"
    return "unplug the camera, wait 5 s, plug it in again; close realsense-viewer and whatever else uses it"


def sdk_version(facts: Facts) -> Finding:
    """Whether this librealsense still has the L515's driver: it was removed in 2.55, without a word."""
    if not facts.sdk.packages:
        return skipped("no package of librealsense is installed that would tell its version")
    newest = max(facts.sdk.packages, key=lambda package: numbers(package[1]))[1]
    fix = f"pip install {_wheel(facts.host.platform.system)}"
    if numbers(newest)[:2] >= REMOVED:
        return failed(
            f"librealsense {newest} has no driver for the L515 (the last that has is 2.54.2): it reports no device",
            fix,
        )
    if numbers(newest)[:3] != TESTED:
        return warning(f"librealsense {newest} knows the L515, but only 2.54.2 is tested", fix)
    return ok(f"librealsense {newest} knows the L515")


def sdk_alone(facts: Facts) -> Finding:
    """Whether a second librealsense overwrites the first: their packages share one folder."""
    told = ", ".join(f"{name} {version}" for name, version in facts.sdk.packages)
    if len(facts.sdk.packages) > 1:
        names = " ".join(name for name, _ in facts.sdk.packages)
        return failed(
            f"{told} are installed into one folder, and overwrite each other",
            f"pip uninstall -y {names} && pip install {_wheel(facts.host.platform.system)}",
        )
    return ok(f"only {told}") if told else skipped("no package of librealsense is installed")


def libusb(facts: Facts) -> Finding:
    """Whether the devices on USB can be listed without librealsense."""
    if facts.usb.error:
        return failed(
            f"USB cannot be looked at: {facts.usb.error}",
            "pip install pyusb libusb-package"
            + (", or `sudo apt install libusb-1.0-0`" if facts.host.platform.system == "linux" else ""),
        )
    return ok(f"{facts.usb.total} USB devices are listed")
