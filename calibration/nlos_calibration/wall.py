"""Wall measurement from the mean of depth frames: plane, pose, uncertainty and a verdict; or a
refusal with its reason.

Uncertainties of distance and angles are propagated to first order from the covariance of the
plane's slopes. The verdict compares distance, angle and flatness with the paper's ranges, and
advises by how much to move.
"""

from dataclasses import dataclass, field, replace
from math import ceil, degrees, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nlos_calibration import geometry
from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.flatness import SURE_SIGMAS, Flatness, block_sums, flatness, ripples
from nlos_calibration.noise import STATISTICS_POINTS, MeanNoise, depth_noise_m
from nlos_calibration.plane import GATE_SIGMAS, fit_depth, plane_depth_m

Verdict = Literal["good", "out of range", "doubtful"]
"""Doubtful: the plane may be off by more than `TOLERANCE_M` or `TOLERANCE_DEG`, and the depth alone
cannot decide.
"""

DISTANCE_RANGE_M = (0.15, 0.30)
FACING_RANGE_DEG = (15.0, 75.0)
"""The paper's ranges (SI 1)."""
TOLERANCE_M = 0.001
TOLERANCE_DEG = 0.2
"""Tolerated error: a wall on the edge of a range is inside, a smaller shift by a bend is
ignored.
"""
MEASURE_BY_TAPE = "measure the distance with a tape and give it with --tape-m"
DOUBTFUL_TOLERANCES = 0.7
REFUSED_TOLERANCES = 5.0
"""Difference between half of the view and the whole, in tolerances. From the second on (5 mm or 1
degree, a bend of 2 degrees) the wall is refused; less could also be ripples of the lidar, 1 or 2 mm
high and half a view wide, which are only reported. Doubt begins below one tolerance, since a half
that bends itself shows too little."""
DOUBTFUL_RIPPLE_M = 0.0009
MAX_RIPPLE_M = 0.002
"""RMS normal to the wall. The L515's ripples are a millimetre or two high; two panes 2 mm apart are
1 mm off a plane between them."""
WARN_RIPPLE_M = 0.0003
WARN_NOISE_SCALE = 2.0


def check_flat(flat: Flatness, ripple_m: float) -> None:
    """Refuse a wall that surely bends, curves or steps, unless a range offset of the lidar explains
    it.
    """
    # A refusal must not be noise's: only what exceeds three standard uncertainties counts. A range
    # offset bends an oblique wall in the same way, and is no fault of the wall.
    sure_m = flat.bend_m - SURE_SIGMAS * flat.bend_std_m
    sure_deg = flat.bend_deg - SURE_SIGMAS * flat.bend_std_deg
    if _tolerances(sure_m, sure_deg) > REFUSED_TOLERANCES and not _explained_by_offset(flat):
        raise WallRefusedError(
            "the wall is not one flat wall: half of the view differs from the whole by"
            f" {_amounts(flat)}, as of a bend, a curve or a step; use a flat wall, or move so that"
            " only one is in view"
        )
    if ripple_m > MAX_RIPPLE_M:
        raise WallRefusedError(
            f"the wall is not flat: parts are {ripple_m * 1e3:.1f} mm RMS off the plane,"
            f" {MAX_RIPPLE_M * 1e3:.1f} mm allowed; use a flat, matt wall and let the lidar warm up"
        )


def judge(
    distance_m: float, facing_deg: float, flat: Flatness, ripple_m: float
) -> tuple[Verdict, str]:
    """Return the verdict, and one sentence with its reason or the remedy."""
    reason = _reason_to_doubt(flat, ripple_m)
    if not reason:
        return range_verdict(distance_m, facing_deg)
    return "doubtful", "; ".join([reason, *out_of_range(distance_m, facing_deg)])


def range_verdict(distance_m: float, facing_deg: float) -> tuple[Verdict, str]:
    """Return verdict and reason for a plane that is not in doubt."""
    if problems := out_of_range(distance_m, facing_deg):
        return "out of range", "; ".join(problems)
    return "good", "distance and angle are inside the paper's ranges"


def warnings(ripple_m: float, noise_scale: float) -> tuple[str, ...]:
    """Return remarks on ripples and noise that leave the verdict unchanged."""
    lines: list[str] = []
    if ripple_m > WARN_RIPPLE_M:
        lines.append(
            f"the depth has ripples of {ripple_m * 1e3:.1f} mm RMS: the uncertainties include them"
        )
    if noise_scale > WARN_NOISE_SCALE:
        lines.append(
            f"depth is {noise_scale:.1f} times as noisy as nominal: let the lidar warm up, dim the"
            " light"
        )
    return tuple(lines)


def _tolerances(bend_m: float, bend_deg: float) -> float:
    return max(bend_m / TOLERANCE_M, bend_deg / TOLERANCE_DEG)


def _explained_by_offset(flat: Flatness) -> bool:
    return flat.offset_m != 0.0 and _tolerances(flat.offset_bend_m, flat.offset_bend_deg) <= 1.0


def _amounts(flat: Flatness) -> str:
    return f"{flat.bend_m * 1e3:.1f} mm and {flat.bend_deg:.2f} degrees"


def _reason_to_doubt(flat: Flatness, ripple_m: float) -> str:
    """Return the reason why the fitted plane may not be the wall's; empty if there is none."""
    bent = _tolerances(flat.bend_m, flat.bend_deg) > DOUBTFUL_TOLERANCES
    if bent and _explained_by_offset(flat):
        return (
            f"a range offset of {1e3 * flat.offset_m:+.1f} mm would make the wall flat (or the"
            f" wall is curved): {MEASURE_BY_TAPE}"
        )
    if ripple_m > DOUBTFUL_RIPPLE_M:
        return (
            f"parts of the wall are {1e3 * ripple_m:.1f} mm RMS off the plane: ripples of the"
            " lidar, or a wall that is not flat; use a flat, matt wall and let the lidar warm up"
        )
    if not bent:
        return ""

    by_noise = (
        flat.bend_m <= SURE_SIGMAS * flat.bend_std_m
        and flat.bend_deg <= SURE_SIGMAS * flat.bend_std_deg
    )
    if by_noise:
        return (
            f"noise leaves {_amounts(flat)} between half of the view and the whole: average more"
            " frames"
        )
    return (
        f"half of the view differs from the whole by {_amounts(flat)}: a bent wall, or ripples"
        " of the lidar; use a flat wall and let the lidar warm up"
    )


def out_of_range(distance_m: float, facing_deg: float) -> list[str]:
    """Return a line for each of distance and angle that is outside the paper's ranges, with the
    move that cures it.
    """
    problems: list[str] = []
    # Centimetres and degrees are rounded up, so that following the advice once is enough.
    low, high = DISTANCE_RANGE_M
    if not low - TOLERANCE_M <= distance_m <= high + TOLERANCE_M:
        way = "back" if distance_m < low else "closer"
        by_cm = at_least(100.0 * max(low - distance_m, distance_m - high))
        problems.append(
            f"{distance_m:.3f} m is outside {low:.2f} to {high:.2f} m: move the lidar {by_cm} cm"
            f" {way}"
        )

    low, high = FACING_RANGE_DEG
    if not low - TOLERANCE_DEG <= facing_deg <= high + TOLERANCE_DEG:
        way = "aside" if facing_deg < low else "towards the wall"
        turn = at_least(max(low - facing_deg, facing_deg - high))
        problems.append(
            f"{facing_deg:.1f} degrees is outside {low:.0f} to {high:.0f}: turn the lidar {turn} "
            f"degree{'s' * (turn != 1)} {way}"
        )
    return problems


def at_least(amount: float) -> int:
    """Return the smallest whole number from 1 on that suffices, to a thousandth."""
    return max(ceil(amount - 1e-3), 1)


@dataclass(frozen=True)
class WallMeasures:
    """Distance and angles of a plane 1 / z = slopes . ray, with standard uncertainties; 1.96 of
    them hold 95 %.
    """

    distance_m: float
    yaw_deg: float
    pitch_deg: float
    facing_deg: float
    distance_std_m: float
    yaw_std_deg: float
    pitch_std_deg: float
    facing_std_deg: float


def measures_of(slopes: Float64, covariance: Float64) -> WallMeasures:
    """Return distance and angles of `slopes` (3,) = -normal / distance_m with covariance (3, 3)."""
    normal, distance_m = geometry.plane_from_slopes(slopes)
    along, across = geometry.plane_gradients(normal, distance_m)
    turn = across @ covariance @ across.T
    # yaw = atan2(x, -z) has the gradient (-z, 0, x) / (x^2 + z^2) over the normal, and pitch =
    # asin(-y) the gradient -1 / sqrt(1 - y^2) = -1 / sqrt(x^2 + z^2) along y.
    x = normal[0]
    z = normal[2]
    level = x**2 + z**2
    yaw_rad, pitch_rad = geometry.angles_from_normal(normal)
    return WallMeasures(
        distance_m=distance_m,
        yaw_deg=degrees(yaw_rad),
        pitch_deg=degrees(pitch_rad),
        facing_deg=degrees(_facing_rad(normal)),
        distance_std_m=geometry.propagated_std(along, covariance),
        yaw_std_deg=degrees(geometry.propagated_std(np.array([-z, 0.0, x]) / level, turn)),
        pitch_std_deg=degrees(
            geometry.propagated_std(np.array([0.0, -1.0, 0.0]) / sqrt(level), turn)
        ),
        facing_std_deg=degrees(_facing_std_rad(normal, turn)),
    )


def _facing_rad(normal: Float64) -> float:
    """Return the facing angle by its tangent, which unlike the cosine resolves small angles."""
    return float(np.arctan2(np.hypot(normal[0], normal[1]), -normal[2]))


def _facing_std_rad(normal: Float64, turn: Float64) -> float:
    """Return the standard uncertainty of the facing angle, `turn` (3, 3) being the normal's
    covariance.
    """
    # A turn towards the axis changes the facing angle f one for one. A turn aside by s changes it
    # to sqrt(f^2 + s^2): by nothing while s << f, by s itself at f = 0, with the standard deviation
    # s^2 / sqrt(f^2 + s^2) in between. There f is measured too large by about s, so the smallest f
    # that s allows is used.
    facing_rad = _facing_rad(normal)
    sideways = float(np.hypot(normal[0], normal[1]))
    x, y = normal[:2] / sideways if sideways > 0.0 else (1.0, 0.0)
    towards = np.array([x * -normal[2], y * -normal[2], sideways])
    aside = np.array([-y, x, 0.0])
    variance = float(aside @ turn @ aside)
    smallest_rad = max(facing_rad - 2.0 * sqrt(max(variance, 0.0)), 0.0)
    second_order = variance**2 / (variance + smallest_rad**2) if variance > 0.0 else 0.0
    return sqrt(float(towards @ turn @ towards) + second_order)


MIN_VALID_SHARE = 0.05
STUCK_SHARE = 0.5
"""Share of identical depths of a stuck lidar: noise spreads those of a true wall, even one that is
faced squarely.
"""
BLOCK_PIXELS = 4
SEEN_IN_BLOCK = 0.75
STRAY_IN_BLOCK = 0.875
MAX_STRAY_SHARE = 0.05
"""Scattered outliers are noise; blocks that stray together are another surface or another light
path. At 40 % of scattered outliers a full block strays by chance once in 8,000, and one where the
wall itself gives no return once in 200."""


@dataclass(frozen=True)
class WallFit(WallMeasures):
    """Measured wall: pose, uncertainty, quality of the depth, and whether the paper's method works
    from there.

    The standard uncertainties (*_std) include noise and ripples visible in the residuals, but no
    error that all depths share: for that see `range_offset`.
    """

    wall_from_lidar: Float64
    """(4, 4)."""
    covariance: Float64 = field(repr=False)
    """(3, 3) of -normal / distance, with the distance from the zero of depth."""
    residual_m: float
    """RMS distance of the inliers from the plane."""
    noise_scale: float
    """Noise of a depth sample over nominal: from the spread over frames; for one frame from the
    residuals.
    """
    inlier_fraction: float
    inliers: Mask = field(repr=False)
    """(height, width); pixels of the plane fit."""
    ripple_m: float
    """RMS deviation of parts of the wall from the plane, beyond noise."""
    bend_m: float
    bend_deg: float
    """Largest difference between planes through half of the view and through the whole."""
    bend_std_deg: float
    """Standard uncertainty of that angle by noise alone."""
    verdict: Verdict
    advice: str
    """One sentence: the reason for the verdict, or the remedy."""
    warnings: tuple[str, ...]


def wall_depth(wall_from_lidar: Float64, intrinsics: geometry.Intrinsics) -> Float64:
    """Return the depth (height, width) in metres of a bare, endless wall; inf where a beam never
    meets it.
    """
    # depth x ray . normal + distance = 0, with the normal the third row of the rotation
    away = -(intrinsics.rays() @ wall_from_lidar[2, :3])
    depth_m = np.full(away.shape, np.inf)
    return np.divide(wall_from_lidar[2, 3], away, out=depth_m, where=away > 0.0)


def fit_wall(
    depth_m: NDArray[np.floating],
    intrinsics: geometry.Intrinsics,
    generator: np.random.Generator,
    noise: MeanNoise | None = None,
    origin_m: float = 0.0,
) -> WallFit:
    """Measure the wall from a mean depth map (height, width); NaN, infinite and non-positive depths
    are no return.

    `noise` is that of the flattened map (`DepthMean.noise`), by default of one frame. The pose is
    that of a point `origin_m` behind the zero of depth on the optical axis (`range_offset`). Raises
    WallRefusedError where the depth is not that of one bare, flat wall.
    """
    # In order: refuse an empty or constant map, fit, refuse a second surface, then a wall that is
    # not flat; what is left is measured, and ripples widen its covariance.
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan).astype(np.float64)
    _check_depth(depth_m)
    rays = intrinsics.rays()
    plane = fit_depth(rays.reshape(-1, 3), depth_m.ravel(), generator, noise)
    if plane.normal[2] >= 0.0:
        raise WallRefusedError(
            "the optical axis never meets the wall's plane: turn the lidar towards the wall"
        )
    # The spread over frames is noise alone; the residuals of one frame hold ripples as well.
    scale = noise.scale if noise is not None and noise.measured else plane.noise_scale
    _check_one_surface(depth_m, plane_depth_m(rays, plane.slopes))
    flat = flatness(plane, rays)
    rippled = ripples(plane, rays)
    check_flat(flat, rippled.rms_m)
    measures = measures_of(plane.slopes, rippled.covariance)
    # the origin is at -origin_m z, farther from the plane by the normal's component along that
    measures = replace(measures, distance_m=plane.distance_m - origin_m * float(plane.normal[2]))
    verdict, advice = judge(measures.distance_m, measures.facing_deg, flat, rippled.rms_m)
    return WallFit(
        **vars(measures),
        wall_from_lidar=geometry.wall_from_plane(plane.normal, measures.distance_m),
        covariance=rippled.covariance,
        residual_m=plane.residual_m,
        noise_scale=scale,
        inlier_fraction=plane.inlier_fraction,
        inliers=plane.inliers.reshape(depth_m.shape),
        ripple_m=rippled.rms_m,
        bend_m=flat.bend_m,
        bend_deg=flat.bend_deg,
        bend_std_deg=flat.bend_std_deg,
        verdict=verdict,
        advice=advice,
        warnings=warnings(rippled.rms_m, scale),
    )


def _check_depth(depth_m: Float64) -> None:
    """Raise WallRefusedError for a map that is nearly empty or constant."""
    valid_m = depth_m[np.isfinite(depth_m)]
    share = len(valid_m) / depth_m.size
    if share < MIN_VALID_SHARE:
        raise WallRefusedError(
            f"{share:.1%} of the pixels have depth, {MIN_VALID_SHARE:.0%} needed: is the lens free"
            " and the wall near?"
        )
    # Depth comes in steps of 0.25 mm and noise spreads it over several, so that half of a live view
    # never reads one and the same value.
    some_m = valid_m[:: max(len(valid_m) // STATISTICS_POINTS, 1)]
    values_m, times = np.unique(some_m, return_counts=True)
    if times.max() >= STUCK_SHARE * len(some_m):
        raise WallRefusedError(
            f"{times.max() / len(some_m):.0%} of the view reads {values_m[times.argmax()]:.5f} m,"
            " as if the lidar were stuck: restart it"
        )


def _check_one_surface(depth_m: Float64, expected_m: Float64) -> None:
    """Raise WallRefusedError for a map in which blocks of pixels stray from the wall together; NaN
    is ignored.
    """
    # The noise of single samples, whatever the number of frames: ripples do not fall with it.
    gate_m = GATE_SIGMAS * depth_noise_m(depth_m)
    valid = np.isfinite(depth_m)
    behind = valid & (depth_m - expected_m > gate_m)
    before = valid & (expected_m - depth_m > gate_m)
    returns, returns_behind, returns_before = (
        block_sums(mask, BLOCK_PIXELS) for mask in (valid, behind, before)
    )
    blocks = returns >= SEEN_IN_BLOCK * BLOCK_PIXELS**2
    total = max(int(blocks.sum()), 1)
    stray = blocks & (returns_behind + returns_before >= STRAY_IN_BLOCK * returns)
    if stray.sum() <= MAX_STRAY_SHARE * total:
        return
    far = (stray & (returns_behind >= returns_before)).sum() / total
    near = stray.sum() / total - far
    raise WallRefusedError(
        f"this does not look like a bare wall: {far:.0%} of the view is behind the wall's plane"
        f" (light by way of a hidden object?), {near:.0%} in front of it (an occluder?): remove"
        " everything in front of the wall"
    )
