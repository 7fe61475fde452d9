"""Laws of a session: resumed equals unbroken, half of the turns have the object, wrong folders."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_turns import made_plan, made_turns
from nlos_calibration import load_rig

from nlos_cam.detect import (
    SETTLING_FRAMES,
    Session,
    analyze,
    measure_turns,
    setting_as_started,
    swept_settings,
    write_report,
)
from nlos_cam.detect.session import PLAN
from nlos_cam.errors import (
    CameraError,
    CameraLostError,
    NlosCamError,
    OutputExistsError,
    RecordingError,
)
from nlos_cam.frames import Frame

PINHOLE = load_rig("bare-wall").pinhole.scaled(80, 64)


class FakeCamera:
    """Camera of small frames whose noise depends on the frame's number alone."""

    uri = "l515"
    limit = 10_000

    def __init__(self, first: int = 0) -> None:
        self.number = first
        self.present = False
        self.options = {"laser_power": 100.0, "min_distance": 0.0}

    def __iter__(self) -> Iterator[Frame]:
        while self.number < self.limit:
            generator = np.random.default_rng(self.number)
            depth = 0.25 + 1e-3 * self.present + 1e-3 * generator.standard_normal((64, 80))
            image = np.full((64, 80), 40, np.uint8)
            yield Frame(depth.astype(np.float32), image, image, self.number / 30, 0, PINHOLE)
            self.number += 1

    def telemetry(self, ending: str = "") -> dict[str, float]:
        return {f"ldd{ending}": 40.0}

    def place(self, turn: int, *, object_in: bool) -> None:
        del turn
        self.present = object_in

    def adjustable(self) -> list[dict[str, Any]]:
        return [
            {"name": name, "value": value, "min": 0.0, "max": 100.0, "step": 1.0}
            for name, value in self.options.items()
        ]

    def set_option(self, name: str, value: float) -> str:
        self.options[name] = value
        return name


def measured(session: Session, camera: Any) -> None:
    measure_turns(session, camera, camera)


def test_resumed_session_equals_an_unbroken_one(tmp_path: Path) -> None:
    plan = made_plan(frames=3)
    whole = Session.start(tmp_path / "whole", plan)
    measured(whole, FakeCamera())

    broken = Session.start(tmp_path / "broken", plan)
    camera = FakeCamera()
    camera.limit = 10 * (3 + SETTLING_FRAMES)  # the eleventh turn has no frame
    with pytest.raises(CameraLostError):
        measured(broken, camera)
    assert broken.missing()[0] == 10
    # The other plan's seed is not used: the order is that of the session that exists.
    again = Session.start(tmp_path / "broken", made_plan(7, frames=3))
    measured(again, FakeCamera(camera.limit))
    for one, other in zip(whole.turns(), again.turns(), strict=True):
        assert one.object_in == other.object_in
        np.testing.assert_array_equal(one.mean, other.mean)


def test_block_with_a_deleted_turn_is_measured_again_as_a_whole(tmp_path: Path) -> None:
    """Turns of two days in a block would leave nothing of the object beside the drift."""
    session = Session.start(tmp_path / "s", made_plan(frames=2))
    measured(session, FakeCamera())
    last = session.plan.turns - 1
    for turn in (1, 2, last):
        session.path(turn).unlink()

    assert session.missing() == [0, 1, 2, 3, last]

    camera = FakeCamera(5000)
    camera.limit = 5000 + 2 * (2 + SETTLING_FRAMES)  # the third one has no frame
    with pytest.raises(CameraLostError):
        measured(session, camera)

    assert session.missing() == [2, 3, last]


def test_session_that_begins_again_keeps_other_files(tmp_path: Path) -> None:
    session = Session.start(tmp_path, made_plan(frames=2))
    measured(session, FakeCamera())
    (tmp_path / "notes.txt").write_text("mine")
    Session.begin(tmp_path, made_plan(7, frames=3))

    assert sorted(path.name for path in tmp_path.iterdir()) == [PLAN, "notes.txt"]


def test_option_that_the_firmware_refuses_is_left_out(tmp_path: Path) -> None:
    class StubbornCamera(FakeCamera):
        def set_option(self, name: str, value: float) -> str:
            if name == "min_distance":
                raise CameraError("min_distance: refused")
            return super().set_option(name, value)

    camera: Any = StubbornCamera()
    start = setting_as_started(camera)

    assert set(start.options) == {"laser_power"}
    assert {name for each in swept_settings(camera) for name in each.options} == {"laser_power"}

    session = Session.start(tmp_path / "s", made_plan(frames=2, settings=(start,)))
    measured(session, camera)

    assert not session.missing()


def test_turn_of_another_session_is_found_by_its_frames(tmp_path: Path) -> None:
    session = Session.start(tmp_path / "s", made_plan(frames=3))
    other = Session.start(tmp_path / "other", made_plan(frames=4))
    measured(session, FakeCamera())
    measured(other, FakeCamera())
    other.path(0).replace(session.path(0))

    with pytest.raises(RecordingError, match="4 frames"):
        session.turns()


@pytest.mark.parametrize("damage", ["frames", "time"])
def test_turn_without_numbers_is_refused(tmp_path: Path, damage: str) -> None:
    session = Session.start(tmp_path / "s", made_plan(frames=3))
    turn = made_turns(session.plan)[0]
    wrong: Any = (
        {"frames": float("inf")} if damage == "frames" else {"time_s": turn.time_s * np.nan}
    )
    replace(turn, **wrong).save(session.path(0))

    with pytest.raises(RecordingError, match="measures its four turns again"):
        session.turns()


def test_order_has_the_object_in_half_of_each_block() -> None:
    order = made_plan(turns=64).order().reshape(16, 4)
    assert (order.sum(axis=1) == 2).all()
    assert (order[:, 0] == order[:, 3]).all()
    assert 0 < order[:, 0].sum() < 16


def test_sweep_changes_one_option_at_a_time_and_restores_it() -> None:
    camera = FakeCamera()
    settings = swept_settings(camera)  # pyright: ignore[reportArgumentType]
    start = settings[0].options
    changes = [sum(each.options[k] != start[k] for k in start) for each in settings[1:]]
    assert set(changes) == {1}
    assert len(settings) == 4
    assert camera.options == start


def test_session_goes_on_under_the_options_it_began_with(tmp_path: Path) -> None:
    """A lidar may choose another laser power at its next start."""
    camera = FakeCamera()
    start = setting_as_started(camera)  # pyright: ignore[reportArgumentType]
    session = Session.start(tmp_path / "s", made_plan(frames=2, settings=(start,)))
    later = FakeCamera()
    later.options["laser_power"] = 60.0

    measured(session, later)

    assert later.options == FakeCamera().options


def test_sweep_is_measured_under_each_setting(tmp_path: Path) -> None:
    camera = FakeCamera()
    settings = swept_settings(camera)  # pyright: ignore[reportArgumentType]
    session = Session.start(tmp_path / "s", made_plan(frames=2, settings=settings))
    measured(session, camera)
    assert session.turns()[0].mean.shape == (len(settings), 3, 64, 80)


@pytest.mark.parametrize(
    "change",
    [
        {"turns": 36},
        {"frames": 5},
        {"alpha": 0.02},
        {"control": True},
        {"camera": "sim:bare-wall"},
    ],
)
def test_plan_never_changes_midway(tmp_path: Path, change: dict[str, Any]) -> None:
    Session.start(tmp_path / "s", made_plan())
    with pytest.raises(RecordingError, match=next(iter(change))):
        Session.start(tmp_path / "s", made_plan(**change))


@pytest.mark.parametrize("turns", [10, 16])
def test_plan_that_cannot_reach_its_rate_is_refused(turns: int) -> None:
    with pytest.raises(ValueError, match="turns"):
        made_plan(turns=turns)


def damaged(folder: Path, kind: str) -> None:
    """Make a folder that is no session, or a damaged one."""
    if kind == "empty":
        folder.mkdir()
        return
    plan = made_plan()
    session = Session.start(folder, plan)
    for number, turn in enumerate(made_turns(plan)):
        turn.save(session.path(number))
    first = session.path(0)
    if kind == "cut turn":
        first.write_bytes(first.read_bytes()[:100])
    elif kind == "other label":
        other = next(n for n in range(32) if plan.order()[n] != plan.order()[0])
        first.write_bytes(session.path(other).read_bytes())
    elif kind == "no json":
        (folder / PLAN).write_text("{", encoding="utf-8")
    elif kind == "a list":
        (folder / PLAN).write_text("[]", encoding="utf-8")
    else:
        (folder / PLAN).write_text('{"kind": "dataset"}', encoding="utf-8")


@pytest.mark.parametrize("kind", ["empty", "cut turn", "other label", "no json", "a list", "other"])
def test_wrong_folder_is_one_line_with_exit_code_4(tmp_path: Path, kind: str) -> None:
    damaged(tmp_path / "s", kind)
    with pytest.raises(NlosCamError) as found:
        Session.open(tmp_path / "s").turns()
    assert found.value.exit_code == 4
    assert "\n" not in str(found.value)


def test_folder_of_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(OutputExistsError):
        Session.start(tmp_path, made_plan())


@pytest.mark.parametrize(
    ("fields", "command"),
    [
        ({"camera": "l515", "rig_option": "--bench bench"}, "detect l515 --bench bench --turns"),
        ({"camera": "l515"}, "detect l515 --wall wall.toml --turns"),
        ({"camera": "sim"}, "detect sim --turns"),
        ({"camera": "sim:mine/farther.toml"}, "detect sim:farther.toml --turns"),
    ],
)
def test_page_names_the_option_that_named_the_rig(
    tmp_path: Path, fields: dict[str, str], command: str
) -> None:
    plan = made_plan(rig=load_rig("paper-rig"), **fields)
    analysis = analyze(plan, made_turns(plan), with_power=False)

    write_report(analysis, tmp_path / "page.html")

    assert f"nlos-cam {command}" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_page_hides_the_serial_number_unless_asked(tmp_path: Path) -> None:
    plan = made_plan(camera="l515:F1234567", serial="F1234567")
    analysis = analyze(plan, made_turns(plan), with_power=False)
    pages = {}
    for shown in (False, True):
        write_report(analysis, tmp_path / "page.html", show_serial=shown)
        pages[shown] = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "F1234567" not in pages[False]
    assert "F1234567" in pages[True]


def test_page_says_which_settings_were_not_tested(tmp_path: Path) -> None:
    """Without a row, a channel in which nothing returned would read as one without an effect."""
    plan = made_plan()
    turns = made_turns(plan)
    blind = [replace(turn, mean=turn.mean.copy()) for turn in turns]
    for turn in blind:
        turn.mean[:, 0] = np.nan

    pages = []
    for measured_turns in (turns, blind):
        write_report(analyze(plan, measured_turns, with_power=False), tmp_path / "page.html")
        pages.append((tmp_path / "page.html").read_text(encoding="utf-8"))

    assert ["not tested" in page for page in pages] == [False, True]


def test_page_hides_the_folders_of_a_scene(tmp_path: Path) -> None:
    plan = made_plan(camera="sim:/home/owner/cup.toml")
    write_report(analyze(plan, made_turns(plan), with_power=False), tmp_path / "page.html")

    assert "/home/owner" not in (tmp_path / "page.html").read_text(encoding="utf-8")
