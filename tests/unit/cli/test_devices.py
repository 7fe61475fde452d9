import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import usb.core
from fake_bench import Bench, fake_device
from fake_lidar import FakeLidar

from nlos_cam.doctor.diagnosis import CHECKS
from nlos_cam.doctor.udev import rules_text

Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def on_bench(monkeypatch: pytest.MonkeyPatch, bench: Bench) -> None:
    monkeypatch.setattr("nlos_cam.doctor.gather_facts", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")


USB_FIELDS = [
    *("id", "kind", "meaning", "serial", "product", "firmware", "usb_type", "link"),
    *("port", "bus", "address", "interfaces", "error", "sdk_seen"),
]


@pytest.fixture
def three_cameras(bench: Bench) -> Bench:
    """The bench's L515, a D435 that only the SDK lists, and an L515 in recovery mode on USB."""
    bench.sdk_devices.append(FakeLidar("123", name="Intel RealSense D435"))
    bench.usb.devices.append(fake_device(0x0B55, serial="", port_numbers=(2,)))
    return bench


@pytest.mark.usefixtures("three_cameras")
def test_devices_json_lists_cameras_by_their_uri(run: Run) -> None:
    result = run("devices")
    found = result["devices"]

    assert list(result) == ["devices", "usb", "sdk_error", "usb_error"]
    assert [one["uri"] for one in found] == ["l515:f0246262", "", "sim", "sim:bare-wall"]
    assert [one["simulated"] for one in found] == [False, False, True, True]
    assert [one["usb_seen"] for one in found] == [True, None, None, None]
    assert {"name", "serial", "firmware", "usb_type"} < set(found[0])


@pytest.mark.usefixtures("three_cameras")
def test_devices_json_lists_cameras_on_usb(run: Run) -> None:
    one, other = run("devices")["usb"]

    assert list(one) == USB_FIELDS
    assert one["id"] == "8086:0b64"
    assert one["serial"] == "f0246262"
    assert one["firmware"] == "1.5.8"
    assert one["sdk_seen"] is True
    assert one["interfaces"] == ["hid", "video", "vendor"]
    assert (other["id"], other["kind"], other["sdk_seen"]) == ("8086:0b55", "recovery", None)


def test_devices_table_lists_cameras_of_both_sides(shown: Run, three_cameras: Bench) -> None:
    three_cameras.usb.devices[1] = fake_device(0x0AD3, serial="77", port_numbers=(2,))
    table = shown("devices").out
    for word in (
        "l515:f0246262",
        "01.05.08.01",
        "5 Gbit/s (USB 3)",
        "D435",
        "RealSense D415",
        "sim:bare-wall",
    ):
        assert word in table

    assert "doctor" not in table


def test_camera_seen_by_one_side_points_to_the_doctor(run: Run, shown: Run, bench: Bench) -> None:
    def row() -> list[str]:
        return next(
            line for line in shown("devices").out.splitlines() if "f0246262" in line
        ).split()

    assert row()[-2:] == ["yes", "yes"]

    bench.hide()

    assert run("devices")["usb"][0]["sdk_seen"] is False
    assert row()[-2:] == ["no", "yes"]
    assert shown("devices").out.count("nlos-cam doctor") == 1

    bench.show()
    bench.usb.devices.clear()

    assert run("devices")["devices"][0]["usb_seen"] is False
    assert "nlos-cam doctor" in shown("devices").out

    bench.hide()

    assert "no l515" in shown("devices").out.lower()


def test_devices_lists_usb_and_simulation_without_the_sdk(
    run: Run, shown: Run, bench: Bench
) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    found = run("devices")
    table = shown("devices").out

    assert [one["uri"] for one in found["devices"]] == ["sim", "sim:bare-wall"]
    assert [one["sdk_seen"] for one in found["usb"]] == [None]
    assert found["sdk_error"] == "No module named 'pyrealsense2'"
    assert found["sdk_error"] in table
    assert next(line for line in table.splitlines() if "f0246262" in line).split()[-2] not in {
        "yes",
        "no",
    }


def test_devices_lists_the_sdk_without_usb(run: Run, shown: Run, bench: Bench) -> None:
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    found = run("devices")

    assert (found["devices"][0]["uri"], found["devices"][0]["usb_seen"]) == ("l515:f0246262", None)
    assert found["usb_error"] == "No backend available"
    assert found["usb_error"] in shown("devices").out


def test_doctor_json_lists_every_check(run: Run, shown: Run, bench: Bench) -> None:
    found = run("doctor")

    assert found["ok"]
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    assert all(list(check) == ["name", "status", "detail", "fix"] for check in found["checks"])

    bench.unplug()

    assert shown("doctor", "--json").err == ""  # a failed check is no error of the command

    found = run("doctor")

    assert not found["ok"]
    assert [check["name"] for check in found["checks"] if check["status"] == "failed"] == [
        "usb-camera"
    ]


def test_doctor_prints_checks_and_each_fix_on_a_line(shown: Run, bench: Bench) -> None:
    assert "in-use: " not in shown("doctor").out

    bench.linux.process(41, "cheese[1]", "/dev/video30")
    out = shown("doctor").out

    assert all(name in out for name in CHECKS)
    assert "cheese[1] (pid 41)" in out

    [fix] = [line for line in out.splitlines() if line.strip().startswith("in-use: ")]

    assert "`kill 41`" in fix
    assert f"1 of {len(CHECKS)}" in out


def test_doctor_writes_udev_rules_and_installation(
    shown: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "99-l515.rules"
    out, err = shown("doctor", "--write-udev", path, "--json")

    assert path.read_text(encoding="utf-8") == rules_text()
    assert f"sudo install -m 644 {path} /etc/udev/rules.d/" in err.replace("\n", "")
    assert json.loads(out.splitlines()[-1])["ok"]

    path.write_text("mine", encoding="utf-8")

    assert "--overwrite" in shown("doctor", "--write-udev", path, code=1).err
    assert path.read_text(encoding="utf-8") == "mine"

    shown("doctor", "--write-udev", path, "--overwrite")

    assert path.read_text(encoding="utf-8") == rules_text()

    monkeypatch.setattr(
        Path, "write_text", Mock(side_effect=PermissionError(13, "Permission denied"))
    )

    assert "Permission denied" in shown("doctor", "--write-udev", tmp_path / "a.rules", code=1).err
