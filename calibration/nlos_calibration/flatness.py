"""Tests of a plane fit's residuals: bends of the wall, range offset and ripples of the lidar.

A bend, a curve, a step or a range offset makes a part of the view show another plane than the
whole, however small the residuals. Ripples correlate neighbouring residuals, which widens the
covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.geometry import plane_from_slopes, plane_gradients, propagated_std
from nlos_calibration.plane import PlaneFit

SURE_SIGMAS = 3.0
HALVES_POINTS = 60_000
"""Number of inliers that halves are compared by."""
MAX_OFFSET_M = 0.02
"""A larger offset is no constant of the device."""


@dataclass(frozen=True)
class Flatness:
    """Deviation of the depth from one flat wall."""

    bend_m: float
    bend_deg: float
    """Largest difference in distance and normal between half of the view and the whole."""
    bend_std_m: float
    bend_std_deg: float
    """Standard uncertainty of that difference by noise alone."""
    offset_m: float
    """Constant to add to every depth so that the halves agree best."""
    offset_bend_m: float
    offset_bend_deg: float
    """Bend that remains after adding the offset."""


def flatness(plane: PlaneFit, rays: Float64) -> Flatness:
    """Compare planes through halves of the view with `plane`, fitted to depth along `rays` (height,
    width, 3).
    """
    # Every half is four adjacent eighths, so that each of four cuts gives two. A fold or step along
    # a cut leaves both of its halves flat but different from the whole; one across it leaves both
    # as tilted as the whole, and another cut finds it. Normal equations add, so eighths suffice.
    matrices, rights, chi2 = _eighths(plane, rays.reshape(-1, 3))
    whole = matrices.sum(axis=0), rights.sum(axis=0)
    near = [(np.arange(4) + first) % 8 for first in range(8)]
    halves = [(matrices[some].sum(axis=0), rights[some].sum(axis=0)) for some in near]
    offset_m = _offset_m(*whole, chi2)
    bend_m, bend_deg = _bend(plane, [_step(*half) for half in halves], np.zeros(3))
    left_m, left_deg = _bend(
        plane, [_step(*half, offset_m) for half in halves], _step(*whole, offset_m)
    )
    stds = [
        _std(plane, chi2 * np.linalg.pinv(matrix[:3, :3]).astype(np.float64))
        for matrix, _ in halves
    ]
    return Flatness(
        bend_m=bend_m,
        bend_deg=bend_deg,
        bend_std_m=max(std[0] for std in stds),
        bend_std_deg=max(std[1] for std in stds),
        offset_m=offset_m,
        offset_bend_m=left_m,
        offset_bend_deg=left_deg,
    )


def _eighths(plane: PlaneFit, rays: Float64) -> tuple[Float64, Float64, float]:
    """Return normal equations of eight sectors, (8, 4, 4) and (8, 4), and the mean square residual
    in sigmas.
    """
    some = np.flatnonzero(plane.inliers)
    some = some[:: max(len(some) // HALVES_POINTS, 1)]
    inliers = rays[some]
    weight = 1.0 / plane.sigmas_m[some]
    sigmas = plane.errors_m[some] * weight
    predicted_m = 1.0 / (inliers @ plane.slopes)
    # unknowns: change of the slopes, d p_z = -p_z^2 r (`plane`), and a constant error of every
    # depth, d p_z = 1
    rows = np.column_stack([inliers * (-(predicted_m**2) * weight)[:, np.newaxis], weight])
    x, y = (inliers[:, :2] - np.median(inliers[:, :2], axis=0)).T
    eighth = np.floor(np.arctan2(y, x) * 4.0 / np.pi).astype(np.int64) % 8
    parts = [(rows[eighth == one], sigmas[eighth == one]) for one in range(8)]
    matrices = np.stack([part.T @ part for part, _ in parts])
    rights = np.stack([part.T @ b for part, b in parts])
    return matrices, rights, float(sigmas @ sigmas) / max(len(sigmas) - 3, 1)


def _step(matrix: Float64, right: Float64, offset_m: float = 0.0) -> Float64:
    """Return the slopes (3,) of a part of the view alone less the whole's, once `offset_m` is added
    to every depth.
    """
    # adding the offset raises every residual by it, and so the right-hand side by the offset times
    # the fourth column
    return np.linalg.lstsq(matrix[:3, :3], right[:3] + offset_m * matrix[:3, 3])[0].astype(
        np.float64
    )


def _bend(plane: PlaneFit, steps: list[Float64], whole: Float64) -> tuple[float, float]:
    """Return the largest change of distance (m) and normal (degrees) by any of the steps (3,),
    beyond the whole's.
    """
    # The angle is that of a tangent: arccos of a product near 1 loses half of the digits.
    normal, distance_m = plane_from_slopes(plane.slopes + whole)
    parts = [plane_from_slopes(plane.slopes + step) for step in steps]
    turns = [
        np.arctan2(np.linalg.norm(np.cross(turned, normal)), turned @ normal) for turned, _ in parts
    ]
    return max(abs(far_m - distance_m) for _, far_m in parts), float(np.degrees(max(turns)))


def _std(plane: PlaneFit, covariance: Float64) -> tuple[float, float]:
    """Return the standard uncertainty of distance (m) and of the normal in its least certain
    direction (degrees).
    """
    along, across = plane_gradients(plane.normal, plane.distance_m)
    turn = np.linalg.eigvalsh(across @ covariance @ across.T)[-1]
    return propagated_std(along, covariance), float(np.degrees(np.sqrt(max(turn, 0.0))))


def _offset_m(matrix: Float64, right: Float64, chi2: float) -> float:
    """Return the constant to add to every depth for the smallest residuals of a plane; 0 where none
    is plausible.
    """
    # The fourth unknown is the constant error of every depth; the offset removes it. On a wall
    # faced squarely it is nearly a change of distance: then its uncertainty exceeds it, and 0 is
    # returned.
    offset_m = -float(np.linalg.lstsq(matrix, right)[0][3])
    std_m = float(np.sqrt(chi2 * np.linalg.pinv(matrix)[3, 3]))
    return offset_m if SURE_SIGMAS * std_m < abs(offset_m) <= MAX_OFFSET_M else 0.0


BLOCKS_ACROSS = 40
"""Number of the finest blocks across the view: they resolve ripples of half a degree and average
noise.
"""
COARSER = (1, 2, 4, 8)
"""Sizes of the larger blocks, in finest blocks: ripples may be wide."""


@dataclass(frozen=True)
class Ripples:
    """Correlation of neighbouring residuals."""

    rms_m: float
    """RMS deviation of blocks of pixels beyond their noise, normal to the wall."""
    correlation: float
    """Mean square of block means over that of independent residuals; 1 where it is not surely
    more.
    """
    covariance: Float64
    """(3, 3) of the plane's slopes, ripples included."""


def ripples(plane: PlaneFit, rays: Float64) -> Ripples:
    """Measure the correlation of the residuals of `plane`, fitted to depth along `rays` (height,
    width, 3).
    """
    # Normal to the wall a depth residual is shorter by distance / p_z = distance (ray . slopes).
    shape = rays.shape[:2]
    size = max(2, shape[1] // BLOCKS_ACROSS)
    across = np.where(plane.inliers, plane.distance_m * (rays.reshape(-1, 3) @ plane.slopes), 0.0)
    sigmas_m = np.where(plane.inliers, plane.sigmas_m, 1.0)
    sigmas = np.nan_to_num(plane.errors_m) / sigmas_m
    maps = (plane.inliers, sigmas, sigmas**2, sigmas * sigmas_m * across, (sigmas_m * across) ** 2)
    count, total, squares, normal_m, variance_m2 = (
        block_sums(one.reshape(shape), size) for one in maps
    )
    rms_m = _beyond_noise_m(
        count, squares - total**2 / np.maximum(count, 1.0), normal_m, variance_m2, size
    )
    correlation, blocks = _correlation(count, total, plane.noise_scale**2)
    if correlation <= 1.0:
        return Ripples(rms_m, 1.0, plane.covariance)
    pulls = _pulls(plane, rays, sigmas / sigmas_m, size * blocks)
    return Ripples(
        rms_m, correlation, _greater(correlation * plane.covariance, _clustered(plane, pulls))
    )


def _beyond_noise_m(
    count: Float64, within: Float64, normal_m: Float64, variance_m2: Float64, size: int
) -> float:
    """Return the RMS of block means beyond their noise, which is estimated from the scatter within
    blocks.
    """
    # analysis of variance: E[mean^2] = ripple^2 + noise sum(sigma^2) / n^2, with the noise scale
    # from within blocks
    full = count >= size**2 / 2
    if not full.any():
        return 0.0
    noise = within[full].sum() / max((count[full] - 1.0).sum(), 1.0)
    beyond_m2 = (normal_m[full] ** 2 - noise * variance_m2[full]) / count[full] ** 2
    return float(np.sqrt(max(beyond_m2.mean(), 0.0)))


def _correlation(count: Float64, total: Float64, chi2: float) -> tuple[float, int]:
    """Return the largest growth of block sums over independent residuals, and its block size; 1 if
    not significant.
    """
    # The sum of n independent residuals has the mean square n chi2, so sum(totals^2) / sum(counts)
    # / chi2 is 1 up to sqrt(2 / blocks). The growth is largest for blocks as wide as a ripple:
    # hence several sizes.
    found = 1.0, 1
    for size in COARSER:
        counts = block_sums(count, size)
        totals = block_sums(total, size)
        blocks = int((counts >= counts.max() / 2).sum())
        growth = float((totals**2).sum() / counts.sum()) / chi2 if chi2 > 0.0 else 1.0
        if growth > 1.0 + SURE_SIGMAS * np.sqrt(2.0 / max(blocks - 3, 1)):
            found = max(found, (growth, size))
    return found


def _pulls(plane: PlaneFit, rays: Float64, weighted: Float64, size: int) -> Float64:
    """Return each block's sum (n, 3) of the least-squares gradient with respect to the slopes."""
    # The gradient of a pixel's half square is J e / sigma^2 with J = -p_z^2 r. At the minimum it
    # sums to zero over the view, but not over a block: that is the block's pull.
    slopewise = rays.reshape(-1, 3) @ plane.slopes
    predicted_m = np.divide(1.0, slopewise, out=np.zeros_like(slopewise), where=plane.inliers)
    strength = -(predicted_m**2 * weighted).reshape(rays.shape[:2])
    return np.stack(
        [block_sums(strength * rays[..., axis], size).ravel() for axis in range(3)], axis=-1
    )


def _clustered(plane: PlaneFit, pulls: Float64) -> Float64:
    """Return the covariance (3, 3) for independent blocks of correlated pixels (Liang and Zeger,
    1986).
    """
    # Sandwich estimator: (J'J)^-1 sum(g g') (J'J)^-1 over the blocks' gradients g, corrected for
    # three fitted parameters. The fit's covariance is chi^2 (J'J)^-1, hence the division.
    bread = plane.covariance / plane.noise_scale**2
    blocks = int(pulls.any(axis=1).sum())
    return bread @ (pulls.T @ pulls) @ bread * blocks / max(blocks - 3, 1)


def _greater(one: Float64, other: Float64) -> Float64:
    """Return a covariance that is at least as large as either of two in every direction."""
    # With one = L L' and L^-1 other L^-T = V D V', the basis L V makes one the identity and other
    # the diagonal D at once; the larger entry of each pair bounds both.
    root = np.linalg.cholesky(one)
    inner = np.linalg.solve(root, np.linalg.solve(root, other).T)
    values, vectors = np.linalg.eigh((inner + inner.T) / 2.0)
    joint = root @ vectors
    return ((joint * np.maximum(values, 1.0)) @ joint.T).astype(np.float64)


def block_sums(values: NDArray[np.generic], size: int) -> Float64:
    """Return the sums over blocks of `size` x `size`, incomplete ones at the far edges included."""
    rows, columns = (np.arange(0, length, size) for length in values.shape)
    return np.add.reduceat(
        np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1
    )
