"""What each effect of a plan costs: the time that a rendering takes with it, less the time without it."""

import time
from collections.abc import Callable

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.effects import Plan
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

REPEATS = 3
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
