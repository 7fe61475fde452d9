"""Plain back-projection: each point of a volume gets the light whose path length fits it (Velten
et al. 2012), without filters or weights.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.errors import RecordingError
from nlos_cam.transients.transient import Transient

MAX_SUMS = 4e9
"""Additions of one back-projection: about ten seconds on two cores. A volume gets coarser to keep
it.
"""
MIN_SIDE = 12
DEFAULT_SIDE = 48
MIN_ALONG_AXIS = 0.94
"""Smallest component of a wall's unit normal along x, y or z: 20 degrees off it. The box of a
volume has its sides along the axes.
"""


@dataclass(frozen=True)
class Volume:
    """Box of the hidden space, and its number of points along x, y and z."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    shape: tuple[int, int, int] = (DEFAULT_SIDE, DEFAULT_SIDE, DEFAULT_SIDE)

    @property
    def axes_m(self) -> tuple[Float64, Float64, Float64]:
        """Coordinates along x, y and z: the middles of equal cells."""
        x, y, z = (
            low + (np.arange(count) + 0.5) * (high - low) / count
            for low, high, count in zip(self.low_m, self.high_m, self.shape, strict=True)
        )
        return x, y, z

    @property
    def points_m(self) -> Float64:
        """(x, y, z, 3)."""
        return np.stack(np.meshgrid(*self.axes_m, indexing="ij"), -1)

    @classmethod
    def of(cls, transient: Transient, side: int = DEFAULT_SIDE) -> "Volume":
        """Return the volume that nlos-cam wrote down, or else the space in front of the points, as
        deep as they are wide.

        Raises RecordingError for a wall that does not face along x, y or z.
        """
        pairs = transient.matrix[0].size
        side = max(MIN_SIDE, min(side, int((MAX_SUMS / pairs) ** (1 / 3))))
        if box := _written(transient):
            return cls(*box, (side, side, side))
        points = np.concatenate(transient.points)
        axis, sign = _facing_axis(transient)
        low = points.min(0)
        high = np.maximum(points.max(0), low + 1e-3)
        width = max(float(np.delete(np.ptp(points, 0), axis).max()), transient.bin_m)
        # No point deeper than half the longest path is ever met.
        deep = min(width, transient.end_m / 2)
        wall = float(points[:, axis].mean())
        low[axis], high[axis] = sorted((wall + sign * 0.02 * deep, wall + sign * deep))
        return cls(tuple(low.tolist()), tuple(high.tolist()), (side, side, side))


def _written(
    transient: Transient,
) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
    """Return the corners of the volume in a description by nlos-cam; None without one."""
    facts: Any = transient.facts().get("volume")
    try:
        center = np.array(facts["center"], np.float64).reshape(3)
        half = np.array(facts["size"], np.float64).reshape(3) / 2
    except (TypeError, KeyError, ValueError, OverflowError):
        return None
    if not (np.isfinite(center).all() and np.isfinite(half).all() and (half > 0).all()):
        return None
    return tuple((center - half).tolist()), tuple((center + half).tolist())


def outward(transient: Transient) -> Float64:
    """Return the unit vector (3,) from the wall into the hidden space: the mean of the normals that
    the file has, or else +z.
    """
    known = [
        normals.reshape(-1, 3)
        for normals in (transient.laser_normals, transient.detector_normals)
        if normals is not None and normals.size
    ]
    mean = np.concatenate(known).mean(0) if known else np.zeros(3)
    length = float(np.linalg.norm(mean))
    return mean / length if length else np.array([0.0, 0.0, 1.0])


def _facing_axis(transient: Transient) -> tuple[int, float]:
    """Return the axis that a wall faces along, and its sign. Raises RecordingError for an oblique
    wall.
    """
    normal = outward(transient)
    axis = int(np.argmax(np.abs(normal)))
    if abs(normal[axis]) < MIN_ALONG_AXIS:
        raise RecordingError(
            "the wall of this transient faces ({:.2f}, {:.2f}, {:.2f}): turn its points so that it"
            " faces along x, y or z".format(*normal)
        )
    return axis, float(np.sign(normal[axis]))


class _Legs(NamedTuple):
    first_m: Float64
    """(l,); d1, or 0."""
    last_m: Float64
    """(s,); d4, or 0."""
    laser_m: Float64
    """(l, 3)."""
    detector_m: Float64
    """(s, 3)."""


def back_projection(transient: Transient, volume: Volume | None = None) -> Float32:
    """Return the light (x, y, z) whose path length fits each point of a volume."""
    volume = volume or Volume.of(transient)
    lasers, detectors = (np.ascontiguousarray(points) for points in transient.points)
    first = np.zeros(len(lasers))
    last = np.zeros(len(detectors))
    if transient.first_and_last and transient.laser_m is not None:
        first = np.linalg.norm(lasers - transient.laser_m, axis=-1)
    if transient.first_and_last and transient.detector_m is not None:
        last = np.linalg.norm(detectors - transient.detector_m, axis=-1)
    # Bins of a pair lie side by side, where the sum of a point looks them up.
    rows = np.ascontiguousarray(np.moveaxis(transient.matrix, 0, -1))
    points = volume.points_m.reshape(-1, 3)
    legs = _Legs(first, last, lasers, detectors)
    sums = _project(rows, legs, points, transient.start_m, transient.bin_m, transient.paired)
    return sums.reshape(volume.shape).astype(np.float32)


@numba.njit(cache=True, parallel=True)
def _project(
    rows: Float32, legs: _Legs, points: Float64, start_m: float, bin_m: float, paired: bool
) -> Float64:
    sums = np.zeros(len(points))
    bins = rows.shape[2]
    for v in numba.prange(len(points)):
        x, y, z = points[v]
        back = np.empty(len(legs.detector_m))
        for s in range(len(back)):
            place = legs.detector_m[s]
            back[s] = legs.last_m[s] + np.sqrt(
                (x - place[0]) ** 2 + (y - place[1]) ** 2 + (z - place[2]) ** 2
            )
        for p in range(len(legs.laser_m)):
            place = legs.laser_m[p]
            there = legs.first_m[p] - start_m
            there += np.sqrt((x - place[0]) ** 2 + (y - place[1]) ** 2 + (z - place[2]) ** 2)
            # A laser point that belongs to one detector's point meets that one alone.
            begin, end = (p, p + 1) if paired else (0, len(back))
            for s in range(begin, end):
                at = int(np.floor((there + back[s]) / bin_m))
                if 0 <= at < bins:
                    sums[v] += rows[0 if paired else p, s, at]
    return sums


def peak_m(light: Float32, volume: Volume) -> tuple[float, float, float]:
    """Return the point of a volume (x, y, z) that got most light."""
    at = np.unravel_index(int(np.argmax(light)), light.shape)
    x, y, z = (float(axis[k]) for axis, k in zip(volume.axes_m, at, strict=True))
    return x, y, z
