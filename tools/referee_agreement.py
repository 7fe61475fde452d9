"""Part one of tools/referee.py: do the three-bounce transients of nine beams agree within the Monte-Carlo noise?

And would this test have noticed a renderer that is wrong?
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float64, Mask
from referee_mitransient import Estimate, Job, sample
from referee_scene import PLATE, RIG, STEP, Face, hidden

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.geometry import cast
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

BEAMS = np.add.outer(80 * np.array([20, 31, 42]), [20, 38, 56]).ravel()
"""Flat indices into the map of 64 x 80: rows and columns that spread over the wall."""
EFFECTS = ("three-bounce", "self-occlusion", "tilt")
BINS = 190
"""No path of the two scenes is longer than 1.9 m."""
FAINT = 0.05
"""Bins below this share of their beam's peak are not compared."""
RUNS = 64
SEEDS = np.random.SeedSequence(2026).generate_state(RUNS * BEAMS.size).reshape(BEAMS.size, RUNS)
"""Each beam has its own: with the same, beams would share their paths from the wall to the object, and their noise."""


@dataclass(frozen=True)
class Case:
    """One scene."""

    name: str
    faces: tuple[Face, ...]
    columns: int
    """Of the relay wall, on both sides."""
    rows: int
    cells: int
    """Along a side of our depth map."""
    samples: int
    extrapolated: bool = False
    """Take the limit of small cells from this grid and one of half the cells: shadows converge as their first power."""

    @property
    def accuracy(self) -> Accuracy:
        """The reference renderer's, on this wall."""
        return Accuracy("reference", self.columns, self.rows, sub_bins=0, tolerance=0.0)


# noise is left well above what else parts the two: 0.02 % of the plate by the start of mitransient's rays, 0.25 % of a
# bin of the step by the extrapolation
CASES = (
    Case("plate", PLATE, 80, 64, cells=128, samples=32),
    Case("step", STEP, 40, 32, cells=256, samples=64, extrapolated=True),
)


@dataclass(frozen=True)
class Trial:
    """Both sides of a case, and what is said of them."""

    case: Case
    job: Job
    ours: Float64
    """(beams, bins)."""
    theirs: Estimate
    figures: dict[str, Any]


def feet_m() -> Float64:
    """Where the beams land (beams, 3)."""
    return cast(RIG, Scene(RIG).cell_intrinsics).foot_m[BEAMS]


def limit(case: Case, effects: tuple[str, ...] = EFFECTS, **change: Any) -> Float64:
    """Our transients (beams, bins) of a case, or of one with its scene changed, in the limit of small cells."""
    fine = _histograms(case, case.cells, effects, **change)
    return 2 * fine - _histograms(case, case.cells // 2, effects, **change) if case.extrapolated else fine


def _histograms(case: Case, cells: int, effects: tuple[str, ...] = EFFECTS, **change: Any) -> Float64:
    found = three_bounce(hidden(case.faces, cells, **change), case.accuracy, effects, chosen=BEAMS)
    return found[:, :BINS].astype(np.float64)


def bright(ours: Float64) -> Mask:
    """The bins (beams, bins) that are compared."""
    return ours > FAINT * ours.max(1, keepdims=True)


def reduced_chi_square(ours: Float64, estimate: Float64, error: Float64, which: Mask) -> float:
    """Mean square of the difference in standard errors: 1 where the noise alone parts the two, with nothing fitted."""
    return float((((estimate - ours)[which] / error[which]) ** 2).mean())


def best_scale(ours: Float64, estimate: Float64, error: Float64, which: Mask) -> tuple[float, float]:
    """The factor on ours that fits best, by least squares, and its standard error."""
    a, b, weight = ours[which], estimate[which], error[which] ** -2.0
    information = float((weight * a * a).sum())
    return float((weight * a * b).sum()) / information, information**-0.5


def relative_error(difference: Float64, truth: Float64, which: Mask) -> float:
    """Root mean square of a difference as a share of the truth, bin by bin."""
    return float(np.sqrt(((difference[which] / truth[which]) ** 2).mean()))


def trial(case: Case) -> Trial:
    """Render a case on both sides and compare."""
    ours = limit(case)
    job = Job(case.faces, case.columns, case.rows, BINS, case.samples)
    theirs = sample(job, feet_m(), SEEDS)
    which = bright(ours)
    sides = ours, theirs.mean, theirs.error, which
    scale, scale_error = best_scale(*sides)
    figures = {
        "name": case.name,
        "beams": len(BEAMS),
        "wall_cells": [case.columns, case.rows],
        "object_cells": case.cells,
        "limit_extrapolated": case.extrapolated,
        "half_the_cells_change": relative_error(_histograms(case, case.cells // 2) - ours, ours, which),
        "second_bounce_sampled": "on the object" if job.aimed else "by the cosine",
        "runs": RUNS,
        "paths_per_beam": RUNS * case.samples * case.columns * case.rows,
        "noise": relative_error(theirs.error, ours, which),
        "bins": int(which.sum()),
        "reduced_chi_square": reduced_chi_square(*sides),
        # errors are themselves estimates, so Student's t and not the normal law stands behind each bin
        "expected": (RUNS - 1) / (RUNS - 3),
        "expected_spread": float(np.sqrt(2 / which.sum())),
        "fitted_parameters": 0,
        "scale_if_it_were_fitted": scale,
        "scale_error": scale_error,
        "reduced_chi_square_if_wrong": _wrong(case, ours, theirs, which),
    }
    return Trial(case, job, ours, theirs, figures)


def _wrong(case: Case, ours: Float64, theirs: Estimate, which: Mask) -> dict[str, float]:
    """The same figure of renderers that are wrong, a scale fitted to help some: what stays near 1 goes unnoticed."""
    found = {
        "one bin late": reduced_chi_square(np.roll(ours, 1, axis=1), theirs.mean, theirs.error, which),
        "1 % brighter": reduced_chi_square(1.01 * ours, theirs.mean, theirs.error, which),
    }
    if case.extrapolated:
        variants: dict[str, Callable[[], Float64]] = {
            "without self-occlusion": lambda: limit(case, ("three-bounce", "tilt"))
        }
    else:
        variants = {
            "object 1 mm nearer": lambda: limit(case, nearer_m=1e-3),
            "the paper's fewer cosines": lambda: limit(case, radiometry="paper"),
        }
    for name, make in variants.items():
        histogram = make()
        scale, _ = best_scale(histogram, theirs.mean, theirs.error, which)
        found[f"{name}, scale fitted"] = reduced_chi_square(scale * histogram, theirs.mean, theirs.error, which)
    return found
