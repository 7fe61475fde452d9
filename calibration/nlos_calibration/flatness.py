"""Is it one flat wall? Whether a part of the view tells of another plane than the whole.

A bend, a curve, a step or an offset of the range does that, and no small residual excuses it.

What neighbouring residuals of a plane have in common: ripples and drift of the lidar, and what they cost.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.plane import PlaneFit

SURE_SIGMAS = 3.0
HALVES_POINTS = 60_000
"""Enough to compare halves by."""
MAX_OFFSET_M = 0.02
"""More than this is no constant of the device."""


@dataclass(frozen=True)
class Flatness:
    """How far the depth is from one flat wall."""

    bend_m: float
    bend_deg: float
    """The most by which distance and normal of a half of the view differ from the whole's."""
    bend_std_m: float
    bend_std_deg: float
    """What noise alone makes of that."""
    offset_m: float
    """What to add to every depth so that the halves agree best."""
    offset_bend_m: float
    offset_bend_deg: float
    """The bend that is left then."""


@dataclass(frozen=True)
class _Sums:
    """The normal equations of a part of the view: of slopes (3) and of a constant added to the depth (1)."""

    matrix: Float64
    """(4, 4)."""
    right: Float64
    """(4,)."""

    def step(self, offset_m: float = 0.0) -> Float64:
        """By how much the slopes (3,) of this part alone differ, once `offset_m` is added to every depth."""
        # an offset to be added is an error to be subtracted: the fourth unknown is its negative
        step = np.linalg.lstsq(self.matrix[:3, :3], self.right[:3] + offset_m * self.matrix[:3, 3])[0]
        return step.astype(np.float64)


def flatness(plane: PlaneFit, rays: Float64) -> Flatness:
    """Judge the residuals of `plane`, fitted to depth along `rays` (height, width, 3)."""
    halves, whole, chi2 = _halves(plane, rays.reshape(-1, 3))
    offset_m = _offset_m(whole, chi2)
    bend_m, bend_deg = _bend(plane, [half.step() for half in halves])
    left_m, left_deg = _bend(plane, [half.step(offset_m) for half in halves], whole.step(offset_m))
    stds = [_std(plane, chi2 * np.linalg.pinv(half.matrix[:3, :3]).astype(np.float64)) for half in halves]
    return Flatness(
        bend_m=bend_m,
        bend_deg=bend_deg,
        bend_std_m=max(std[0] for std in stds),
        bend_std_deg=max(std[1] for std in stds),
        offset_m=offset_m,
        offset_bend_m=left_m,
        offset_bend_deg=left_deg,
    )


def _halves(plane: PlaneFit, rays: Float64) -> tuple[list[_Sums], _Sums, float]:
    """Eight halves of some inliers, of four ways to cut; all of these; their mean square in standard deviations.

    A step along a cut leaves both of its halves flat; a step across it leaves both as tilted as the whole.
    """
    some = np.flatnonzero(plane.inliers)
    some = some[:: max(len(some) // HALVES_POINTS, 1)]
    seen, weight = rays[some], 1.0 / plane.sigmas_m[some]
    sigmas = plane.errors_m[some] * weight
    predicted_m = 1.0 / (seen @ plane.slopes)
    rows = np.column_stack([seen * (-(predicted_m**2) * weight)[:, np.newaxis], weight])
    x, y = (seen[:, :2] - np.median(seen[:, :2], axis=0)).T
    eighth = np.floor(np.arctan2(y, x) * 4.0 / np.pi).astype(np.int64) % 8
    eighths = [_sums(rows, sigmas, eighth == one) for one in range(8)]
    halves = [_total([eighths[(one + more) % 8] for more in range(4)]) for one in range(8)]
    return halves, _total(eighths), float(sigmas @ sigmas) / max(len(sigmas) - 3, 1)


def _total(parts: list[_Sums]) -> _Sums:
    return _Sums(
        sum((part.matrix for part in parts), np.zeros((4, 4))), sum((part.right for part in parts), np.zeros(4))
    )


def _sums(rows: Float64, sigmas: Float64, part: NDArray[np.bool_]) -> _Sums:
    rows = rows[part]
    return _Sums(rows.T @ rows, rows.T @ sigmas[part])


def _bend(plane: PlaneFit, steps: list[Float64], whole: Float64 | None = None) -> tuple[float, float]:
    """The most by which distance (m) and normal (degrees) change by any of the steps (3,), beyond the whole's."""
    distance_m, normal = _plane(plane.slopes + (np.zeros(3) if whole is None else whole))
    parts = [_plane(plane.slopes + step) for step in steps]
    turns = [np.arctan2(np.linalg.norm(np.cross(turned, normal)), turned @ normal) for _, turned in parts]
    return max(abs(far_m - distance_m) for far_m, _ in parts), float(np.degrees(max(turns)))


def _plane(slopes: Float64) -> tuple[float, Float64]:
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    return distance_m, -slopes * distance_m


def _std(plane: PlaneFit, covariance: Float64) -> tuple[float, float]:
    """Of distance (m) and of the normal's turn, whichever way (degrees)."""
    along = plane.distance_m**2 * plane.normal
    across = plane.distance_m * (np.eye(3) - np.outer(plane.normal, plane.normal))
    turn = np.linalg.eigvalsh(across @ covariance @ across.T)[-1]
    return float(np.sqrt(along @ covariance @ along)), float(np.degrees(np.sqrt(max(turn, 0.0))))


def _offset_m(whole: _Sums, chi2: float) -> float:
    """The constant to add to every depth that leaves the least residuals of a plane; 0 where none is plausible."""
    offset_m = -float(np.linalg.lstsq(whole.matrix, whole.right)[0][3])
    std_m = float(np.sqrt(chi2 * np.linalg.pinv(whole.matrix)[3, 3]))
    return offset_m if SURE_SIGMAS * std_m < abs(offset_m) <= MAX_OFFSET_M else 0.0


BLOCKS_ACROSS = 40
"""The finest blocks: fine enough for ripples of half a degree, coarse enough to average noise."""
COARSER = (1, 2, 4, 8)
"""Blocks of blocks: ripples may be wide."""


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
