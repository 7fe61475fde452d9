import json
from collections.abc import Callable
from typing import Any

import pytest
import usb.core

from nlos_cam.cli import devices

Listed = Callable[..., str]


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bench: Any) -> Listed:
    """What the command prints of the bench."""
    monkeypatch.setattr(devices, "gather", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")

    def run(*, as_json: bool = False) -> str:
        devices.devices(json=as_json)
        return capsys.readouterr().out

    return run


def told(listed: Listed) -> dict[str, Any]:
    return json.loads(listed(as_json=True).splitlines()[-1])


def test_every_device_is_listed_with_what_to_ask_for(listed: Listed, bench: Any, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    found = told(listed)["devices"]
    assert [one["uri"] for one in found] == ["l515:f0246262", "", "sim", "sim:bare-wall"]
    assert [one["simulated"] for one in found] == [False, False, True, True]
    assert [one["usb_seen"] for one in found] == [True, None, None, None]
    assert {"name", "serial", "firmware", "usb_type"} < set(found[0])


def test_what_usb_sees_is_listed_beside_it(listed: Listed, bench: Any, device: Any) -> None:
    bench.usb.devices.append(device(0x0B55, serial="", port_numbers=(2,)))
    one, other = told(listed)["usb"]
    assert (one["id"], one["serial"], one["firmware"], one["sdk_seen"]) == ("8086:0b64", "f0246262", "1.5.8", True)
    assert one["interfaces"] == ["hid", "video", "vendor"]
    assert (other["id"], other["kind"], other["sdk_seen"]) == ("8086:0b55", "recovery", None)


def test_the_names_of_the_json_are_fixed(listed: Listed) -> None:
    found = told(listed)
    assert list(found) == ["devices", "usb", "sdk_error", "usb_error"]
    names = "id kind meaning serial product firmware usb_type link port bus address interfaces error sdk_seen"
    assert list(found["usb"][0]) == names.split()


def test_a_person_is_told_the_same(listed: Listed, bench: Any, fake_l515: Any, device: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    bench.usb.devices.append(device(0x0AD3, serial="77", port_numbers=(2,)))
    shown = listed()
    for word in ("l515:f0246262", "01.05.08.01", "5 Gbit/s (USB 3)", "D435", "RealSense D415", "sim:bare-wall"):
        assert word in shown
    assert "doctor" not in shown


def test_a_camera_that_only_usb_sees_points_to_the_doctor(listed: Listed, bench: Any) -> None:
    bench.sdk_devices.clear()
    assert told(listed)["usb"][0]["sdk_seen"] is False
    shown = listed()
    assert "f0246262" in shown
    assert shown.count("nlos-cam doctor") == 1


def test_a_camera_that_only_the_sdk_sees_points_to_the_doctor(listed: Listed, bench: Any) -> None:
    bench.usb.devices.clear()
    assert told(listed)["devices"][0]["usb_seen"] is False
    assert "nlos-cam doctor" in listed()


def test_the_columns_say_who_sees_a_camera(listed: Listed, bench: Any) -> None:
    def row() -> list[str]:
        return next(line for line in listed().splitlines() if "f0246262" in line).split()

    assert row()[-2:] == ["yes", "yes"]
    bench.sdk_devices.clear()
    assert row()[-2:] == ["no", "yes"]
    bench.sdk_error = ImportError("no such module")
    assert row()[-2:] == ["3)", "yes"]  # nobody asked the SDK


def test_no_device_is_said(listed: Listed, bench: Any) -> None:
    bench.unplug()
    assert "no L515 is seen" in listed()


def test_without_the_sdk_usb_and_simulation_are_still_listed(listed: Listed, bench: Any) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    found = told(listed)
    assert [one["uri"] for one in found["devices"]] == ["sim", "sim:bare-wall"]
    assert [one["sdk_seen"] for one in found["usb"]] == [None]
    assert found["sdk_error"] == "No module named 'pyrealsense2'"
    assert "No module named 'pyrealsense2'" in listed()


def test_without_usb_the_sdks_devices_are_still_listed(listed: Listed, bench: Any) -> None:
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    found = told(listed)
    assert (found["devices"][0]["uri"], found["devices"][0]["usb_seen"]) == ("l515:f0246262", None)
    assert found["usb_error"] == "No backend available"
    assert "USB cannot be looked at" in listed()
