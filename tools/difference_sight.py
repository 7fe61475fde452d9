"""Raw and difference maps of a device: what is left in them beside the signal, and their signal to noise."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
from difference_noise import REFERENCE_CELSIUS, MapNoise, Pattern
from difference_scenes import Signal
from difference_snr import Cells, Ratio, effective, ratio
from difference_waveform import Array
from nlos_calibration.arrays import Mask

Which = Callable[[Signal], Mask]
"""The cells (64, 80) of an object's maps that are looked at."""
Track = Callable[[Iterable[Any], str], Iterable[Any]]
"""Shows how far a loop is; the second argument says over what."""

MAPS = "raw", "difference", "levelled"
"""Less the ideal wall of the fitted plane; less the measured bare wall; that, less its median over the wall."""
REFERENCE_FRAMES = 1000
LEAST_M = 1e-6
"""Cells whose depth changes by less are not counted as changed by an object."""


def merged(signal: Signal) -> Mask:
    """The direct return still wins, and its depth is changed."""
    return signal.direct_wins & (np.abs(signal.depth_m) > LEAST_M)


def switched(signal: Signal) -> Mask:
    """Another echo is reported than the direct return."""
    return ~signal.direct_wins


@dataclass(frozen=True)
class Sight:
    """The cells (64, 80) that see the wall, and their noise."""

    cells: Mask
    noise: MapNoise

    def levelled(self, values: Array) -> Array:
        """A map less its median over the wall: without what all depths have in common."""
        return values - np.median(values[self.cells])

    def left_m(self, pattern: Pattern, warmer: float) -> dict[str, Array]:
        """The pattern (64, 80) that stays in each kind of map, by so many degrees warmer than the reference."""
        celsius = REFERENCE_CELSIUS + warmer
        drift_m = pattern.drift_m(celsius)
        return {"raw": pattern.misfit_m(celsius)[0], "difference": drift_m, "levelled": self.levelled(drift_m)}

    def of(self, signal: Signal, which: Which, left_m: Array) -> Cells:
        """The depth of the cells that are looked at."""
        chosen = which(signal) & self.cells
        return Cells(signal.depth_m[chosen], self.noise.depth_m[chosen], left_m[chosen])

    def counts_of(self, signal: Signal, which: Which) -> Cells:
        """The same of the intensity, in which the simulated sensor has no pattern."""
        chosen = which(signal) & self.cells
        return Cells(signal.counts[chosen], self.noise.counts[chosen], np.zeros(int(chosen.sum())))

    def ratios(self, signals: list[Signal], which: Which, left_m: dict[str, Array], frames: int) -> dict[str, Any]:
        """Signal to noise of the depth of each kind of map after so many frames: the median over the objects."""
        return {
            name: _median([ratio(self.of(one, which, left_m[name]), _averaged(name, frames)) for one in signals])
            for name in MAPS
        }

    def intensity_ratios(self, signals: list[Signal], which: Which, frames: int) -> dict[str, Any]:
        """The same of the intensity, which has nothing to level."""
        return {
            name: _median([ratio(self.counts_of(one, which), _averaged(name, frames)) for one in signals])
            for name in MAPS[:2]
        }


def _averaged(name: str, frames: int) -> float:
    return effective(frames) if name == "raw" else effective(frames, REFERENCE_FRAMES)


def _median(ratios: list[Ratio]) -> dict[str, float]:
    return asdict(Ratio(*np.median([astuple(one) for one in ratios], axis=0).tolist()))
