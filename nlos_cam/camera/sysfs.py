"""What Linux's kernel shows of a plugged-in L515 in its file systems, and who has it open."""

import os
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from nlos_cam.camera.usb_ids import INTEL, LIDARS


@dataclass(frozen=True)
class KernelCamera:
    """A camera of the L515's family, as the kernel sees it: the path of a node is that on the running system."""

    port: str
    product_id: int
    serial: str
    usb_node: str
    video_nodes: tuple[str, ...]
    """Of the driver uvcvideo."""
    hid_devices: tuple[str, ...]
    """Each with the driver that has it."""
    hid_sensors: tuple[str, ...]
    """Names of its industrial-I/O devices: what the SDK counts before it believes in an L515."""

    @property
    def nodes(self) -> tuple[str, ...]:
        """Everything that has to be opened to stream."""
        return (self.usb_node, *self.video_nodes)


@dataclass(frozen=True)
class Holder:
    """A process that has a node open."""

    pid: int
    name: str
    node: str


def text(path: Path) -> str:
    """A small file's content; empty where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except (OSError, ValueError):
        return ""


def entries(folder: Path) -> list[Path]:
    """What a folder holds, in order; nothing where it cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except (OSError, ValueError):
        return []


def is_there(path: Path) -> bool:
    """Whether there is such a file or folder, as far as we may know."""
    try:
        return path.exists()
    except OSError:
        return False


def kernel_cameras(root: Path = Path("/")) -> tuple[KernelCamera, ...]:
    """Every camera of the family that the kernel has enumerated; `root` holds `sys`."""
    devices = entries(root / "sys/bus/usb/devices")
    return tuple(_camera(root / "sys", device) for device in devices if _is_lidar(device))


def _is_lidar(device: Path) -> bool:
    return _hex(device / "idVendor") == INTEL and _hex(device / "idProduct") in LIDARS


def _hex(path: Path) -> int:
    try:
        return int(text(path), 16)
    except ValueError:
        return 0


def _camera(sys: Path, device: Path) -> KernelCamera:
    bus, address = (text(device / name).zfill(3) for name in ("busnum", "devnum"))
    return KernelCamera(
        port=device.name,
        product_id=_hex(device / "idProduct"),
        serial=text(device / "serial"),
        usb_node=f"/dev/bus/usb/{bus}/{address}",
        video_nodes=tuple(f"/dev/{found.name}" for found in _below(device, sys / "class/video4linux")),
        hid_devices=tuple(f"{found.name} ({_driver(found)})" for found in _below(device, sys / "bus/hid/devices")),
        hid_sensors=tuple(text(found / "name") or found.name for found in _below(device, sys / "bus/iio/devices")),
    )


def _below(device: Path, folder: Path) -> list[Path]:
    """Those links of a folder that lead to something that is part of the device."""
    whole = os.path.realpath(device) + os.sep
    return [found for found in entries(folder) if os.path.realpath(found).startswith(whole)]


def _driver(device: Path) -> str:
    driver = device / "driver"
    return Path(os.path.realpath(driver)).name if is_there(driver) else "no driver"


def holders(nodes: Collection[str], root: Path = Path("/")) -> tuple[list[Holder], int]:
    """Other processes that have one of the nodes open, and how many processes would not be looked into."""
    found: set[Holder] = set()
    closed = 0
    for process in entries(root / "proc"):
        if not process.name.isdecimal() or int(process.name) == os.getpid():
            continue
        try:
            targets = {_target(link) for link in (process / "fd").iterdir()}
        except FileNotFoundError:  # it has ended meanwhile
            continue
        except OSError:
            closed += 1
            continue
        found |= {Holder(int(process.name), text(process / "comm"), node) for node in targets & set(nodes)}
    return sorted(found, key=lambda one: (one.pid, one.node)), closed


def _target(link: Path) -> str:
    with suppress(OSError):  # closed since it was listed
        return str(link.readlink())
    return ""
