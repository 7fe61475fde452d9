from typing import Any
from unittest.mock import Mock

import pytest

from nlos_cam.camera.l515 import DeviceInfo
from nlos_cam.doctor.facts import Facts, Pair, gather, look_at_sdk, pair
from nlos_cam.errors import CameraError


def info(serial: str, name: str = "Intel RealSense L515", usb: str = "3.2") -> DeviceInfo:
    return DeviceInfo(name, serial, "01.05.08.01", usb)


def serials(pairs: list[Pair]) -> list[tuple[str | None, str | None]]:
    return [(one.usb and one.usb.serial, one.sdk and one.sdk.serial) for one in pairs]


def test_this_machine_can_be_asked() -> None:
    facts = gather()
    assert facts.sdk.load_error == ""
    assert ("pyrealsense2", facts.sdk.version) in facts.sdk.packages


def test_the_sdk_tells_version_and_devices(bench: Any, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("9", name="Intel RealSense D435"))
    sdk = bench.facts().sdk
    assert sdk.version == "2.54.2.5684"
    assert [one.serial for one in sdk.devices] == ["f0246262", "9"]
    assert [one.serial for one in sdk.lidars] == ["f0246262"]
    assert sdk.error == ""


def test_the_cause_of_a_failed_import_is_kept_and_not_its_advice(bench: Any) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    sdk = bench.facts().sdk
    assert sdk.load_error == sdk.error == "No module named 'pyrealsense2'"
    assert sdk.devices == ()


def test_an_sdk_that_cannot_list_is_told(bench: Any) -> None:
    def fail() -> None:
        raise RuntimeError("failed to set power state")

    bench.load_sdk = lambda: Mock(context=lambda: Mock(query_devices=fail))
    assert "failed to set power state" in bench.facts().sdk.query_error
    bench.load_sdk = lambda: Mock(context=fail)
    assert "failed to set power state" in bench.facts().sdk.query_error


def test_an_error_without_a_cause_is_its_own() -> None:
    def load() -> None:
        raise CameraError("no such luck")

    assert look_at_sdk(load, list).load_error == "no such luck"


def test_a_folder_of_the_wheels_name_is_told(bench: Any) -> None:
    bench.load_sdk = object
    assert "attribute" in bench.facts().sdk.query_error


def test_of_two_packages_no_version_is_known(bench: Any) -> None:
    bench.installed["PyRealSense2-beta"] = "2.56.0"
    assert bench.facts().sdk.version == ""
    assert len(bench.facts().sdk.packages) == 2


def test_serials_match_whatever_their_zeros(bench: Any, device: Any) -> None:
    bench.usb.devices = [device(serial="00000000F1"), device(serial="00000000F2", address=4)]
    usb = bench.facts().usb.of_kind("camera")
    assert serials(pair(usb, [info("f2"), info("00000000f1")])) == [("f1", "00000000f1"), ("f2", "f2")]


def test_what_only_one_side_sees_stands_alone(bench: Any) -> None:
    usb = bench.facts().usb.of_kind("camera")
    assert serials(pair(usb, [])) == [("f0246262", None)]
    assert serials(pair([], [info("f9")])) == [(None, "f9")]
    assert serials(pair(usb, [info("f9")])) == [("f0246262", None), (None, "f9")]


@pytest.mark.parametrize(
    ("there", "matched"),
    [(["f1"], [("", "f1")]), ([], [("", None)]), (["f1", "f2"], [("", None), (None, "f1"), (None, "f2")])],
)
def test_a_camera_without_serial_is_the_one_left_over_or_nobody(
    bench: Any, device: Any, there: list[str], matched: list[tuple[str | None, str | None]]
) -> None:
    bench.usb.devices = [device(serial="", port_numbers=None)]
    assert serials(pair(bench.facts().usb.of_kind("camera"), [info(serial) for serial in there])) == matched


def test_a_pair_tells_the_better_of_both(bench: Any) -> None:
    [both] = bench.facts().pairs
    assert (both.name, both.serial, both.firmware) == ("Intel RealSense L515", "f0246262", "01.05.08.01")
    assert (both.link, both.is_slow, both.label) == ("5 Gbit/s (USB 3)", False, "L515 f0246262 at 2-1")
    alone = Pair(both.usb, None)
    assert (alone.name, alone.serial, alone.firmware) == ("L515", "f0246262", "1.5.8")
    seen = Pair(None, info("f1", usb="2.1"))
    assert (seen.link, seen.is_slow, seen.label) == ("USB 2.1", True, "Intel RealSense L515 f1")


def test_a_camera_in_recovery_mode_is_no_pair(bench: Any, device: Any) -> None:
    bench.usb.devices = [device(0x0B55)]
    facts: Facts = bench.facts()
    assert [one.usb for one in facts.pairs] == [None]
