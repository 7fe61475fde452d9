"""The bare wall from depth frames: a streaming mean, a plane, a pose, a verdict; or a refusal that says why."""

from dataclasses import dataclass
from math import degrees
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import angles_from_normal, facing_angle_rad, wall_from_plane
from nlos_calibration.plane import GATE_SIGMAS, PlaneFit, depth_noise_m, fit_plane
from nlos_calibration.projection import Intrinsics

Array = NDArray[np.float64]
Verdict = Literal["good", "out of range"]

DISTANCE_RANGE_M, FACING_RANGE_DEG = (0.15, 0.30), (15.0, 75.0)
"""The paper's ranges (SI 1)."""
DISTANCE_ERROR_M, FACING_ERROR_DEG = 0.001, 0.2
"""What the measurement itself may err by: a wall on the edge of a range is in it."""
MIN_VALID_SHARE = 0.05
RESIDUAL_NOISES = 2.0
"""One frame of a flat wall stays below 1: the noise across the wall is at most that of a sample at its distance."""
BLOCK_PIXELS, STRAY_IN_BLOCK = 4, 0.875
MAX_STRAY_SHARE = 0.05
"""Scattered outliers are noise; blocks that stray as one are another surface or another path. At 40 % of scattered
outliers a full block strays by chance once in 8,000."""


@dataclass(frozen=True)
class WallFit:
    """Where the wall is, how well the depth says so, and whether the paper's method works from there."""

    distance_m: float
    yaw_deg: float
    pitch_deg: float
    facing_deg: float
    wall_from_lidar: Array
    """(4, 4)."""
    residual_m: float
    inlier_fraction: float
    verdict: Verdict
    advice: str
    """One sentence: what the verdict rests on, or what to move."""


class DepthMean:
    """The mean of each pixel over the frames that had a return there; holds two maps, not the frames."""

    def __init__(self, height: int, width: int) -> None:
        self.frames = 0
        self._sum_m = np.zeros((height, width))
        self._count = np.zeros((height, width), np.int64)

    def add(self, depth_m: NDArray[np.floating]) -> None:
        """Take one frame (height, width) in; NaN, infinite and not positive samples are no return."""
        valid = np.isfinite(depth_m) & (depth_m > 0.0)
        np.add(self._sum_m, depth_m, out=self._sum_m, where=valid)
        self._count += valid
        self.frames += 1

    def mean_m(self) -> Array:
        """(height, width); NaN where fewer than half of the frames had a return."""
        enough = 2 * self._count >= max(self.frames, 1)
        return np.divide(self._sum_m, self._count, out=np.full_like(self._sum_m, np.nan), where=enough)


def wall_depth(wall_from_lidar: Array, intrinsics: Intrinsics) -> Array:
    """The depth (height, width) that a bare, endless wall gives; inf where a beam never meets it."""
    away = -(intrinsics.rays() @ wall_from_lidar[2, :3])
    depth_m = np.full(away.shape, np.inf)
    return np.divide(wall_from_lidar[2, 3], away, out=depth_m, where=away > 0.0)


def fit_wall(depth_m: Array, intrinsics: Intrinsics, generator: np.random.Generator) -> WallFit:
    """Measure the wall from a mean depth map (height, width); NaN, infinite or not positive is no return.

    Raises WallRefusedError where the depth is not that of one bare wall.
    """
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan)
    share = float(np.isfinite(depth_m).mean())
    if share < MIN_VALID_SHARE:
        raise WallRefusedError(
            f"{share:.1%} of the pixels have depth, {MIN_VALID_SHARE:.0%} needed: is the lens free and the wall near?",
        )
    plane = fit_plane((intrinsics.rays() * depth_m[..., np.newaxis]).reshape(-1, 3), generator)
    if plane.normal[2] >= 0.0:
        raise WallRefusedError("the optical axis never meets the wall's plane: turn the lidar towards the wall")
    pose = wall_from_plane(plane.normal, plane.distance_m)
    _check_one_surface(depth_m, wall_depth(pose, intrinsics))
    allowed_m = RESIDUAL_NOISES * depth_noise_m(plane.distance_m)
    if plane.residual_m > allowed_m:
        raise WallRefusedError(
            f"the wall is not flat: {plane.residual_m * 1e3:.1f} mm RMS from the plane, {allowed_m * 1e3:.1f} mm "
            "allowed; take a flat, matt wall and let the lidar warm up",
        )
    return _judged(plane, pose)


def _check_one_surface(depth_m: Array, expected_m: Array) -> None:
    """Refuse a map in which blocks of pixels stray from the wall together (NaN in `depth_m` is neither)."""
    noise_m = depth_noise_m(depth_m)
    valid = np.isfinite(depth_m)
    behind = valid & (depth_m - expected_m > GATE_SIGMAS * noise_m)
    before = valid & (expected_m - depth_m > GATE_SIGMAS * noise_m)
    seen, behind_seen, before_seen = _block_sums(valid), _block_sums(behind), _block_sums(before)
    blocks = seen >= BLOCK_PIXELS**2 / 2
    total = max(int(blocks.sum()), 1)
    stray = blocks & (behind_seen + before_seen >= STRAY_IN_BLOCK * seen)
    if stray.sum() <= MAX_STRAY_SHARE * total:
        return
    far = (stray & (behind_seen >= before_seen)).sum() / total
    near = stray.sum() / total - far
    raise WallRefusedError(
        f"the depth is not a bare wall's: {far:.0%} of the view is behind the wall's plane (light that went by way of "
        f"a hidden object?), {near:.0%} in front of it (an occluder?): take away whatever stands before the wall",
    )


def _block_sums(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    rows, columns = (np.arange(0, size, BLOCK_PIXELS) for size in mask.shape)
    return np.add.reduceat(np.add.reduceat(mask.astype(np.int64), rows, axis=0), columns, axis=1)


def _judged(plane: PlaneFit, pose: Array) -> WallFit:
    yaw_rad, pitch_rad = angles_from_normal(plane.normal)
    facing_deg = degrees(facing_angle_rad(pose))
    problems = _problems(plane.distance_m, facing_deg)
    return WallFit(
        distance_m=plane.distance_m,
        yaw_deg=degrees(yaw_rad),
        pitch_deg=degrees(pitch_rad),
        facing_deg=facing_deg,
        wall_from_lidar=pose,
        residual_m=plane.residual_m,
        inlier_fraction=plane.inlier_fraction,
        verdict="out of range" if problems else "good",
        advice="; ".join(problems) or "distance and angle are inside the paper's ranges",
    )


def _problems(distance_m: float, facing_deg: float) -> list[str]:
    """What is out of the paper's ranges, each with what to do."""
    problems: list[str] = []
    low, high = DISTANCE_RANGE_M
    if not low - DISTANCE_ERROR_M <= distance_m <= high + DISTANCE_ERROR_M:
        move = "closer" if distance_m > high else "back"
        problems.append(f"{distance_m:.3f} m is outside {low:.2f} to {high:.2f} m: move the lidar {move}")
    low, high = FACING_RANGE_DEG
    if not low - FACING_ERROR_DEG <= facing_deg <= high + FACING_ERROR_DEG:
        turn = "towards the wall" if facing_deg > high else "aside"
        problems.append(f"{facing_deg:.1f} degrees is outside {low:.0f} to {high:.0f}: turn the lidar {turn}")
    return problems
