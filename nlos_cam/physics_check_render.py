"""The physics check itself: a reconstruction rendered again, through the expected sensor, against the lidar's maps."""

import time
from collections.abc import Callable
from functools import lru_cache
from typing import Self

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import Rig

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps
from nlos_cam.physics_check import Check, failure, log_warning
from nlos_cam.physics_check_score import Expected, explanation
from nlos_cam.reconstruct import Clock
from nlos_cam.render.accuracy import Stop
from nlos_cam.render.geometry import cast
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene

CHECKED_FRAMES = 30
"""Of a replay, every so many frames are checked: about once a second."""


def check(
    maps: LidarMaps,
    depth_m: Float32 | None,
    rig: Rig,
    *,
    frame_number: int = 0,
    accuracy: Stop = "standard",
    clock: Clock = time.perf_counter,
) -> Check:
    """Render a hidden depth (64, 64) again, and hold what a lidar would see of it against the maps that it gave.

    Without any surface, and on a rig without an object box, the bare bench is held against them. The depth of the maps
    is that of the rig: what the lidar is known to lack was added (`Bench.corrected`).
    """
    begun_s = clock()
    bare = _bare(rig)  # pyright: ignore[reportArgumentType]  frozen, so hashable
    hides = depth_m is not None and rig.object_box is not None and bool(np.isfinite(depth_m).any())
    expected = _expected(render(Scene(rig, depth_m), accuracy), rig, bare) if hides else bare
    best = explanation(maps, expected, bare)
    rendered_m, rendered = expected.seen(best.albedo, best.gain)
    seen_m = np.where(maps.valid, maps.depth_m, np.float32(np.nan))
    residuals = seen_m - rendered_m, maps.intensity - rendered
    return Check(frame_number, *residuals, best.score, clock() - begun_s, best.albedo)


@lru_cache(maxsize=4)
def _bare(rig: Rig) -> Expected:
    """What comes back with nothing hidden."""
    return _expected(render(Scene(rig)), rig, None)


def _expected(rendering: Rendering, rig: Rig, bare: Expected | None) -> Expected:
    """Both echoes of each cell; where three bounces won, the direct one is the bare bench's."""
    cos_axis = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)).cos_axis.reshape(MAP_ROWS, MAP_COLUMNS)
    echo, echo_m = rendering.multi.peak.astype(np.float64), rendering.multi.path_m / 2 * cos_axis
    direct, direct_m = rendering.intensity.astype(np.float64), rendering.depth_m.astype(np.float64)
    if bare is None:
        return Expected(direct_m, direct, echo_m, echo)
    bounced = (rendering.intensity <= rendering.multi.peak) & (echo > 0)
    return Expected(np.where(bounced, bare.direct_m, direct_m), np.where(bounced, bare.direct, direct), echo_m, echo)


class EveryFrames:
    """Checks every so many frames on the spot: of the same frames always the same ones, to the bit.

    `on_error` hears of the first check that fails.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        every: int = CHECKED_FRAMES,
        accuracy: Stop = "standard",
        on_error: Callable[[str], None] = log_warning,
    ) -> None:
        self.newest: Check | None = None
        self._rig, self._every, self._offered = rig, every, 0
        self._accuracy: Stop = accuracy
        self._on_error, self._said = on_error, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Check this frame if it is one of those."""
        self._offered += 1
        if (self._offered - 1) % self._every:
            return
        try:
            self.newest = check(maps, depth_m, self._rig, frame_number=frame_number, accuracy=self._accuracy)
        except Exception as error:  # noqa: BLE001  whatever it was, frames go on without
            if not self._said:
                self._on_error(failure(frame_number, f"{type(error).__name__}: {error}"))
            self._said = True
