"""Signal against noise of a map: RMS, cell by cell, and for a matched filter; and the frames that it takes.

Noise is random, falling as one over the root of the frames, and a pattern, which stays. `weight` of a matched filter is
signal over the mean square of both, as if the pattern had no structure; what the pattern then puts into the filter's
output is told from the pattern itself.
"""

from dataclasses import dataclass

import numpy as np
from difference_waveform import Array

FRAMES_PER_S = 30.0


@dataclass(frozen=True)
class Cells:
    """Some cells (k,) of one object's maps."""

    signal: Array
    spread: Array
    """Standard deviation of a single frame's noise."""
    pattern: Array
    """What does not fall with frames."""


@dataclass(frozen=True)
class Ratio:
    """Signal over noise."""

    rms: float
    """RMS of the signal over RMS of all else."""
    median_cell: float
    """The median of the cells' signals over the RMS of all else."""
    best_cell: float
    """The largest of the cells' signals over their own random noise and the pattern's RMS together."""
    seen: float
    """Share of cells whose signal exceeds that."""
    matched: float
    """The matched filter's output over its standard deviation and what the pattern puts there."""


def effective(frames: float, reference: float = np.inf) -> float:
    """As many frames without a reference have the noise of that many minus the mean of so many of the bare wall."""
    return 1 / (1 / frames + 1 / reference)


def ratio(cells: Cells, frames: float) -> Ratio:
    """Signal to noise of the mean of `frames`; `effective` counts the reference's noise in. 0 where nothing changes."""
    strength = np.abs(cells.signal)
    if not strength.any():
        return Ratio(0.0, 0.0, 0.0, 0.0, 0.0)
    flat = np.mean(cells.pattern**2)
    square = cells.spread**2 / frames + flat
    weight = cells.signal / square
    noise = np.sqrt(np.sum(weight**2 * cells.spread**2) / frames + np.sum(weight * cells.pattern) ** 2)
    return Ratio(
        rms=float(np.sqrt(np.mean(cells.signal**2) / np.mean(square))),
        median_cell=float(np.median(strength) / np.sqrt(np.mean(square))),
        best_cell=float(np.max(strength / np.sqrt(square))),
        seen=float(np.mean(strength > np.sqrt(square))),
        matched=float(np.sum(weight * cells.signal) / noise),
    )


def frames_for_cells(cells: Cells, wanted: float = 1.0) -> Array:
    """Effective frames (k,) at which each cell's signal is `wanted` times its noise; inf where the pattern is more."""
    room = (cells.signal / wanted) ** 2 - np.mean(cells.pattern**2)
    return np.divide(cells.spread**2, room, out=np.full(room.shape, np.inf), where=room > 0)


def frames_for_filter(cells: Cells, wanted: float = 1.0) -> float:
    """Effective frames at which the matched filter first reaches `wanted`, to 0.1 %; inf for never.

    More frames bring other weights, which may let more of the pattern in: so the first is looked for on a grid.
    """
    grid = np.exp(np.arange(-10.0, 40.0))
    reached = np.array([ratio(cells, frames).matched >= wanted for frames in grid])
    if not reached.any():
        return np.inf
    high = np.log(grid[reached.argmax()])
    low = high - 1.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if ratio(cells, np.exp(middle)).matched >= wanted else (middle, high)
    return float(np.exp(high))


def hours(frames: float) -> float:
    """How long a lidar takes for them."""
    return frames / FRAMES_PER_S / 3600.0
