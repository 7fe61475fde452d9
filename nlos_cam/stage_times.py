"""How long each stage of the last frames took, in memory of a fixed size."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

REMEMBERED = 100_000
"""Frames: 55 minutes at 30 frames/s, and 0.8 MB for each stage, which are taken at the first frame."""
SHARES = 50, 95, 99

Percentiles = dict[str, float]
"""p50, p95 and p99, rising."""


class StageTimes:
    """Seconds by stage of the last frames; a stage may be missing from some."""

    def __init__(self, remembered: int = REMEMBERED) -> None:
        self._remembered, self._next = remembered, 0
        self._columns: dict[str, NDArray[np.float64]] = {}

    def add(self, seconds: Mapping[str, float]) -> None:
        """Take one frame's in, in the place of the oldest where there is no other."""
        for name in seconds:
            if name not in self._columns:
                self._columns[name] = np.full(self._remembered, np.nan)
        for name, column in self._columns.items():
            column[self._next] = seconds.get(name, np.nan)
        self._next = (self._next + 1) % self._remembered

    @property
    def stages(self) -> list[str]:
        """In the order in which they were first told."""
        return list(self._columns)

    def of(self, stage: str) -> NDArray[np.float64]:
        """What is remembered of a stage, in no order."""
        column = self._columns.get(stage, np.empty(0))
        return column[~np.isnan(column)]


def percentiles_ms(seconds: NDArray[np.float64]) -> Percentiles:
    """Of any number of times; 0 of none."""
    values = np.percentile(seconds, SHARES) if seconds.size else np.zeros(len(SHARES))
    return {f"p{share}": 1e3 * float(value) for share, value in zip(SHARES, values, strict=True)}
