"""Our renderer against an independent one, mitransient: docs/referee.json and docs/images/referee.png, some minutes.

mitransient traces Monte-Carlo paths through meshes, on top of Mitsuba 3. None of it is ours, and none of it is a
dependency: the tool runs in an environment of its own that also holds this project.

    pip install -e . mitransient==1.3.1 mitsuba==3.7.0        (Mitsuba 3.9.1 aborts with LLVM 15)
    apt-get install libllvm15
    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1

Part one checks that the transients of nine beams agree within the Monte-Carlo noise, and that the test would notice a
wrong renderer. Part two measures which renderer is sooner at an error, in core-seconds of all threads together, so that
other load does not count.
"""

import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.arrays import Mask
from referee_mitransient import PLATE, RIG, STEP, Estimate, Face, Float64, Job, hidden, load, sample

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.render import Accuracy, Scene, cast, three_bounce

BEAMS = np.add.outer(80 * np.array([20, 31, 42]), [20, 38, 56]).ravel()
"""Flat indices into the map of 64 x 80: rows and columns that spread over the wall."""
EFFECTS = ("three-bounce", "self-occlusion", "tilt")
BINS = 190
"""No path of the two scenes is longer than 1.9 m."""
STOPS = ("draft", "standard", "fine")
LONG_RUN = 1024
"""Paths for each point of the wall in the run that is timed: enough that launching it costs little."""
REPEATS = 7
"""Of which the quickest counts, on both sides."""
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
    """Both sides of a case, and their comparison."""

    case: Case
    job: Job
    ours: Float64
    """(beams, bins)."""
    theirs: Estimate
    figures: dict[str, Any]


def feet_m() -> Float64:
    """Return the beams' spots on the wall (beams, 3)."""
    return cast(RIG, Scene(RIG).cell_intrinsics).laser_spot_m[BEAMS]


def limit(case: Case, effects: tuple[str, ...] = EFFECTS, **change: Any) -> Float64:
    """Return our transients (beams, bins) of a case, or of one with its scene changed, in the limit of small cells."""
    fine = _histograms(case, case.cells, effects, **change)
    return 2 * fine - _histograms(case, case.cells // 2, effects, **change) if case.extrapolated else fine


def _histograms(case: Case, cells: int, effects: tuple[str, ...] = EFFECTS, **change: Any) -> Float64:
    found = three_bounce(hidden(case.faces, cells, **change), case.accuracy, effects, chosen=BEAMS)
    return found[:, :BINS].astype(np.float64)


def bright(ours: Float64) -> Mask:
    """Mask the bins (beams, bins) that are compared."""
    return ours > FAINT * ours.max(1, keepdims=True)


def reduced_chi_square(ours: Float64, estimate: Float64, error: Float64, which: Mask) -> float:
    """Return the mean square of the difference in standard errors: 1 for noise alone, with nothing fitted."""
    return float((((estimate - ours)[which] / error[which]) ** 2).mean())


def best_scale(ours: Float64, estimate: Float64, error: Float64, which: Mask) -> tuple[float, float]:
    """Return the factor on ours that fits best, by least squares, and its standard error."""
    a, b, weight = ours[which], estimate[which], error[which] ** -2.0
    information = float((weight * a * a).sum())
    return float((weight * a * b).sum()) / information, information**-0.5


def relative_error(difference: Float64, truth: Float64, which: Mask) -> float:
    """Return the root mean square of a difference as a share of the truth, bin by bin."""
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
    """Return the same figure of wrong renderers, some with a fitted scale: near 1 they would go unnoticed."""
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


def race(plate: Trial) -> dict[str, Any]:
    """Return core-seconds to an error on the plate: ours for the map, theirs for one beam, extrapolated to it.

    Errors are against the limit that part one confirmed, over its bins. Theirs falls as 1 / sqrt(time), and beams are
    taken one by one: its exhaustive mode would share first legs, for a film of wall points x beams x bins.
    """
    which = bright(plate.ours)
    seconds = sample(replace(plate.job, samples=LONG_RUN), feet_m()[:1], SEEDS[:1, :REPEATS]).core_seconds
    noise = relative_error(plate.theirs.noise, plate.ours, which) * (plate.job.samples / LONG_RUN) ** 0.5
    lit = int(cast(RIG, Scene(RIG).cell_intrinsics).on_wall.sum())
    return {
        "beams_on_wall": lit,
        "mitransient_measured": {
            "core_seconds_for_one_beam": seconds,
            "paths": LONG_RUN * plate.job.columns * plate.job.rows,
            "error": noise,
        },
        "stops": [_against(stop, plate.ours, which, noise**2 * seconds, lit) for stop in STOPS],
    }


def _against(stop: str, truth: Float64, which: Mask, cost: float, lit: int) -> dict[str, Any]:
    """Return one stop, and the core-seconds that mitransient takes to its error: cost / error^2 for each beam."""
    scene, seconds = hidden(PLATE, OBJECT_PIXELS), list[float]()
    found = three_bounce(scene, stop, EFFECTS)
    for _ in range(REPEATS):
        started = time.process_time()
        found = three_bounce(scene, stop, EFFECTS)
        seconds.append(time.process_time() - started)
    error = relative_error(found[BEAMS, :BINS] - truth, truth, which)
    theirs = cost / error**2
    return {
        "name": stop,
        "error": error,
        "core_seconds_for_the_map": min(seconds),
        "mitransient_core_seconds_for_one_beam": theirs,
        "mitransient_core_seconds_for_the_map_extrapolated": lit * theirs,
        "times_faster_for_the_map": lit * theirs / min(seconds),
    }


def draw(trials: list[Trial], found: dict[str, Any]) -> Figure:
    """Draw transients of three beams and their differences case by case, and error against time."""
    names = [one.case.name for one in trials]
    layout = [[*names, "race"], [*(f"{name}, difference" for name in names), "race"]]
    figure = Figure(figsize=(14, 5.5), layout="constrained")
    axes = figure.subplot_mosaic(layout, height_ratios=(2, 1))
    for one in trials:
        _draw_trial(axes[one.case.name], axes[f"{one.case.name}, difference"], one)
    _draw_race(axes["race"], found)
    return figure


def _draw_trial(top: Any, low: Any, one: Trial) -> None:
    path_m = (np.arange(BINS) + 0.5) * RIG.device.bin_m
    for beam, colour in ((3, "C0"), (4, "C1"), (5, "C2")):
        k = bright(one.ours)[beam]
        ours, mean, error = one.ours[beam], one.theirs.mean[beam], one.theirs.error[beam]
        top.step(path_m, ours, where="mid", color=colour, lw=1, label="nlos-cam, reference" if beam == 3 else None)
        top.errorbar(
            path_m[k], mean[k], error[k], fmt=".", ms=4, color=colour, label="mitransient" if beam == 3 else None
        )
        low.plot(path_m[k], (mean[k] - ours[k]) / error[k], ".", color=colour)
    chi, bins = one.figures["reduced_chi_square"], one.figures["bins"]
    top.set(title=f"{one.case.name}: reduced chi-square {chi:.2f} over {bins} bins", ylabel="intensity / I0")
    top.set(xlim=(0.75, 1.75))
    top.legend(title="three of nine beams")
    low.set(xlabel="path length (m)", ylabel="difference /\nstandard error", xlim=(0.75, 1.75), ylim=(-5, 5))


def _draw_race(axis: Any, found: dict[str, Any]) -> None:
    measured, lit = found["mitransient_measured"], found["beams_on_wall"]
    seconds, error = measured["core_seconds_for_one_beam"], 100 * measured["error"]
    span = np.geomspace(0.05, 1e5, 2)
    axis.loglog(span, error * np.sqrt(seconds / span), "k--", label="mitransient, one beam: 1 / sqrt(time)")
    axis.loglog(span, error * np.sqrt(lit * seconds / span), "k:", label=f"mitransient, {lit} beams, one by one")
    axis.loglog(seconds, error, "ks", label="mitransient, one beam, measured")
    for stop in found["stops"]:
        label = f"nlos-cam {stop['name']}, {lit} beams, measured"
        axis.loglog(stop["core_seconds_for_the_map"], 100 * stop["error"], "o", label=label)
    axis.set(title="plate: error against time", xlabel="core-seconds", ylabel="error of a bin, rms (%)")
    axis.set_ylim(3e-4, 300)
    axis.legend(fontsize=8, loc="lower left")


def main() -> None:
    """Measure, write, draw, print."""
    load()  # fails early where a package is missing
    trials = [trial(case) for case in CASES]
    found = race(trials[0])
    result = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "referee": {name: version(name) for name in ("mitransient", "mitsuba")},
        "agreement": [one.figures for one in trials],
        "time_to_equal_error": found,
    }
    harness.write("referee", result)
    harness.save("referee", draw(trials, found), dpi=110)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
