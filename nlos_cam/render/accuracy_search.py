"""The stop of the dial for a scene: the cheapest that keeps an error bound, or the most accurate within a time budget.

Both are found out on the spot. The error: brute force on a few beams, and each stop on the same. The time: of a small
share of the beams, in two sizes, since planning and tables are paid once and beams one by one. The look costs about as
much as three beams in a hundred by brute force; the budget is for the rendering after it.

How far one rendering of a scene is from another, echo by echo.

What each effect of a plan costs: the time that a rendering takes with it, less the time without it.
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
from nlos_cam.render.backend_numba import BEAM_TILE
from nlos_cam.render.echoes import spread, strongest
from nlos_cam.render.effects import Effects, Plan, included
from nlos_cam.render.geometry import cast
from nlos_cam.render.planning import Prepared
from nlos_cam.render.renderer import Rendering, histograms, render
from nlos_cam.render.scene import Scene

Floating = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Echoes:
    """What is compared, one entry (n,) for each beam or each cell."""

    intensity: Floating
    path_m: Floating
    """NaN where nothing comes back."""
    depth_m: Floating
    """What the lidar reports; NaN where nothing comes back."""

    @classmethod
    def of_beams(cls, rendering: Rendering) -> Self:
        """The strongest three-bounce bin of each beam, one per cell: stricter than maps, which a direct one may win."""
        multi = rendering.multi
        return cls(multi.peak.ravel(), multi.path_m.ravel(), rendering.depth_m.ravel())

    @classmethod
    def of_cells(cls, rendering: Rendering, scene: Scene) -> Self:
        """The maps (64, 80), for renderings with different numbers of beams per cell."""
        depth = rendering.depth_m.ravel()
        cos_axis = cast(scene.rig, scene.cell_intrinsics).cos_axis
        return cls(rendering.intensity.ravel(), 2 * depth / cos_axis, depth)

    def some(self, which: Mask) -> "Echoes":
        """Only some of them."""
        return Echoes(self.intensity[which], self.path_m[which], self.depth_m[which])


@dataclass(frozen=True)
class Agreement:
    """One rendering against another that is taken to be the truth."""

    intensity_error_median: float
    """Relative."""
    intensity_error_p99: float
    intensity_error_max: float
    bin_exact: float
    """Share of echoes in the same bin of path length."""
    bin_within_1: float
    depth_error_mm: float
    """Median, where both report a depth."""
    depth_error_mean_mm: float


def relative_error(found: Floating, truth: Floating) -> Floating:
    """|found - truth| / truth (n,); where nothing should come back, 0 if nothing does and else 1."""
    off = np.abs(found - truth)
    return np.divide(off, truth, out=(off > 0).astype(off.dtype), where=truth > 0)


def agreement(found: Echoes, truth: Echoes, bin_m: float) -> Agreement:
    """Hold echoes (at least one) against the true ones."""
    error = relative_error(found.intensity, truth.intensity)
    bins = np.abs(found.path_m - truth.path_m) / bin_m
    bins[np.isnan(found.path_m) & np.isnan(truth.path_m)] = 0  # NaN of one alone is in no bin of the other
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
"""At least so many are summed by brute force."""
CAUTION = 1.5
"""The largest error of a sample, times this, is at least the 99th percentile of all in nine draws of ten."""
SHARE = 4
"""One beam of this many is timed, and one of as many of those."""
REPEATS = 3


@dataclass(frozen=True)
class Choice:
    """A stop, and what it may be expected to cost and to miss by."""

    accuracy: Accuracy
    predicted_error: float
    """Of peak intensity: the 99th percentile of its relative error, rather too large than too small."""
    predicted_seconds: float


Work = Callable[[], object]
Stopwatch = Callable[[Work, int], float]
"""The least seconds that a piece of work took, in a number of repeats."""


def least_seconds(work: Work, repeats: int) -> float:
    """A stopwatch by the clock."""
    taken: list[float] = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        taken.append(time.perf_counter() - started)
    return min(taken)


def choose(
    scene: Scene,
    max_error: float | None = None,
    max_seconds: float | None = None,
    effects: Effects = "auto",
    backend: str = "cpu",
    *,
    stops: Collection[Accuracy] = tuple(STOPS.values()),
    stopwatch: Stopwatch = least_seconds,
) -> Choice:
    """The cheapest stop that keeps `max_error`; with `max_seconds` alone, the most accurate that keeps it.

    Raises SceneError where none does, with what the nearest misses by, and where a bound is no bound.
    """
    for name, value in (("max_error", max_error), ("max_seconds", max_seconds)):
        if value is not None and not 0 <= value < inf:
            raise SceneError(f"{name} is {value}: it must be a finite number, not negative")
    if max_error is None and max_seconds is None:
        raise SceneError("neither max_error nor max_seconds is given: give one, or both")
    return pick(predict(scene, effects, backend, stops, stopwatch), max_error, max_seconds)


def pick(choices: Collection[Choice], max_error: float | None, max_seconds: float | None) -> Choice:
    """The choice of `choose` among these."""
    error, seconds = inf if max_error is None else max_error, inf if max_seconds is None else max_seconds
    kept = [choice for choice in choices if choice.predicted_error <= error and choice.predicted_seconds <= seconds]
    if not kept:
        raise SceneError(_nothing_keeps(choices, error, seconds))
    if max_error is None:
        return min(kept, key=lambda choice: (choice.predicted_error, choice.predicted_seconds))
    return min(kept, key=lambda choice: (choice.predicted_seconds, choice.predicted_error))


def _nothing_keeps(choices: Collection[Choice], max_error: float, max_seconds: float) -> str:
    def missed(choice: Choice) -> float:
        return max(choice.predicted_error / max(max_error, 1e-9), choice.predicted_seconds / max(max_seconds, 1e-9))

    nearest = min(choices, key=missed)
    error, seconds = nearest.predicted_error, nearest.predicted_seconds
    asked = [f"max_error {max_error:g}"] * (max_error < inf) + [f"max_seconds {max_seconds:g}"] * (max_seconds < inf)
    over = [f"an error of {error:.3g} is {error - max_error:.3g} too large"] * (error > max_error)
    over += [f"{seconds:.3g} s are {seconds - max_seconds:.3g} s too long"] * (seconds > max_seconds)
    return (
        f"no accuracy keeps {' and '.join(asked)}: the nearest is {nearest.accuracy.name}, where {' and '.join(over)}; "
        "allow that much"
    )


def predict(
    scene: Scene, effects: Effects, backend: str, stops: Collection[Accuracy], stopwatch: Stopwatch
) -> list[Choice]:
    """What each stop costs and misses by. One of them must be brute force, and all cast one beam per cell."""
    (brute,) = (stop for stop in stops if stop.sub_bins == 0)
    whole = Prepared.of(scene, brute, effects)
    ready = Prepared.of(scene, brute, _three_bounces_of(whole))
    lit = np.flatnonzero(ready.beams.on_wall)
    sample = some_of(lit, _whole_rounds(SAMPLE_BEAMS, 1))
    truth = histograms(ready, ready.job(), backend, sample).max(1)
    choices: list[Choice] = []
    for stop in stops:
        if stop is brute and included(whole.plan, "inter-reflection"):
            continue
        seconds = _seconds(scene, stop, effects, backend, lit, stopwatch)
        if stop is brute:
            choices.append(Choice(stop, 0.0, seconds))
            continue
        there = Prepared.of(scene, stop, _three_bounces_of(Prepared.of(scene, stop, effects)))
        found = histograms(there, there.job(), backend, sample).max(1)
        error = CAUTION * float(relative_error(found, truth).max(initial=0.0))
        choices.append(Choice(stop, error, seconds))
    return choices


def _three_bounces_of(ready: Prepared) -> Effects:
    """What a plan includes, but for inter-reflection: path by path that would take hours."""
    return [effect.name for effect in ready.plan if effect.included and effect.name != "inter-reflection"]


def some_of(lit: Int64, count: int) -> Int64:
    """About `count` of the beams, spread over the map: one at random, but always the same, from each strip."""
    if len(lit) <= count:
        return lit
    edges = np.linspace(0, len(lit), count + 1)
    within = np.random.default_rng(0).random(count)
    return lit[(edges[:-1] + within * np.diff(edges)).astype(np.int64)]


def _whole_rounds(beams: float, tile: int) -> int:
    """At least so many beams that every thread has as many tiles of them as every other."""
    one_round = tile * numba.get_num_threads()
    return int(-(-beams // one_round)) * one_round


def _seconds(scene: Scene, stop: Accuracy, effects: Effects, backend: str, lit: Int64, stopwatch: Stopwatch) -> float:
    """Seconds of a whole rendering, told from those of some beams and of some of those."""
    if stop.sub_bins == 0:
        tile, repeats, beams = 1, 1, SAMPLE_BEAMS
    else:
        tile, repeats, beams = BEAM_TILE, REPEATS, len(lit) / SHARE
    few = some_of(lit, _whole_rounds(beams / SHARE, tile))
    many = some_of(lit, max(_whole_rounds(beams, tile), 2 * len(few)))

    def rendered(chosen: Int64) -> Work:
        return lambda: _render_some(scene, stop, effects, backend, chosen)

    rendered(few)()  # compiles
    of_few, of_many = (stopwatch(rendered(chosen), repeats) for chosen in (few, many))
    if len(few) == len(many):
        return of_many
    each = max(of_many - of_few, 0.0) / (len(many) - len(few))
    return of_many + each * (len(lit) - len(many))


def _render_some(
    scene: Scene, stop: Accuracy, effects: Effects, backend: str, chosen: Int64
) -> NDArray[np.floating[Any]]:
    """The work of a rendering, for some of the beams."""
    ready = Prepared.of(scene, stop, effects)
    found = np.empty((0, 0))
    for channel in [None] if ready.channels == 1 else [None, 0, 1, 2]:
        found = histograms(ready, ready.job(channel), backend, chosen)
        if included(ready.plan, "pulse"):
            found = spread(found.astype(np.float32), scene.pulse_ns, scene.rig.device.bin_m)
        strongest(found, scene.rig.device.bin_m)
    return found


"""The least of so many: what disturbs a machine only ever adds."""


def costs(
    scene: Scene,
    accuracy: str | Accuracy,
    plan: Plan,
    backend: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Seconds that each included effect adds to a rendering, by name; 0 for what is left out."""
    names = [effect.name for effect in plan if effect.included]

    def least(effects: list[str]) -> float:
        times: list[float] = []
        for _ in range(REPEATS):
            started = clock()
            render(scene, accuracy, effects, backend)
            times.append(clock() - started)
        return min(times)

    least(names)  # compiles
    whole = least(names)
    added = {name: max(whole - least([other for other in names if other != name]), 0.0) for name in names}
    return {effect.name: added.get(effect.name, 0.0) for effect in plan}
