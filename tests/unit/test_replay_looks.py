from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from made_up_moments import RIG, Recorded, bump, full_moment

from nlos_cam.frames import maps_from_frame
from nlos_cam.live.replay import REPORT, RESULT, SHEET, replay_recording
from nlos_cam.live.replay_media import VIDEO, VIEW, Looks, moment_of
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import FrameResult, Pipeline

BENCH = CalibratedRig(RIG)
NAMES = {REPORT, RESULT, SHEET}


def network(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Shows the same hill whatever the lidar sees."""
    return np.repeat(image_from_depth(bump(0), object_box(RIG))[np.newaxis], len(depth_m), axis=0)


def replayed(out: Path, count: int, **asked: Any) -> set[str]:
    processing = Pipeline(BENCH, network)
    replay_recording(Recorded(count), processing, out, stop=Event(), looks=Looks(BENCH, **asked))
    return {file.name for file in out.iterdir()}


def test_what_was_not_asked_for_is_not_made(tmp_path: Path) -> None:
    assert replayed(tmp_path / "out", 3) == NAMES


def test_a_view_a_video_and_stills_are_made_where_asked_for(tmp_path: Path) -> None:
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


def test_a_view_holds_each_third_frame_by_its_number(tmp_path: Path, chunks_of: Any) -> None:
    replayed(tmp_path / "out", 30, view=True)
    numbers = [
        number
        for chunk in chunks_of(tmp_path / "out" / VIEW)
        if chunk.entity_path == "/drops" and not chunk.is_static
        for number in chunk.to_record_batch().column("frame").to_pylist()
    ]
    assert sorted(numbers) == list(range(0, 30, 3))


def test_looks_change_nothing_of_the_result(tmp_path: Path) -> None:
    for name, asked in {"plain": {}, "looked": {"view": True, "stills": 2}}.items():
        replayed(tmp_path / name, 9, **asked)
    for file in (RESULT, REPORT):
        assert (tmp_path / "plain" / file).read_bytes() == (tmp_path / "looked" / file).read_bytes()


def test_what_an_earlier_replay_left_to_look_at_goes_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replayed(out, 40, view=True, stills=4)
    (out / "mine.png").write_text("keep me")
    made = replayed(out, 9, stills=1)
    assert made == NAMES | {"mine.png", "still-000000.png"}


@pytest.mark.parametrize("count", [1, 2, 40])
def test_there_are_as_many_stills_as_asked_for_or_frames(tmp_path: Path, count: int) -> None:
    made = replayed(tmp_path / "out", count, stills=4) - NAMES
    assert len(made) == min(count, 4)


def test_an_error_leaves_no_thread_and_draws_no_stills(tmp_path: Path) -> None:
    step = FrameResult(
        full_moment(0).frame, maps_from_frame(full_moment(0).frame), full_moment(0).reconstruction, 0.0, {}
    )
    looks = Looks(BENCH, view=True, stills=2).into(tmp_path)
    looks.__enter__().add(step, {})
    assert not looks.__exit__(ZeroDivisionError, ZeroDivisionError(), None), "it goes on to whoever replays"
    assert {file.name for file in tmp_path.iterdir()} == {VIEW}


def test_a_step_is_shown_at_its_own_time_with_all_that_is_known_of_it() -> None:
    full = full_moment(42)
    stages_s = {"wait": 9.0, "maps": 0.001, "network": 0.01}
    known = full.difference, (), full.verdict, full.check
    shown = moment_of(
        FrameResult(full.frame, maps_from_frame(full.frame), full.reconstruction, 77.0, stages_s, *known),
        full.celsius,
    )
    assert shown.published_s == full.frame.timestamp_s
    assert shown.latency_s == pytest.approx(0.011)
    assert (shown.difference, shown.verdict, shown.check, shown.celsius) == (
        full.difference,
        full.verdict,
        full.check,
        full.celsius,
    )
