import errno
import os
import platform
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nlos_cam.doctor.host import MODULES, Host, Platform, open_node, read_host, this_platform

LINUX = Platform("linux", "x86_64", (3, 11))
READ = (".dockerenv", "proc/modules", "proc/1/cgroup", "proc/1/environ", "proc/version", "proc/sys/kernel/osrelease")
ODD = (*READ, "sys/bus/usb/devices/2-1", "sys/bus/usb/devices/2-1/idVendor", "proc/77/fd", "etc/udev/rules.d/a.rules")


def look(root: Path) -> Host:
    return read_host(root, LINUX, lambda _: None)


def test_this_platform_is_the_one_that_python_runs_on() -> None:
    found = this_platform()
    assert found.python == sys.version_info[:2]
    assert (found.system, found.machine) == (platform.system().lower(), platform.machine().lower())
    assert found.is_root == (os.geteuid() == 0)
    assert found.is_musl == (platform.libc_ver()[0] == "")


def test_this_host_can_be_looked_at() -> None:
    assert set(read_host().modules) == set(MODULES)


def test_a_host_that_is_not_linux_is_not_searched(tmp_path: Path) -> None:
    (tmp_path / ".dockerenv").touch()
    on = Platform("darwin", "arm64", (3, 11))
    assert read_host(tmp_path, on) == Host(on)


@pytest.mark.parametrize(
    ("path", "content", "kind"),
    [
        (".dockerenv", "", "docker"),
        ("run/.containerenv", "", "podman"),
        ("run/systemd/container", "systemd-nspawn", "systemd-nspawn"),
        ("proc/1/environ", "PATH=/bin\0container=lxc\0", "lxc"),
        ("proc/1/cgroup", "0::/kubepods.slice/pod7", "kubernetes"),
        ("proc/1/cgroup", "0::/init.scope", ""),
        ("proc/1/environ", "PATH=/container\0", ""),
    ],
)
def test_a_container_is_told_by_what_it_leaves(bench: Any, tmp_path: Path, path: str, content: str, kind: str) -> None:
    bench.linux.write(path, content)
    assert look(tmp_path).container == kind


def test_wsl_is_told_by_its_kernel(bench: Any, tmp_path: Path) -> None:
    assert not look(tmp_path).is_wsl
    bench.linux.write("proc/version", "Linux version 5.15.167.4-microsoft-standard-WSL2 (gcc)")
    assert look(tmp_path).is_wsl


def test_a_module_is_loaded_built_in_available_or_missing(bench: Any, tmp_path: Path) -> None:
    bench.linux.load("uvcvideo")
    bench.linux.write("lib/modules/6.8.0/modules.builtin", "kernel/drivers/hid/hid-sensor-hub.ko\n")
    bench.linux.write("lib/modules/6.8.0/modules.dep", "kernel/drivers/iio/hid-sensor-accel-3d.ko.xz: a.ko\n")
    assert list(look(tmp_path).modules.values()) == ["loaded", "built in", "available", "missing"]


def test_a_module_that_shows_itself_is_loaded(bench: Any, tmp_path: Path) -> None:
    bench.linux.load()
    bench.linux.write("sys/module/hid_sensor_hub/uevent", "")
    assert look(tmp_path).modules["hid_sensor_hub"] == "loaded"


def test_a_kernel_whose_modules_are_not_to_be_seen_is_not_judged(tmp_path: Path) -> None:
    assert set(look(tmp_path).modules.values()) == {"unknown"}


def test_librealsenses_driver_is_told_by_its_version(bench: Any, tmp_path: Path) -> None:
    bench.linux.write("sys/module/uvcvideo/version", "1.1.1")
    assert not look(tmp_path).patched_uvc
    bench.linux.write("sys/module/uvcvideo/version", "1.1.1.realsense-6.1")
    assert look(tmp_path).patched_uvc


@pytest.mark.parametrize("folder", ["etc", "run", "usr/lib", "lib"])
def test_rules_are_found_wherever_udev_looks(bench: Any, tmp_path: Path, folder: str) -> None:
    (tmp_path / "etc/udev/rules.d/99-l515.rules").unlink()
    bench.linux.write("etc/udev/rules.d/10-other.rules", 'ATTRS{idProduct}=="0b07"')
    bench.linux.write("etc/udev/rules.d/readme.txt", "0b64")
    assert look(tmp_path).rules == ()
    bench.linux.rules(f"{folder}/udev/rules.d/60-cameras.rules")
    assert look(tmp_path).rules == (f"/{folder}/udev/rules.d/60-cameras.rules",)


def test_one_file_behind_two_folders_is_told_once(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "etc/udev/rules.d/99-l515.rules").unlink()
    bench.linux.rules("usr/lib/udev/rules.d/60-cameras.rules")
    bench.linux.link("lib/udev", tmp_path / "usr/lib/udev")
    assert len(look(tmp_path).rules) == 1


def test_processes_are_searched_only_for_a_camera(bench: Any, tmp_path: Path) -> None:
    bench.linux.write("proc/43/fd", "stands for a folder that may not be listed")
    assert look(tmp_path).closed_processes == 1
    bench.unplug()
    assert look(tmp_path).closed_processes == 0


def test_every_node_is_opened_and_refusals_are_kept(bench: Any) -> None:
    bench.refused = {
        "/dev/video30": PermissionError(errno.EACCES, "Permission denied"),
        "/dev/video31": FileNotFoundError(errno.ENOENT, "No such file"),
    }
    nodes = {node.path: node for node in bench.facts().host.nodes}
    assert list(nodes) == ["/dev/bus/usb/002/003", "/dev/video30", "/dev/video31"]
    assert [node.error for node in nodes.values()] == ["", "Permission denied", "No such file"]


def test_a_node_is_really_opened(tmp_path: Path) -> None:
    (tmp_path / "node").touch()
    before = set(Path("/proc/self/fd").iterdir())
    open_node(str(tmp_path / "node"))
    assert set(Path("/proc/self/fd").iterdir()) == before
    with pytest.raises(IsADirectoryError):
        open_node(str(tmp_path))
    with pytest.raises(FileNotFoundError):
        open_node(str(tmp_path / "absent"))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(odd=st.dictionaries(st.sampled_from(ODD), st.binary(max_size=40) | st.none()))
def test_no_host_is_too_odd(tmp_path_factory: pytest.TempPathFactory, odd: dict[str, bytes | None]) -> None:
    root = tmp_path_factory.mktemp("odd")
    for path, content in odd.items():
        if any(parent.is_file() for parent in (root / path).parents) or (root / path).exists():
            continue
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).mkdir() if content is None else (root / path).write_bytes(content)
    assert look(root).platform == LINUX
