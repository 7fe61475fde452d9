"""Each check on a bench with one fault: the checks that fail, and the detail and fix of one of
them.

A case: steps that cause the fault, names of the checks that fail, checks with their status
("failed" if none is given), and words of the detail and fix of the first of them.
"""

from functools import partial
from operator import attrgetter
from operator import methodcaller as do
from typing import Any
from unittest.mock import Mock

import pytest
import usb.core
from fake_bench import fake_device
from fake_lidar import FakeLidar

from nlos_cam.camera.sdk import WHEEL
from nlos_cam.doctor.diagnosis import REPLUG

DENIED = usb.core.USBError("Access denied (insufficient permissions)", -3, 13)
LINUX_ONLY = ("container", "udev-rules", "permissions", "video-driver", "hid-sensors", "in-use")
CAMERA_ONLY = (
    "recovery",
    "link",
    "permissions",
    "video-driver",
    "hid-sensors",
    "in-use",
    "sdk-camera",
    "firmware",
)


def linux(name: str, *arguments: Any) -> Any:
    """Call a method of the fake Linux."""
    return lambda bench: do(name, *arguments)(bench.linux)


write, runs, load = (partial(linux, name) for name in ("write", "process", "load"))


def remove(path: str) -> Any:
    return lambda bench: (bench.linux.root / path).unlink()


def put(name: str, value: Any) -> Any:
    """Set an attribute of the bench, or of a part of it."""
    part, _, last = name.rpartition(".")
    return lambda bench: setattr(attrgetter(part)(bench) if part else bench, last, value)


def all_of(status: str, *names: str) -> str:
    return ", ".join(f"{name} {status}" for name in names)


UNPLUG = do("unplug")
HIDE = do("hide")
NO_RULES = do("remove_rules")
REFUSE = do("refuse")
DOCKER = write(".dockerenv", "")
NO_USB = put("usb.devices", [])
SECOND = do("plug_second", hid=0)
NO_SDK = put("sdk_error", ImportError("No module named 'pyrealsense2'"))
WSL = write("proc/version", "Linux version 6.6.87-microsoft-standard-WSL2")


@pytest.mark.parametrize(
    ("steps", "failures", "check", "words"),
    [
        # the camera on USB
        ([UNPLUG], "usb-camera", "usb-camera", "no device at all|--camera sim"),
        ([UNPLUG], "usb-camera", all_of("skipped", *CAMERA_ONLY), ""),
        ([UNPLUG, do("put_on_usb", idVendor=0x046D)], "usb-camera", "usb-camera", "1 devices"),
        ([UNPLUG, do("put_on_usb", 0x0B07, serial="123")], "usb-camera", "usb-camera", "D435 123|8086:0b07"),
        ([NO_USB, HIDE], "usb-camera", "usb-camera", "udev"),
        ([NO_USB, HIDE, DOCKER], "usb-camera container", "usb-camera", "-v /dev:/dev"),
        ([UNPLUG, do("show")], "", "usb-camera warning, sdk-camera warning, link ok", "as a user"),
        ([UNPLUG, do("show"), DOCKER], "", "usb-camera warning", "-v /dev:/dev"),
        ([UNPLUG, do("put_on_usb", 0x0B55, serial="")], "recovery", "recovery", "8086:0b55|rs-fw-update -r"),
        ([UNPLUG, do("put_on_usb", 0x0ADC, serial="")], "recovery", "recovery", "8086:0adc|rs-fw-update -r"),
        ([do("put_on_usb", bcdUSB=0x0210, speed=3)], "", "link warning", "320 x 240|USB-C"),
        ([do("show", usb_type_descriptor="2.1"), put("usb.fails", OSError("none"))], "libusb", "link warning", ""),
        # udev rules and permissions
        ([UNPLUG, NO_RULES], "usb-camera udev-rules", "udev-rules", "nlos-cam doctor --write-udev|--reload-rules"),
        ([NO_RULES], "", "udev-rules warning", "--write-udev"),
        ([NO_RULES, REFUSE], "udev-rules permissions", "permissions", "--write-udev"),
        ([NO_RULES, UNPLUG, do("run_on", "linux", is_root=True)], "usb-camera", "udev-rules warning", ""),
        ([REFUSE], "permissions", "permissions", "/dev/video30 (Permission denied)|udevadm trigger"),
        ([REFUSE, do("run_on", "linux", in_plugdev=False)], "permissions", "permissions", "usermod -aG plugdev"),
        ([remove("sys/bus/usb/devices/2-1"), do("put_on_usb", shut=DENIED)], "permissions", "permissions",
         "Access denied"),
        # kernel drivers
        ([SECOND], "hid-sensors", "hid-sensors", "2-2|(none; 0003:8086:0B64.5 (hid-generic))|modprobe"),
        ([do("plug_second", hid=1)], "hid-sensors", "hid-sensors", "(accel_3d; |sudo modprobe -a hid_sensor_hub"),
        ([SECOND, load("uvcvideo")], "hid-sensors", "hid-sensors", "hid_sensor_gyro_3d|CONFIG_HID_SENSOR_HUB"),
        ([SECOND, DOCKER], "hid-sensors", "hid-sensors", "modprobe"),
        ([SECOND, remove("sys/bus/hid/devices/0003:8086:0B64.5")], "hid-sensors", "hid-sensors",
         "(none; no HID device)"),
        ([SECOND, do("put_on_usb", port_numbers=(2,), classes=(0x0E, 0xFF))], "hid-sensors", "hid-sensors",
         "no HID interface"),
        ([do("plug_second", video=0)], "video-driver", "video-driver", "2-2|sudo modprobe uvcvideo"),
        ([do("plug_second", product="0b3d", hid=0, video=0)], "video-driver", "hid-sensors ok", ""),
        ([do("plug_second", video=0), load(), write("lib/modules/6.8.0/modules.dep", "kernel/fs/ext4/ext4.ko:")],
         "video-driver", "video-driver", "CONFIG_USB_VIDEO_CLASS"),
        ([UNPLUG, do("plug_second", product="0b55", hid=0, video=0), do("put_on_usb", 0x0B55)], "recovery",
         "recovery", ""),
        # other programs
        ([runs(41, "cheese", "/dev/video30")], "in-use", "in-use", "cheese (pid 41)|kill 41`"),
        ([runs(42, "wireplumber", "/dev/video30"), runs(43, "pipewire", "/dev/video30")], "", "in-use warning", ""),
        ([runs(42, "pipewire", "/dev/video30"), runs(41, "cheese", "/dev/video30")], "in-use", "in-use", ""),
        ([write("proc/43/fd", "stands for a folder that may not be listed")], "", "in-use ok", "1 processes"),
        # containers
        ([DOCKER, NO_USB, HIDE], "container usb-camera",
         "container", '-v /dev:/dev|-v /sys:/sys|"c 81:* rmw"|"c 189:* rmw"'),
        ([write("run/.containerenv", ""), UNPLUG], "usb-camera", "container warning", "podman"),
        ([DOCKER, NO_RULES], "", "container ok, udev-rules skipped", ""),
        ([DOCKER, REFUSE], "permissions", "permissions, container warning", "--device-cgroup-rule"),
        # systems
        *(([do("run_on", system)], "", all_of("skipped", *LINUX_ONLY), "") for system in ("windows", "darwin")),
        ([do("run_on", "windows"), HIDE], "sdk-camera", "sdk-camera", "Device Manager"),
        ([do("run_on", "darwin", "arm64"), HIDE], "system sdk-camera", "system", "pyrealsense2-macosx==2.54.2|sudo"),
        ([do("run_on", "darwin", "arm64"), NO_SDK], "system sdk", "sdk", "pip install pyrealsense2-macosx==2.54.2"),
        ([WSL, UNPLUG], "system usb-camera", "system", "usbipd attach --wsl --busid"),
        ([WSL], "", "system warning", ""),
        # times of frames
        ([], "", "metadata ok", "host's clock"),
        ([write("sys/module/uvcvideo/version", "1.1.1")], "", "metadata ok", "host's clock"),
        ([write("sys/module/uvcvideo/version", "1.1.1.realsense-6.1")], "", "metadata ok", "camera's clock"),
        ([do("run_on", "darwin", "arm64")], "", "metadata skipped, system warning", "Linux and Windows"),
        ([do("run_on", "windows")], "", "metadata ok, sdk-camera ok", "realsense_metadata_win10.ps1"),
        ([load()], "", "metadata skipped", "uvcvideo"),
        # Python and the SDK
        ([NO_SDK], "sdk", "python ok, sdk-camera skipped", ""),
        ([do("run_on", "linux", "x86_64", 12)], "", "python ok", ""),
        ([do("run_on", "linux", "x86_64", 12), NO_SDK], "python sdk", "python", "x86_64|python3.11 -m venv"),
        ([do("run_on", "windows", "amd64", 13), NO_SDK], "python sdk", "python", "amd64|python3.11 -m venv"),
        ([do("run_on", "linux", "aarch64"), NO_SDK], "python sdk", "python", "aarch64|BUILD_PYTHON_BINDINGS"),
        ([do("run_on", "linux", "riscv64"), NO_SDK], "python sdk", "python", "riscv64|BUILD_PYTHON_BINDINGS"),
        ([do("run_on", "darwin", "arm64", 13), NO_SDK], "python system sdk", "python", "arm64|python3.12 -m venv"),
        ([do("run_on", "linux", "x86_64", is_musl=True), NO_SDK], "python sdk", "python", "glibc"),
        *(([put("sdk_error", ImportError(error))], "sdk", "sdk", f"{error}|{fix}") for error, fix in (
            ("No module named 'pyrealsense2'", f"pip install {WHEEL}"),
            ("No module named 'libusb_package'", "libusb-package"),
            ("libusb-1.0.so.0: cannot open", "apt install libusb-1.0-0, or `pip install libusb-package`"),
            ("libudev.so.1: cannot open", "sudo apt install libudev1"),
            ("libstdc++.so.6: cannot open", "sudo apt install libstdc++6"),
            ("/lib/libc.so.6: version `GLIBC_2.17' not found", "newer release"),
            ("DLL load failed while importing pyrealsense2", "vc_redist"))),
        ([put("load_sdk", object)], "sdk", "sdk", "attribute|--force-reinstall"),
        ([put("load_sdk", lambda: Mock(context=Mock(side_effect=RuntimeError("no power"))))], "sdk", "sdk",
         "no power|unplug"),
        ([put("installed", {"pyrealsense2": "2.53.1.4623"})], "", "sdk-version warning", ""),
        ([put("installed", {})], "", "sdk ok, sdk-version skipped, sdk-alone skipped", "unknown version"),
        ([put("installed", dict.fromkeys(("pyrealsense2", "pyrealsense2-beta"), "2.54.2.5684"))], "sdk-alone",
         "sdk-alone", f"pip uninstall -y pyrealsense2 pyrealsense2-beta && pip install {WHEEL}"),
        ([put("usb.fails", usb.core.NoBackendError("No backend available"))], "libusb",
         "libusb, usb-camera skipped, sdk-camera ok", "No backend available|pip install pyusb libusb-package|sudo apt"),
        # the camera in the SDK
        ([HIDE], "sdk-camera", "sdk-camera", f"L515 f0246262 at 2-1|{REPLUG}"),
        ([HIDE, do("refuse", "/dev/bus/usb/002/003")], "permissions sdk-camera", "sdk-camera", "udevadm trigger"),
        ([HIDE, SECOND], "hid-sensors sdk-camera", "sdk-camera", "hid-sensors|sudo modprobe -a hid_sensor_hub"),
    ],
)  # fmt: skip
def test_check_reports_fault_with_its_fix(
    bench: Any, steps: list[Any], failures: str, check: str, words: str
) -> None:
    for step in steps:
        step(bench)
    checks = bench.checks()
    wanted = [(*each.split(), "failed")[:2] for each in check.split(", ")]
    assert {each.name for each in checks.values() if each.status == "failed"} == set(
        failures.split()
    )
    assert [(name, checks[name].status) for name, _ in wanted] == wanted
    first = checks[wanted[0][0]]
    for word in words.split("|"):
        assert word in f"{first.detail}\n{first.fix}"


def test_fixes_fit_the_platform_and_the_user(bench: Any) -> None:
    bench.refuse()
    assert "usermod" not in bench.failed()["permissions"].fix  # in the group already
    bench.run_on("windows")
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    assert "apt" not in bench.checks()["libusb"].fix


def test_container_that_hides_sensors_is_named_as_the_cause(bench: Any) -> None:
    DOCKER(bench)
    SECOND(bench)
    for sensor in (bench.linux.root / "sys/bus/iio/devices").iterdir():
        sensor.unlink()
    (bench.linux.root / "sys/bus/iio/devices").rmdir()
    (bench.linux.root / "sys/bus/iio").rmdir()
    assert "-v /sys:/sys" in bench.failed()["hid-sensors"].fix


@pytest.mark.parametrize("version", ["2.55.1.6486", "2.59.1.11053", "3.0"])
def test_sdk_without_the_l515_is_why_it_is_not_seen(bench: Any, version: str) -> None:
    bench.installed["pyrealsense2"] = version
    bench.hide()
    failed = bench.failed()
    assert set(failed) == {"sdk-version", "sdk-camera"}
    assert failed["sdk-version"].fix == failed["sdk-camera"].fix == f"pip install {WHEEL}"
    assert version in failed["sdk-camera"].detail


@pytest.mark.parametrize(
    ("firmware", "status"),
    [
        *(
            ("01.05.08.01", "ok"),
            ("01.05.10.00", "ok"),
            ("01.05.08.00", "warning"),
            ("01.05.01.03", "warning"),
        ),
        *(("01.05.01.02", "failed"), ("01.04.01.02", "failed")),
        *(
            (0x1058, "ok"),
            (0x1052, "warning"),
            (0x1041, "failed"),
            (0x2F00, "skipped"),
            (0, "skipped"),
        ),
    ],
)
def test_firmware_is_judged_by_sdk_or_usb(bench: Any, firmware: str | int, status: str) -> None:
    """USB has three of its four version_numbers, and not of every firmware."""
    if isinstance(firmware, str):
        bench.show(firmware_version=firmware)
    else:
        bench.put_on_usb(bcdDevice=firmware)
        bench.hide()
    check = bench.checks()["firmware"]
    assert check.status == status
    if isinstance(firmware, str):
        assert firmware in check.detail
        assert ("1.5.8.1" in check.fix) == (status != "ok")


def test_older_of_two_firmwares_counts(bench: Any) -> None:
    bench.usb.devices.append(fake_device(serial="F1", port_numbers=(2,), address=4))
    bench.sdk_devices.append(FakeLidar("f1"))
    bench.sdk_devices[1].info["firmware_version"] = "01.04.01.02"
    assert "f0246262" in (detail := bench.failed()["firmware"].detail)
    assert "01.04.01.02" in detail
