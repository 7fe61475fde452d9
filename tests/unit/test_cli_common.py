"""Where commands write: nowhere that would lose something."""

import os
from pathlib import Path

import pytest

from nlos_cam.cli.common import finish, output_path, say
from nlos_cam.errors import OutputExistsError


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_does_not_give_way_to_a_folder(tmp_path: Path, *, overwrite: bool) -> None:
    out = tmp_path / "figures"
    out.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputExistsError, match="figures is a file, and a folder is what is written"):
        output_path(out, "figures", "", overwrite=overwrite)


def test_a_folder_that_cannot_be_written_to_is_told_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who runs the tests may be somebody who may write anywhere, so the system's answer is given here."""
    out = tmp_path / "wall.toml"
    assert output_path(out, "wall", ".toml", overwrite=False) == out

    def access(path: Path, mode: int) -> bool:
        return not (path == tmp_path and mode == os.W_OK)

    monkeypatch.setattr(os, "access", access)
    with pytest.raises(OutputExistsError, match=r"wall\.toml cannot be written to"):
        output_path(out, "wall", ".toml", overwrite=True)


def test_what_is_told_is_told_whole_unless_it_is_marked(capsys: pytest.CaptureFixture[str]) -> None:
    finish({}, as_json=False, text="wrote runs/[bold]x")
    finish({}, as_json=False, text="[bold]good[/]", marked=True)
    say("kept in [red]")
    told = capsys.readouterr()
    assert told.out == "wrote runs/[bold]x\ngood\n"
    assert told.err == "kept in [red]\n"
