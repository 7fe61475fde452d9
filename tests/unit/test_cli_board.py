import json
from pathlib import Path

import pytest
import typer
from nlos_calibration.board import BOARDS, Board

from nlos_cam.cli import calibrate
from nlos_cam.cli.main import main
from nlos_cam.errors import OutputExistsError


def call(*arguments: str) -> None:
    app = typer.Typer()
    calibrate.register_board(app)
    app(list(arguments), standalone_mode=False)


@pytest.mark.parametrize("paper", BOARDS)
def test_the_json_says_what_was_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str], paper: str) -> None:
    out = tmp_path / "board.pdf"
    call("--out", str(out), "--paper", paper, "--json")
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result.pop("out") == str(out)
    assert out.read_bytes().startswith(b"%PDF")
    assert (result.pop("paper"), len(result.pop("page_mm"))) == (paper, 2)
    assert Board.model_validate(result) == BOARDS[paper]


def test_a_person_is_told_how_to_print_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call("--out", str(tmp_path / "b.pdf"))
    told = capsys.readouterr().out
    for part in ("6 x 9 squares of 30 mm on a4", "100 %", "laser printer", "b.pdf"):
        assert part in told


def test_an_existing_file_is_kept_unless_asked(tmp_path: Path) -> None:
    out = tmp_path / "board.pdf"
    out.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputExistsError):
        call("--out", str(out))
    assert out.read_text(encoding="utf-8") == "mine"
    call("--out", str(out), "--overwrite")
    assert out.read_bytes().startswith(b"%PDF")


def test_a_paper_that_is_not_known_is_wrong_usage(tmp_path: Path) -> None:
    assert main(["board", "--paper", "napkin", "--out", str(tmp_path / "b.pdf")]) == 2
    assert not list(tmp_path.iterdir())
