"""Replays of made-up recordings, and what their folders hold."""

from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from fake_wall import SMALL, WallCamera, measured_wall
from made_up_moments import RIG, Recorded
from small_frames import FrameCamera, SheetNetwork

from nlos_cam.frames import Frame
from nlos_cam.reconstruct import CalibratedRig, Pipeline
from nlos_cam.replay import REPORT, ReplayMedia, replay_recording
from nlos_cam.replay.replay import RESULT, SHEET, ReplayReport

TEXT = "report.md"
NAMES = {REPORT, RESULT, SHEET, TEXT}
BENCH = CalibratedRig(RIG)
FIRST_NUMBER = 100
FIRST_S = 5.0
"""Number and timestamp of the first frame of noise."""


def left_half(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Return the left half of the depth map as the image of the hidden object."""
    return np.nan_to_num(depth_m[:, :, :64])


def noise_frame(number: int) -> Frame:
    depth_m = np.random.default_rng(number).uniform(0.1, 1.0, (64, 80)).astype(np.float32)
    ir = np.full((64, 80), 9, np.uint8)
    return Frame(depth_m, ir, depth_m, FIRST_S + number / 30, FIRST_NUMBER + number, SMALL)


def replay_noise(out: Path, count: int = 2, **options: Any) -> ReplayReport:
    """Replay `count` frames of noise without a wall; the camera counts duplicates."""
    camera = FrameCamera(count, make=noise_frame)
    camera.counts.update(duplicate=2, out_of_order=1)
    given = {"pipeline": Pipeline(BENCH, left_half), "stop": Event(), **options}
    return replay_recording(camera, out=out, **given)


def replay_wall(tmp_path: Path, camera: WallCamera, out: str = "out") -> Path:
    """Replay a camera on a measured wall; return the folder."""
    pipeline = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), left_half)
    replay_recording(camera, pipeline, tmp_path / out, stop=Event())
    return tmp_path / out


def replay_moments(out: Path, count: int, **media: Any) -> set[str]:
    """Replay full moments with media; return the names in the folder."""
    pipeline = Pipeline(BENCH, SheetNetwork())
    asked = ReplayMedia(BENCH, **media)
    replay_recording(Recorded(count), pipeline, out, stop=Event(), media=asked)
    return {file.name for file in out.iterdir()}


def text_of(out: Path) -> str:
    """Return the text of a replay's report."""
    return (out / TEXT).read_text(encoding="utf-8")
