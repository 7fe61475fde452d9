"""Bare wall of a bench, cell by cell, and the correction of a frame by it.

No wall is uniform and no lidar's range is, and networks that were trained for a bench's own rig saw
both as ideal. What a spot of the wall reflects scales all of its light: the direct return that
leaves it, and the echo of three bounces that ends there. By as much as a cell's range is off, by a
ripple of the lidar, it is off for both. The bare wall's record holds the two, so that they can be
taken out, as alignment with another rig does.
"""

from dataclasses import replace

import numpy as np
from nlos_calibration import BareWall, Rig
from nlos_calibration.arrays import Float32, Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps
from nlos_cam.reconstruct.bare_bench import bare_rendering, brightest_light, wall_as_rendered
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.render import Sensor, SensorModel, cast

SAME_SURFACE_M = 0.03
"""Largest difference of measured and calibrated depth at which a cell's reference is of what the rig
has there: it may have been measured without the occluder, or with another one."""
MIN_WALL_CELLS = 100
MIN_COUNTS = 2.0
"""Intensity below which a cell's reflectance is not known: counts are whole numbers."""
LARGEST = 4.0
"""Largest factor of the correction, either way: a black occluder's noise is not made brighter than that."""


class FlatField:
    """Correction of maps for the reflectance of the wall and the ripples of the lidar, as the bare
    wall's record shows them.

    The occluder's reflectance is taken out too: it tells nothing about what is hidden, but networks
    have seen it as bright as the wall.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        self._factor: Float32 | None = None
        """(64, 80); light of a uniform bench over this one's, 1 where that is not known."""
        self._farther_m: Float32 | None = None
        """(64, 80); depth of this bench less that of an exact one, 0 where that is not known."""
        self._to_middle_m = np.zeros((MAP_ROWS, MAP_COLUMNS), np.float32)
        """(64, 80); depth of the cells' middle beams, less that of an exact bench's maps."""
        if bench.reference is None:
            return
        bare = bare_rendering(bench.rig)  # pyright: ignore[reportArgumentType]
        known = same_surface(bench.reference, bare.depth_m, bench.range_offset_m)
        known &= (bench.reference.map_intensity >= MIN_COUNTS) & (bare.intensity > 0)
        wall = known & (wall_as_rendered(bench.rig)[1] > 0)
        if wall.sum() < MIN_WALL_CELLS:
            return
        ratio = np.divide(
            bare.intensity, bench.reference.map_intensity, out=np.ones(known.shape), where=known
        )
        # the wall's median is the device's gain, which the networks take out by themselves
        factor = np.clip(ratio / np.median(ratio[wall]), 1 / LARGEST, LARGEST)
        self._factor = np.where(known, factor, 1).astype(np.float32)

        # Against maps of the sensor, not the cells' middle beams: the median depth over a cell that
        # sees the wall at a slant is up to 0.7 mm from that of its middle.
        exact_m = Sensor(bench.rig, SensorModel()).maps(bare.multi, None).depth_m
        measured_m = bench.reference.map_depth_m.astype(np.float64) + bench.range_offset_m
        known &= np.isfinite(exact_m)
        self._farther_m = np.where(known, measured_m - exact_m, 0).astype(np.float32)
        self._to_middle_m = np.where(known, bare.depth_m - exact_m, 0).astype(np.float32)

    def correct(self, maps: LidarMaps) -> LidarMaps:
        """Return maps (64, 80), their range offset corrected, as an exact lidar would give them of a
        uniform wall.
        """
        if self._factor is None or self._farther_m is None:
            return maps
        return replace(
            maps,
            depth_m=maps.depth_m - self._farther_m,
            intensity=maps.intensity * self._factor,
        )

    def as_rendered(self, corrected: LidarMaps) -> LidarMaps:
        """Return maps that `correct` has corrected as the renderer computes them: by the middle beam
        of each cell.
        """
        return replace(corrected, depth_m=corrected.depth_m + self._to_middle_m)


def measured_counts(rig: Rig, reference: BareWall, offset_m: float) -> float | None:
    """Return the counts of the brightest bare-wall return (`SensorModel.bare_wall_counts`) that a
    reference shows; None where too little of it is wall.

    By the cells that see the wall alone: an occluder is nearer, and brighter. Their median, so that
    the wall's texture takes no part.
    """
    depth_m, _ = wall_as_rendered(rig)
    wall = same_surface(reference, depth_m, offset_m)
    if wall.sum() < MIN_WALL_CELLS:
        return None
    direct = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)).direct.reshape(wall.shape)
    return brightest_light(rig) * float(np.median(reference.map_intensity[wall] / direct[wall]))


def as_measured(
    depth_m: Float64, light: Float64, reference: BareWall, offset_m: float
) -> tuple[Float64, Float64]:
    """Return a surface's depth and light (64, 80) as a reference measured them, as rendered in the
    cells where it saw another surface; all as rendered where those that it saw are too few.
    """
    same = same_surface(reference, depth_m, offset_m)
    if same.sum() < MIN_WALL_CELLS:
        return depth_m, light

    # in the rendering's units, so that cells without a measurement still fit
    units = float(np.median(light[same] / reference.map_intensity[same]))
    measured_m = reference.map_depth_m.astype(np.float64) + offset_m
    return (
        np.where(same, measured_m, depth_m),
        np.where(same, units * reference.map_intensity, light),
    )


def same_surface(reference: BareWall, depth_m: Float32 | Float64, offset_m: float) -> Mask:
    """Return the cells (64, 80) whose reference is of a surface at `depth_m`; `offset_m` is the
    lidar's range offset.
    """
    measured_m = reference.map_depth_m.astype(np.float64) + offset_m
    # NaN compares false
    return (np.abs(measured_m - depth_m) < SAME_SURFACE_M) & (reference.map_intensity > 0)
