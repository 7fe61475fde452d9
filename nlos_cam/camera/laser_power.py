"""Rule for lowering a laser's power until its returns do not saturate, apart from the device."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from nlos_cam.frames import MAX_SATURATED

STRIDES = 10
"""Strides from the strongest laser to the weakest."""


@dataclass(frozen=True)
class PowerLimits:
    """Range of an option of the device."""

    min: float
    max: float
    step: float
    """Above 0."""

    def nearest(self, value: float) -> float:
        """Return the nearest allowed value."""
        steps = round((min(max(value, self.min), self.max) - self.min) / self.step)
        return min(self.min + steps * self.step, self.max)


@dataclass(frozen=True)
class Settled:
    """Power at which lowering ended."""

    power: float
    saturated: float | None
    """Share of saturated infrared pixels at that power; None where no frame came."""


def weaker(power: float, limits: PowerLimits) -> Iterator[float]:
    """Yield the powers to try below this one, down to the weakest but 0, which turns the laser
    off.
    """
    weakest = limits.min if limits.min > 0 else limits.min + limits.step
    stride = max(1, round((limits.max - limits.min) / STRIDES / limits.step)) * limits.step
    while power > weakest:
        power = max(weakest, power - stride)
        yield power


def turn_down(
    power: float,
    limits: PowerLimits,
    measure: Callable[[], float | None],
    put: Callable[[float], bool],
) -> Settled:
    """Lower the power while more than MAX_SATURATED saturates, and no further.

    `measure` returns the share that saturates now, None without frames; `put` sets a power and
    returns True if it held.
    """
    saturated = measure()
    for lower in weaker(power, limits):
        if saturated is None or saturated <= MAX_SATURATED or not put(lower):
            break
        power = lower
        saturated = measure()
    return Settled(power, saturated)
