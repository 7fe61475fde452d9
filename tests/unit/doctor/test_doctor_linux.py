import errno
from dataclasses import replace
from typing import Any

import pytest

from nlos_cam.doctor.host import Platform

RULES = "etc/udev/rules.d/99-l515.rules"


def hide(bench: Any) -> None:
    """The SDK does not see the camera, as it would not in the case that is set up."""
    bench.sdk_devices.clear()


def test_missing_udev_rules_fail_with_how_to_write_them(bench: Any) -> None:
    bench.unplug()
    (bench.linux.root / RULES).unlink()
    assert set(bench.failed()) == {"usb-camera", "udev-rules"}
    fix = bench.failed()["udev-rules"].fix
    assert "nlos-cam doctor --write-udev" in fix
    assert "udevadm control --reload-rules" in fix


def test_without_rules_a_camera_that_does_not_open_is_a_failure_and_one_that_does_a_warning(bench: Any) -> None:
    (bench.linux.root / RULES).unlink()
    assert bench.failed() == {}
    assert bench.checks()["udev-rules"].status == "warning"
    bench.refused["/dev/video30"] = PermissionError(errno.EACCES, "Permission denied")
    assert set(bench.failed()) == {"udev-rules", "permissions"}


def test_root_needs_no_rules_but_is_warned(bench: Any) -> None:
    (bench.linux.root / RULES).unlink()
    bench.unplug()
    bench.platform = replace(bench.platform, is_root=True)
    assert bench.checks()["udev-rules"].status == "warning"


def test_a_node_that_does_not_open_fails_and_is_why_it_is_not_seen(bench: Any) -> None:
    hide(bench)
    bench.refused["/dev/bus/usb/002/003"] = PermissionError(errno.EACCES, "Permission denied")
    failed = bench.failed()
    assert set(failed) == {"permissions", "sdk-camera"}
    assert "/dev/bus/usb/002/003 (Permission denied)" in failed["permissions"].detail
    assert "udevadm trigger" in failed["permissions"].fix
    assert failed["sdk-camera"].fix == failed["permissions"].fix


@pytest.mark.parametrize(("in_plugdev", "word"), [(False, True), (True, False)])
def test_who_is_not_in_the_group_is_told_how_to_join_it(bench: Any, in_plugdev: bool, word: bool) -> None:
    bench.platform = replace(bench.platform, in_plugdev=in_plugdev)
    bench.refused["/dev/video30"] = PermissionError(errno.EACCES, "Permission denied")
    assert ("usermod -aG plugdev" in bench.failed()["permissions"].fix) == word


def test_without_rules_permission_comes_from_writing_them(bench: Any) -> None:
    (bench.linux.root / RULES).unlink()
    bench.refused["/dev/video30"] = PermissionError(errno.EACCES, "Permission denied")
    assert "--write-udev" in bench.failed()["permissions"].fix


def test_where_the_kernel_shows_nothing_libusb_is_the_witness_of_a_refusal(
    bench: Any, device: Any, access_denied: Exception
) -> None:
    (bench.linux.root / "sys/bus/usb/devices/2-1").unlink()
    bench.usb.devices = [device(shut=access_denied)]
    assert "Access denied" in bench.failed()["permissions"].detail


def test_missing_motion_sensors_fail_and_are_why_it_is_not_seen(bench: Any) -> None:
    bench.linux.plug("2-2", address=5, hid=1)
    hide(bench)
    failed = bench.failed()
    assert set(failed) == {"hid-sensors", "sdk-camera"}
    assert "2-2" in failed["hid-sensors"].detail
    assert "(accel_3d; " in failed["hid-sensors"].detail
    assert "sudo modprobe -a hid_sensor_hub" in failed["hid-sensors"].fix
    assert "hid-sensors" in failed["sdk-camera"].detail
    assert failed["sdk-camera"].fix == failed["hid-sensors"].fix


def test_a_kernel_without_the_sensors_drivers_is_named_as_the_cause(bench: Any) -> None:
    bench.linux.plug("2-2", address=5, hid=0)
    bench.linux.load("uvcvideo")
    fix = bench.failed()["hid-sensors"].fix
    assert "no hid_sensor_hub, hid_sensor_accel_3d, hid_sensor_gyro_3d" in fix
    assert "CONFIG_HID_SENSOR_HUB" in fix


def test_a_container_that_hides_the_sensors_is_named_as_the_cause(bench: Any) -> None:
    bench.linux.write(".dockerenv", "")
    bench.linux.plug("2-2", address=5, hid=0)
    for sensor in (bench.linux.root / "sys/bus/iio/devices").iterdir():
        sensor.unlink()
    (bench.linux.root / "sys/bus/iio/devices").rmdir()
    (bench.linux.root / "sys/bus/iio").rmdir()
    assert "-v /sys:/sys" in bench.failed()["hid-sensors"].fix


def test_a_container_that_shows_sensors_of_others_is_not_blamed(bench: Any) -> None:
    bench.linux.write(".dockerenv", "")
    bench.linux.plug("2-2", address=5, hid=0)
    assert "modprobe" in bench.failed()["hid-sensors"].fix


def test_a_camera_without_any_hid_device_is_told_as_such(bench: Any) -> None:
    bench.linux.plug("2-2", address=5, hid=0)
    assert "(none; 0003:8086:0B64.5 (hid-generic))" in bench.failed()["hid-sensors"].detail
    (bench.linux.root / "sys/bus/hid/devices/0003:8086:0B64.5").unlink()
    assert "(none; no HID device)" in bench.failed()["hid-sensors"].detail


def test_a_camera_that_offers_no_hid_interface_is_to_be_replugged(bench: Any, device: Any) -> None:
    bench.linux.plug("2-2", address=5, hid=0)
    bench.usb.devices = [device(port_numbers=(2,), classes=(0x0E, 0xFF))]
    assert "no HID interface" in bench.failed()["hid-sensors"].fix


def test_no_video_nodes_fail(bench: Any) -> None:
    bench.linux.plug("2-2", address=5, video=0)
    check = bench.failed()["video-driver"]
    assert "2-2" in check.detail
    assert check.fix == "sudo modprobe uvcvideo"


def test_a_pre_production_unit_needs_video_nodes_and_no_motion_sensors(bench: Any) -> None:
    bench.linux.plug("2-2", product="0b3d", address=5, hid=0, video=0)
    assert set(bench.failed()) == {"video-driver"}


def test_a_kernel_without_uvcvideo_is_named_as_the_cause(bench: Any) -> None:
    bench.linux.plug("2-2", address=5, video=0)
    bench.linux.load()
    bench.linux.write("lib/modules/6.8.0/modules.dep", "kernel/fs/ext4/ext4.ko:")
    assert "CONFIG_USB_VIDEO_CLASS" in bench.failed()["video-driver"].fix


def test_recovery_mode_needs_neither_video_nor_motion(bench: Any, device: Any) -> None:
    bench.unplug()
    bench.linux.plug("2-2", product="0b55", address=5, hid=0, video=0)
    bench.usb.devices = [device(0x0B55)]
    assert set(bench.failed()) == {"recovery"}


def test_a_process_that_holds_the_camera_fails_with_its_name_and_number(bench: Any) -> None:
    bench.linux.process(41, "realsense-viewe", "/dev/video30", "/dev/video31")
    check = bench.failed()["in-use"]
    assert "realsense-viewe (pid 41) has it open" in check.detail
    assert "kill 41`" in check.fix


def test_a_desktop_service_that_looks_on_is_a_warning(bench: Any) -> None:
    bench.linux.process(42, "wireplumber", "/dev/video30")
    bench.linux.process(43, "pipewire", "/dev/video30")
    assert bench.checks()["in-use"].status == "warning"
    bench.linux.process(41, "cheese", "/dev/video30")
    assert bench.checks()["in-use"].status == "failed"


def test_processes_that_are_not_to_be_seen_are_told(bench: Any) -> None:
    bench.linux.write("proc/43/fd", "stands for a folder that may not be listed")
    assert "1 processes of others do not show" in bench.checks()["in-use"].detail


def test_a_container_without_the_hosts_camera_fails_with_the_flags(bench: Any) -> None:
    bench.linux.write(".dockerenv", "")
    bench.usb.devices.clear()
    hide(bench)
    check = bench.failed()["container"]
    for flag in ("-v /dev:/dev", "-v /sys:/sys", '"c 81:* rmw"', '"c 189:* rmw"'):
        assert flag in check.fix


def test_a_container_with_nothing_plugged_in_is_a_warning(bench: Any) -> None:
    bench.linux.write("run/.containerenv", "")
    bench.unplug()
    check = bench.checks()["container"]
    assert (check.status, "podman" in check.detail) == ("warning", True)


def test_a_container_that_shows_the_camera_is_ok_and_needs_no_rules_of_its_own(bench: Any) -> None:
    bench.linux.write(".dockerenv", "")
    (bench.linux.root / RULES).unlink()
    checks = bench.checks()
    assert (checks["container"].status, checks["udev-rules"].status) == ("ok", "skipped")


def test_a_container_that_may_not_open_the_camera_gets_the_flags(bench: Any) -> None:
    bench.linux.write(".dockerenv", "")
    bench.refused["/dev/video30"] = PermissionError(errno.EPERM, "Operation not permitted")
    checks = bench.checks()
    assert checks["container"].status == "warning"
    assert "--device-cgroup-rule" in checks["permissions"].fix


@pytest.mark.parametrize("system", ["windows", "darwin"])
def test_elsewhere_nothing_of_linux_is_asked(bench: Any, system: str) -> None:
    bench.platform = Platform(system, "amd64", (3, 11))
    checks = bench.checks()
    for name in ("container", "udev-rules", "permissions", "video-driver", "hid-sensors", "in-use"):
        assert checks[name].status == "skipped", name


def test_where_times_come_from_is_told(bench: Any) -> None:
    assert "this host's clock" in bench.checks()["metadata"].detail
    bench.linux.write("sys/module/uvcvideo/version", "1.1.1.realsense-6.1")
    assert "the camera's clock" in bench.checks()["metadata"].detail
    bench.platform = Platform("darwin", "arm64", (3, 11))
    assert bench.checks()["metadata"].detail == "only Linux and Windows have it"
    bench.platform = Platform("windows", "amd64", (3, 11))
    assert "realsense_metadata_win10.ps1" in bench.checks()["metadata"].detail


def test_without_uvcvideo_there_are_no_times_to_tell_of(bench: Any) -> None:
    bench.linux.load()
    check = bench.checks()["metadata"]
    assert (check.status, check.detail) == ("skipped", "uvcvideo is not loaded")
