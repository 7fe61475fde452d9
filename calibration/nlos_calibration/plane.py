"""Robust plane fit to a lidar's depth: consensus first, then least squares over the inliers.

Along the ray r = p / p_z of a pixel, the plane normal . p + distance_m = 0 reads p_z (normal . r) =
-distance_m, so p_z = 1 / (slopes . r) with slopes = -normal / distance_m: inverse depth is linear
in the slopes. The noise, however, is on p_z, and the mean of 1 / p_z is biased by it; therefore p_z
itself is fitted, by Gauss-Newton steps.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import plane_from_slopes
from nlos_calibration.noise import MEDIAN_PER_SIGMA, STATISTICS_POINTS, MeanNoise, depth_noise_m

GATE_SIGMAS = 5.0
MIN_SCALE = 0.25
MAX_SCALE = 8.0
"""Limits of the residuals over the expected noise: the gate neither closes on exact depth nor opens
to anything.
"""
MIN_DEPTH_M = 0.01
"""Nearest depth used; below it the gate would be as wide as the depth."""
FARTHEST_M = 1000.0
"""Depth assigned to a beam that never meets the plane."""
MIN_POINTS = 100
"""A plane through fewer points cannot be checked."""
MIN_INLIER_FRACTION = 0.5
"""Two planes cannot both hold a majority."""
MIN_RAY_EXTENT = 0.1
"""Narrowest angular width (tangent) of the middle 80 % of the inliers: points in a line do not
define a plane.
"""
MIN_TRIPLE_AREA = 1e-4
TRIPLES = 300
SCORED_POINTS = 2000
MAX_REFITS = 20
SETTLED_SIGMAS = 1e-3
"""A step smaller than this, in standard uncertainties of the slopes, ends the iteration."""


@dataclass(frozen=True)
class PlaneFit:
    """A plane normal . p + distance_m = 0 in the lidar frame, the unit normal towards the lidar."""

    normal: Float64
    """(3,)."""
    distance_m: float
    residual_m: float
    """RMS distance of the inliers from the plane."""
    inlier_fraction: float
    """Inliers as a share of the valid points."""
    inliers: Mask
    """(N,); False for points that are not valid."""
    slopes: Float64
    """(3,); -normal / distance_m."""
    covariance: Float64
    """(3, 3) of the slopes, scaled by the residuals, as if these were independent of one
    another.
    """
    noise_scale: float
    """RMS of the residuals over the expected noise."""
    errors_m: Float64
    """(N,); depth residuals, positive beyond the plane; NaN except for inliers."""
    sigmas_m: Float64
    """(N,); expected noise of the residuals; NaN except for inliers."""


@dataclass(frozen=True)
class _Points:
    """Valid points: rays (n, 3) of unit z, depths (n,) along them, and the noise of these."""

    rays: Float64
    depth_m: Float64
    noise: MeanNoise

    def at(self, points: Mask | slice) -> "_Points":
        return _Points(self.rays[points], self.depth_m[points], self.noise.at(points))

    def thinned(self) -> "_Points":
        return self.at(slice(None, None, max(len(self.rays) // STATISTICS_POINTS, 1)))


def fit_depth(
    rays: Float64,
    depth_m: Float64,
    generator: np.random.Generator,
    noise: MeanNoise | None = None,
    min_extent: float = MIN_RAY_EXTENT,
) -> PlaneFit:
    """Fit the plane of most of the depths (N,) along rays (N, 3) of unit z; NaN and non-positive
    depths are ignored.

    `noise` is that of the depths, by default of single samples; inliers narrower than `min_extent`
    count as a line. Raises WallRefusedError for too few depths, for no plane that holds half of
    them, and for inliers in a line (also a wall seen edge on).
    """
    # Consensus finds the majority among outliers; a refit on 20,000 points at most brings slopes
    # and noise scale close, so that the refit on all points settles in a step or two.
    valid = np.isfinite(depth_m) & (depth_m >= MIN_DEPTH_M)
    count = int(valid.sum())
    if count < MIN_POINTS:
        raise WallRefusedError(
            f"{count} points in front of the lidar, {MIN_POINTS} needed: point it at the wall"
        )
    points = _Points(rays[valid], depth_m[valid], (noise or MeanNoise()).at(valid))
    slopes, scale, _ = _refit(points.thinned(), _consensus(points, generator), np.inf)
    slopes, _, inside = _refit(points, slopes, scale)
    _check_majority(inside, points, slopes)
    agreed = points if inside.all() else points.at(inside)
    _check_extent(agreed.thinned().rays, min_extent)
    inliers = valid.copy()
    inliers[valid] = inside
    return _plane(slopes, agreed, float(inside.mean()), inliers)


def _plane(slopes: Float64, agreed: _Points, inlier_fraction: float, inliers: Mask) -> PlaneFit:
    """Return the fit with `slopes` and its covariance from the inliers `agreed`."""
    errors_m, sigmas_m, predicted_m = _errors(agreed, slopes)
    # Covariance of weighted least squares: chi^2 (J' J)^-1, with J and residuals in standard
    # deviations and chi^2 their mean square over n - 3 degrees of freedom. The mean square, not a
    # median: outliers within the gate move the slopes as much as the noise that they resemble.
    rows, sigmas = _rows(
        agreed.rays, errors_m, sigmas_m, predicted_m, np.ones(len(errors_m), np.bool_)
    )
    chi2 = float(sigmas @ sigmas) / max(len(sigmas) - 3, 1)
    normal, distance_m = plane_from_slopes(slopes)
    all_errors_m, all_sigmas_m = np.full((2, len(inliers)), np.nan)
    all_errors_m[inliers] = errors_m
    all_sigmas_m[inliers] = sigmas_m
    return PlaneFit(
        normal=normal,
        distance_m=distance_m,
        # similar triangles: a depth residual e at predicted depth p is e x distance / p along the
        # normal
        residual_m=float(np.sqrt(np.mean((errors_m * distance_m / predicted_m) ** 2))),
        inlier_fraction=inlier_fraction,
        inliers=inliers,
        slopes=slopes,
        covariance=chi2 * np.linalg.pinv(rows.T @ rows).astype(np.float64),
        noise_scale=sqrt(chi2),
        errors_m=all_errors_m,
        sigmas_m=all_sigmas_m,
    )


def plane_depth_m(rays: Float64, slopes: Float64) -> Float64:
    """Return the depth (...) of planes along rays (..., 3), FARTHEST_M where a ray misses; slopes
    (3,) or (3, n).
    """
    return 1.0 / np.maximum(rays @ slopes, 1.0 / FARTHEST_M)


def _errors(points: _Points, slopes: Float64) -> tuple[Float64, Float64, Float64]:
    """Return depth residuals, their expected noise and the plane's depth, each (n,) in metres."""
    predicted_m = plane_depth_m(points.rays, slopes)
    return points.depth_m - predicted_m, points.noise.of(predicted_m), predicted_m


def _consensus(points: _Points, generator: np.random.Generator) -> Float64:
    """Return the slopes (3,) of the best plane through three random points (MSAC: Torr and
    Zisserman, 2000).
    """
    # Three pixels determine the slopes: R slopes = 1 / depth. With half of the points on the wall
    # one triple in eight lies on it entirely; that none of 300 does has a probability of (7 /
    # 8)^300 = 4e-18.
    triples = generator.integers(len(points.rays), size=(TRIPLES, 3))
    # the determinant of three rays of unit z is twice the area of their triangle in the image: 0
    # for points in a line
    triples = triples[np.abs(np.linalg.det(points.rays[triples])) > 2.0 * MIN_TRIPLE_AREA]
    if len(triples) == 0:
        raise WallRefusedError(_line_message(0.0))
    candidates = np.linalg.solve(
        points.rays[triples], 1.0 / points.depth_m[triples][..., np.newaxis]
    )[..., 0]
    # 2,000 points rank the candidates: an inlier share of one half is known to 1.1 % then.
    scored = generator.integers(len(points.rays), size=SCORED_POINTS)
    predicted_m = plane_depth_m(points.rays[scored], candidates.T.astype(np.float64))
    errors = (points.depth_m[scored, np.newaxis] - predicted_m) / _widest_gate_m(
        predicted_m, points.noise
    )
    # MSAC's cost: the square inside the gate, and 1 for an outlier, however far it is.
    cost = np.minimum(errors**2, 1.0).sum(axis=0)
    return candidates[np.argmin(cost)]


def _widest_gate_m(predicted_m: Float64, noise: MeanNoise) -> Float64:
    """Return the initial gate: that of a single sample, since ripples do not fall with the number
    of samples.
    """
    return GATE_SIGMAS * max(noise.scale, 1.0) * depth_noise_m(predicted_m)


def _refit(points: _Points, slopes: Float64, scale: float) -> tuple[Float64, float, Mask]:
    """Repeat weighted least squares over the points inside the gate until it settles.

    Returns slopes, residual scale (inf while unknown) and the inliers.
    """
    inside = np.zeros(len(points.rays), np.bool_)
    few = points.thinned()
    for _ in range(MAX_REFITS):
        errors_m, sigmas_m, predicted_m = _errors(points, slopes)
        inside = np.abs(errors_m) <= _gate_m(points.noise, scale, sigmas_m, predicted_m)
        if inside.sum() < 3:
            break
        rows, sigmas = _rows(points.rays, errors_m, sigmas_m, predicted_m, inside)
        step = np.linalg.lstsq(rows.T @ rows, rows.T @ sigmas)[0]
        slopes = slopes + step
        before = scale
        scale = _residual_scale(few, slopes, scale)
        # |J step|^2 is the step in units of the slopes' own covariance (J' J)^-1
        if (
            float(np.sum((rows @ step) ** 2)) < SETTLED_SIGMAS**2
            and abs(scale - before) < SETTLED_SIGMAS * before
        ):
            break
    return slopes, scale, inside


def _rows(
    rays: Float64, errors_m: Float64, sigmas_m: Float64, predicted_m: Float64, inside: Mask
) -> tuple[Float64, Float64]:
    """Return the linear problem J step = b of one Gauss-Newton step, (n, 3) and (n,), in standard
    deviations.
    """
    # p_z = 1 / (slopes . r), so d p_z / d slopes = -p_z^2 r, and the residual z - p_z has the
    # derivative J = +p_z^2 r: it vanishes to first order where J step = -(z - p_z). Weights come
    # from the predicted depth, not from the noisy sample, whose own weight would favour samples
    # that read too near.
    weight = np.where(inside, 1.0 / sigmas_m, 0.0)
    return rays * (predicted_m**2 * weight)[:, np.newaxis], -errors_m * weight


def _gate_m(noise: MeanNoise, scale: float, sigmas_m: Float64, predicted_m: Float64) -> Float64:
    """Return the largest residual (n,) of an inlier: by the measured residual scale once that is
    known.
    """
    widest_m = _widest_gate_m(predicted_m, noise)
    if not np.isfinite(scale):
        return widest_m
    return np.minimum(GATE_SIGMAS * max(scale, MIN_SCALE) * sigmas_m, MAX_SCALE * widest_m)


def _residual_scale(points: _Points, slopes: Float64, scale: float) -> float:
    """Return the residuals over the expected noise by the median of those inside the gate, robust
    to outliers.
    """
    errors_m, sigmas_m, predicted_m = _errors(points, slopes)
    inside = np.abs(errors_m) <= _gate_m(points.noise, scale, sigmas_m, predicted_m)
    if not inside.any():
        return scale
    return float(np.median(np.abs(errors_m[inside] / sigmas_m[inside]))) / MEDIAN_PER_SIGMA


def _check_majority(inside: Mask, points: _Points, slopes: Float64) -> None:
    """Raise WallRefusedError if fewer than half of the points are inliers."""
    if inside.mean() >= MIN_INLIER_FRACTION:
        return
    # Light that comes by way of a hidden object reads too far; an occluder reads too near.
    farther = _errors(points, slopes)[0] > 0.0
    behind = (~inside & farther).mean()
    before = (~inside & ~farther).mean()
    raise WallRefusedError(
        f"only {inside.mean():.1%} of the depth lies on one plane ({MIN_INLIER_FRACTION:.0%}"
        f" needed), {behind:.0%} is behind it and {before:.0%} in front: remove object and"
        " occluder, so that the lidar sees one bare wall"
    )


def _check_extent(rays: Float64, min_extent: float) -> None:
    """Raise WallRefusedError if the inliers are in a line across the view."""
    # width along the minor principal axis; percentiles, since a few chance inliers beside a line do
    # not make a plane
    centred = rays[:, :2] - rays[:, :2].mean(axis=0)
    narrow = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    low, high = np.percentile(centred @ narrow, (10.0, 90.0))
    if high - low < min_extent:
        raise WallRefusedError(_line_message(float(high - low)))


def _line_message(extent: float) -> str:
    return (
        f"the points are in a line {np.degrees(extent):.1f}° wide"
        f" ({np.degrees(MIN_RAY_EXTENT):.1f}° needed), as of a wall seen edge on: turn the lidar"
        " towards the wall"
    )
