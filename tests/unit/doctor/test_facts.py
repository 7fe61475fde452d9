from typing import Any
from unittest.mock import Mock

import pytest

from nlos_cam.camera.l515 import DeviceInfo
from nlos_cam.doctor.facts import Pair, gather_facts, match_devices, query_sdk
from nlos_cam.errors import CameraError


def info(serial: str, name: str = "Intel RealSense L515", usb: str = "3.2") -> DeviceInfo:
    return DeviceInfo(name, serial, "01.05.08.01", usb)


def serials(pairs: list[Pair]) -> list[tuple[str | None, str | None]]:
    return [(one.usb and one.usb.serial, one.sdk and one.sdk.serial) for one in pairs]


def test_gather_asks_this_machine() -> None:
    facts = gather_facts()
    assert facts.sdk.load_error == ""
    assert ("pyrealsense2", facts.sdk.version) in facts.sdk.packages


def test_sdk_facts_hold_version_and_devices(bench: Any, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("9", name="Intel RealSense D435"))
    sdk = bench.facts().sdk
    assert sdk.version == "2.54.2.5684"
    assert [one.serial for one in sdk.devices] == ["f0246262", "9"]
    assert [one.serial for one in sdk.lidars] == ["f0246262"]
    assert sdk.error == ""
    bench.installed["PyRealSense2-beta"] = "2.56.0"
    assert bench.facts().sdk.version == ""  # of two packages, none is known
    assert len(bench.facts().sdk.packages) == 2


def test_failed_import_keeps_the_cause_without_advice(bench: Any) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    sdk = bench.facts().sdk
    assert sdk.load_error == sdk.error == "No module named 'pyrealsense2'"
    assert sdk.devices == ()
    assert query_sdk(Mock(side_effect=CameraError("no such luck")), list).load_error == "no such luck"


def test_sdk_that_cannot_list_devices_keeps_the_error(bench: Any) -> None:
    fail = Mock(side_effect=RuntimeError("failed to set power state"))
    for sdk in (Mock(context=lambda: Mock(query_devices=fail)), Mock(context=fail)):
        bench.load_sdk = lambda sdk=sdk: sdk
        assert "failed to set power state" in bench.facts().sdk.query_error
    bench.load_sdk = object  # a folder of the wheel's name
    assert "attribute" in bench.facts().sdk.query_error


def test_pair_matches_serials_whatever_their_zeros(bench: Any, device: Any) -> None:
    usb = bench.facts().usb.of_kind("camera")
    assert serials(match_devices(usb, [])) == [("f0246262", None)]
    assert serials(match_devices([], [info("f9")])) == [(None, "f9")]
    assert serials(match_devices(usb, [info("f9")])) == [("f0246262", None), (None, "f9")]
    bench.usb.devices = [device(serial="00000000F1"), device(serial="00000000F2", address=4)]
    usb = bench.facts().usb.of_kind("camera")
    assert serials(match_devices(usb, [info("f2"), info("00000000f1")])) == [("f1", "00000000f1"), ("f2", "f2")]
    bench.put_on_usb(0x0B55)
    assert [one.usb for one in bench.facts().pairs] == [None]  # one in recovery mode is no camera


@pytest.mark.parametrize(
    ("there", "matched"),
    [(["f1"], [("", "f1")]), ([], [("", None)]), (["f1", "f2"], [("", None), (None, "f1"), (None, "f2")])],
)
def test_pair_gives_the_last_device_to_a_camera_without_serial(
    bench: Any, device: Any, there: list[str], matched: list[tuple[str | None, str | None]]
) -> None:
    bench.usb.devices = [device(serial="", port_numbers=None)]
    assert serials(match_devices(bench.facts().usb.of_kind("camera"), [info(serial) for serial in there])) == matched


def test_pair_prefers_what_the_sdk_reports(bench: Any) -> None:
    [both] = bench.facts().pairs
    assert (both.name, both.serial, both.firmware) == ("Intel RealSense L515", "f0246262", "01.05.08.01")
    assert (both.link, both.is_slow, both.label) == ("5 Gbit/s (USB 3)", False, "L515 f0246262 at 2-1")
    alone = Pair(both.usb, None)
    assert (alone.name, alone.serial, alone.firmware) == ("L515", "f0246262", "1.5.8")
    seen = Pair(None, info("f1", usb="2.1"))
    assert (seen.link, seen.is_slow, seen.label) == ("USB 2.1", True, "Intel RealSense L515 f1")
