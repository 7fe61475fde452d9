"""Search for the cheapest accuracy within an error bound, or the most accurate within a time
budget, on a given scene.

Errors are measured: brute force on some beams, and every stop on the same. Times are extrapolated
from two sizes of a small share of the beams, since planning and tables are paid once and beams one
by one. The search costs about as much as three beams in a hundred by brute force; the budget is for
the rendering after it.
"""

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import inf
from typing import Any, Self

import numba
import numpy as np
from nlos_calibration.arrays import Int64, Mask
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.echoes import strongest, with_pulse
from nlos_cam.render.effects import Effects, Plan
from nlos_cam.render.geometry import cast
from nlos_cam.render.legs import BEAM_TILE
from nlos_cam.render.planning import prepare
from nlos_cam.render.renderer import Rendering, beam_histograms, render
from nlos_cam.render.scene import Scene

Floating = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class EchoMaps:
    """Echoes to compare, one entry (n,) for each beam or each cell."""

    intensity: Floating
    path_m: Floating
    """NaN if nothing comes back."""
    depth_m: Floating
    """Depth that the lidar reports; NaN if nothing comes back."""

    @classmethod
    def of_beams(cls, rendering: Rendering) -> Self:
        """Return the strongest three-bounce bin of each beam: stricter than maps, in which a direct
        return may win.
        """
        multi = rendering.multi
        return cls(multi.peak.ravel(), multi.path_m.ravel(), rendering.depth_m.ravel())

    @classmethod
    def of_cells(cls, rendering: Rendering, scene: Scene) -> Self:
        """Return the maps (64, 80), for renderings with different numbers of beams per cell."""
        depth = rendering.depth_m.ravel()
        cos_axis = cast(scene.rig, scene.cell_intrinsics).cos_axis
        return cls(rendering.intensity.ravel(), 2 * depth / cos_axis, depth)

    def select(self, which: Mask) -> "EchoMaps":
        """Return the entries with True in a mask."""
        return EchoMaps(self.intensity[which], self.path_m[which], self.depth_m[which])


@dataclass(frozen=True)
class Agreement:
    """Difference of one rendering from another that is taken as the truth."""

    intensity_error_median: float
    """Relative."""
    intensity_error_p99: float
    intensity_error_max: float
    bin_exact: float
    """Share of echoes in the same bin of path length."""
    bin_within_1: float
    depth_error_mm: float
    """Median over the entries where both report a depth."""
    depth_error_mean_mm: float


def relative_error(found: Floating, truth: Floating) -> Floating:
    """Return |found - truth| / truth (n,); where the truth is 0, 0 if nothing was found and else
    1.
    """
    off = np.abs(found - truth)
    return np.divide(off, truth, out=(off > 0).astype(off.dtype), where=truth > 0)


def agreement(found: EchoMaps, truth: EchoMaps, bin_m: float) -> Agreement:
    """Return the agreement of echoes (at least one) with the true ones."""
    error = relative_error(found.intensity, truth.intensity)
    bins = np.abs(found.path_m - truth.path_m) / bin_m
    bins[np.isnan(found.path_m) & np.isnan(truth.path_m)] = (
        0  # NaN of one alone is in no bin of the other
    )
    depth = 1000 * np.abs(found.depth_m - truth.depth_m)
    depth = depth[~np.isnan(depth)]
    return Agreement(
        intensity_error_median=float(np.median(error)),
        intensity_error_p99=float(np.quantile(error, 0.99)),
        intensity_error_max=float(error.max()),
        bin_exact=float((bins < 0.5).mean()),
        bin_within_1=float((bins < 1.5).mean()),
        depth_error_mm=float(np.median(depth)) if depth.size else 0.0,
        depth_error_mean_mm=float(depth.mean()) if depth.size else 0.0,
    )


SAMPLE_BEAMS = 32
"""Smallest number of beams summed by brute force."""
CAUTION = 1.5
"""Factor on the largest error of a sample: at least the 99th percentile of all in nine draws of
ten.
"""
SHARE = 4
"""One beam in SHARE is timed, and one in SHARE of those."""
REPEATS = 3
"""Runs of each timing; the shortest counts, as other load only adds time."""


@dataclass(frozen=True)
class AccuracyChoice:
    """Stop with its predicted error and time."""

    accuracy: Accuracy
    predicted_error: float
    """99th percentile of the relative error of the peak intensity, rather too large than too
    small.
    """
    predicted_seconds: float


Work = Callable[[], object]
Stopwatch = Callable[[Work, int], float]
"""Function that returns the shortest of a number of runs of some work, in seconds."""


def least_seconds(
    work: Work, repeats: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the shortest of `repeats` runs by the clock, in seconds."""
    seconds: list[float] = []
    for _ in range(repeats):
        start_s = clock()
        work()
        seconds.append(clock() - start_s)
    return min(seconds)


def choose(
    scene: Scene,
    max_error: float | None = None,
    max_seconds: float | None = None,
    effects: Effects = "auto",
    backend: str = "cpu",
    *,
    stops: Collection[Accuracy] = tuple(STOPS.values()),
    stopwatch: Stopwatch = least_seconds,
) -> AccuracyChoice:
    """Return the cheapest stop within `max_error`; with `max_seconds` alone, the most accurate
    within it.

    Raises SceneError if no stop is, naming the nearest and its excess, and for bounds that are
    negative or not finite.
    """
    for name, value in (("max_error", max_error), ("max_seconds", max_seconds)):
        if value is not None and not 0 <= value < inf:
            raise SceneError(f"{name} is {value}: it must be finite and at least 0")
    if max_error is None and max_seconds is None:
        raise SceneError("give max_error, max_seconds or both")
    return pick(predict(scene, effects, backend, stops, stopwatch), max_error, max_seconds)


def pick(
    choices: Collection[AccuracyChoice], max_error: float | None, max_seconds: float | None
) -> AccuracyChoice:
    """Return the choice of `choose` among these."""
    error = inf if max_error is None else max_error
    seconds = inf if max_seconds is None else max_seconds
    kept = [
        choice
        for choice in choices
        if choice.predicted_error <= error and choice.predicted_seconds <= seconds
    ]
    if not kept:
        raise SceneError(_nothing_keeps(choices, error, seconds))
    if max_error is None:
        return min(kept, key=lambda choice: (choice.predicted_error, choice.predicted_seconds))
    return min(kept, key=lambda choice: (choice.predicted_seconds, choice.predicted_error))


def _nothing_keeps(
    choices: Collection[AccuracyChoice], max_error: float, max_seconds: float
) -> str:
    """Return the error message for bounds that no choice keeps, with the nearest."""

    def missed(choice: AccuracyChoice) -> float:
        return max(
            choice.predicted_error / max(max_error, 1e-9),
            choice.predicted_seconds / max(max_seconds, 1e-9),
        )

    nearest = min(choices, key=missed)
    error = nearest.predicted_error
    seconds = nearest.predicted_seconds
    asked = [f"max_error {max_error:g}"] * (max_error < inf) + [f"max_seconds {max_seconds:g}"] * (
        max_seconds < inf
    )
    over = [f"an error of {error:.3g} is {error - max_error:.3g} too large"] * (error > max_error)
    over += [f"{seconds:.3g} s is {seconds - max_seconds:.3g} s too long"] * (seconds > max_seconds)
    return (
        f"no accuracy keeps {' and '.join(asked)}: the nearest is {nearest.accuracy.name}, where"
        f" {' and '.join(over)}; raise the limit by that"
    )


def predict(
    scene: Scene, effects: Effects, backend: str, stops: Collection[Accuracy], stopwatch: Stopwatch
) -> list[AccuracyChoice]:
    """Return the predicted error and time of each stop. One must be brute force, and all cast one
    beam per cell.
    """
    (brute,) = (stop for stop in stops if stop.sub_bins == 0)
    whole = prepare(scene, brute, effects)
    problem = prepare(scene, brute, _three_bounces_of(whole.plan))
    lit = np.flatnonzero(problem.beams.on_wall)
    sample = sample_beams(lit, _whole_rounds(SAMPLE_BEAMS, 1))
    truth = beam_histograms(problem, problem.job, backend, sample).max(1)
    choices: list[AccuracyChoice] = []
    for stop in stops:
        if stop is brute and whole.includes("inter-reflection"):
            continue
        seconds = _seconds(scene, stop, effects, backend, lit, stopwatch)
        if stop is brute:
            choices.append(AccuracyChoice(stop, 0.0, seconds))
            continue
        problem = prepare(scene, stop, _three_bounces_of(prepare(scene, stop, effects).plan))
        found = beam_histograms(problem, problem.job, backend, sample).max(1)
        error = CAUTION * float(relative_error(found, truth).max(initial=0.0))
        choices.append(AccuracyChoice(stop, error, seconds))
    return choices


def _three_bounces_of(plan: Plan) -> Effects:
    """Return the included effects without interreflection, which would take hours path by path."""
    return [effect.name for effect in plan if effect.included and effect.name != "inter-reflection"]


def sample_beams(lit: Int64, count: int) -> Int64:
    """Return about `count` beams spread over the map: one from each strip, at random but always the
    same.
    """
    if len(lit) <= count:
        return lit
    # Stratified: errors vary smoothly over the map, so one beam from each strip has less variance
    # than free draws.
    edges = np.linspace(0, len(lit), count + 1)
    within = np.random.default_rng(0).random(count)
    return lit[(edges[:-1] + within * np.diff(edges)).astype(np.int64)]


def _whole_rounds(beams: float, tile: int) -> int:
    """Return the smallest number of beams, at least `beams`, that gives every thread the same
    number of tiles.
    """
    # An incomplete round leaves threads idle, and its time would not grow with the beams in it.
    one_round = tile * numba.get_num_threads()
    return int(-(-beams // one_round)) * one_round


def _seconds(
    scene: Scene, stop: Accuracy, effects: Effects, backend: str, lit: Int64, stopwatch: Stopwatch
) -> float:
    """Return the predicted seconds of a whole rendering, from the times of some beams and of some
    of those.
    """
    if stop.sub_bins == 0:
        tile = 1
        repeats = 1
        beams = SAMPLE_BEAMS
    else:
        tile = BEAM_TILE
        repeats = REPEATS
        beams = len(lit) / SHARE
    few = sample_beams(lit, _whole_rounds(beams / SHARE, tile))
    many = sample_beams(lit, max(_whole_rounds(beams, tile), 2 * len(few)))

    def rendered(chosen: Int64) -> Work:
        return lambda: _render_some(scene, stop, effects, backend, chosen)

    rendered(few)()  # compiles
    of_few, of_many = (stopwatch(rendered(chosen), repeats) for chosen in (few, many))
    if len(few) == len(many):
        return of_many
    # time(n) = fixed + each n: two sizes give both.
    each = max(of_many - of_few, 0.0) / (len(many) - len(few))
    return of_many + each * (len(lit) - len(many))


def _render_some(
    scene: Scene, stop: Accuracy, effects: Effects, backend: str, chosen: Int64
) -> NDArray[np.floating[Any]]:
    """Do the work of a rendering for some of the beams, and return the last histograms."""
    problem = prepare(scene, stop, effects)
    found = np.empty((0, 0))
    for job in (problem.job, *problem.color_jobs):
        found = beam_histograms(problem, job, backend, chosen)
        if problem.includes("pulse"):
            found = with_pulse(found.astype(np.float32), scene.pulse_ns, scene.rig.device.bin_m)
        strongest(found, scene.rig.device.bin_m)
    return found


def costs(
    scene: Scene,
    accuracy: str | Accuracy,
    plan: Plan,
    backend: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Return the seconds that each included effect adds to a rendering, by name; 0 for effects left
    out.
    """
    names = [effect.name for effect in plan if effect.included]

    def least(effects: list[str]) -> float:
        return least_seconds(lambda: render(scene, accuracy, effects, backend), REPEATS, clock)

    least(names)  # compiles
    whole = least(names)
    added = {
        name: max(whole - least([other for other in names if other != name]), 0.0) for name in names
    }
    return {effect.name: added.get(effect.name, 0.0) for effect in plan}
