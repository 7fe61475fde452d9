"""Measured error and time of each stop, from which a bound on either chooses one.

Written from `python tools/studies/renderer.py tradeoff` (docs/figures/renderer.json): the default scene, an
airplane of 702 patches, on 2 cores of an AMD EPYC. Another scene or machine has other figures; the
order of the stops stays.
"""

from math import inf
from typing import NamedTuple

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import Stop


class StopFigures(NamedTuple):
    """Measured figures of a stop."""

    stop: Stop
    error: float
    """99th percentile of the relative error of the peak intensity."""
    seconds: float
    """Time of one rendering."""

    def __str__(self) -> str:
        return f"{self.stop} (error {self.error:.2g}, {self.seconds:.2g} s, on the default scene)"


STOP_FIGURES = (
    StopFigures("draft", 0.034, 0.0043),
    StopFigures("standard", 0.0033, 0.0127),
    StopFigures("fine", 0.0009, 0.0223),
    StopFigures("reference", 0.0, 34.0),
)
"""From fast to slow, and so from rough to exact."""


def choose(max_error: float | None = None, max_seconds: float | None = None) -> StopFigures:
    """Return the fastest stop within `max_error`; with `max_seconds` alone, the most accurate
    within it.

    Raises SceneError if no stop is, naming the nearest, and for bounds that are negative or not
    finite.
    """
    for name, value in (("max_error", max_error), ("max_seconds", max_seconds)):
        if value is not None and not 0 <= value < inf:
            raise SceneError(f"{name} is {value}: it must be finite and at least 0")
    if max_error is None and max_seconds is None:
        raise SceneError("give max_error, max_seconds or both")

    error = inf if max_error is None else max_error
    seconds = inf if max_seconds is None else max_seconds
    fitting = [one for one in STOP_FIGURES if one.error <= error and one.seconds <= seconds]
    if fitting:
        return fitting[-1] if max_error is None else fitting[0]

    # No stop is too slow without a faster one that is too rough: the most accurate in time, or the
    # fastest of all.
    in_time = [one for one in STOP_FIGURES if one.seconds <= seconds]
    nearest = in_time[-1] if in_time else STOP_FIGURES[0]
    bounds = {"max_error": max_error, "max_seconds": max_seconds}
    given = " and ".join(f"{name} {value:g}" for name, value in bounds.items() if value is not None)
    raise SceneError(f"no accuracy keeps {given}: the nearest is {nearest}; raise the limit")
