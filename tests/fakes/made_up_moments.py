"""Moments of a made-up run, with every field that a view can show."""

from dataclasses import replace
from typing import Any

import numpy as np
from nlos_calibration import load_rig
from small_frames import FrameCamera

from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import PhysicsCheckResult, Verdict
from nlos_cam.reconstruct.network import Reconstruction, box_pose
from nlos_cam.view import Moment

RIG = load_rig("paper-rig")
NOTHING = np.full((64, 64), np.nan, np.float32)
SHEET = np.full((64, 64), 0.2, np.float32)


def bump(number: int) -> np.ndarray:
    """A round hill that goes from left to right, a pixel each frame; nothing around it."""
    y, x = np.mgrid[:64, :64]
    height = 1.0 - np.hypot(x - 20 - number % 24, y - 32) / 16
    return np.where(height > 0, 0.3 - 0.1 * np.sqrt(np.clip(height, 0.0, 1.0)), np.nan).astype(
        np.float32
    )


def moment(
    number: int,
    hidden_m: np.ndarray | None = None,
    *,
    size: tuple[int, int] = (64, 80),
    **fields: Any,
) -> Moment:
    """Frame `number`, of which only the reconstruction is known; `fields` replace the moment's."""
    depth_m = np.random.default_rng(number).uniform(0.2, 1.0, size).astype(np.float32)
    ir = np.full(size, 40, np.uint8)
    frame = Frame(depth_m, ir, ir % 16, number / 30, number, RIG.pinhole.scaled(size[1], size[0]))
    hidden = SHEET if hidden_m is None else hidden_m
    made = Reconstruction(hidden, box_pose(object_box(RIG)), None, {})
    return replace(Moment(frame, made, number / 30, 0.02), **fields)


def full_moment(
    number: int, verdict: Verdict = Verdict.SEEN, size: tuple[int, int] = (64, 80)
) -> Moment:
    """All that a moment can hold."""
    hidden_m = NOTHING if verdict is Verdict.NOTHING else bump(number)
    plain = moment(number, hidden_m, size=size)
    cells = np.random.default_rng(number).normal(0.0, 0.01, (64, 80)).astype(np.float32)
    spread_m = np.linspace(0.0, 0.04, 64, dtype=np.float32) * np.ones((64, 1), np.float32)
    return replace(
        plain,
        frame=replace(plain.frame, truth_depth_m=bump(number + 2)),
        reconstruction=replace(plain.reconstruction, uncertainty_m=spread_m),
        difference=LidarMaps(cells, cells, np.isfinite(cells)),
        verdict=verdict,
        check=PhysicsCheckResult(number - number % 30, cells, cells, 0.2 + 0.1 * (number % 3), 0.5),
        stages_s={
            "wait": 0.02,
            "maps": 0.002,
            "bench": 0.0001,
            "network": 0.009 + 0.001 * (number % 4),
        },
        dropped=number // 50,
        celsius={"ldd_temperature": 40.0 + number / 100, "mc_temperature": 35.0},
    )


class Recorded(FrameCamera):
    """Recording of `count` frames of full moments, at 41 degrees."""

    def __init__(self, count: int) -> None:
        super().__init__(count, make=lambda number: full_moment(number).frame)
        self.intrinsics = full_moment(0).frame.intrinsics

    def telemetry(self, _: str = "") -> dict[str, float]:
        return {"ldd_temperature": 41.0}
