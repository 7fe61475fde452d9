"""Facts about this host: USB product ids, cameras the kernel has enumerated, modules, udev rules,
device nodes.
"""

import os
import platform
import sys
import sysconfig
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

INTEL = 0x8086
Kind = Literal["camera", "recovery", "other"]
L515 = 0x0B64
LIDARS: dict[int, tuple[Kind, str]] = {
    L515: ("camera", "L515"),
    0x0B3D: ("camera", "L515 (pre-production)"),
    0x0B0D: ("camera", "L500"),
    0x0B55: ("recovery", "L515 in recovery mode"),
    0x0ADC: ("recovery", "RealSense in recovery mode on USB 2 (an early L515, or a D400)"),
}
"""The L515's family by product id: kind and name."""
OTHERS = {
    0x0AA5: "SR300",
    0x0AD1: "D400",
    0x0AD2: "D410",
    0x0AD3: "D415",
    0x0AD4: "D430",
    0x0ADB: "D400 in recovery mode",
    0x0B07: "D435",
    0x0B3A: "D435i",
    0x0B48: "SR305",
    0x0B4B: "D430i",
    0x0B5B: "D405",
    0x0B5C: "D455",
}
"""Names of other common RealSense cameras by product id."""


@dataclass(frozen=True)
class KernelCamera:
    """Camera of the L515's family as the kernel has enumerated it; nodes are paths on the running
    system.
    """

    port: str
    product_id: int
    serial: str
    usb_node: str
    video_nodes: tuple[str, ...]
    """Nodes of the driver uvcvideo."""
    hid_devices: tuple[str, ...]
    """Each with its driver."""
    hid_sensors: tuple[str, ...]
    """Names of its industrial-I/O devices: the SDK requires them to list an L515."""

    @property
    def nodes(self) -> tuple[str, ...]:
        """Every node that has to be opened to stream."""
        return (self.usb_node, *self.video_nodes)


@dataclass(frozen=True)
class Holder:
    """Process that has a device node open."""

    pid: int
    name: str
    node: str


def read_text(path: Path) -> str:
    """Return a small file's content, stripped; empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except (OSError, ValueError):
        return ""


def list_folder(folder: Path) -> list[Path]:
    """Return a folder's entries in order; none if it cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except (OSError, ValueError):
        return []


def path_exists(path: Path) -> bool:
    """Return True for a file or folder that exists and may be accessed."""
    try:
        return path.exists()
    except OSError:
        return False


def kernel_cameras(root: Path = Path("/")) -> tuple[KernelCamera, ...]:
    """Return the cameras of the family that the kernel has enumerated; `root` holds `sys`."""
    intel = [
        one for one in list_folder(root / "sys/bus/usb/devices") if _hex(one / "idVendor") == INTEL
    ]
    return tuple(
        _camera(root / "sys", device) for device in intel if _hex(device / "idProduct") in LIDARS
    )


def _hex(path: Path) -> int:
    try:
        return int(read_text(path), 16)
    except ValueError:
        return 0


def _camera(sys: Path, device: Path) -> KernelCamera:
    bus, address = (read_text(device / name).zfill(3) for name in ("busnum", "devnum"))
    return KernelCamera(
        port=device.name,
        product_id=_hex(device / "idProduct"),
        serial=read_text(device / "serial"),
        usb_node=f"/dev/bus/usb/{bus}/{address}",
        video_nodes=tuple(
            f"/dev/{found.name}" for found in _below(device, sys / "class/video4linux")
        ),
        hid_devices=tuple(
            f"{found.name} ({_driver(found)})" for found in _below(device, sys / "bus/hid/devices")
        ),
        hid_sensors=tuple(
            read_text(found / "name") or found.name
            for found in _below(device, sys / "bus/iio/devices")
        ),
    )


def _below(device: Path, folder: Path) -> list[Path]:
    whole = os.path.realpath(device) + os.sep
    return [found for found in list_folder(folder) if os.path.realpath(found).startswith(whole)]


def _driver(device: Path) -> str:
    driver = device / "driver"
    return Path(os.path.realpath(driver)).name if path_exists(driver) else "no driver"


def find_holders(nodes: Collection[str], root: Path = Path("/")) -> tuple[list[Holder], int]:
    """Return other processes that have one of the nodes open, and the number of processes that deny
    access.
    """
    found: set[Holder] = set()
    closed = 0
    for process in list_folder(root / "proc"):
        if not process.name.isdecimal() or int(process.name) == os.getpid():
            continue
        try:
            targets = {_target(link) for link in (process / "fd").iterdir()}
        except FileNotFoundError:  # the process has ended
            continue
        except OSError:
            closed += 1
            continue
        found |= {
            Holder(int(process.name), read_text(process / "comm"), node)
            for node in targets & set(nodes)
        }
    return sorted(found, key=lambda one: (one.pid, one.node)), closed


def _target(link: Path) -> str:
    with suppress(OSError):  # closed since it was listed
        return str(link.readlink())
    return ""


MODULES = ("uvcvideo", "hid_sensor_hub", "hid_sensor_accel_3d", "hid_sensor_gyro_3d")
"""Kernel modules that librealsense's Linux wheel needs for an L515."""
RULE_FOLDERS = ("etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d")
CONTAINERS = {
    "docker": "docker",
    "kubepods": "kubernetes",
    "libpod": "podman",
    "containerd": "containerd",
    "lxc": "lxc",
}
"""Container type by a word in the control groups of its first process."""


@dataclass(frozen=True)
class Platform:
    """Python interpreter and operating system."""

    system: str
    """linux, darwin or windows."""
    machine: str
    """In lower case: x86_64, aarch64, amd64, arm64."""
    python: tuple[int, int]
    is_musl: bool = False
    is_root: bool = False
    in_plugdev: bool = False


@dataclass(frozen=True)
class Node:
    """Device file of a camera, and the error of opening it; empty without one."""

    path: str
    error: str = ""


@dataclass(frozen=True)
class Host:
    """Facts about this host; all but `platform` are empty on systems other than Linux."""

    platform: Platform
    container: str = ""
    """Type of the container; empty outside one."""
    is_wsl: bool = False
    modules: Mapping[str, str] = field(default_factory=dict[str, str])
    """Each of MODULES: loaded, built in, available or missing; unknown without the kernel's
    lists.
    """
    has_iio: bool = False
    patched_uvc: bool = False
    """True for librealsense's uvcvideo, which passes on the frames' metadata."""
    cameras: tuple[KernelCamera, ...] = ()
    rules: tuple[str, ...] = ()
    """Files of udev rules that name the L515."""
    nodes: tuple[Node, ...] = ()
    holders: tuple[Holder, ...] = ()
    closed_processes: int = 0
    """Number of processes whose open files this user may not read."""
    is_jetson: bool = False


def this_platform() -> Platform:
    """Return the platform of this process."""
    return Platform(
        system=platform.system().lower(),
        machine=platform.machine().lower(),
        python=sys.version_info[:2],
        is_musl="musl" in str(sysconfig.get_config_var("SOABI")),
        is_root=hasattr(os, "geteuid") and os.geteuid() == 0,
        in_plugdev=_in_plugdev(),
    )


def _in_plugdev() -> bool:
    try:
        import grp

        return grp.getgrnam("plugdev").gr_gid in os.getgroups()
    except (ImportError, KeyError, OSError):  # Windows, or no such group
        return False


def open_node(path: str) -> None:
    """Open a device for reading and writing, as the SDK would, and close it again. Raises
    OSError.
    """
    os.close(os.open(path, os.O_RDWR | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)))


def read_host(
    root: Path = Path("/"), on: Platform | None = None, opening: Callable[[str], None] = open_node
) -> Host:
    """Return the facts about this host; never raises. `root` holds the system's `sys`, `proc`,
    `etc`, ...
    """
    on = on or this_platform()
    if on.system != "linux":
        return Host(on)
    cameras = kernel_cameras(root)
    nodes = [node for camera in cameras for node in camera.nodes]
    holding, closed = find_holders(nodes, root) if nodes else ([], 0)
    return Host(
        platform=on,
        container=_container(root),
        is_wsl="microsoft" in read_text(root / "proc/version").lower(),
        is_jetson=path_exists(root / "etc/nv_tegra_release")
        or "jetson" in read_text(root / "proc/device-tree/model").lower(),
        modules=_modules(root),
        has_iio=path_exists(root / "sys/bus/iio"),
        patched_uvc="realsense" in read_text(root / "sys/module/uvcvideo/version"),
        cameras=cameras,
        rules=_rules(root),
        nodes=tuple(_node(path, opening) for path in nodes),
        holders=tuple(holding),
        closed_processes=closed,
    )


def _container(root: Path) -> str:
    if path_exists(root / ".dockerenv"):
        return "docker"
    if path_exists(root / "run/.containerenv"):
        return "podman"
    for entry in read_text(root / "proc/1/environ").split("\0"):
        name, _, value = entry.partition("=")
        if name == "container" and value:
            return value
    if named := read_text(root / "run/systemd/container"):
        return named
    groups = read_text(root / "proc/1/cgroup")
    return next((name for word, name in CONTAINERS.items() if word in groups), "")


def _modules(root: Path) -> dict[str, str]:
    loaded = {line.split(" ")[0] for line in read_text(root / "proc/modules").splitlines()}
    folder = root / "lib/modules" / (read_text(root / "proc/sys/kernel/osrelease") or "unknown")
    lists = {
        "built in": read_text(folder / "modules.builtin"),
        "available": read_text(folder / "modules.dep"),
    }
    return {name: _state(name, loaded, lists, root / "sys/module" / name) for name in MODULES}


def _state(name: str, loaded: set[str], lists: Mapping[str, str], shown: Path) -> str:
    """Return a module's state. Its file may have hyphens for underscores in its name, and be
    compressed.
    """
    if name in loaded or path_exists(shown):
        return "loaded"
    files = (f"/{name}.ko", f"/{name.replace('_', '-')}.ko")
    for state, listed in lists.items():
        if any(file in listed for file in files):
            return state
    return "missing" if any(lists.values()) else "unknown"


def _rules(root: Path) -> tuple[str, ...]:
    files = {
        os.path.realpath(file): file
        for folder in RULE_FOLDERS
        for file in list_folder(root / folder)
        if file.suffix == ".rules" and "0b64" in read_text(file).lower()
    }
    return tuple(f"/{file.relative_to(root)}" for file in files.values())


def _node(path: str, opening: Callable[[str], None]) -> Node:
    try:
        opening(path)
    except OSError as error:
        return Node(path, error.strerror or str(error))
    return Node(path)
