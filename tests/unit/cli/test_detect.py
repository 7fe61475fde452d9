"""Laws of `nlos-cam detect`: hands at a terminal, stored turns, wrong folders."""

import json
import os
import signal
import termios
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from made_benches import make_bench, wall_of
from made_turns import made_plan, made_turns, patch_effect

from nlos_cam.cli.detect import TerminalHands, read_fresh_line
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


def test_folder_may_be_named_like_a_camera(run: Run, tmp_path: Path) -> None:
    folder = stored(tmp_path / "sim")

    assert "multiple of 4" in run("detect", "sim", "--turns", 18, "--out", folder, code=2).err
    assert run("detect", "./sim")["detected"]


def test_unfinished_session_is_no_detection(run: Run, tmp_path: Path) -> None:
    folder = stored(tmp_path / "session", turns=40)
    (folder / "turn-0038.npz").unlink()
    answer = run("detect", folder)
    assert not answer["detected"]
    assert not answer["complete"]


def test_wrong_folder_is_one_line_with_exit_code_4(run: Run, tmp_path: Path) -> None:
    answer = run("detect", tmp_path, code=4)
    assert "is not a detection" in answer.err


def camera_at_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every camera be one without frames, before a terminal whose stdin ends at once."""

    class Camera(nullcontext[None]):
        uri = "l515"
        identity: dict[str, str] = {}  # noqa: RUF012
        rig = None
        intrinsics = wall_of().record.rig.pinhole

        def __iter__(self) -> Any:
            return iter(())

    def end_of_stdin(*_: Any, **__: Any) -> None:
        raise NlosCamError("stdin ended")

    terminal = SimpleNamespace(isatty=lambda: True)
    monkeypatch.setattr("nlos_cam.camera.open_camera", lambda *_, **__: Camera())
    monkeypatch.setattr("nlos_cam.cli.detect.sys.stdin", terminal)
    monkeypatch.setattr(TerminalHands, "place", end_of_stdin)


@pytest.mark.parametrize("again", [True, False])
def test_signal_after_the_last_turn_names_the_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: bool
) -> None:
    folder = stored(tmp_path / "session")
    camera_at_a_terminal(monkeypatch)

    def interrupted(*_: Any, **__: Any) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("nlos_cam.detect.analyze", interrupted)

    answer = run("detect", *([folder] if again else ["l515", "--out", folder]), code=130)

    assert (f"the turns in {folder}" if again else f"whole turns are in {folder}") in answer.err
    assert "nothing" not in answer.err


def test_unknown_power_is_null_and_said_in_words(
    shown: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = stored(tmp_path / "session")
    monkeypatch.setattr("nlos_cam.detect.analysis.smallest_in_noises", lambda *_: float("inf"))

    line = shown("detect", folder, "--json").out.splitlines()[-1]
    text = shown("detect", folder).out

    found = json.loads(line, parse_constant=pytest.fail)
    assert {each["smallest"] for each in found["findings"]} == {None}
    assert "power was not determined" in text
    page = (folder / "detection.html").read_text(encoding="utf-8")
    assert "power was not determined" in page
    assert "inf mm" not in page
    assert "says nothing about a real L515" in page


def test_wrong_number_of_turns_is_refused_in_one_line(run: Run, tmp_path: Path) -> None:
    err = run("detect", "sim", "--turns", 18, "--out", tmp_path / "s", code=2).err

    assert "error: turns must be a multiple of 4 (got 18)" in err
    assert not (tmp_path / "s").exists()


def test_refused_command_overwrites_no_session(run: Run, tmp_path: Path) -> None:
    session = Session.start(tmp_path / "session", made_plan())

    run("detect", "sim", "--turns", 18, "--out", session.folder, "--overwrite", code=2)

    assert Session.open(session.folder).plan == session.plan


def test_bench_folder_in_place_of_a_camera_names_bench(run: Run, tmp_path: Path) -> None:
    make_bench(tmp_path / "bench")

    err = run("detect", "bench", code=2).err

    assert "`nlos-cam detect l515 --bench bench`" in err


def test_camera_that_cannot_be_swept_overwrites_no_session(run: Run, tmp_path: Path) -> None:
    session = Session.start(tmp_path / "session", made_plan())
    sweep = "--settings", "sweep"

    err = run("detect", "sim:bare-wall", *sweep, "--out", session.folder, "--overwrite", code=3).err

    assert "no options to sweep" in err
    assert Session.open(session.folder).plan == session.plan


def test_session_of_another_seed_is_refused(run: Run, tmp_path: Path) -> None:
    session = Session.start(tmp_path / "session", made_plan(seed=3, camera="sim:bare-wall"))
    session.path(0).write_bytes(b"measured")

    err = run("detect", "sim:bare-wall", "--seed", 4, "--out", session.folder, code=2).err

    assert "the session that goes on (seed 3)" in err
    assert session.path(0).read_bytes() == b"measured"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--turns", 36), "another turns (32, not 36)"),
        (("--frames", 31), "another frames (30, not 31)"),
        (("--alpha", 0.05), "another alpha (0.01, not 0.05)"),
        (("--control",), "another control:"),
    ],
)
def test_another_plan_is_refused_before_a_camera_is_open(
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[Any, ...],
    words: str,
) -> None:
    session = Session.start(tmp_path / "session", made_plan(frames=30, turns=32))
    opened = Mock()
    monkeypatch.setattr("nlos_cam.camera.open_camera", opened)

    err = run("detect", "l515", *options, "--out", session.folder, code=4).err

    assert words in err
    assert not opened.called


@pytest.mark.parametrize("words", [["l515", "--bench", "bench"], ["bench", "--camera", "l515"]])
def test_new_session_keeps_the_name_of_its_bench(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    make_bench(tmp_path / "bench")
    camera_at_a_terminal(monkeypatch)

    assert "stdin ended" in run("detect", *words, "--out", "session", code=1).err

    plan = Session.open(tmp_path / "session").plan
    assert plan.rig is not None
    assert plan.rig_option == "--bench bench"


def test_occluder_that_was_not_measured_is_noted(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = make_bench(tmp_path / "bench") / "stations/main/wall.toml"
    camera_at_a_terminal(monkeypatch)

    err = run("detect", "l515", "--wall", bare, "--out", "session", code=1).err

    assert "note: the occluder has not been measured" in err


@pytest.mark.parametrize(
    "ignored",
    [
        ["--wall", "wall.toml"],
        ["--bench", "bench"],
        ["--turns", "64"],
        ["--frames", "2"],
        ["--alpha", "0.05"],
        ["--settings", "as-started"],
        ["--control"],
        ["--seed", "0"],
        ["--out", "other"],
    ],
)
def test_stored_turns_refuse_options_of_a_measurement(
    run: Run, tmp_path: Path, ignored: list[str]
) -> None:
    Session.start(tmp_path / "session", made_plan())

    err = run("detect", "session", *ignored, code=1).err

    assert f"{ignored[0]} would have no effect" in err


def test_recording_has_no_turns(run: Run) -> None:
    assert "without turns" in run("detect", "run.bag", code=2).err


def test_enter_during_a_turn_answers_no_later_question(monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard, terminal = os.openpty()
    os.write(keyboard, b"early\n")
    flush = termios.tcflush

    def typed_after(*queue: int) -> None:
        flush(*queue)
        os.write(keyboard, b"late\n")

    monkeypatch.setattr(termios, "tcflush", typed_after)
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("nlos_cam.cli.detect.sys.stdin", stdin)
        assert read_fresh_line() == "late\n"
    os.close(keyboard)


def test_terminal_asks_for_each_turn_until_stdin_ends(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = iter(["\n", ""])
    hands = TerminalHands(made_plan(control=True), Path("a session"), lambda: next(lines))
    hands.place(0, object_in=True)
    assert "Turn 1 of 32" in capsys.readouterr().err
    with pytest.raises(NlosCamError, match="stdin ended") as refused:
        hands.place(1, object_in=False)

    assert str(refused.value).endswith("without --overwrite, goes on with --out 'a session'")
