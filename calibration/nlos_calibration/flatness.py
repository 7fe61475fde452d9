"""Is it one flat wall? Whether a part of the view tells of another plane than the whole.

A bend, a curve, a step or an offset of the range does that, and no small residual excuses it.
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
