"""Moments of a made-up run, with every field that a view can show."""

from dataclasses import replace
from typing import Any

import numpy as np
from nlos_calibration import load_rig
from small_frames import FrameCamera

from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import FrameResult, PhysicsCheckResult, Reconstruction, Verdict
from nlos_cam.view import Moment

RIG = load_rig("paper-rig")
NOTHING = np.full((64, 64), np.nan, np.float32)
SHEET = np.full((64, 64), 0.2, np.float32)
NO_MAPS = LidarMaps(
    np.full((64, 80), np.nan, np.float32), np.zeros((64, 80), np.float32), np.zeros((64, 80), bool)
)


def bump(number: int) -> np.ndarray:
    """A round hill that goes from left to right, a pixel each frame; nothing around it."""
    y, x = np.mgrid[:64, :64]
    height = 1.0 - np.hypot(x - 20 - number % 24, y - 32) / 16
    return np.where(height > 0, 0.3 - 0.1 * np.sqrt(np.clip(height, 0.0, 1.0)), np.nan).astype(
        np.float32
    )


def moment(
    number: int, hidden_m: np.ndarray = SHEET, *, size: tuple[int, int] = (64, 80)
) -> Moment:
    """Frame `number`, of which only the reconstruction is known."""
    depth_m = np.random.default_rng(number).uniform(0.2, 1.0, size).astype(np.float32)
    ir = np.full(size, 40, np.uint8)
    frame = Frame(depth_m, ir, ir % 16, number / 30, number, RIG.pinhole.scaled(size[1], size[0]))
    reconstruction = Reconstruction(hidden_m, object_box(RIG), None, {})
    result = FrameResult(frame, NO_MAPS, reconstruction, frame.timestamp_s, {})
    return Moment(result, frame.timestamp_s, 0.02)


def full_moment(
    number: int, verdict: Verdict = Verdict.SEEN, size: tuple[int, int] = (64, 80)
) -> Moment:
    """Return a moment with all that one can hold."""
    hidden_m = NOTHING if verdict is Verdict.NOTHING else bump(number)
    plain = moment(number, hidden_m, size=size)
    cells = np.random.default_rng(number).normal(0.0, 0.01, (64, 80)).astype(np.float32)
    spread_m = np.linspace(0.0, 0.04, 64, dtype=np.float32) * np.ones((64, 1), np.float32)
    known = with_result(
        plain,
        frame=replace(plain.result.frame, truth_depth_m=bump(number + 2)),
        reconstruction=replace(plain.result.reconstruction, uncertainty_m=spread_m),
        difference=LidarMaps(cells, cells, np.isfinite(cells)),
        verdict=verdict,
        check=PhysicsCheckResult(number - number % 30, cells, cells, 0.2 + 0.1 * (number % 3), 0.5),
        stages_s={
            "wait": 0.02,
            "maps": 0.002,
            "bench": 0.0001,
            "network": 0.009 + 0.001 * (number % 4),
        },
    )
    celsius = {"ldd_temperature": 40.0 + number / 100, "mc_temperature": 35.0}
    return replace(known, dropped=number // 50, celsius=celsius)


def with_result(shown: Moment, **fields: Any) -> Moment:
    """Return a moment with other fields of its result."""
    return replace(shown, result=replace(shown.result, **fields))


class Recorded(FrameCamera):
    """Recording of `count` frames of full moments, at 41 degrees."""

    def __init__(self, count: int) -> None:
        super().__init__(count, make=lambda number: full_moment(number).result.frame)
        self.intrinsics = full_moment(0).result.frame.intrinsics

    def telemetry(self, ending: str = "") -> dict[str, float]:
        return {"ldd_temperature": 41.0} if "ldd_temperature".endswith(ending) else {}
