import errno
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nlos_cam.doctor import host

LINUX = host.Platform("linux", "x86_64", (3, 11))
READ = (".dockerenv", "proc/modules", "proc/1/cgroup", "proc/1/environ", "proc/version", "proc/sys/kernel/osrelease")
ODD = (*READ, "sys/bus/usb/devices/2-1", "sys/bus/usb/devices/2-1/idVendor", "proc/77/fd", "etc/udev/rules.d/a.rules")
HOLDS = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
UNLISTED = "proc/43/fd", "stands for a folder that may not be listed"


def look(root: Path) -> host.Host:
    return host.read_host(root, LINUX, lambda _: None)


def test_this_host_and_platform_can_be_read(tmp_path: Path) -> None:
    found = host.this_platform()
    assert found.python == sys.version_info[:2]
    assert (found.system, found.machine) == (platform.system().lower(), platform.machine().lower())
    assert found.is_root == (os.geteuid() == 0)
    assert found.is_musl == (platform.libc_ver()[0] == "")
    assert set(host.read_host().modules) == set(host.MODULES)
    (tmp_path / ".dockerenv").touch()
    mac = host.Platform("darwin", "arm64", (3, 11))
    assert host.read_host(tmp_path, mac) == host.Host(mac)  # only Linux is searched


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
def test_container_is_known_by_its_files(bench: Any, tmp_path: Path, path: str, content: str, kind: str) -> None:
    bench.linux.write(path, content)
    assert look(tmp_path).container == kind


def test_wsl_and_patched_driver_are_known_by_versions(bench: Any, tmp_path: Path) -> None:
    bench.linux.write("sys/module/uvcvideo/version", "1.1.1")
    assert (look(tmp_path).is_wsl, look(tmp_path).patched_uvc) == (False, False)
    bench.linux.write("proc/version", "Linux version 5.15.167.4-microsoft-standard-WSL2 (gcc)")
    bench.linux.write("sys/module/uvcvideo/version", "1.1.1.realsense-6.1")
    assert (look(tmp_path).is_wsl, look(tmp_path).patched_uvc) == (True, True)


def test_module_is_loaded_built_in_available_or_missing(bench: Any, tmp_path: Path) -> None:
    bench.linux.load("uvcvideo")
    bench.linux.write("lib/modules/6.8.0/modules.builtin", "kernel/drivers/hid/hid-sensor-hub.ko\n")
    bench.linux.write("lib/modules/6.8.0/modules.dep", "kernel/drivers/iio/hid-sensor-accel-3d.ko.xz: a.ko\n")
    assert list(look(tmp_path).modules.values()) == ["loaded", "built in", "available", "missing"]
    bench.linux.load()
    bench.linux.write("sys/module/hid_sensor_hub/uevent", "")
    assert look(tmp_path).modules["hid_sensor_hub"] == "loaded"
    assert set(look(tmp_path / "none").modules.values()) == {"unknown"}


@pytest.mark.parametrize("folder", ["etc", "run", "usr/lib", "lib"])
def test_rules_are_found_in_every_folder_of_udev(bench: Any, tmp_path: Path, folder: str) -> None:
    bench.remove_rules()
    bench.linux.write("etc/udev/rules.d/10-other.rules", 'ATTRS{idProduct}=="0b07"')
    bench.linux.write("etc/udev/rules.d/readme.txt", "0b64")
    assert look(tmp_path).rules == ()
    bench.linux.rules(f"{folder}/udev/rules.d/60-cameras.rules")
    if folder == "usr/lib":
        bench.linux.link("lib/udev", tmp_path / "usr/lib/udev")  # the same file once more
    found = "lib" if folder == "usr/lib" else folder
    assert look(tmp_path).rules == (f"/{found}/udev/rules.d/60-cameras.rules",)


def test_processes_are_searched_only_for_a_camera(bench: Any, tmp_path: Path) -> None:
    bench.linux.write(*UNLISTED)
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


def test_open_node_opens_and_closes_the_file(tmp_path: Path) -> None:
    (tmp_path / "node").touch()
    before = set(Path("/proc/self/fd").iterdir())
    host.open_node(str(tmp_path / "node"))
    assert set(Path("/proc/self/fd").iterdir()) == before
    with pytest.raises(IsADirectoryError):
        host.open_node(str(tmp_path))
    with pytest.raises(FileNotFoundError):
        host.open_node(str(tmp_path / "absent"))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(odd=st.dictionaries(st.sampled_from(ODD), st.binary(max_size=40) | st.none()))
def test_read_host_accepts_any_files(tmp_path_factory: pytest.TempPathFactory, odd: dict[str, bytes | None]) -> None:
    root = tmp_path_factory.mktemp("odd")
    for path, content in odd.items():
        if any(parent.is_file() for parent in (root / path).parents) or (root / path).exists():
            continue
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).mkdir() if content is None else (root / path).write_bytes(content)
    assert look(root).platform == LINUX


def test_kernel_cameras_hold_what_hangs_on_each_port(bench: Any, tmp_path: Path) -> None:
    assert bench.linux.root == tmp_path
    bench.linux.plug("2-2", product="0b07", address=5)  # no L515
    bench.linux.write("sys/bus/usb/devices/2-3/idVendor", "not a number")
    [found] = host.kernel_cameras(tmp_path)
    assert (found.port, found.product_id, found.serial) == ("2-1", 0x0B64, "00000000F0246262")
    assert found.nodes == ("/dev/bus/usb/002/003", "/dev/video30", "/dev/video31")
    assert found.hid_sensors == ("accel_3d", "gyro_3d")
    assert found.hid_devices == ("0003:8086:0B64.3 (hid-sensor-hub)",)
    bench.linux.plug("2-1.4", address=7, hid=0, video=1)  # behind a hub whose name begins like the other's
    one, other = host.kernel_cameras(tmp_path)
    assert (one.port, len(one.hid_sensors), len(one.video_nodes)) == ("2-1", 2, 2)
    assert (other.port, other.hid_sensors, other.video_nodes) == ("2-1.4", (), ("/dev/video70",))


def test_odd_files_are_empty_and_odd_folders_hold_nothing(tmp_path: Path) -> None:
    assert host.kernel_cameras(tmp_path) == ()
    assert host.find_holders(["/dev/video0"], tmp_path) == ([], 0)
    (tmp_path / "binary").write_bytes(b"\xff\xfe 1 ")
    assert host.read_text(tmp_path / "binary").endswith("1")
    assert host.read_text(tmp_path) == host.read_text(tmp_path / "absent") == host.read_text(Path("nul\0byte")) == ""
    assert host.list_folder(tmp_path / "binary") == host.list_folder(tmp_path / "absent") == []
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert not host.path_exists(tmp_path / "loop")


def test_process_that_holds_a_node_is_named(bench: Any, tmp_path: Path) -> None:
    bench.linux.process(41, "realsense-viewer", "/dev/null", "/dev/video30", "/dev/video31")
    bench.linux.process(42, "bash", "/dev/tty")
    bench.linux.write(*UNLISTED)
    found, closed = host.find_holders(["/dev/video30", "/dev/bus/usb/002/003"], tmp_path)
    assert (found, closed) == ([host.Holder(41, "realsense-viewer", "/dev/video30")], 1)


def test_real_process_that_has_a_file_open_is_found(tmp_path: Path) -> None:
    held = tmp_path / "video0"
    held.touch()
    with subprocess.Popen([sys.executable, "-c", HOLDS, held], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        other.stdout.readline()
        with held.open():  # ours is left out
            found, _ = host.find_holders([str(held)])
        other.communicate(b"")
    assert [(one.pid, one.node) for one in found] == [(other.pid, str(held))]
    assert found[0].name.startswith("python")
    assert host.find_holders([str(held)])[0] == []
