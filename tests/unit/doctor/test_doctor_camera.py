from typing import Any

import pytest


def info(bench: Any, **changes: str) -> None:
    bench.sdk_devices[0].info |= changes


def test_nothing_plugged_in_is_the_first_failure_and_the_rest_is_left_out(bench: Any) -> None:
    bench.unplug()
    checks = bench.checks()
    failed = [check for check in checks.values() if check.status == "failed"]
    assert [check.name for check in failed] == ["usb-camera"]
    assert failed[0].detail.startswith("nothing is plugged in")
    assert "--camera sim" in failed[0].fix
    for name in ("recovery", "link", "permissions", "video-driver", "hid-sensors", "in-use", "sdk-camera", "firmware"):
        assert checks[name].status == "skipped", name


def test_a_bus_with_other_things_on_it_is_told_apart_from_an_empty_one(bench: Any, device: Any) -> None:
    bench.unplug()
    assert "no device at all" in bench.failed()["usb-camera"].detail
    bench.usb.devices = [device(idVendor=0x046D)]
    assert "none of the 1 devices" in bench.failed()["usb-camera"].detail


def test_another_realsense_alone_is_named(bench: Any, device: Any) -> None:
    bench.unplug()
    bench.usb.devices = [device(0x0B07, serial="123")]
    check = bench.failed()["usb-camera"]
    assert "RealSense D435 123" in check.detail
    assert "8086:0b07" in check.detail


def test_a_camera_that_only_the_kernel_sees_fails(bench: Any) -> None:
    bench.usb.devices.clear()
    bench.sdk_devices.clear()
    assert "udev" in bench.failed()["usb-camera"].fix
    bench.linux.write(".dockerenv", "")
    assert "-v /dev:/dev" in bench.failed()["usb-camera"].fix


def test_a_camera_that_only_the_sdk_sees_is_a_warning(bench: Any) -> None:
    devices = list(bench.sdk_devices)
    bench.unplug()
    bench.sdk_devices.extend(devices)
    checks = bench.checks()
    assert checks["usb-camera"].status == checks["sdk-camera"].status == "warning"
    assert (checks["link"].status, checks["firmware"].status) == ("ok", "ok")
    assert "as a user" in checks["usb-camera"].fix
    bench.linux.write(".dockerenv", "")
    assert "-v /dev:/dev" in bench.checks()["usb-camera"].fix


@pytest.mark.parametrize("product", [0x0B55, 0x0ADC])
def test_recovery_mode_fails_with_how_to_flash(bench: Any, device: Any, product: int) -> None:
    bench.unplug()
    bench.usb.devices = [device(product, serial="")]
    assert set(bench.failed()) == {"recovery"}
    check = bench.failed()["recovery"]
    assert f"8086:{product:04x}" in check.detail
    assert "rs-fw-update -r" in check.fix


def test_usb_2_is_a_warning_that_says_what_still_works(bench: Any, device: Any) -> None:
    bench.usb.devices = [device(bcdUSB=0x0210, speed=3)]
    check = bench.checks()["link"]
    assert check.status == "warning"
    assert "320 x 240" in check.detail
    assert "turn the USB-C plug round" in check.fix
    assert bench.failed() == {}


def test_the_sdk_tells_the_link_where_usb_does_not(bench: Any) -> None:
    info(bench, usb_type_descriptor="2.1")
    bench.usb.fails = OSError("no USB here")
    assert bench.checks()["link"].status == "warning"


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
def test_firmware_is_judged_by_what_librealsense_accepts_and_asks_for(bench: Any, firmware: str, status: str) -> None:
    info(bench, firmware_version=firmware)
    check = bench.checks()["firmware"]
    assert (check.status, firmware in check.detail) == (status, True)
    assert ("1.5.8.1" in check.fix) == (status != "ok")


@pytest.mark.parametrize(
    ("bcd_device", "status"), [(0x1058, "ok"), (0x1052, "warning"), (0x1041, "failed"), (0x2F00, "skipped")]
)
def test_three_numbers_from_usb_are_judged_as_far_as_they_go(
    bench: Any, device: Any, bcd_device: int, status: str
) -> None:
    bench.usb.devices = [device(bcdDevice=bcd_device)]
    bench.sdk_devices.clear()
    assert bench.checks()["firmware"].status == status


def test_a_firmware_that_nobody_tells_is_told_apart_from_no_camera(bench: Any, device: Any) -> None:
    bench.usb.devices = [device(bcdDevice=0)]
    bench.sdk_devices.clear()
    assert bench.checks()["firmware"].detail == "no camera tells its firmware"
    bench.unplug()
    assert bench.checks()["firmware"].detail.startswith("no L515")


def test_the_older_of_two_firmwares_counts(bench: Any, device: Any, fake_l515: Any) -> None:
    bench.usb.devices.append(device(serial="F1", port_numbers=(2,), address=4))
    other = fake_l515("f1")
    other.info["firmware_version"] = "01.04.01.02"
    bench.sdk_devices.append(other)
    check = bench.failed()["firmware"]
    assert "f0246262" in check.detail
    assert "01.04.01.02" in check.detail
