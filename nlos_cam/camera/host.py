"""What this host is to a camera: system, container, kernel modules, udev rules, and nodes that open or do not."""

import os
import platform
import sys
import sysconfig
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from nlos_cam.camera.sysfs import Holder, KernelCamera, entries, holders, is_there, kernel_cameras, text

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
"""Words in the control groups of a container's first process, and what they tell."""


@dataclass(frozen=True)
class Platform:
    """The interpreter and the system that it runs on."""

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
    """A device file that a camera needs, and why it does not open; empty if it does."""

    path: str
    error: str = ""


@dataclass(frozen=True)
class Host:
    """The facts; everything but `platform` is empty where the system is not Linux."""

    platform: Platform
    container: str = ""
    """What kind of container this is; empty outside one."""
    is_wsl: bool = False
    modules: Mapping[str, str] = field(default_factory=dict[str, str])
    """Each of MODULES: loaded, built in, available, or missing; unknown where the kernel's list is not to be seen."""
    has_iio: bool = False
    patched_uvc: bool = False
    """Whether uvcvideo is librealsense's, which passes on the frames' metadata."""
    cameras: tuple[KernelCamera, ...] = ()
    rules: tuple[str, ...] = ()
    """Files of udev rules that speak of the L515."""
    nodes: tuple[Node, ...] = ()
    holders: tuple[Holder, ...] = ()
    closed_processes: int = 0
    """Processes of others, whose open files are not shown to this user."""


def this_platform() -> Platform:
    """The platform of this process."""
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
    """Open a device for reading and writing, as the SDK would, and close it again. Raises OSError."""
    os.close(os.open(path, os.O_RDWR | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)))


def read_host(root: Path = Path("/"), on: Platform | None = None, opening: Callable[[str], None] = open_node) -> Host:
    """Look around; never raises. `root` holds the system's `sys`, `proc`, `etc`, ..."""
    on = on or this_platform()
    if on.system != "linux":
        return Host(on)
    cameras = kernel_cameras(root)
    nodes = [node for camera in cameras for node in camera.nodes]
    holding, closed = holders(nodes, root) if nodes else ([], 0)
    return Host(
        platform=on,
        container=_container(root),
        is_wsl="microsoft" in text(root / "proc/version").lower(),
        modules=_modules(root),
        has_iio=is_there(root / "sys/bus/iio"),
        patched_uvc="realsense" in text(root / "sys/module/uvcvideo/version"),
        cameras=cameras,
        rules=_rules(root),
        nodes=tuple(_node(path, opening) for path in nodes),
        holders=tuple(holding),
        closed_processes=closed,
    )


def _container(root: Path) -> str:
    if is_there(root / ".dockerenv"):
        return "docker"
    if is_there(root / "run/.containerenv"):
        return "podman"
    environment = text(root / "proc/1/environ").split("\0")
    named = [value for name, _, value in (entry.partition("=") for entry in environment) if name == "container"]
    groups = text(root / "proc/1/cgroup")
    named += [text(root / "run/systemd/container"), *(name for word, name in CONTAINERS.items() if word in groups)]
    return next((name for name in named if name), "")


def _modules(root: Path) -> dict[str, str]:
    loaded = {line.split(" ")[0] for line in text(root / "proc/modules").splitlines()}
    folder = root / "lib/modules" / (text(root / "proc/sys/kernel/osrelease") or "unknown")
    lists = {"built in": text(folder / "modules.builtin"), "available": text(folder / "modules.dep")}
    return {name: _state(name, loaded, lists, root / "sys/module" / name) for name in MODULES}


def _state(name: str, loaded: set[str], lists: Mapping[str, str], shown: Path) -> str:
    """A module's file may be spelled with hyphens where its name has underscores, and be compressed."""
    if name in loaded or is_there(shown):
        return "loaded"
    files = (f"/{name}.ko", f"/{name.replace('_', '-')}.ko")
    told = next((state for state, listed in lists.items() if any(file in listed for file in files)), "")
    return told or ("missing" if any(lists.values()) else "unknown")


def _rules(root: Path) -> tuple[str, ...]:
    files = {
        os.path.realpath(file): file
        for folder in RULE_FOLDERS
        for file in entries(root / folder)
        if file.suffix == ".rules" and "0b64" in text(file).lower()
    }
    return tuple(f"/{file.relative_to(root)}" for file in files.values())


def _node(path: str, opening: Callable[[str], None]) -> Node:
    try:
        opening(path)
    except OSError as error:
        return Node(path, error.strerror or str(error))
    return Node(path)
