import json
from collections.abc import Callable
from typing import Any

import pytest
import usb.core
from fake_bench import Bench, fake_device

from nlos_cam.cli import devices

Listed = Callable[..., str]


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bench: Bench) -> Listed:
    """Return what the command prints of the bench."""
    monkeypatch.setattr("nlos_cam.doctor.gather_facts", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")

    def run(*, as_json: bool = False) -> str:
        devices.devices(json=as_json)
        return capsys.readouterr().out

    return run


def json_of(listed: Listed) -> dict[str, Any]:
    return json.loads(listed(as_json=True).splitlines()[-1])


def test_devices_json_lists_usb_and_sdk(listed: Listed, bench: Bench, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    bench.usb.devices.append(fake_device(0x0B55, serial="", port_numbers=(2,)))
    made = json_of(listed)
    assert list(made) == ["devices", "usb", "sdk_error", "usb_error"]
    found = made["devices"]
    assert [one["uri"] for one in found] == ["l515:f0246262", "", "sim", "sim:bare-wall"]
    assert [one["simulated"] for one in found] == [False, False, True, True]
    assert [one["usb_seen"] for one in found] == [True, None, None, None]
    assert {"name", "serial", "firmware", "usb_type"} < set(found[0])
    one, other = made["usb"]
    names = "id kind meaning serial product firmware usb_type link port bus address interfaces error sdk_seen"
    assert list(one) == names.split()
    assert (one["id"], one["serial"], one["firmware"], one["sdk_seen"]) == ("8086:0b64", "f0246262", "1.5.8", True)
    assert one["interfaces"] == ["hid", "video", "vendor"]
    assert (other["id"], other["kind"], other["sdk_seen"]) == ("8086:0b55", "recovery", None)


def test_devices_table_lists_usb_and_sdk(listed: Listed, bench: Bench, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    bench.usb.devices.append(fake_device(0x0AD3, serial="77", port_numbers=(2,)))
    shown = listed()
    for word in ("l515:f0246262", "01.05.08.01", "5 Gbit/s (USB 3)", "D435", "RealSense D415", "sim:bare-wall"):
        assert word in shown
    assert "doctor" not in shown


def test_camera_seen_by_one_side_points_to_the_doctor(listed: Listed, bench: Bench) -> None:
    def row() -> list[str]:
        return next(line for line in listed().splitlines() if "f0246262" in line).split()

    assert row()[-2:] == ["yes", "yes"]
    bench.hide()
    assert json_of(listed)["usb"][0]["sdk_seen"] is False
    assert row()[-2:] == ["no", "yes"]
    assert listed().count("nlos-cam doctor") == 1
    bench.show()
    bench.usb.devices.clear()
    assert json_of(listed)["devices"][0]["usb_seen"] is False
    assert "nlos-cam doctor" in listed()
    bench.hide()
    assert "no l515" in listed().lower()


def test_devices_lists_usb_and_simulation_without_the_sdk(listed: Listed, bench: Bench) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    found = json_of(listed)
    assert [one["uri"] for one in found["devices"]] == ["sim", "sim:bare-wall"]
    assert [one["sdk_seen"] for one in found["usb"]] == [None]
    assert found["sdk_error"] == "No module named 'pyrealsense2'"
    shown = listed()
    assert "No module named 'pyrealsense2'" in shown
    assert next(line for line in shown.splitlines() if "f0246262" in line).split()[-2] not in {"yes", "no"}


def test_devices_lists_the_sdk_without_usb(listed: Listed, bench: Bench) -> None:
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    found = json_of(listed)
    assert (found["devices"][0]["uri"], found["devices"][0]["usb_seen"]) == ("l515:f0246262", None)
    assert found["usb_error"] == "No backend available"
    assert "No backend available" in listed()
