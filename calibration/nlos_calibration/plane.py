"""A plane through a lidar's points: consensus first, then least squares over the points that agree.

Along the ray r = p / p_z of a pixel, a plane normal . p + distance_m = 0 reads 1 / p_z = slopes . r with slopes =
-normal / distance_m: linear in the unknowns, with the noise on the left side only, so least squares has no bias.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.errors import WallRefusedError

Array = NDArray[np.float64]
Depth = TypeVar("Depth", float, Array)

NOISE_FLOOR_M, NOISE_PER_METRE = 0.0005, 0.002
"""Standard deviation of one depth sample: the floor, and what each metre of depth adds."""
GATE_SIGMAS = 5.0
MIN_DEPTH_M = 0.01
"""Nothing nearer can be measured, and the gate would be as wide as the depth."""
MIN_POINTS = 100
"""A plane through fewer points cannot be checked."""
MIN_INLIER_FRACTION = 0.5
"""Two planes cannot both hold a majority."""
MIN_RAY_EXTENT = 0.1
"""How wide (tangent of an angle) the middle four fifths of the points must be seen: a line has no plane of its own."""
MIN_TRIPLE_AREA = 1e-4
TRIPLES, SCORED_POINTS, MAX_REFITS = 300, 2000, 20


@dataclass(frozen=True)
class PlaneFit:
    """A plane normal . p + distance_m = 0 in the lidar frame, the unit normal towards the lidar."""

    normal: Array
    """(3,)."""
    distance_m: float
    residual_m: float
    """RMS distance of the inliers from the plane."""
    inlier_fraction: float
    """Share of the valid points that lie on the plane."""
    inliers: NDArray[np.bool_]
    """(N,); False for points that are not valid."""


def depth_noise_m(depth_m: Depth) -> Depth:
    """The standard deviation of a depth sample at `depth_m`, any shape."""
    return NOISE_FLOOR_M + NOISE_PER_METRE * depth_m


def fit_plane(points_m: Array, generator: np.random.Generator) -> PlaneFit:
    """Fit the plane that most of the points (N, 3) in the lidar frame lie on; NaN and points behind are left out.

    Raises WallRefusedError where there are too few points, where no plane holds half of them, and where they are seen
    along a line (collinear, or a wall seen edge on).
    """
    valid = np.isfinite(points_m).all(axis=1) & (points_m[:, 2] >= MIN_DEPTH_M)
    count = int(valid.sum())
    if count < MIN_POINTS:
        raise WallRefusedError(f"{count} points in front of the lidar, {MIN_POINTS} needed: point it at the wall")
    points = points_m[valid].astype(np.float64)
    rays, inverse = points / points[:, 2:], 1.0 / points[:, 2]
    gate = GATE_SIGMAS * depth_noise_m(points[:, 2]) * inverse**2
    slopes, inside = _refit(rays, inverse, gate, _consensus(rays, inverse, gate, generator))
    _check_majority(inside, inverse - rays @ slopes)
    _check_extent(rays[inside])
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    normal = -slopes * distance_m
    residual_m = float(np.sqrt(np.mean((points[inside] @ normal + distance_m) ** 2)))
    inliers = valid.copy()
    inliers[valid] = inside
    return PlaneFit(normal, distance_m, residual_m, float(inside.mean()), inliers)


def _consensus(rays: Array, inverse: Array, gate: Array, generator: np.random.Generator) -> Array:
    """The slopes (3,), out of those through random triples of points, that the most points agree on."""
    triples = generator.integers(len(rays), size=(TRIPLES, 3))
    # the determinant of three rays is twice the area of their triangle in the image: none for points seen in a line
    triples = triples[np.abs(np.linalg.det(rays[triples])) > 2.0 * MIN_TRIPLE_AREA]
    if len(triples) == 0:
        raise WallRefusedError(_in_a_line(0.0))
    candidates = np.linalg.solve(rays[triples], inverse[triples][..., np.newaxis])[..., 0]
    some = generator.integers(len(rays), size=SCORED_POINTS)
    errors = (inverse[some, np.newaxis] - rays[some] @ candidates.T) / gate[some, np.newaxis]
    return candidates[np.argmin(np.minimum(errors**2, 1.0).sum(axis=0))]


def _refit(rays: Array, inverse: Array, gate: Array, slopes: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Weighted least squares over the inliers, repeated until they stay the same: (slopes, inliers)."""
    inside = np.abs(inverse - rays @ slopes) <= gate
    for _ in range(MAX_REFITS):
        if inside.sum() < 3:
            break
        slopes = _least_squares(rays[inside], inverse[inside], slopes)
        before, inside = inside, np.abs(inverse - rays @ slopes) <= gate
        if np.array_equal(before, inside):
            break
    return slopes, inside


def _least_squares(rays: Array, inverse: Array, slopes: Array) -> Array:
    # weights from the plane predicted last, not from the noisy sample: those would favour samples that err far
    depth_m = 1.0 / (rays @ slopes)
    root_weight = depth_m**2 / depth_noise_m(depth_m)
    return np.linalg.lstsq(rays * root_weight[:, np.newaxis], inverse * root_weight)[0].astype(np.float64)


def _check_majority(inside: NDArray[np.bool_], nearer: Array) -> None:
    if inside.mean() >= MIN_INLIER_FRACTION:
        return
    behind, before = (~inside & (nearer <= 0.0)).mean(), (~inside & (nearer > 0.0)).mean()
    raise WallRefusedError(
        f"only {inside.mean():.1%} of the depth lies on one plane ({MIN_INLIER_FRACTION:.0%} needed), {behind:.0%} is "
        f"behind it and {before:.0%} in front: take away object and occluder, so that the lidar sees one bare wall",
    )


def _check_extent(rays: Array) -> None:
    """Refuse inliers seen in a line; percentiles, since a few chance inliers beside a line do not make a plane."""
    centred = rays[:, :2] - rays[:, :2].mean(axis=0)
    narrow = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    low, high = np.percentile(centred @ narrow, (10.0, 90.0))
    if high - low < MIN_RAY_EXTENT:
        raise WallRefusedError(_in_a_line(float(high - low)))


def _in_a_line(extent: float) -> str:
    return (
        f"the points are seen in a line {np.degrees(extent):.1f} degrees wide ({np.degrees(MIN_RAY_EXTENT):.1f} "
        "needed), as of a wall seen edge on: turn the lidar towards the wall"
    )
