"""What a diagnosis rests on: the host, what USB shows, what librealsense shows, and which of them are the same.

What a check finds: a status, what was seen, and what to do about it.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Literal

from nlos_cam.camera import DeviceInfo, connected, load_sdk, shared_context
from nlos_cam.doctor.host import Host, read_host
from nlos_cam.doctor.usb import UsbDevice, UsbScan, scan, sdk_serial
from nlos_cam.errors import CameraError

LIDAR_NAMES = ("L515", "L500")
"""What the SDK calls a camera of this family; in recovery mode it is an L51X."""


@dataclass(frozen=True)
class Sdk:
    """librealsense, as far as it can be had."""

    packages: tuple[tuple[str, str], ...] = ()
    """The installed distributions that bring it: name and version."""
    load_error: str = ""
    """Why it cannot be loaded; empty if it was."""
    query_error: str = ""
    """Why it cannot list devices; empty if it did."""
    devices: tuple[DeviceInfo, ...] = ()

    @property
    def error(self) -> str:
        """Why it cannot be asked for its devices; empty if it was."""
        return self.load_error or self.query_error

    @property
    def version(self) -> str:
        """Of the only one that is installed; empty where that is not known."""
        return self.packages[0][1] if len(self.packages) == 1 else ""

    @property
    def lidars(self) -> list[DeviceInfo]:
        """The cameras of the L515's family that it sees."""
        return [info for info in self.devices if any(name in info.name for name in LIDAR_NAMES)]


@dataclass(frozen=True)
class Pair:
    """One camera of the L515's family, as USB and as the SDK see it; None where one does not."""

    usb: UsbDevice | None
    sdk: DeviceInfo | None

    @property
    def label(self) -> str:
        """What to call it in a sentence."""
        return self.usb.label if self.usb else f"{self.name} {self.serial}".strip()

    @property
    def name(self) -> str:
        """The SDK's, or what its id on USB stands for."""
        return self.sdk.name if self.sdk else self.usb.meaning if self.usb else ""

    @property
    def serial(self) -> str:
        """As the SDK writes it; empty where it was not to be had."""
        return self.sdk.serial if self.sdk else self.usb.serial if self.usb else ""

    @property
    def firmware(self) -> str:
        """Four numbers from the SDK, or three of them from USB."""
        return (self.sdk and self.sdk.firmware) or (self.usb.firmware if self.usb else "")

    @property
    def link(self) -> str:
        """The speed of the link in words, or the version of USB."""
        return self.usb.link if self.usb else f"USB {self.sdk.usb_type}" if self.sdk else ""

    @property
    def is_slow(self) -> bool:
        """Whether the link is USB 2 or less."""
        return self.usb.is_slow if self.usb else bool(self.sdk and self.sdk.usb_type.startswith("2"))


@dataclass(frozen=True)
class Facts:
    """The three views of one moment."""

    host: Host
    usb: UsbScan
    sdk: Sdk

    @property
    def pairs(self) -> list[Pair]:
        """Every camera of the family that anybody sees, without those in recovery mode."""
        return pair(self.usb.of_kind("camera"), self.sdk.lidars)


def gather() -> Facts:
    """Look at this machine; never raises."""
    return Facts(read_host(), scan(), look_at_sdk())  # the SDK last: it opens nodes of its own


def look_at_sdk(
    load: Callable[[], Any] = load_sdk, installed: Callable[[], Iterable[Any]] = metadata.distributions
) -> Sdk:
    """Load librealsense and ask it for its devices; never raises."""
    names = {(str(one.name), str(one.version)) for one in installed()}
    packages = tuple(sorted(pair for pair in names if pair[0].lower().startswith("pyrealsense2")))
    try:
        sdk = load()
    except CameraError as error:
        return Sdk(packages, load_error=str(error.__cause__ or error))  # the cause alone: what to do is told beside it
    try:
        return Sdk(packages, devices=tuple(info for _, info in connected(sdk, shared_context(sdk))))
    except (CameraError, RuntimeError, AttributeError) as error:  # AttributeError: a folder of its name, not the wheel
        return Sdk(packages, query_error=str(error))


def pair(usb: Sequence[UsbDevice], sdk: Sequence[DeviceInfo]) -> list[Pair]:
    """Match by serial number, and what has none by being the only ones left over on both sides."""
    known = {device.serial: device for device in usb if device.serial}
    seen = {sdk_serial(info.serial): info for info in sdk}
    matched = [Pair(device, seen.get(serial)) for serial, device in known.items()]
    unread = [device for device in usb if not device.serial]
    strange = [info for serial, info in seen.items() if serial not in known]
    if len(unread) == len(strange):
        return matched + [Pair(device, info) for device, info in zip(unread, strange, strict=True)]
    return matched + [Pair(device, None) for device in unread] + [Pair(None, info) for info in strange]


Status = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one question; a warning or a failure always says what to do."""

    status: Status
    detail: str
    fix: str = ""


@dataclass(frozen=True)
class Check:
    """A finding under the name of its question; names and fields are fixed: scripts depend on them."""

    name: str
    status: Status
    detail: str
    fix: str


def ok(detail: str) -> Finding:
    """All is well: what was seen."""
    return Finding("ok", detail)


def skipped(reason: str) -> Finding:
    """The question does not arise here: why."""
    return Finding("skipped", reason)


def warning(detail: str, fix: str) -> Finding:
    """It works, but not as well as it could."""
    return Finding("warning", detail, fix)


def failed(detail: str, fix: str) -> Finding:
    """A camera will not work like this."""
    return Finding("failed", detail, fix)
