import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.cli import devices
from nlos_cam.cli.main import main
from nlos_cam.doctor.diagnosis import CHECKS
from nlos_cam.doctor.udev import rules

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bench: Any) -> Run:
    """The command on the bench: exit code, stdout and stderr."""
    monkeypatch.setattr(devices, "gather", bench.facts)
    monkeypatch.setenv("COLUMNS", "160")

    def act(*arguments: str) -> tuple[int, str, str]:
        code = main(["doctor", *arguments])
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return act


def test_a_healthy_bench_is_ok(run: Run) -> None:
    code, out, _ = run("--json")
    found = json.loads(out.splitlines()[-1])
    assert (code, found["ok"]) == (0, True)
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    assert all(list(check) == ["name", "status", "detail", "fix"] for check in found["checks"])


def test_a_failure_is_no_error_of_the_command(run: Run, bench: Any) -> None:
    bench.unplug()
    code, out, err = run("--json")
    found = json.loads(out.splitlines()[-1])
    assert (code, found["ok"], err) == (0, False, "")
    assert [check["name"] for check in found["checks"] if check["status"] == "failed"] == ["usb-camera"]


def test_a_person_sees_every_check_and_each_fix_on_a_line_of_its_own(run: Run, bench: Any) -> None:
    bench.linux.process(41, "cheese[1]", "/dev/video30")
    _, out, _ = run()
    assert all(name in out for name in CHECKS)
    assert "cheese[1] (pid 41)" in out
    assert "in-use: close that program, or `kill 41`\n" in out
    assert f"1 of {len(CHECKS)} checks failed" in out


def test_nothing_to_do_is_said(run: Run) -> None:
    _, out, _ = run()
    assert "nothing failed" in out
    assert "what to do" not in out


def test_the_udev_rules_are_written_with_how_to_install_them(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "99-l515.rules"
    code, out, err = run("--write-udev", str(path), "--json")
    assert (code, path.read_text(encoding="utf-8")) == (0, rules())
    assert f"sudo install -m 644 {path} /etc/udev/rules.d/" in err.replace("\n", "")
    assert json.loads(out.splitlines()[-1])["ok"]


def test_rules_that_are_there_are_kept_unless_told_otherwise(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "99-l515.rules"
    path.write_text("mine", encoding="utf-8")
    code, _, err = run("--write-udev", str(path))
    assert (code, path.read_text(encoding="utf-8")) == (1, "mine")
    assert "--overwrite" in err
    assert run("--write-udev", str(path), "--overwrite")[0] == 0
    assert path.read_text(encoding="utf-8") == rules()


def test_a_place_that_cannot_be_written_is_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "write_text", refuse)
    code, _, err = run("--write-udev", str(tmp_path / "a.rules"))
    assert code == 1
    assert "cannot be written (Permission denied)" in err
