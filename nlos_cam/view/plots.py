"""What is plotted over time: latency by stage, frames lost, temperatures, the physics check's score."""

from collections.abc import Callable, Mapping
from math import nan
from typing import Any

import rerun as rr

from nlos_cam.view.viewer import Moment

Log = Callable[..., None]
"""`(path, thing, static=False)`."""
STAGE_RGB = ((235, 240, 245), (90, 170, 255), (255, 190, 90), (80, 220, 120), (230, 120, 220), (120, 220, 220))
SENSOR_RGB = ((255, 120, 90), (255, 190, 90), (120, 200, 255), (160, 230, 140))
DROPS_RGB, SCORE_RGB = (255, 110, 90), (90, 170, 255)
WAITED_FOR = "wait"
"""Of all stages, the one that is no work: the loop waits for the camera."""


class Plots:
    """Logs each moment's figures; what is plotted is named where it first appears."""

    def __init__(self, log: Log, first: Moment) -> None:
        self._log = log
        self._stages = [name for name in first.stages_s if name != WAITED_FOR]
        self._sensors: list[str] = []
        self._checked = -1
        self._name("latency", [f"{name}, ms" for name in ("total", *self._stages)], STAGE_RGB)
        self._name("drops", ["frames lost"], [DROPS_RGB])
        self._name("physics/score", ["score"], [SCORE_RGB])

    def draw(self, moment: Moment) -> None:
        """Log the figures of a moment; the check's when it is a new one."""
        stages_s = [moment.stages_s.get(name, nan) for name in self._stages]
        self._log("latency", rr.Scalars([1e3 * value for value in (moment.latency_s, *stages_s)]))
        self._log("drops", rr.Scalars([moment.dropped]))
        self._draw_celsius(moment.celsius)
        if moment.check and moment.check.frame_number != self._checked:
            self._checked = moment.check.frame_number
            self._log("physics/score", rr.Scalars([moment.check.score]))

    def _draw_celsius(self, celsius: Mapping[str, float]) -> None:
        if not celsius:
            return
        if not self._sensors:
            self._sensors = sorted(celsius)
            self._name("temperature", [name.replace("_", " ") for name in self._sensors], SENSOR_RGB)
        self._log("temperature", rr.Scalars([celsius.get(name, nan) for name in self._sensors]))

    def _name(self, path: str, names: list[str], colours: Any) -> None:
        rgb = [colours[i % len(colours)] for i in range(len(names))]
        self._log(path, rr.SeriesLines(colors=rgb, names=names, widths=[1.5] * len(names)), static=True)
