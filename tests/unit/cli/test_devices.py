import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import usb.core
from fake_bench import Bench, fake_device

from nlos_cam.cli.main import main
from nlos_cam.doctor.diagnosis import CHECKS
from nlos_cam.doctor.udev import rules_text

Run = Callable[..., tuple[str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bench: Bench) -> Run:
    """Run a command on the bench, assert its exit code, and return stdout and stderr."""
    monkeypatch.setattr("nlos_cam.doctor.gather_facts", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")

    def act(*arguments: str, code: int = 0) -> tuple[str, str]:
        assert main(list(arguments)) == code
        return capsys.readouterr()

    return act


def listed(run: Run) -> str:
    return run("devices")[0]


def json_of(run: Run, command: str = "devices") -> dict[str, Any]:
    return json.loads(run(command, "--json")[0].splitlines()[-1])


def test_devices_json_lists_usb_and_sdk(run: Run, bench: Bench, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    bench.usb.devices.append(fake_device(0x0B55, serial="", port_numbers=(2,)))
    made = json_of(run)
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


def test_devices_table_lists_usb_and_sdk(run: Run, bench: Bench, fake_l515: Any) -> None:
    bench.sdk_devices.append(fake_l515("123", name="Intel RealSense D435"))
    bench.usb.devices.append(fake_device(0x0AD3, serial="77", port_numbers=(2,)))
    shown = listed(run)
    for word in ("l515:f0246262", "01.05.08.01", "5 Gbit/s (USB 3)", "D435", "RealSense D415", "sim:bare-wall"):
        assert word in shown
    assert "doctor" not in shown


def test_camera_seen_by_one_side_points_to_the_doctor(run: Run, bench: Bench) -> None:
    def row() -> list[str]:
        return next(line for line in listed(run).splitlines() if "f0246262" in line).split()

    assert row()[-2:] == ["yes", "yes"]
    bench.hide()
    assert json_of(run)["usb"][0]["sdk_seen"] is False
    assert row()[-2:] == ["no", "yes"]
    assert listed(run).count("nlos-cam doctor") == 1
    bench.show()
    bench.usb.devices.clear()
    assert json_of(run)["devices"][0]["usb_seen"] is False
    assert "nlos-cam doctor" in listed(run)
    bench.hide()
    assert "no l515" in listed(run).lower()


def test_devices_lists_usb_and_simulation_without_the_sdk(run: Run, bench: Bench) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    found = json_of(run)
    assert [one["uri"] for one in found["devices"]] == ["sim", "sim:bare-wall"]
    assert [one["sdk_seen"] for one in found["usb"]] == [None]
    assert found["sdk_error"] == "No module named 'pyrealsense2'"
    shown = listed(run)
    assert "No module named 'pyrealsense2'" in shown
    assert next(line for line in shown.splitlines() if "f0246262" in line).split()[-2] not in {"yes", "no"}


def test_devices_lists_the_sdk_without_usb(run: Run, bench: Bench) -> None:
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    found = json_of(run)
    assert (found["devices"][0]["uri"], found["devices"][0]["usb_seen"]) == ("l515:f0246262", None)
    assert found["usb_error"] == "No backend available"
    assert "No backend available" in listed(run)


def test_doctor_json_lists_every_check(run: Run, bench: Bench) -> None:
    found = json_of(run, "doctor")
    assert found["ok"]
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    assert all(list(check) == ["name", "status", "detail", "fix"] for check in found["checks"])
    bench.unplug()
    out, err = run("doctor", "--json")
    found = json.loads(out.splitlines()[-1])
    assert (found["ok"], err) == (False, "")  # a failed check is no error of the command
    assert [check["name"] for check in found["checks"] if check["status"] == "failed"] == ["usb-camera"]


def test_doctor_prints_checks_and_each_fix_on_a_line(run: Run, bench: Bench) -> None:
    healthy, _ = run("doctor")
    bench.linux.process(41, "cheese[1]", "/dev/video30")
    out, _ = run("doctor")
    assert all(name in out for name in CHECKS)
    assert "cheese[1] (pid 41)" in out
    [fix] = [line for line in out.splitlines() if line.strip().startswith("in-use: ")]
    assert "`kill 41`" in fix
    assert f"1 of {len(CHECKS)}" in out
    assert "in-use: " not in healthy


def test_doctor_writes_udev_rules_and_how_to_install_them(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "99-l515.rules"
    out, err = run("doctor", "--write-udev", str(path), "--json")
    assert path.read_text(encoding="utf-8") == rules_text()
    assert f"sudo install -m 644 {path} /etc/udev/rules.d/" in err.replace("\n", "")
    assert json.loads(out.splitlines()[-1])["ok"]
    path.write_text("mine", encoding="utf-8")
    assert "--overwrite" in run("doctor", "--write-udev", str(path), code=1)[1]
    assert path.read_text(encoding="utf-8") == "mine"
    run("doctor", "--write-udev", str(path), "--overwrite")
    assert path.read_text(encoding="utf-8") == rules_text()


def test_doctor_reports_rules_that_cannot_be_written(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_text", Mock(side_effect=PermissionError(13, "Permission denied")))
    assert "Permission denied" in run("doctor", "--write-udev", str(tmp_path / "a.rules"), code=1)[1]
