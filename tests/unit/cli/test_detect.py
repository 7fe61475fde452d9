"""Laws of `nlos-cam detect`: hands at a terminal, stored turns, wrong folders."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_turns import made_plan, made_turns, patch_effect

from nlos_cam.cli.detect import TerminalHands
from nlos_cam.detect import Session
from nlos_cam.errors import NlosCamError

Run = Callable[..., Any]


def stored(folder: Path, turns: int = 32) -> Path:
    """Write a session whose object changes the depth of some cells by 1 mm."""
    plan = made_plan(turns=turns)
    session = Session.start(folder, plan)
    for number, turn in enumerate(made_turns(plan, effect=patch_effect(1e-3, 5))):
        turn.save(session.path(number))
    return folder


def test_stored_turns_are_analyzed_again(run: Run, tmp_path: Path) -> None:
    answer = run("detect", stored(tmp_path / "session"))
    assert answer["detected"]
    assert answer["p_value"] <= 0.01
    assert answer["findings"][0]["channel"] == "depth"
    assert Path(answer["out"]).read_text(encoding="utf-8").count("data:image/png") == 1


def test_unfinished_session_is_no_detection(run: Run, tmp_path: Path) -> None:
    folder = stored(tmp_path / "session", turns=40)
    (folder / "turn-0038.npz").unlink()
    answer = run("detect", folder)
    assert not answer["detected"]
    assert not answer["complete"]


def test_wrong_folder_is_one_line_with_exit_code_4(run: Run, tmp_path: Path) -> None:
    answer = run("detect", tmp_path, code=4)
    assert "is not a detection" in answer.err


def test_recording_has_no_turns(run: Run) -> None:
    assert "without turns" in run("detect", "run.bag", code=2).err


def test_terminal_asks_for_each_turn_until_stdin_ends(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = iter(["\n", ""])
    hands = TerminalHands(made_plan(control=True), lambda: next(lines))
    hands.place(0, object_in=True)
    assert "Turn 1 of 32" in capsys.readouterr().err
    with pytest.raises(NlosCamError, match="stdin ended"):
        hands.place(1, object_in=False)
