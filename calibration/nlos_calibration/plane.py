"""A plane through a lidar's points: consensus first, then least squares over the points that agree.

Along the ray r = p / p_z of a pixel, a plane normal . p + distance_m = 0 reads p_z = 1 / (slopes . r) with slopes =
-normal / distance_m. The noise is on p_z, so that is what is fitted (by Gauss and Newton's steps): 1 / p_z would be
linear in the slopes, but noise moves its mean.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.noise import STATISTICS_POINTS, MeanNoise, depth_noise_m

GATE_SIGMAS = 5.0
MIN_SCALE, MAX_SCALE = 0.25, 8.0
"""Of the residuals over the noise to expect: a gate cannot close on exact depth, nor open to anything."""
MIN_DEPTH_M = 0.01
"""Nothing nearer can be measured, and the gate would be as wide as the depth."""
FARTHEST_M = 1000.0
"""Where a beam that never meets the plane is held to meet it."""
MIN_POINTS = 100
"""A plane through fewer points cannot be checked."""
MIN_INLIER_FRACTION = 0.5
"""Two planes cannot both hold a majority."""
MIN_RAY_EXTENT = 0.1
"""How wide (tangent of an angle) the middle four fifths of the points must be seen: a line has no plane of its own."""
MIN_TRIPLE_AREA = 1e-4
TRIPLES, SCORED_POINTS, MAX_REFITS = 300, 2000, 20
SETTLED_SIGMAS = 1e-3
"""A step this small against the slopes' uncertainty changes nothing."""
MEDIAN_PER_SIGMA = 0.67449
"""The median of |x| of a normal distribution."""


@dataclass(frozen=True)
class PlaneFit:
    """A plane normal . p + distance_m = 0 in the lidar frame, the unit normal towards the lidar."""

    normal: Float64
    """(3,)."""
    distance_m: float
    residual_m: float
    """RMS distance of the inliers from the plane."""
    inlier_fraction: float
    """Share of the valid points that lie on the plane."""
    inliers: Mask
    """(N,); False for points that are not valid."""
    slopes: Float64
    """(3,); -normal / distance_m."""
    covariance: Float64
    """(3, 3) of the slopes, scaled by the residuals, as if these were independent of one another."""
    noise_scale: float
    """RMS of the residuals over the noise to expect."""
    errors_m: Float64
    """(N,); how far each point's depth is beyond the plane's; NaN but for inliers."""
    sigmas_m: Float64
    """(N,); the noise to expect there; NaN but for inliers."""


@dataclass(frozen=True)
class _Points:
    """The points that are valid."""

    rays: Float64
    depth_m: Float64
    noise: MeanNoise

    def at(self, points: Mask | slice) -> "_Points":
        return _Points(self.rays[points], self.depth_m[points], self.noise.at(points))

    def few(self) -> "_Points":
        return self.at(slice(None, None, max(len(self.rays) // STATISTICS_POINTS, 1)))


def fit_plane(points_m: Float64, generator: np.random.Generator, noise: MeanNoise | None = None) -> PlaneFit:
    """Fit the plane that most of the points (N, 3) in the lidar frame lie on: `fit_depth` of points."""
    depth_m = np.where(np.isfinite(points_m).all(axis=1), points_m[:, 2], np.nan)
    seen = depth_m >= MIN_DEPTH_M
    rays = np.divide(points_m, depth_m[:, np.newaxis], out=np.zeros_like(points_m), where=seen[:, np.newaxis])
    return fit_depth(rays, depth_m, generator, noise)


def fit_depth(
    rays: Float64,
    depth_m: Float64,
    generator: np.random.Generator,
    noise: MeanNoise | None = None,
    min_extent: float = MIN_RAY_EXTENT,
) -> PlaneFit:
    """Fit the plane that most of the depths (N,) along rays (N, 3) of unit z lie on, but for NaN and what is behind.

    `noise` is that of the depths; one sample's where it is not given. A plane that is seen narrower than `min_extent`
    counts as a line. Raises WallRefusedError where there are too few
    depths, where no plane holds half of them, and where they are seen along a line (collinear, or a wall seen edge on).
    """
    valid = np.isfinite(depth_m) & (depth_m >= MIN_DEPTH_M)
    count = int(valid.sum())
    if count < MIN_POINTS:
        raise WallRefusedError(f"{count} points in front of the lidar, {MIN_POINTS} needed: point it at the wall")
    points = _Points(rays[valid], depth_m[valid], (noise or MeanNoise()).at(valid))
    slopes, scale, _ = _refit(points.few(), _consensus(points, generator), np.inf)
    slopes, _, inside = _refit(points, slopes, scale)
    _check_majority(inside, points, slopes)
    agreed = points if inside.all() else points.at(inside)
    _check_extent(agreed.few().rays, min_extent)
    inliers = valid.copy()
    inliers[valid] = inside
    return _plane(slopes, agreed, float(inside.mean()), inliers)


def _plane(slopes: Float64, agreed: _Points, inlier_fraction: float, inliers: Mask) -> PlaneFit:
    """The plane of `slopes`, fitted to the points that agreed.

    Its covariance is scaled by the residuals' mean square, not their median: outliers inside the gate move the slopes
    like the noise that they look like.
    """
    errors_m, sigmas_m, predicted_m = _errors(agreed, slopes)
    rows, sigmas = _rows(agreed.rays, errors_m, sigmas_m, predicted_m, np.ones(len(errors_m), np.bool_))
    chi2 = float(sigmas @ sigmas) / max(len(sigmas) - 3, 1)
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    return PlaneFit(
        normal=-slopes * distance_m,
        distance_m=distance_m,
        residual_m=float(np.sqrt(np.mean((errors_m * distance_m / predicted_m) ** 2))),
        inlier_fraction=inlier_fraction,
        inliers=inliers,
        slopes=slopes,
        covariance=chi2 * np.linalg.pinv(rows.T @ rows).astype(np.float64),
        noise_scale=sqrt(chi2),
        errors_m=_spread_over(inliers, errors_m),
        sigmas_m=_spread_over(inliers, sigmas_m),
    )


def _spread_over(inliers: Mask, values: Float64) -> Float64:
    everywhere = np.full(len(inliers), np.nan)
    everywhere[inliers] = values
    return everywhere


def plane_depth_m(rays: Float64, slopes: Float64) -> Float64:
    """The depth (...) of planes along rays (..., 3), far away where a ray never meets them; slopes (3,) or (3, n)."""
    return 1.0 / np.maximum(rays @ slopes, 1.0 / FARTHEST_M)


def _errors(points: _Points, slopes: Float64) -> tuple[Float64, Float64, Float64]:
    """How far depths are beyond the plane's, the noise to expect there, and the plane's depth (far if it has none)."""
    predicted_m = plane_depth_m(points.rays, slopes)
    return points.depth_m - predicted_m, points.noise.of(predicted_m), predicted_m


def _consensus(points: _Points, generator: np.random.Generator) -> Float64:
    """The slopes (3,), out of those through random triples of points, that the most points agree on."""
    triples = generator.integers(len(points.rays), size=(TRIPLES, 3))
    # the determinant of three rays is twice the area of their triangle in the image: none for points seen in a line
    triples = triples[np.abs(np.linalg.det(points.rays[triples])) > 2.0 * MIN_TRIPLE_AREA]
    if len(triples) == 0:
        raise WallRefusedError(_in_a_line(0.0))
    candidates = np.linalg.solve(points.rays[triples], 1.0 / points.depth_m[triples][..., np.newaxis])[..., 0]
    some = generator.integers(len(points.rays), size=SCORED_POINTS)
    predicted_m = plane_depth_m(points.rays[some], candidates.T.astype(np.float64))
    errors = (points.depth_m[some, np.newaxis] - predicted_m) / _widest_m(predicted_m, points.noise)
    return candidates[np.argmin(np.minimum(errors**2, 1.0).sum(axis=0))]


def _widest_m(predicted_m: Float64, noise: MeanNoise) -> Float64:
    """The gate to begin with: that of a single sample, since ripples do not fall with the number of samples."""
    return GATE_SIGMAS * max(noise.scale, 1.0) * depth_noise_m(predicted_m)


def _refit(points: _Points, slopes: Float64, scale: float) -> tuple[Float64, float, Mask]:
    """Weighted least squares over the points inside the gate, repeated until it moves no more.

    Returns slopes, the residuals' scale (inf while it is not known) and which points are inside.
    """
    inside, few = np.zeros(len(points.rays), np.bool_), points.few()
    for _ in range(MAX_REFITS):
        errors_m, sigmas_m, predicted_m = _errors(points, slopes)
        inside = np.abs(errors_m) <= _gate_m(points.noise, scale, sigmas_m, predicted_m)
        if inside.sum() < 3:
            break
        rows, sigmas = _rows(points.rays, errors_m, sigmas_m, predicted_m, inside)
        step = np.linalg.lstsq(rows.T @ rows, rows.T @ sigmas)[0]
        slopes, before = slopes + step, scale
        scale = _residual_scale(few, slopes, scale)
        if float(np.sum((rows @ step) ** 2)) < SETTLED_SIGMAS**2 and abs(scale - before) < SETTLED_SIGMAS * before:
            break
    return slopes, scale, inside


def _rows(
    rays: Float64, errors_m: Float64, sigmas_m: Float64, predicted_m: Float64, inside: Mask
) -> tuple[Float64, Float64]:
    """The linear least-squares problem of a step of the slopes, in standard deviations: d p_z = -p_z^2 r . step."""
    # weights from the plane predicted last, not from the noisy sample: those would favour samples that err far
    weight = np.where(inside, 1.0 / sigmas_m, 0.0)
    return rays * (predicted_m**2 * weight)[:, np.newaxis], -errors_m * weight


def _gate_m(noise: MeanNoise, scale: float, sigmas_m: Float64, predicted_m: Float64) -> Float64:
    """How far inliers may be off: the noise as the residuals show it, once they do."""
    widest_m = _widest_m(predicted_m, noise)
    if not np.isfinite(scale):
        return widest_m
    return np.minimum(GATE_SIGMAS * max(scale, MIN_SCALE) * sigmas_m, MAX_SCALE * widest_m)


def _residual_scale(points: _Points, slopes: Float64, scale: float) -> float:
    """The residuals over the noise to expect, by the median of those inside the gate, which few outliers move."""
    errors_m, sigmas_m, predicted_m = _errors(points, slopes)
    inside = np.abs(errors_m) <= _gate_m(points.noise, scale, sigmas_m, predicted_m)
    if not inside.any():
        return scale
    return float(np.median(np.abs(errors_m[inside] / sigmas_m[inside]))) / MEDIAN_PER_SIGMA


def _check_majority(inside: Mask, points: _Points, slopes: Float64) -> None:
    if inside.mean() >= MIN_INLIER_FRACTION:
        return
    farther = _errors(points, slopes)[0] > 0.0
    behind, before = (~inside & farther).mean(), (~inside & ~farther).mean()
    raise WallRefusedError(
        f"only {inside.mean():.1%} of the depth lies on one plane ({MIN_INLIER_FRACTION:.0%} needed), {behind:.0%} is "
        f"behind it and {before:.0%} in front: take away object and occluder, so that the lidar sees one bare wall",
    )


def _check_extent(rays: Float64, min_extent: float) -> None:
    """Refuse inliers seen in a line; percentiles, since a few chance inliers beside a line do not make a plane."""
    centred = rays[:, :2] - rays[:, :2].mean(axis=0)
    narrow = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    low, high = np.percentile(centred @ narrow, (10.0, 90.0))
    if high - low < min_extent:
        raise WallRefusedError(_in_a_line(float(high - low)))


def _in_a_line(extent: float) -> str:
    return (
        f"the points are seen in a line {np.degrees(extent):.1f} degrees wide ({np.degrees(MIN_RAY_EXTENT):.1f} "
        "needed), as of a wall seen edge on: turn the lidar towards the wall"
    )
