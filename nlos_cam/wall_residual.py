"""How far the bare wall's mean depth is off the plane of its record, how far noise alone would put it, in blocks."""

from math import ceil

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.bare_wall import BareWall
from nlos_calibration.measured_wall import wall_points_m
from nlos_calibration.range_noise import MeanNoise
from nlos_calibration.wall_record import WallRecord
from numpy.typing import NDArray

DRAWN_COLUMNS = 320
"""Maps are drawn in blocks of pixels, at most so many across: what the wall does shows better without the noise."""


def residual_m(record: WallRecord, reference: BareWall) -> Float64:
    """How far behind the record's plane each pixel's mean is, normal to the wall (height, width); NaN: no return.

    The range offset of the record is in it, by its cause (`nlos_calibration.range_offset`).
    """
    return -wall_points_m(record, reference)[..., 2]


def expected_std_m(record: WallRecord, reference: BareWall) -> Float64:
    """The standard deviation that the lidar's noise alone gives a residual (height, width)."""
    scale = 1.0 if record.noise_scale is None else record.noise_scale
    noise = MeanNoise(np.array([float(reference.frames)]), scale)
    return noise.of(reference.depth_m.astype(np.float64)) * np.abs(_towards(record, reference))


def _towards(record: WallRecord, reference: BareWall) -> Float64:
    """How far each pixel's ray comes nearer to the wall with each metre of depth (height, width)."""
    return -(reference.intrinsics.rays() @ np.array(record.wall_from_lidar)[2, :3])


def block_side(columns: int) -> int:
    """How many pixels a block of a map so wide is across."""
    return ceil(columns / DRAWN_COLUMNS)


def in_blocks(values: NDArray[np.floating], side: int) -> Float64:
    """Means over blocks of side x side pixels, NaN left out; NaN where there is nothing else."""
    known = np.isfinite(values)
    count = _sums(known.astype(np.float64), side)
    return np.divide(
        _sums(np.where(known, values, 0.0), side), count, out=np.full(count.shape, np.nan), where=count > 0.0
    )


def most_of_block(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """The blocks of which at least half is in the mask."""
    return in_blocks(mask.astype(np.float64), side) >= 0.5


def _sums(values: NDArray[np.floating], side: int) -> Float64:
    rows, columns = (ceil(length / side) * side for length in values.shape)
    padded = np.zeros((rows, columns))
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(rows // side, side, columns // side, side).sum(axis=(1, 3))
