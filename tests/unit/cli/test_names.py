"""Names of files that a terminal would obey, that are no UTF-8, or that are links to nowhere."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.calibrate.files import WallFiles
from nlos_cam.camera.recorder import SdkRecorder
from nlos_cam.cli import common
from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.files import atomic_directory
from nlos_cam.recording.bag_reader import SAMPLE

Run = Callable[..., Any]
OBEYED = "a\x1b[2J\x07\u202eb"
FOREIGN = os.fsdecode(b"\xff.bag")
PLAIN_LOCALE = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
PROGRAM = "from nlos_cam.cli import run; run()"


@pytest.fixture
def nowhere(tmp_path: Path) -> Path:
    """Link to a file that does not exist."""
    link = tmp_path / "link.toml"
    link.symlink_to("missing")
    return link


def test_error_shows_control_characters_as_escapes(shown: Run) -> None:
    error = shown("info", f"{OBEYED}.bag", code=4).err

    assert r"a\x1b[2J\x07\u202eb.bag" in error
    assert "\x1b" not in error


def test_result_shows_control_characters_as_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    common.finish({}, as_json=False, text=f"Wrote {OBEYED} {FOREIGN}\nä")
    assert capsys.readouterr().out == "Wrote a\\x1b[2J\\x07\\u202eb \\udcff.bag\nä\n"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
@pytest.mark.slow
def test_foreign_name_works_in_a_plain_locale(tmp_path: Path) -> None:
    (tmp_path / FOREIGN).write_bytes(SAMPLE.read_bytes())
    ended = subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, "info", FOREIGN],
        env={**os.environ, **PLAIN_LOCALE},
        capture_output=True,
        check=False,
    )

    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith(b"\\udcff.bag: recording")


def test_recorder_refuses_a_name_that_is_not_utf8(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="UTF-8"):
        SdkRecorder(tmp_path / FOREIGN, "device", None)


def test_unforeseen_use_of_a_foreign_name_is_one_line(
    shown: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.info.describe", lambda *_, **__: FOREIGN.encode())
    assert "not UTF-8" in shown("info", FOREIGN, code=1).err


def test_output_that_is_a_link_to_nowhere_exists(nowhere: Path) -> None:
    with pytest.raises(OutputExistsError):
        common.output_path(nowhere, "wall", ".toml", overwrite=False)
    assert nowhere.is_symlink()


def test_output_folder_that_is_a_link_to_nowhere_is_refused(nowhere: Path) -> None:
    with pytest.raises(OutputExistsError), atomic_directory(nowhere):
        pass
    assert nowhere.is_symlink()


def test_wall_files_that_are_links_to_nowhere_exist(nowhere: Path) -> None:
    nowhere.with_suffix(".npz").symlink_to("missing")
    with pytest.raises(OutputExistsError):
        WallFiles.beside(nowhere, overwrite=False)
