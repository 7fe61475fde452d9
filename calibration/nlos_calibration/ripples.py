"""What neighbouring residuals of a plane have in common: ripples and drift of the lidar, and what they cost."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.plane import PlaneFit

BLOCKS_ACROSS = 40
"""The finest blocks: fine enough for ripples of half a degree, coarse enough to average noise."""
COARSER = (1, 2, 4, 8)
"""Blocks of blocks: ripples may be wide."""
SURE_SIGMAS = 3.0


@dataclass(frozen=True)
class Ripples:
    """How alike neighbouring residuals are."""

    rms_m: float
    """Normal to the wall, of what blocks of pixels deviate by beyond their noise."""
    correlation: float
    """By how much the mean square of block means exceeds that of independent residuals; 1 where it surely does not."""
    covariance: Float64
    """(3, 3) of the plane's slopes, with that in it."""


def ripples(plane: PlaneFit, rays: Float64) -> Ripples:
    """Judge the residuals of `plane`, fitted to depth along `rays` (height, width, 3)."""
    shape = rays.shape[:2]
    size = max(2, shape[1] // BLOCKS_ACROSS)
    across = np.where(plane.inliers, plane.distance_m * (rays.reshape(-1, 3) @ plane.slopes), 0.0)
    sigmas_m = np.where(plane.inliers, plane.sigmas_m, 1.0)
    sigmas = np.nan_to_num(plane.errors_m) / sigmas_m
    maps = (plane.inliers, sigmas, sigmas**2, sigmas * sigmas_m * across, (sigmas_m * across) ** 2)
    count, total, squares, normal_m, variance_m2 = (block_sums(one.reshape(shape), size) for one in maps)
    rms_m = _beyond_noise_m(count, squares - total**2 / np.maximum(count, 1.0), normal_m, variance_m2, size)
    correlation, blocks = _correlation(count, total, plane.noise_scale**2)
    if correlation <= 1.0:
        return Ripples(rms_m, 1.0, plane.covariance)
    pulls = _pulls(plane, rays, sigmas / sigmas_m, size * blocks)
    return Ripples(rms_m, correlation, _greater(correlation * plane.covariance, _clustered(plane, pulls)))


def _beyond_noise_m(count: Float64, within: Float64, normal_m: Float64, variance_m2: Float64, size: int) -> float:
    """RMS of block means beyond their noise, which is judged by the scatter within blocks."""
    full = count >= size**2 / 2
    if not full.any():
        return 0.0
    noise = within[full].sum() / max((count[full] - 1.0).sum(), 1.0)
    beyond_m2 = (normal_m[full] ** 2 - noise * variance_m2[full]) / count[full] ** 2
    return float(np.sqrt(max(beyond_m2.mean(), 0.0)))


def _correlation(count: Float64, total: Float64, chi2: float) -> tuple[float, int]:
    """The mean square of block means over what it would be if residuals were independent, and the size of the blocks.

    Of blocks of several sizes the largest: the mean over a patch as wide as a ripple varies most. 1 if it is not sure.
    """
    found = 1.0, 1
    for size in COARSER:
        counts, totals = block_sums(count, size), block_sums(total, size)
        blocks = int((counts >= counts.max() / 2).sum())
        growth = float((totals**2).sum() / counts.sum()) / chi2 if chi2 > 0.0 else 1.0
        if growth > 1.0 + SURE_SIGMAS * np.sqrt(2.0 / max(blocks - 3, 1)):
            found = max(found, (growth, size))
    return found


def _pulls(plane: PlaneFit, rays: Float64, weighted: Float64, size: int) -> Float64:
    """How each block (n, 3) pulls at the slopes: the sums of the least squares' gradient over it."""
    slopewise = rays.reshape(-1, 3) @ plane.slopes
    predicted_m = np.divide(1.0, slopewise, out=np.zeros_like(slopewise), where=plane.inliers)
    strength = -(predicted_m**2 * weighted).reshape(rays.shape[:2])
    return np.stack([block_sums(strength * rays[..., axis], size).ravel() for axis in range(3)], axis=-1)


def _clustered(plane: PlaneFit, pulls: Float64) -> Float64:
    """The covariance if blocks, not pixels, are independent (Liang and Zeger): each block tells its own spread."""
    bread = plane.covariance / plane.noise_scale**2
    blocks = int(pulls.any(axis=1).sum())
    return bread @ (pulls.T @ pulls) @ bread * blocks / max(blocks - 3, 1)


def _greater(one: Float64, other: Float64) -> Float64:
    """The covariance that is the greater of two in every direction: where both are diagonal, entry by entry."""
    root = np.linalg.cholesky(one)
    inner = np.linalg.solve(root, np.linalg.solve(root, other).T)
    values, vectors = np.linalg.eigh((inner + inner.T) / 2.0)
    joint = root @ vectors
    return ((joint * np.maximum(values, 1.0)) @ joint.T).astype(np.float64)


def block_sums(values: NDArray[np.generic], size: int) -> Float64:
    """The sums over blocks of `size` x `size`."""
    rows, columns = (np.arange(0, length, size) for length in values.shape)
    return np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1)
