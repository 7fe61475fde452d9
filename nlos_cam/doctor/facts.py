"""Facts for a diagnosis: the host, cameras seen by USB and by librealsense, and their pairing;
findings of checks.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import Any, Literal

from nlos_cam.camera import DeviceInfo, connected, load_sdk, sdk_serial, shared_context
from nlos_cam.doctor.host import Host, read_host
from nlos_cam.doctor.usb import UsbDevice, UsbScan, scan_usb
from nlos_cam.errors import CameraError

PLATFORM_CAMERA = "Platform Camera"
"""The SDK's name on Windows of any camera that it has no driver for: a webcam, or since 2.55 an
L515.
"""
LIDAR_NAMES = ("L515", "L500")
"""The SDK's names of this family; in recovery mode a camera is called L51X."""


@dataclass(frozen=True)
class Sdk:
    """librealsense: its packages, errors, and the devices it lists."""

    packages: tuple[tuple[str, str], ...] = ()
    """Installed distributions of it: name and version."""
    load_error: str = ""
    """Why it cannot be loaded; empty otherwise."""
    query_error: str = ""
    """Why it cannot list devices; empty otherwise."""
    devices: tuple[DeviceInfo, ...] = ()

    @property
    def error(self) -> str:
        """Error of loading or of listing devices; empty without one."""
        return self.load_error or self.query_error

    @property
    def version(self) -> str:
        """Version of the only installed package; empty with none or several."""
        return self.packages[0][1] if len(self.packages) == 1 else ""

    @property
    def lidars(self) -> list[DeviceInfo]:
        """Cameras of the L515's family."""
        return [info for info in self.devices if any(name in info.name for name in LIDAR_NAMES)]

    @property
    def has_platform_camera(self) -> bool:
        """Return whether it lists a camera that it has no driver for, as it does on Windows."""
        return any(info.name == PLATFORM_CAMERA for info in self.devices)


@dataclass(frozen=True)
class Pair:
    """Camera of the L515's family as listed by USB and by the SDK; None where one of them does not
    list it.
    """

    usb: UsbDevice | None
    sdk: DeviceInfo | None

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.usb.label if self.usb else f"{self.name} {self.serial}".strip()

    @property
    def name(self) -> str:
        """Product name by the SDK, or else by its USB id."""
        if self.sdk:
            return self.sdk.name
        return self.usb.meaning if self.usb else ""

    @property
    def serial(self) -> str:
        """Serial number as the SDK writes it; empty if unknown."""
        if self.sdk:
            return self.sdk.serial
        return self.usb.serial if self.usb else ""

    @property
    def firmware(self) -> str:
        """Firmware: four numbers from the SDK, or three of them from USB."""
        if self.sdk and self.sdk.firmware:
            return self.sdk.firmware
        return self.usb.firmware if self.usb else ""

    @property
    def link(self) -> str:
        """Speed of the link, or version of USB."""
        if self.usb:
            return self.usb.link
        return f"USB {self.sdk.usb_type}" if self.sdk else ""

    @property
    def is_slow(self) -> bool:
        """True for a link of USB 2 or less."""
        if self.usb:
            return self.usb.is_slow
        return self.sdk is not None and self.sdk.usb_type.startswith("2")


@dataclass(frozen=True)
class Watched:
    """Frames of a camera over some seconds."""

    camera: str
    frames: int
    seconds: float
    is_frozen: bool = False
    """True if it sent the same frame again and again."""
    frames_expected: float = 0.0
    """Frames that a sound camera sends in the time for which it was watched."""
    error: str = ""
    """Why it could not be watched; empty otherwise."""


@dataclass(frozen=True)
class Facts:
    """Facts of one moment: host, USB and SDK."""

    host: Host
    usb: UsbScan
    sdk: Sdk
    reported: str = ""
    """Message that another program showed, as the user gives it."""
    watched: Watched | None = None
    """Frames of the camera that the user named."""

    @property
    def pairs(self) -> list[Pair]:
        """Every camera of the family that USB or the SDK lists, without those in recovery mode."""
        return match_devices(self.usb.of_kind("camera"), self.sdk.lidars)


def gather_facts(reported: str = "") -> Facts:
    """Return the facts of this machine, and the message given; never raises."""
    host = read_host()
    usb = scan_usb()
    # The SDK last: it opens device nodes of its own, which the host's check would find held.
    return Facts(host, usb, query_sdk(), reported)


def query_sdk(
    load: Callable[[], Any] = load_sdk,
    installed: Callable[[], Iterable[Any]] = metadata.distributions,
) -> Sdk:
    """Load librealsense and list its devices; never raises."""
    names = {(str(one.name), str(one.version)) for one in installed()}
    packages = tuple(sorted(pair for pair in names if pair[0].lower().startswith("pyrealsense2")))
    try:
        sdk = load()
    except CameraError as error:
        # The cause alone: the check adds the fix.
        return Sdk(packages, load_error=str(error.__cause__ or error))
    try:
        found = connected(sdk, shared_context(sdk))
    except (CameraError, RuntimeError, AttributeError) as error:
        # AttributeError: a folder called pyrealsense2 shadows the wheel.
        return Sdk(packages, query_error=str(error))
    return Sdk(packages, devices=tuple(info for _, info in found))


def match_devices(usb: Sequence[UsbDevice], sdk: Sequence[DeviceInfo]) -> list[Pair]:
    """Pair cameras by serial number; those without one in order, if as many are left over on both
    sides.
    """
    known = {device.serial: device for device in usb if device.serial}
    listed = {sdk_serial(info.serial): info for info in sdk}
    matched = [Pair(device, listed.get(serial)) for serial, device in known.items()]
    nameless = [device for device in usb if not device.serial]
    unmatched = [info for serial, info in listed.items() if serial not in known]
    if len(nameless) == len(unmatched):
        return matched + list(map(Pair, nameless, unmatched))
    usb_only = [Pair(device, None) for device in nameless]
    sdk_only = [Pair(None, info) for info in unmatched]
    return matched + usb_only + sdk_only


Status = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True)
class Finding:
    """Outcome of one check; a warning or a failure always has a fix."""

    status: Status
    detail: str
    fix: str = ""


@dataclass(frozen=True)
class Check:
    """Finding with the name of its check; names and fields are fixed: scripts depend on them."""

    name: str
    status: Status
    detail: str
    fix: str


ok = partial(Finding, "ok")
skipped = partial(Finding, "skipped")
warning = partial(Finding, "warning")
failed = partial(Finding, "failed")
"""A camera works with what a warning names, and not with what has failed."""
