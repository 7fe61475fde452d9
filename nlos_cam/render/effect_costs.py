"""Costs of a rendering's effects, in seconds."""

import time
from collections.abc import Callable

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.effects import Plan, brings_light
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

REPEATS = 3
"""Runs of each timing; the shortest counts, as other load only adds time."""
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


def costs(
    scene: Scene,
    accuracy: str | Accuracy,
    plan: Plan,
    backend: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Return the seconds that each included effect adds to a rendering, by name; 0 for effects left
    out, for the only one that brings light, without which nothing can be rendered, and for all of a
    plan without light.
    """
    names = [effect.name for effect in plan if effect.included]
    if not brings_light(names):
        return dict.fromkeys((effect.name for effect in plan), 0.0)

    # An effect's own cost is what a rendering saves without it. Effects share work, so the costs do
    # not add up to the whole; noise may make one negative.
    def least(effects: list[str]) -> float:
        return least_seconds(lambda: render(scene, accuracy, effects, backend), REPEATS, clock)

    least(names)  # compiles
    whole = least(names)

    def added(name: str) -> float:
        rest = [other for other in names if other != name]
        return max(whole - least(rest), 0.0) if brings_light(rest) else 0.0

    return {effect.name: added(effect.name) if effect.included else 0.0 for effect in plan}
