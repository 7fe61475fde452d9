"""What is read of a host: files and processes of Linux, udev rules, and USB, by the real pyusb on a
fake bus.
"""

import errno
import inspect
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import usb.backend
import usb.core
import usb.util
from fake_bench import fake_device
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from usb.backend.libusb1 import _LibUSB

from nlos_cam.camera import sdk_serial
from nlos_cam.doctor import host
from nlos_cam.doctor.host import LIDARS, OTHERS
from nlos_cam.doctor.udev import FILE_NAME, RELOAD, WRITE_AND_INSTALL, install_command, rules_text
from nlos_cam.doctor.usb import SPEEDS, UsbDevice, firmware_of, scan_usb

LINUX = host.Platform("linux", "x86_64", (3, 11))
READ = (
    ".dockerenv",
    "proc/modules",
    "proc/1/cgroup",
    "proc/1/environ",
    "proc/version",
    "proc/sys/kernel/osrelease",
)
ODD = (
    *READ,
    "sys/bus/usb/devices/2-1",
    "sys/bus/usb/devices/2-1/idVendor",
    "proc/77/fd",
    "etc/udev/rules.d/a.rules",
)
HOLDS = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"


def look(root: Path) -> host.Host:
    return host.read_host(root, LINUX, lambda _: None)


def test_this_host_and_platform_can_be_read(tmp_path: Path) -> None:
    found = host.this_platform()

    assert found.python == sys.version_info[:2]
    assert found.system == platform.system().lower()
    assert found.machine == platform.machine().lower()
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
def test_container_is_known_by_its_files(
    bench: Any, tmp_path: Path, path: str, content: str, kind: str
) -> None:
    bench.linux.write(path, content)
    assert look(tmp_path).container == kind


def test_module_is_loaded_built_in_available_or_missing(bench: Any, tmp_path: Path) -> None:
    bench.linux.load("uvcvideo")
    bench.linux.write("lib/modules/6.8.0/modules.builtin", "kernel/drivers/hid/hid-sensor-hub.ko\n")
    bench.linux.write(
        "lib/modules/6.8.0/modules.dep", "kernel/drivers/iio/hid-sensor-accel-3d.ko.xz: a.ko\n"
    )

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


def test_every_node_is_opened_and_refusals_are_kept(bench: Any) -> None:
    bench.refuse()
    bench.refused["/dev/video31"] = FileNotFoundError(errno.ENOENT, "No such file")
    nodes = {node.path: node.error for node in bench.facts().host.nodes}

    assert list(nodes.items()) == [
        ("/dev/bus/usb/002/003", ""),
        ("/dev/video30", "Permission denied"),
        ("/dev/video31", "No such file"),
    ]


def test_open_node_opens_and_closes_the_file(tmp_path: Path) -> None:
    (tmp_path / "node").touch()
    before = set(Path("/proc/self/fd").iterdir())
    host.open_node(str(tmp_path / "node"))

    assert set(Path("/proc/self/fd").iterdir()) == before

    with pytest.raises(IsADirectoryError):
        host.open_node(str(tmp_path))
    with pytest.raises(FileNotFoundError):
        host.open_node(str(tmp_path / "absent"))


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(odd=st.dictionaries(st.sampled_from(ODD), st.binary(max_size=40) | st.none()))
def test_read_host_accepts_any_files(
    tmp_path_factory: pytest.TempPathFactory, odd: dict[str, bytes | None]
) -> None:
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

    bench.linux.plug(
        "2-1.4", address=7, hid=0, video=1
    )  # behind a hub whose name begins like the other's
    one, other = host.kernel_cameras(tmp_path)

    assert (one.port, len(one.hid_sensors), len(one.video_nodes)) == ("2-1", 2, 2)
    assert (other.port, other.hid_sensors, other.video_nodes) == ("2-1.4", (), ("/dev/video70",))


def test_odd_files_are_empty_and_odd_folders_hold_nothing(tmp_path: Path) -> None:
    assert host.kernel_cameras(tmp_path) == ()
    assert host.find_holders(["/dev/video0"], tmp_path) == ([], 0)

    (tmp_path / "binary").write_bytes(b"\xff\xfe 1 ")

    assert host.read_text(tmp_path / "binary").endswith("1")
    assert (
        host.read_text(tmp_path)
        == host.read_text(tmp_path / "absent")
        == host.read_text(Path("nul\0byte"))
        == ""
    )
    assert host.list_folder(tmp_path / "binary") == host.list_folder(tmp_path / "absent") == []

    (tmp_path / "loop").symlink_to(tmp_path / "loop")

    assert not host.path_exists(tmp_path / "loop")


def test_process_that_holds_a_cameras_node_is_named(bench: Any, tmp_path: Path) -> None:
    bench.linux.process(41, "realsense-viewer", "/dev/null", "/dev/video30", "/dev/video31")
    bench.linux.process(42, "bash", "/dev/tty")
    bench.linux.write("proc/43/fd", "stands for a folder that may not be listed")
    found, closed = host.find_holders(["/dev/video30", "/dev/bus/usb/002/003"], tmp_path)

    assert found == [host.Holder(41, "realsense-viewer", "/dev/video30")]
    assert closed == 1
    assert look(tmp_path).closed_processes == 1

    bench.unplug()

    assert look(tmp_path).closed_processes == 0


def test_real_process_that_has_a_file_open_is_found(tmp_path: Path) -> None:
    held = tmp_path / "video0"
    held.touch()
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, held], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout
        other.stdout.readline()
        with held.open():  # ours is left out
            found, _ = host.find_holders([str(held)])
        other.communicate(b"")

    assert [(one.pid, one.node) for one in found] == [(other.pid, str(held))]
    assert found[0].name.startswith("python")
    assert host.find_holders([str(held)])[0] == []


CLAUSE = re.compile(r'[A-Z]+(\{\w+\})?(==|:=|\+=)"[^"]*"')


@pytest.fixture(scope="module")
def rules() -> list[str]:
    return [line for line in rules_text().splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("product_id", LIDARS)
def test_rules_open_each_lidar(rules: list[str], product_id: int) -> None:
    usb_rules = [line for line in rules if line.startswith('SUBSYSTEMS=="usb"')]
    [rule] = [line for line in usb_rules if f'"{product_id:04x}"' in line]

    assert 'ATTRS{idVendor}=="8086"' in rule
    assert 'MODE:="0666"' in rule


def test_rules_open_the_motion_sensors_of_the_l515(rules: list[str]) -> None:
    sensors = [line for line in rules if not line.startswith("SUBSYSTEMS")]

    assert [line.split(",")[0] for line in sensors] == ['KERNEL=="iio*"', 'DRIVER=="hid_sensor*"']

    for line in sensors:
        assert 'ATTRS{idProduct}=="0b64"' in line
        assert "chmod -R 0777 /sys/%p" in line


def test_rules_have_the_syntax_of_udev(rules: list[str]) -> None:
    for line in rules:
        assert all(CLAUSE.fullmatch(clause) for clause in line.split(", ")), line


def test_rules_are_written_installed_and_reloaded_in_order() -> None:
    assert f"--write-udev {FILE_NAME}" in WRITE_AND_INSTALL
    assert WRITE_AND_INSTALL.endswith(RELOAD)

    command = install_command("my rules")

    assert "'my rules'" in command
    assert command.index("install") < command.index("udevadm")


def test_product_ids_are_of_one_family_only() -> None:
    assert not LIDARS.keys() & OTHERS.keys()


Scan = Callable[..., list[UsbDevice]]


@pytest.fixture
def seen(bench: Any, tmp_path: Path) -> Scan:
    """Scan these devices, on a host that has only the healthy camera's files."""

    def look(*devices: SimpleNamespace) -> list[UsbDevice]:
        bench.usb.devices = devices
        found = scan_usb(bench.usb, tmp_path)
        assert found.total == len(devices)
        return list(found.devices)

    return look


def test_l515_has_every_field_that_usb_knows(seen: Scan) -> None:
    [found, nowhere] = seen(fake_device(), fake_device(serial="", port_numbers=None))

    assert (found.id, found.kind, found.meaning) == ("8086:0b64", "camera", "L515")
    assert (found.bus, found.address, found.port) == (2, 3, "2-1")
    assert (found.usb_type, found.link, found.is_slow) == (
        "3.2",
        SPEEDS[usb.util.SPEED_SUPER],
        False,
    )
    assert (found.firmware, found.serial, found.product) == (
        "1.5.8",
        "f0246262",
        "Intel(R) RealSense(TM) 515",
    )
    assert found.interfaces == ("hid", "video", "vendor")
    assert (found.error, found.denied) == ("", False)
    assert found.label == "L515 f0246262 at 2-1"
    assert nowhere.label == "L515"


def test_realsense_products_are_known(seen: Scan) -> None:
    for product, kind, word in (
        *(
            (0x0B64, "camera", "L515"),
            (0x0B3D, "camera", "pre-production"),
            (0x0B0D, "camera", "L500"),
        ),
        *(
            (0x0B55, "recovery", "recovery"),
            (0x0ADC, "recovery", "USB 2"),
            (0x0B07, "other", "D435"),
        ),
    ):
        [found] = seen(
            fake_device(product), fake_device(0x1234), fake_device(idVendor=0x046D)
        )  # strangers are counted
        assert (found.kind, word in found.meaning) == (kind, True)


def test_link_is_slow_by_speed_or_else_by_version(seen: Scan) -> None:
    assert SPEEDS[usb.util.SPEED_HIGH] == "480 Mbit/s (USB 2)"
    assert SPEEDS[usb.util.SPEED_SUPER] == "5 Gbit/s (USB 3)"

    fast = (0x0320, 4), (0x0320, 5), (0x0320, 0), (0x0300, None)
    slow = (0x0210, 3), (0x0210, 0), (0x0210, None)
    for bcd_usb, speed in fast + slow:
        [found] = seen(fake_device(bcdUSB=bcd_usb, speed=speed))
        assert found.is_slow == ("USB 2" in found.link) == ((bcd_usb, speed) in slow)


def test_firmware_and_serial_are_read_as_the_sdk_writes_them() -> None:
    known = {0x1058: "1.5.8", 0x1052: "1.5.2", 0x1041: "1.4.1", 0x1099: "1.9.9"}
    expected = known | dict.fromkeys((0x1158, 0x0058, 0x105A), "")

    assert {number: firmware_of(number) for number in expected} == expected

    for serial, written in {
        "00000000F0246262": "f0246262",
        "00000000f0140727": "f0140727",
        "": "",
    }.items():
        assert sdk_serial(serial) == written == sdk_serial(written)


def test_serial_comes_from_the_kernel_without_permission(seen: Scan) -> None:
    [found] = seen(fake_device(shut=usb.core.USBError("Access denied", -3, errno.EACCES)))

    assert (found.denied, "Access denied" in found.error) == (True, True)
    assert found.serial == "f0246262"
    assert found.product == "RealSense"
    assert found.firmware == "1.5.8"
    assert "hid" in found.interfaces


@pytest.mark.parametrize(
    "refusal", [NotImplementedError("no driver"), usb.core.USBError("gone", -4, 19)]
)
def test_other_refusals_are_no_lack_of_permission(seen: Scan, refusal: Exception) -> None:
    """As by a driver of Windows, or of a device that left."""
    [found] = seen(fake_device(shut=refusal, hides=refusal, port_numbers=None))

    assert (found.error, found.denied) == (str(refusal), False)
    assert found.serial == ""
    assert found.interfaces == ()
    assert found.port == ""


def test_broken_string_is_an_error_of_the_device(seen: Scan) -> None:
    strings = {1: "", 2: "", 3: SimpleNamespace(encode=lambda _: b"\x00\xd8")}  # half a surrogate
    [found] = seen(fake_device(strings=strings, port_numbers=()))

    assert "surrogate" in found.error or "decode" in found.error


def test_scan_closes_every_device_and_claims_none(bench: Any, seen: Scan, tmp_path: Path) -> None:
    assert len(seen(fake_device(), fake_device(0x0B07, address=4))) == 2
    assert bench.usb.open_handles == 0
    assert bench.usb.meddled == []

    bench.usb.fails = usb.core.USBError("Input/Output Error", -1, 5)

    assert "Input/Output Error" in scan_usb(bench.usb, tmp_path).error


def test_scan_of_the_real_bus_reports_what_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = scan_usb()

    assert found.error == ""
    assert len(found.devices) <= found.total

    for package in ("usb.core", "libusb_package"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            assert package in scan_usb().error
    monkeypatch.setattr("libusb_package.get_libusb1_backend", lambda: None)
    for name in ("libusb1", "libusb0", "openusb"):
        monkeypatch.setattr(f"usb.backend.{name}.get_backend", lambda: None)

    assert scan_usb().error == "No backend available"


def test_fake_bus_has_the_methods_of_the_real_one(bench: Any) -> None:
    faked = [name for name in vars(type(bench.usb)) if not name.startswith("_")]

    assert len(faked) == 10

    for name in faked:
        real = list(inspect.signature(getattr(_LibUSB, name)).parameters)
        assert list(inspect.signature(getattr(type(bench.usb), name)).parameters) == real
        assert hasattr(usb.backend.IBackend, name)


def test_fake_bus_notes_what_changes_a_device(bench: Any) -> None:
    usb.core.find(backend=bench.usb).set_configuration()
    assert [what.split(" ")[0] for what in bench.usb.meddled] == ["configure"]
