"""The bare wall from the mean of depth frames: a plane, a pose, their uncertainty, a verdict; or a refusal."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.flatness import flatness
from nlos_calibration.geometry import wall_from_plane
from nlos_calibration.plane import GATE_SIGMAS, fit_depth, plane_depth_m
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_noise import STATISTICS_POINTS, MeanNoise, depth_noise_m
from nlos_calibration.ripples import block_sums, ripples
from nlos_calibration.uncertainty import WallMeasures, measures_of
from nlos_calibration.verdict import Verdict, check_flat, judge, warnings

MIN_VALID_SHARE = 0.05
STUCK_SHARE = 0.5
"""Of depths that are one and the same: noise spreads those of a true wall, even one that is faced squarely."""
BLOCK_PIXELS, SEEN_IN_BLOCK, STRAY_IN_BLOCK = 4, 0.75, 0.875
MAX_STRAY_SHARE = 0.05
"""Scattered outliers are noise; blocks that stray as one are another surface or another path. At 40 % of scattered
outliers a full block strays by chance once in 8,000, and one in which nothing else is seen counts once in 200."""


@dataclass(frozen=True)
class WallFit(WallMeasures):
    """Where the wall is, how surely, how well the depth says so, and whether the paper's method works from there.

    The standard uncertainties (*_std) allow for noise and for ripples that show in the residuals. They do not know of
    what every depth has in common: that is `range_offset`'s.
    """

    wall_from_lidar: Float64
    """(4, 4)."""
    covariance: Float64 = field(repr=False)
    """(3, 3) of -normal / distance, as seen from the zero of depth."""
    residual_m: float
    """RMS distance of the inliers from the plane."""
    noise_scale: float
    """The noise of a depth sample over the lidar's nominal: by its spread over frames; of one frame by residuals."""
    inlier_fraction: float
    inliers: NDArray[np.bool_] = field(repr=False)
    """(height, width); which pixels the plane rests on."""
    ripple_m: float
    """RMS of the deviation of parts of the wall from the plane, beyond noise."""
    bend_m: float
    bend_deg: float
    """By how much a plane through half of the view differs from that through the whole."""
    verdict: Verdict
    advice: str
    """One sentence: what the verdict rests on, or what to do."""
    warnings: tuple[str, ...]


def wall_depth(wall_from_lidar: Float64, intrinsics: Intrinsics) -> Float64:
    """The depth (height, width) that a bare, endless wall gives; inf where a beam never meets it."""
    away = -(intrinsics.rays() @ wall_from_lidar[2, :3])
    depth_m = np.full(away.shape, np.inf)
    return np.divide(wall_from_lidar[2, 3], away, out=depth_m, where=away > 0.0)


def fit_wall(
    depth_m: NDArray[np.floating],
    intrinsics: Intrinsics,
    generator: np.random.Generator,
    noise: MeanNoise | None = None,
    origin_m: float = 0.0,
) -> WallFit:
    """Measure the wall from a mean depth map (height, width); NaN, infinite or not positive is no return.

    `noise` is that of the flattened map (`DepthMean.noise`), of one frame where it is not given. The pose is of a point
    `origin_m` behind the zero of depth on the optical axis (`range_offset`). Raises WallRefusedError where the depth is
    not that of one bare, flat wall.
    """
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan).astype(np.float64)
    _check_depth(depth_m)
    rays = intrinsics.rays()
    plane = fit_depth(rays.reshape(-1, 3), depth_m.ravel(), generator, noise)
    if plane.normal[2] >= 0.0:
        raise WallRefusedError("the optical axis never meets the wall's plane: turn the lidar towards the wall")
    scale = noise.scale if noise is not None and noise.measured else plane.noise_scale
    _check_one_surface(depth_m, plane_depth_m(rays, plane.slopes))
    flat, rippled = flatness(plane, rays), ripples(plane, rays)
    check_flat(flat, rippled.rms_m)
    measures = measures_of(plane.slopes, rippled.covariance)
    measures = replace(measures, distance_m=plane.distance_m - origin_m * float(plane.normal[2]))
    verdict, advice = judge(measures.distance_m, measures.facing_deg, flat, rippled.rms_m)
    return WallFit(
        **vars(measures),
        wall_from_lidar=wall_from_plane(plane.normal, measures.distance_m),
        covariance=rippled.covariance,
        residual_m=plane.residual_m,
        noise_scale=scale,
        inlier_fraction=plane.inlier_fraction,
        inliers=plane.inliers.reshape(depth_m.shape),
        ripple_m=rippled.rms_m,
        bend_m=flat.bend_m,
        bend_deg=flat.bend_deg,
        verdict=verdict,
        advice=advice,
        warnings=warnings(rippled.rms_m, scale),
    )


def _check_depth(depth_m: Float64) -> None:
    """Refuse a map that is nearly empty, or that says the same everywhere."""
    valid_m = depth_m[np.isfinite(depth_m)]
    share = len(valid_m) / depth_m.size
    if share < MIN_VALID_SHARE:
        raise WallRefusedError(
            f"{share:.1%} of the pixels have depth, {MIN_VALID_SHARE:.0%} needed: is the lens free and the wall near?",
        )
    some_m = valid_m[:: max(len(valid_m) // STATISTICS_POINTS, 1)]
    values_m, times = np.unique(some_m, return_counts=True)
    if times.max() >= STUCK_SHARE * len(some_m):
        raise WallRefusedError(
            f"{times.max() / len(some_m):.0%} of the view reads {values_m[times.argmax()]:.5f} m, as if the lidar were "
            "stuck: start it again",
        )


def _check_one_surface(depth_m: Float64, expected_m: Float64) -> None:
    """Refuse a map in which blocks of pixels stray from the wall together (NaN in `depth_m` is neither)."""
    gate_m = GATE_SIGMAS * depth_noise_m(depth_m)
    valid = np.isfinite(depth_m)
    behind = valid & (depth_m - expected_m > gate_m)
    before = valid & (expected_m - depth_m > gate_m)
    seen, behind_seen, before_seen = (block_sums(mask, BLOCK_PIXELS) for mask in (valid, behind, before))
    blocks = seen >= SEEN_IN_BLOCK * BLOCK_PIXELS**2
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
