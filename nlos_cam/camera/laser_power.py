"""How a laser is turned down until its returns do not saturate: the rule, without the device."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from nlos_cam.frames import MAX_SATURATED

STRIDES = 10
"""Strides from the strongest laser to the weakest."""


@dataclass(frozen=True)
class PowerLimits:
    """What an option of the device can be set to."""

    least: float
    most: float
    step: float
    """Above 0."""

    def nearest(self, value: float) -> float:
        """The allowed value that is nearest."""
        steps = round((min(max(value, self.least), self.most) - self.least) / self.step)
        return min(self.least + steps * self.step, self.most)


@dataclass(frozen=True)
class Settled:
    """Where turning down ended."""

    power: float
    saturated: float | None
    """Share of infrared pixels at that power; None where no frame came to look at."""


def weaker(power: float, limits: PowerLimits) -> Iterator[float]:
    """Every power to try below this one, down to the weakest that is no darkness: 0 turns the laser off."""
    weakest = limits.least if limits.least > 0 else limits.least + limits.step
    stride = max(1, round((limits.most - limits.least) / STRIDES / limits.step)) * limits.step
    while power > weakest:
        power = max(weakest, power - stride)
        yield power


def turn_down(
    power: float, limits: PowerLimits, look: Callable[[], float | None], put: Callable[[float], bool]
) -> Settled:
    """Turn down while too much saturates, no further than that takes.

    `look` gives the share that saturates now, None where it cannot see; `put` sets a power, and whether it took.
    """
    saturated = look()
    for lower in weaker(power, limits):
        if saturated is None or saturated <= MAX_SATURATED or not put(lower):
            break
        power, saturated = lower, look()
    return Settled(power, saturated)
