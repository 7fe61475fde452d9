"""Each check on a bench with one fault: the checks that fail, and the detail and fix of one."""

from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest
import usb.core
from fake_bench import Bench, fake_device
from fake_lidar import FakeLidar

from nlos_cam.camera.sdk import WHEEL
from nlos_cam.doctor.diagnosis import REPLUG

Fault = Callable[[Any], object]
"""Change of a healthy bench."""


class Case(NamedTuple):
    """Faults of a bench, and the finding of one check that they lead to."""

    faults: list[Fault]
    check: str
    status: str = "failed"
    words: str = ""
    """Parts of the detail or fix, separated by |."""
    also_failed: str = ""
    """Names of the other checks that fail."""


def of_bench(method: str, *arguments: Any, **options: Any) -> Fault:
    """Call a method of the bench."""
    return lambda bench: getattr(bench, method)(*arguments, **options)


def of_linux(method: str, *arguments: Any) -> Fault:
    """Call a method of the bench's Linux."""
    return lambda bench: getattr(bench.linux, method)(*arguments)


def put(name: str, value: Any) -> Fault:
    """Set an attribute of the bench, or of a part of it."""
    part, _, last = name.rpartition(".")
    return lambda bench: setattr(attrgetter(part)(bench) if part else bench, last, value)


def remove(path: str) -> Fault:
    return lambda bench: (bench.linux.root / path).unlink()


run_on = partial(of_bench, "run_on")
put_on_usb = partial(of_bench, "put_on_usb")
plug_second = partial(of_bench, "plug_second")
write = partial(of_linux, "write")
runs = partial(of_linux, "process")
load_modules = partial(of_linux, "load")
sdk_fails = partial(put, "sdk_error")

UNPLUG = of_bench("unplug")
SHOW_TO_SDK = of_bench("show")
HIDE_FROM_SDK = of_bench("hide")
NO_RULES = of_bench("remove_rules")
REFUSE = of_bench("refuse")
DOCKER = write(".dockerenv", "")
NO_USB = put("usb.devices", [])
SECOND_WITHOUT_SENSORS = plug_second(hid=0)
NO_SDK = sdk_fails(ImportError("No module named 'pyrealsense2'"))
WSL = write("proc/version", "Linux version 6.6.87-microsoft-standard-WSL2")
NO_VIDEO_CLASS = write("lib/modules/6.8.0/modules.dep", "kernel/fs/ext4/ext4.ko:")
NOT_LISTED = write("proc/43/fd", "stands for a folder that may not be listed")
DENIED = usb.core.USBError("Access denied (insufficient permissions)", -3, 13)
NO_LIBUSB = put("usb.fails", usb.core.NoBackendError("No backend available"))
NO_POWER = Mock(context=Mock(side_effect=RuntimeError("no power")))
TWO_PACKAGES = dict.fromkeys(("pyrealsense2", "pyrealsense2-beta"), "2.54.2.5684")
HID_DEVICE = "sys/bus/hid/devices/0003:8086:0B64.5"

CAMERA_ON_USB = [
    Case([UNPLUG], "usb-camera", words="no device at all|--camera sim"),
    Case([UNPLUG, put_on_usb(idVendor=0x046D)], "usb-camera", words="1 devices"),
    Case([UNPLUG, put_on_usb(0x0B07, serial="123")], "usb-camera", words="D435 123|8086:0b07"),
    Case([NO_USB, HIDE_FROM_SDK], "usb-camera", words="udev"),
    Case(
        [NO_USB, HIDE_FROM_SDK, DOCKER],
        "usb-camera",
        words="-v /dev:/dev",
        also_failed="container",
    ),
    Case([UNPLUG, SHOW_TO_SDK], "usb-camera", "warning", "as a user"),
    Case([UNPLUG, SHOW_TO_SDK], "sdk-camera", "warning"),
    Case([UNPLUG, SHOW_TO_SDK], "link", "ok"),
    Case([UNPLUG, SHOW_TO_SDK, DOCKER], "usb-camera", "warning", "-v /dev:/dev"),
    Case([UNPLUG, put_on_usb(0x0B55, serial="")], "recovery", words="8086:0b55|rs-fw-update -r"),
    Case([UNPLUG, put_on_usb(0x0ADC, serial="")], "recovery", words="8086:0adc|rs-fw-update -r"),
    Case([put_on_usb(bcdUSB=0x0210, speed=3)], "link", "warning", "320 x 240|USB-C"),
    Case(
        [of_bench("show", usb_type_descriptor="2.1"), put("usb.fails", OSError("none"))],
        "link",
        "warning",
        also_failed="libusb",
    ),
]

RULES_AND_PERMISSIONS = [
    Case(
        [UNPLUG, NO_RULES],
        "udev-rules",
        words="nlos-cam doctor --write-udev|--reload-rules",
        also_failed="usb-camera",
    ),
    Case([NO_RULES], "udev-rules", "warning", "--write-udev"),
    Case([NO_RULES, REFUSE], "permissions", words="--write-udev", also_failed="udev-rules"),
    Case(
        [NO_RULES, UNPLUG, run_on("linux", is_root=True)],
        "udev-rules",
        "warning",
        also_failed="usb-camera",
    ),
    Case([REFUSE], "permissions", words="/dev/video30 (Permission denied)|udevadm trigger"),
    Case([REFUSE, run_on("linux", in_plugdev=False)], "permissions", words="usermod -aG plugdev"),
    Case(
        [remove("sys/bus/usb/devices/2-1"), put_on_usb(shut=DENIED)],
        "permissions",
        words="Access denied",
    ),
]

KERNEL_DRIVERS = [
    Case(
        [SECOND_WITHOUT_SENSORS],
        "hid-sensors",
        words="2-2|(none; 0003:8086:0B64.5 (hid-generic))|modprobe",
    ),
    Case(
        [plug_second(hid=1)],
        "hid-sensors",
        words="(accel_3d; |sudo modprobe -a hid_sensor_hub",
    ),
    Case(
        [SECOND_WITHOUT_SENSORS, load_modules("uvcvideo")],
        "hid-sensors",
        words="hid_sensor_gyro_3d|CONFIG_HID_SENSOR_HUB",
    ),
    Case([SECOND_WITHOUT_SENSORS, DOCKER], "hid-sensors", words="modprobe"),
    Case(
        [SECOND_WITHOUT_SENSORS, remove(HID_DEVICE)],
        "hid-sensors",
        words="(none; no HID device)",
    ),
    Case(
        [SECOND_WITHOUT_SENSORS, put_on_usb(port_numbers=(2,), classes=(0x0E, 0xFF))],
        "hid-sensors",
        words="no HID interface",
    ),
    Case([plug_second(video=0)], "video-driver", words="2-2|sudo modprobe uvcvideo"),
    Case(
        [plug_second(product="0b3d", hid=0, video=0)],
        "hid-sensors",
        "ok",
        also_failed="video-driver",
    ),
    Case(
        [plug_second(video=0), load_modules(), NO_VIDEO_CLASS],
        "video-driver",
        words="CONFIG_USB_VIDEO_CLASS",
    ),
    Case(
        [UNPLUG, plug_second(product="0b55", hid=0, video=0), put_on_usb(0x0B55)],
        "recovery",
    ),
]

OTHER_PROGRAMS = [
    Case([runs(41, "cheese", "/dev/video30")], "in-use", words="cheese (pid 41)|kill 41`"),
    Case(
        [runs(42, "wireplumber", "/dev/video30"), runs(43, "pipewire", "/dev/video30")],
        "in-use",
        "warning",
    ),
    Case([runs(42, "pipewire", "/dev/video30"), runs(41, "cheese", "/dev/video30")], "in-use"),
    Case([NOT_LISTED], "in-use", "ok", "1 processes"),
]

CONTAINERS = [
    Case(
        [DOCKER, NO_USB, HIDE_FROM_SDK],
        "container",
        words='-v /dev:/dev|-v /sys:/sys|"c 81:* rmw"|"c 189:* rmw"',
        also_failed="usb-camera",
    ),
    Case(
        [write("run/.containerenv", ""), UNPLUG],
        "container",
        "warning",
        "podman",
        also_failed="usb-camera",
    ),
    Case([DOCKER, NO_RULES], "container", "ok"),
    Case([DOCKER, NO_RULES], "udev-rules", "skipped"),
    Case([DOCKER, REFUSE], "permissions", words="--device-cgroup-rule"),
    Case([DOCKER, REFUSE], "container", "warning", also_failed="permissions"),
]

SYSTEMS = [
    Case([run_on("windows"), HIDE_FROM_SDK], "sdk-camera", words="Device Manager"),
    Case(
        [run_on("darwin", "arm64"), HIDE_FROM_SDK],
        "system",
        words="pyrealsense2-macosx==2.54.2|sudo",
        also_failed="sdk-camera",
    ),
    Case([run_on("darwin", "arm64")], "system", "warning"),
    Case(
        [run_on("darwin", "arm64"), NO_SDK],
        "sdk",
        words="pip install pyrealsense2-macosx==2.54.2",
        also_failed="system",
    ),
    Case(
        [WSL, UNPLUG],
        "system",
        words="usbipd attach --wsl --busid",
        also_failed="usb-camera",
    ),
    Case([WSL], "system", "warning"),
]

TIMES_OF_FRAMES = [
    Case([], "metadata", "ok", "host's clock"),
    Case([write("sys/module/uvcvideo/version", "1.1.1")], "metadata", "ok", "host's clock"),
    Case(
        [write("sys/module/uvcvideo/version", "1.1.1.realsense-6.1")],
        "metadata",
        "ok",
        "camera's clock",
    ),
    Case([run_on("darwin", "arm64")], "metadata", "skipped", "Linux and Windows"),
    Case([run_on("windows")], "metadata", "ok", "realsense_metadata_win10.ps1"),
    Case([run_on("windows")], "sdk-camera", "ok"),
    Case([load_modules()], "metadata", "skipped", "uvcvideo"),
]

PYTHON = [
    Case([NO_SDK], "python", "ok", also_failed="sdk"),
    Case([run_on("linux", "x86_64", 12)], "python", "ok"),
    *(
        Case([run_on(*platform), NO_SDK], "python", words=words, also_failed=also)
        for platform, words, also in (
            (("linux", "x86_64", 12), "x86_64|python3.11 -m venv", "sdk"),
            (("windows", "amd64", 13), "amd64|python3.11 -m venv", "sdk"),
            (("linux", "aarch64"), "aarch64|BUILD_PYTHON_BINDINGS", "sdk"),
            (("linux", "riscv64"), "riscv64|BUILD_PYTHON_BINDINGS", "sdk"),
            (("darwin", "arm64", 13), "arm64|python3.12 -m venv", "system sdk"),
        )
    ),
    Case(
        [run_on("linux", "x86_64", is_musl=True), NO_SDK],
        "python",
        words="glibc",
        also_failed="sdk",
    ),
]

LOADING_ERRORS = {
    "No module named 'pyrealsense2'": f"pip install {WHEEL}",
    "No module named 'libusb_package'": "libusb-package",
    "libusb-1.0.so.0: cannot open": "apt install libusb-1.0-0, or `pip install libusb-package`",
    "libudev.so.1: cannot open": "sudo apt install libudev1",
    "libstdc++.so.6: cannot open": "sudo apt install libstdc++6",
    "/lib/libc.so.6: version `GLIBC_2.17' not found": "newer release",
    "DLL load failed while importing pyrealsense2": "vc_redist",
}

LIBREALSENSE = [
    Case([NO_SDK], "sdk-camera", "skipped", also_failed="sdk"),
    *(
        Case([sdk_fails(ImportError(error))], "sdk", words=f"{error}|{fix}")
        for error, fix in LOADING_ERRORS.items()
    ),
    Case([put("load_sdk", object)], "sdk", words="attribute|--force-reinstall"),
    Case([put("load_sdk", lambda: NO_POWER)], "sdk", words="no power|unplug"),
    Case([put("installed", {"pyrealsense2": "2.53.1.4623"})], "sdk-version", "warning"),
    Case([put("installed", {})], "sdk", "ok", "unknown version"),
    Case([put("installed", {})], "sdk-version", "skipped"),
    Case([put("installed", {})], "sdk-alone", "skipped"),
    Case(
        [put("installed", TWO_PACKAGES)],
        "sdk-alone",
        words=f"pip uninstall -y pyrealsense2 pyrealsense2-beta && pip install {WHEEL}",
    ),
    Case(
        [NO_LIBUSB],
        "libusb",
        words="No backend available|pip install pyusb libusb-package|sudo apt",
    ),
    Case([NO_LIBUSB], "usb-camera", "skipped", also_failed="libusb"),
    Case([NO_LIBUSB], "sdk-camera", "ok", also_failed="libusb"),
    Case([HIDE_FROM_SDK], "sdk-camera", words=f"L515 f0246262 at 2-1|{REPLUG}"),
    Case(
        [HIDE_FROM_SDK, of_bench("refuse", "/dev/bus/usb/002/003")],
        "sdk-camera",
        words="udevadm trigger",
        also_failed="permissions",
    ),
    Case(
        [HIDE_FROM_SDK, SECOND_WITHOUT_SENSORS],
        "sdk-camera",
        words="hid-sensors|sudo modprobe -a hid_sensor_hub",
        also_failed="hid-sensors",
    ),
]

JETSON = write("proc/device-tree/model", "NVIDIA Jetson Orin Nano")
NEWER_SDK = put("installed", {"pyrealsense2": "2.57.3.1"})
AS_PLATFORM_CAMERA = of_bench("show", name="Platform Camera", serial_number="12a32f8f")
NO_POWER_STATE = Mock(context=Mock(side_effect=RuntimeError("failed to set power state")))
REPORTED = {
    "Fatal error occurred (16)": "broken|replace the camera",
    "RuntimeError: failed to set power state": "root|sudo nlos-cam doctor",
    "cannot parse device name from 'Platform Camera'": f"pip install {WHEEL}",
    "the same frame number again and again": "stands still|unplug the camera",
    "Frame didn't arrive within 5000": "no frame came in time|doctor --camera l515",
    "RuntimeError: Couldn't resolve requests": "320 x 240|USB 3 cable",
    "Failed to create ros reader: Bag unindexed": "cut before its index|nlos-cam repair",
}

OWNERS_MEET = [
    Case(
        [run_on("windows"), NEWER_SDK, AS_PLATFORM_CAMERA],
        "sdk-version",
        words=f"'Platform Camera'|pip install {WHEEL}",
        also_failed="sdk-camera",
    ),
    Case(
        [run_on("windows"), put("installed", {}), AS_PLATFORM_CAMERA],
        "sdk-version",
        words=f"'Platform Camera'|pip install {WHEEL}",
        also_failed="sdk-camera",
    ),
    Case([JETSON, HIDE_FROM_SDK], "sdk-camera", words="-DFORCE_RSUSB_BACKEND=ON"),
    Case([JETSON, SECOND_WITHOUT_SENSORS], "hid-sensors", words="-DFORCE_RSUSB_BACKEND=ON"),
    Case([put("load_sdk", lambda: NO_POWER_STATE)], "sdk", words="sudo nlos-cam doctor"),
    *(Case([put("reported", text)], "reported", words=words) for text, words in REPORTED.items()),
    Case([put("reported", "something else")], "reported", "warning"),
]


@pytest.mark.parametrize(
    "case",
    [
        *CAMERA_ON_USB,
        *RULES_AND_PERMISSIONS,
        *KERNEL_DRIVERS,
        *OTHER_PROGRAMS,
        *CONTAINERS,
        *SYSTEMS,
        *TIMES_OF_FRAMES,
        *PYTHON,
        *LIBREALSENSE,
        *OWNERS_MEET,
    ],
    ids=lambda case: f"{case.check}-{case.status}",
)
def test_check_reports_fault_with_its_fix(bench: Bench, case: Case) -> None:
    for fault in case.faults:
        fault(bench)
    checks = bench.checks()

    finding = checks[case.check]

    assert finding.status == case.status

    for word in case.words.split("|"):
        assert word in f"{finding.detail}\n{finding.fix}"

    failed = {name for name, check in checks.items() if check.status == "failed"}
    expected = {case.check} if case.status == "failed" else set[str]()

    assert failed == expected | set(case.also_failed.split())


def statuses(bench: Bench, names: str) -> set[str]:
    checks = bench.checks()
    return {checks[name].status for name in names.split()}


def test_checks_of_a_camera_are_skipped_without_one(bench: Bench) -> None:
    bench.unplug()
    names = "recovery link permissions video-driver hid-sensors in-use sdk-camera firmware"

    assert statuses(bench, names) == {"skipped"}


@pytest.mark.parametrize("system", ["windows", "darwin"])
def test_checks_of_linux_are_skipped_elsewhere(bench: Bench, system: str) -> None:
    bench.run_on(system)

    assert not bench.failed()

    names = "container udev-rules permissions video-driver hid-sensors in-use"

    assert statuses(bench, names) == {"skipped"}


def test_fix_does_not_add_a_user_to_a_group_that_has_him(bench: Bench) -> None:
    bench.refuse()
    assert "usermod" not in bench.failed()["permissions"].fix


def test_fix_on_windows_names_no_package_of_linux(bench: Bench) -> None:
    bench.run_on("windows")
    NO_LIBUSB(bench)

    assert "apt" not in bench.checks()["libusb"].fix


def test_container_that_hides_sensors_is_named_as_the_cause(bench: Bench) -> None:
    DOCKER(bench)
    SECOND_WITHOUT_SENSORS(bench)
    sensors = bench.linux.root / "sys/bus/iio/devices"
    for sensor in sensors.iterdir():
        sensor.unlink()
    sensors.rmdir()
    sensors.parent.rmdir()

    assert "-v /sys:/sys" in bench.failed()["hid-sensors"].fix


@pytest.mark.parametrize("version", ["2.55.1.6486", "2.59.1.11053", "3.0"])
def test_sdk_without_the_l515_is_why_it_is_not_seen(bench: Bench, version: str) -> None:
    bench.installed["pyrealsense2"] = version
    bench.hide()
    failed = bench.failed()

    assert set(failed) == {"sdk-version", "sdk-camera"}
    assert failed["sdk-version"].fix == f"pip install {WHEEL}"
    assert failed["sdk-camera"].fix == f"pip install {WHEEL}"
    assert version in failed["sdk-camera"].detail


@pytest.mark.parametrize(
    ("firmware", "status"),
    [
        ("01.05.08.01", "ok"),
        ("01.05.10.00", "ok"),
        ("01.05.08.00", "warning"),
        ("01.05.01.03", "warning"),
        ("01.05.01.02", "failed"),
        ("01.04.01.02", "failed"),
    ],
)
def test_firmware_of_the_sdk_has_four_numbers(bench: Bench, firmware: str, status: str) -> None:
    bench.show(firmware_version=firmware)
    check = bench.checks()["firmware"]

    assert check.status == status
    assert firmware in check.detail
    assert ("1.5.8.1" in check.fix) == (status != "ok")


@pytest.mark.parametrize(
    ("release", "status"),
    [
        (0x1058, "ok"),
        (0x1052, "warning"),
        (0x1041, "failed"),
        (0x2F00, "skipped"),
        (0, "skipped"),
    ],
)
def test_firmware_of_usb_has_three_numbers_or_none(bench: Bench, release: int, status: str) -> None:
    bench.put_on_usb(bcdDevice=release)
    bench.hide()

    assert bench.checks()["firmware"].status == status


def test_older_of_two_firmwares_counts(bench: Bench) -> None:
    bench.usb.devices.append(fake_device(serial="F1", port_numbers=(2,), address=4))
    bench.sdk_devices.append(FakeLidar("f1"))
    bench.sdk_devices[1].info["firmware_version"] = "01.04.01.02"
    detail = bench.failed()["firmware"].detail

    assert "f0246262" in detail
    assert "01.04.01.02" in detail
