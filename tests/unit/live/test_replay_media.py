from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from fake_wall import wall_frame
from made_up_moments import RIG, Recorded, bump, full_moment
from matplotlib.figure import Figure
from small_frames import NOTHING
from view_streams import saved_moments

from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.live import REPORT, VIDEO, ReplayMedia, replay_recording
from nlos_cam.live.replay import RESULT, SHEET
from nlos_cam.live.replay_media import VIEW, FrameSampler, draw_contact_sheet, moment_of
from nlos_cam.objects import image_from_depth, object_box
from nlos_cam.reconstruct import CalibratedRig, FrameResult, Pipeline, Verdict

BENCH = CalibratedRig(RIG)
FULL = full_moment(0)
STEP = FrameResult(FULL.frame, maps_from_frame(FULL.frame), FULL.reconstruction, 0.0, {})
NAMES = {REPORT, RESULT, SHEET, "report.md"}


def network(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Return the same hill for all maps."""
    return np.repeat(image_from_depth(bump(0), object_box(RIG))[np.newaxis], len(depth_m), axis=0)


def replayed(out: Path, count: int, **asked: Any) -> set[str]:
    processing = Pipeline(BENCH, network)
    replay_recording(Recorded(count), processing, out, stop=Event(), media=ReplayMedia(BENCH, **asked))
    return {file.name for file in out.iterdir()}


def test_replay_makes_view_video_and_stills_as_asked(tmp_path: Path) -> None:
    assert replayed(tmp_path / "plain", 30) == NAMES
    made = replayed(tmp_path / "out", 30, view=True, stills=3, video=True) - NAMES
    assert {VIEW, VIDEO} <= made
    numbers = sorted(int(name[6:12]) for name in made - {VIEW, VIDEO})
    assert len(numbers) == 3
    assert numbers[0] == 0
    assert numbers[-1] >= 20
    video, frames = cv2.VideoCapture(str(tmp_path / "out" / VIDEO)), 0
    while video.read()[0]:
        frames += 1
    assert frames == 15
    assert [each["frame"] for each in saved_moments(tmp_path / "out" / VIEW)] == list(range(0, 30, 3))
    assert (tmp_path / "plain" / RESULT).read_bytes() == (tmp_path / "out" / RESULT).read_bytes()
    assert VIDEO in (tmp_path / "out" / REPORT).read_text(encoding="utf-8")


@pytest.mark.slow
def test_replay_removes_media_of_an_earlier_one_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replayed(out, 12, view=True, stills=4, objects=["csv"])
    assert (out / "object" / "000003.csv").is_file()
    (out / "mine.png").write_text("keep me")
    assert replayed(out, 3, stills=1) == NAMES | {"mine.png", "still-000000.png"}


def test_media_of_a_failed_replay_have_no_stills(tmp_path: Path) -> None:
    media = ReplayMedia(BENCH, view=True, stills=2)
    with pytest.raises(ZeroDivisionError), media.into(tmp_path):
        media.add(STEP, 1 / 0)  # type: ignore[arg-type]
    assert {file.name for file in tmp_path.iterdir()} == {VIEW}


def test_moment_of_step_is_complete_and_at_its_own_time() -> None:
    known = {name: getattr(FULL, name) for name in ("difference", "verdict", "check")}
    stages_s = {"wait": 9.0, "maps": 0.001, "network": 0.01}
    shown = moment_of(replace(STEP, published_s=77.0, stages_s=stages_s, **known), FULL.celsius)
    assert shown.published_s == FULL.frame.timestamp_s
    assert shown.latency_s == pytest.approx(0.011)
    assert {name: getattr(shown, name) for name in known} == known
    assert shown.celsius == FULL.celsius


@pytest.mark.parametrize("count", [1, 5, 6, 7, 100, 1001])
def test_samples_are_few_ordered_and_spread(count: int) -> None:
    samples = FrameSampler(6)
    for number in range(count):
        samples.add(number)  # type: ignore[arg-type]
    chosen = samples.results()
    assert len(chosen) == min(count, 6)
    assert chosen[0] == 0
    assert chosen == sorted(set(chosen))
    assert chosen[-1] >= 0.7 * (count - 1)


def wall_step(number: int, difference: LidarMaps | None = None) -> FrameResult:
    frame = wall_frame(number)
    return FrameResult(frame, maps_from_frame(frame), NOTHING, 0.0, {}, difference)


@pytest.fixture
def titles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[FrameResult]], list[str]]:
    """Titles of the contact sheet's columns and labels of its colour bars."""

    def titles_of(steps: list[FrameResult]) -> list[str]:
        saved: list[Any] = []
        monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: saved.append(figure))
        draw_contact_sheet(tmp_path / "sheet.png", steps)
        return [title for axis in saved[0].axes if (title := axis.get_ylabel() or axis.get_title())]

    return titles_of


def test_sheet_has_a_row_per_map_and_a_column_per_frame(titles: Callable[[list[FrameResult]], list[str]]) -> None:
    plain = ["lidar depth (m)", "infrared (counts)", "hidden depth (m)"]
    assert titles([wall_step(3), wall_step(9)]) == ["frame 3", "frame 9", *plain]
    differing = [wall_step(number, maps_from_frame(wall_frame(number))) for number in (3, 9)]
    assert titles(differing)[2:] == [*plain[:2], "difference (mm)", plain[2]]
    made = replace(NOTHING, uncertainty_m=np.full((64, 64), 0.01, np.float32))
    doubted = titles([replace(wall_step(3), verdict=Verdict.OUTSIDE, reconstruction=made)])
    assert doubted[0] == "frame 3\noutside the trained range"
    assert doubted[-1] == "uncertainty (mm)"
