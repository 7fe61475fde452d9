"""The running mean of maps over the last frames, per cell over those in which it was valid."""

import numpy as np

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps


class MapMean:
    """The mean of the last maps, as many as are given, in the same time however many; NaN depth is no sample.

    Sums in float64 are of float32 depths, which are exact while the depths lie between 2^-15 m and 2^15 m over the
    number of frames: what is taken off is what was added, and no error accumulates.
    """

    def __init__(self, frames: int) -> None:
        shape = MAP_ROWS, MAP_COLUMNS
        self._last = np.zeros((frames, 2, *shape), np.float32)
        """Depth and intensity, 0 where there was none."""
        self._valid = np.zeros((frames, *shape), np.bool_)
        self._sums, self._count = np.zeros((2, *shape)), np.zeros(shape, np.int64)
        self._next = 0

    def add(self, maps: LidarMaps) -> LidarMaps:
        """Take the maps of a frame in, let go of those that have become too old, and return the mean."""
        if len(self._last) == 1:
            return maps
        last, valid = self._last[self._next], self._valid[self._next]
        self._sums -= last
        self._count -= valid
        last[:] = np.where(maps.valid, (maps.depth_m, maps.intensity), np.float32(0.0))
        valid[:] = maps.valid
        self._sums += last
        self._count += valid
        self._next = (self._next + 1) % len(self._last)
        seen = self._count > 0
        depth_m, intensity = (self._sums / np.maximum(self._count, 1)).astype(np.float32)
        return LidarMaps(np.where(seen, depth_m, np.float32(np.nan)), np.where(seen, intensity, np.float32(0.0)), seen)
