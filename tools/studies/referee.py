"""Our renderer against an independent one, mitransient: `python tools/referee.py`, some minutes.

mitransient traces Monte-Carlo paths through meshes, on top of Mitsuba 3. None of it is ours, and none of it is a
dependency: the tool runs in an environment of its own that also holds this project.

    pip install -e . mitransient==1.3.1 mitsuba==3.7.0        (Mitsuba 3.9.1 aborts with LLVM 15)
    apt-get install libllvm15
    export DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1

Part one (referee_agreement.py) asks whether the two agree. Part two, here, asks which of them is sooner at an error.
Times are core-seconds, all threads together, so that whatever else runs does not count.
Writes docs/referee.json and docs/images/referee.png.
"""

import json
import os
import platform
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from referee_agreement import (
    BEAMS,
    BINS,
    CASES,
    EFFECTS,
    SEEDS,
    Array,
    Mask,
    Trial,
    bright,
    feet_m,
    relative_error,
    trial,
)
from referee_mitransient import load, sample
from referee_scene import PLATE, RIG, hidden

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.render.beams import cast
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

DOCS = Path(__file__).parents[2] / "docs"
STOPS = ("draft", "standard", "fine")
LONG_RUN = 1024
"""Paths for each point of the wall in the run that is timed: enough that launching it costs little."""
REPEATS = 7
"""Of which the quickest counts, on both sides."""


def race(plate: Trial) -> dict[str, Any]:
    """Core-seconds to an error on the plate: ours for the map, theirs for one beam and, extrapolated, for the map.

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


def _against(stop: str, truth: Array, which: Mask, cost: float, lit: int) -> dict[str, Any]:
    """One stop, and the core-seconds that mitransient takes to its error: cost / error^2 for each beam."""
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


def draw(trials: list[Trial], found: dict[str, Any], out: Path) -> None:
    """Transients of three beams and their differences, case by case; then error against time."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    names = [one.case.name for one in trials]
    layout = [[*names, "race"], [*(f"{name}, difference" for name in names), "race"]]
    figure, axes = plt.subplot_mosaic(layout, figsize=(14, 5.5), height_ratios=(2, 1), layout="constrained")
    for one in trials:
        _draw_trial(axes[one.case.name], axes[f"{one.case.name}, difference"], one)
    _draw_race(axes["race"], found)
    figure.savefig(out, dpi=110)


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
    load()  # says at once what is missing
    trials = [trial(case) for case in CASES]
    found = race(trials[0])
    result = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "referee": {name: version(name) for name in ("mitransient", "mitsuba")},
        "agreement": [one.figures for one in trials],
        "time_to_equal_error": found,
    }
    text = json.dumps(result, indent=2)
    (DOCS / "referee.json").write_text(text + "\n", encoding="utf-8")
    draw(trials, found, DOCS / "images" / "referee.png")
    print(text)


if __name__ == "__main__":
    main()
