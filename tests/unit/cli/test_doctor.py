import json
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from fake_bench import Bench

from nlos_cam.cli.main import main
from nlos_cam.doctor.diagnosis import CHECKS
from nlos_cam.doctor.udev import rules_text

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bench: Bench) -> Run:
    """Run the command on the bench; returns exit code, stdout and stderr."""
    monkeypatch.setattr("nlos_cam.doctor.gather_facts", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")

    def act(*arguments: str) -> tuple[int, str, str]:
        code = main(["doctor", *arguments])
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return act


def test_doctor_json_lists_every_check(run: Run, bench: Bench) -> None:
    code, out, _ = run("--json")
    found = json.loads(out.splitlines()[-1])
    assert (code, found["ok"]) == (0, True)
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    assert all(list(check) == ["name", "status", "detail", "fix"] for check in found["checks"])
    bench.unplug()
    code, out, err = run("--json")
    found = json.loads(out.splitlines()[-1])
    assert (code, found["ok"], err) == (0, False, "")  # a failed check is no error of the command
    assert [check["name"] for check in found["checks"] if check["status"] == "failed"] == ["usb-camera"]


def test_doctor_prints_checks_and_each_fix_on_a_line(run: Run, bench: Bench) -> None:
    _, healthy, _ = run()
    bench.linux.process(41, "cheese[1]", "/dev/video30")
    _, out, _ = run()
    assert all(name in out for name in CHECKS)
    assert "cheese[1] (pid 41)" in out
    [fix] = [line for line in out.splitlines() if line.strip().startswith("in-use: ")]
    assert "`kill 41`" in fix
    assert f"1 of {len(CHECKS)}" in out
    assert "in-use: " not in healthy


def test_doctor_writes_udev_rules_and_how_to_install_them(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "99-l515.rules"
    code, out, err = run("--write-udev", str(path), "--json")
    assert (code, path.read_text(encoding="utf-8")) == (0, rules_text())
    assert f"sudo install -m 644 {path} /etc/udev/rules.d/" in err.replace("\n", "")
    assert json.loads(out.splitlines()[-1])["ok"]
    path.write_text("mine", encoding="utf-8")
    code, _, err = run("--write-udev", str(path))
    assert (code, path.read_text(encoding="utf-8")) == (1, "mine")
    assert "--overwrite" in err
    assert run("--write-udev", str(path), "--overwrite")[0] == 0
    assert path.read_text(encoding="utf-8") == rules_text()


def test_doctor_reports_rules_that_cannot_be_written(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_text", Mock(side_effect=PermissionError(13, "Permission denied")))
    code, _, err = run("--write-udev", str(tmp_path / "a.rules"))
    assert code == 1
    assert "Permission denied" in err
