"""Cells at the occluder's edge, where a bench that is a little off its record differs most from it.

A column of cells there sees the wall in place of the occluder, or the other way round, as soon as
the lidar or the occluder stands some millimetres elsewhere. These few cells are then off by far more
than an object moves any, and networks answer them with nonsense. What they ought to show is known: an
occluder's cell tells nothing, and a wall's cell much what its neighbors tell.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED, LidarMaps
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.consistency import OFF_WALL_M
from nlos_cam.reconstruct.flat_field import MIN_WALL_CELLS, as_measured
from nlos_cam.reconstruct.physics_check import bare_rendering
from nlos_cam.render import Rendering, cast

BEAMS_PER_CELL = 4
"""Along a row: an edge within a cell counts, not only one that passes its middle."""
SIGNS = -1, 1
REACH_M = 0.005
REACH_DEG = 1.0
"""How far off its record a bench may be whose edge is repaired. Farther ones are another bench."""
OTHER_SURFACE_M = 0.03
"""Depth off its surface's from which on a cell sees the other one: most occluders stand 0.05 m and
more before the wall, and a wall seen at a slant moves by a centimeter with a degree."""
OTHER_CELLS = 0.1
"""Share of a column's cells that see the other surface from which on the edge is in it."""
OTHER_LIGHT = 0.07
"""Logarithm of the light over the record's from which on a column holds some of both surfaces: the
median over its cells, which neither noise nor the grain of a wall moves as far."""
MIN_CELLS = 8
"""Cells of one surface from which on a column is judged by their light."""
FALL_M = 0.05
FALLING_CELLS = 0.06
"""Share of a column's cells whose echo falls back by FALL_M from the column before it, from which on
the occluder is in it. Of 108 unharmed frames no column has more than 0.03: echoes do not end just
where the occluder begins."""
SLOPE = 0.5
"""Share of the last step, from column to column, that the next one takes: at 2 mm and half a degree
a whole one is as good, at 5 mm and a degree, where an echo may end, worse by 0.02 of IoU."""


def edge_cells(rig: Rig, place_m: float, angle_deg: float) -> Mask:
    """Return the cells (64, 80) that the occluder's edge crosses or can pass, on a bench whose
    lidar and occluder are up to `place_m` elsewhere and whose lidar is turned by up to `angle_deg`.

    None of a rig without an occluder. Cached; the mask is read-only.
    """
    return _edge_cells(rig, place_m, angle_deg)  # pyright: ignore[reportArgumentType]  hashable


@lru_cache(maxsize=4)
def _edge_cells(rig: Rig, place_m: float, angle_deg: float) -> Mask:
    sheet = rig.occluder
    if sheet is None:
        return np.zeros((MAP_ROWS, MAP_COLUMNS), bool)
    lidar = rig.lidar
    lidars = [
        lidar.model_copy(
            update={
                "distance_m": lidar.distance_m + farther * place_m,
                "yaw_deg": lidar.yaw_deg + turned * angle_deg,
                "pitch_deg": lidar.pitch_deg + raised * angle_deg,
            }
        )
        for farther, turned, raised in product(SIGNS, repeat=3)
    ]
    sheets = [
        sheet.model_copy(
            update={"x_m": sheet.x_m + along * place_m, "z_min_m": sheet.z_min_m + wider * place_m}
        )
        for along, wider in product(SIGNS, repeat=2)
    ]
    some = np.zeros((MAP_ROWS, MAP_COLUMNS), bool)
    every = ~some
    for lidar, sheet in product(lidars, sheets):
        bench = rig.model_copy(update={"lidar": lidar, "occluder": sheet})
        beams = _occluded(bench, BEAMS_PER_CELL)
        some |= beams.any(2)
        every &= beams.all(2)
    found = some & ~every
    found.setflags(write=False)
    return found


def _occluded(rig: Rig, beams_per_cell: int) -> Mask:
    """Return which beams (64, 80, beams_per_cell) meet the occluder before the wall."""
    beams = cast(rig, rig.pinhole.scaled(beams_per_cell * MAP_COLUMNS, MAP_ROWS))
    occluded = ~beams.on_wall & np.isfinite(beams.length_m)
    return occluded.reshape(MAP_ROWS, MAP_COLUMNS, beams_per_cell)


class Surface(NamedTuple):
    """Wall or occluder as a bench's record has it, and the cells (64, 80) at the edge that see it."""

    depth_m: Float64
    """(64, 80); along the optical axis."""
    light: Float64
    """(64, 80); in units of the renderer's."""
    cells: Mask


class EdgeRepair:
    """Repair of the cells at the occluder's edge, where it is not where the record has it.

    A column is repaired if some of its cells see the other surface, or if their light is of both:
    the occluder's cells get its own depth and light, the wall's go on as the two columns before
    them do. Frames of a bench as it was recorded stay as they are.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        rig = bench.rig
        band = edge_cells(rig, REACH_M, REACH_DEG)
        self._sheet: Surface | None = None
        if not band.any():
            return
        alone = rig.model_copy(update={"occluder": None})
        occluded = _occluded(rig, 1)[:, :, 0]
        self._wall = _surface(_bare(alone), bench, band & ~occluded)
        self._sheet = _surface(_bare(rig), bench, band & occluded)
        self._apart = ~band & ~occluded, ~band & occluded
        """Cells of the wall, and of the occluder, by which the units of their light are found."""
        columns = np.arange(MAP_COLUMNS)
        sides = [(mask.sum(0) @ columns) / max(mask.sum(), 1) for mask in (occluded, ~occluded)]
        self._step = 1 if sides[0] > sides[1] else -1
        """From the wall to the occluder, in columns."""
        columns = np.flatnonzero(band.any(0))[:: self._step].tolist()
        # a wall's column goes on from two others
        self._columns = [each for each in columns if 0 <= each - 2 * self._step < MAP_COLUMNS]

    def repair(self, maps: LidarMaps) -> LidarMaps:
        """Return maps (64, 80), with the range offset corrected, as the record's edge gives them."""
        sheet = self._sheet
        if sheet is None:
            return maps
        wall_gain = _gain(maps, self._wall, self._apart[0], OFF_WALL_M)
        # of its own: no record says how dark an occluder is
        sheet_gain = _gain(maps, sheet, self._apart[1], OTHER_SURFACE_M)
        of_wall = self._off(maps, self._wall, wall_gain)
        of_sheet = self._off(maps, sheet, sheet_gain)
        if not of_wall and not of_sheet:
            return maps
        for surface, off in ((self._wall, of_wall), (sheet, of_sheet)):
            if off and off == self._columns_of(surface):
                return maps  # not a little off: another bench, or one without its occluder

        depth_m = maps.depth_m.copy()
        intensity = maps.intensity.copy()
        valid = maps.valid.copy()
        for column in self._columns:
            if column in of_sheet and sheet_gain is not None:
                rows = sheet.cells[:, column]
                depth_m[rows, column] = sheet.depth_m[rows, column]
                intensity[rows, column] = sheet_gain * sheet.light[rows, column]
                valid[rows, column] = True
            if column in of_wall:
                rows = self._wall.cells[:, column]
                before, earlier = (column - self._step * back for back in (1, 2))
                last_m = depth_m[rows, before]
                depth_m[rows, column] = last_m + SLOPE * (last_m - depth_m[rows, earlier])
                last = intensity[rows, before]
                brighter = last / np.maximum(intensity[rows, earlier], 1)
                known = valid[rows, before] & valid[rows, earlier]
                counts = np.minimum(last * brighter**SLOPE, SATURATED)
                intensity[rows, column] = np.where(known, counts, 0)
                valid[rows, column] = known
        return replace(maps, depth_m=depth_m, intensity=intensity, valid=valid)

    def _columns_of(self, surface: Surface) -> list[int]:
        """Return the columns at the edge that have cells of a surface."""
        return [column for column in self._columns if surface.cells[:, column].any()]

    def _off(self, maps: LidarMaps, surface: Surface, gain: float | None) -> list[int]:
        """Return the columns of a surface's cells that the edge is in."""
        columns = self._columns_of(surface)
        return [each for each in columns if self._is_off(maps, surface, gain, each)]

    def _is_off(self, maps: LidarMaps, surface: Surface, gain: float | None, column: int) -> bool:
        """Return True if the edge is within a column of a surface's cells."""
        rows = surface.cells[:, column] & maps.valid[:, column] & (surface.light[:, column] > 0)
        if not rows.any():
            return False
        beyond_m = maps.depth_m[rows, column] - surface.depth_m[rows, column]
        # an echo's path is longer than the wall's, so only nearer cells see the occluder
        other = beyond_m < -OTHER_SURFACE_M
        if surface is self._sheet:
            other = np.abs(beyond_m) > OTHER_SURFACE_M
        if other.mean() > OTHER_CELLS:
            return True
        if surface is self._wall and self._falls_back(maps, column):
            return True
        same = np.abs(beyond_m) < OFF_WALL_M
        if gain is None or same.sum() < MIN_CELLS:
            return False
        expected = gain * surface.light[rows, column][same]
        off = np.log((maps.intensity[rows, column][same] + 1) / (expected + 1))
        return abs(float(np.median(off))) > OTHER_LIGHT

    def _falls_back(self, maps: LidarMaps, column: int) -> bool:
        """Return True if echoes end at a column of the wall, as where half of each cell sees the
        occluder.
        """
        pair = [column - self._step, column]
        rows = self._wall.cells[:, column] & maps.valid[:, pair].all(1)
        if rows.sum() < MIN_CELLS:
            return False
        beyond_m = maps.depth_m[rows][:, pair] - self._wall.depth_m[rows][:, pair]
        falling = beyond_m[:, 1] < beyond_m[:, 0] - FALL_M
        return float(falling.mean()) > FALLING_CELLS


def _bare(rig: Rig) -> Rendering:
    """Return the rendering of a rig with nothing hidden."""
    return bare_rendering(rig)  # pyright: ignore[reportArgumentType]  hashable


def _gain(maps: LidarMaps, surface: Surface, cells: Mask, within_m: float) -> float | None:
    """Return a frame's counts for each unit of a surface's light, by the cells whose depth is
    within a limit of it; None where they are too few.
    """
    seen = cells & maps.valid & (surface.light > 0)
    seen &= np.abs(maps.depth_m - surface.depth_m) < within_m
    if seen.sum() < MIN_WALL_CELLS:
        return None
    return float(np.median(maps.intensity[seen] / surface.light[seen]))


def _surface(rendering: Rendering, bench: CalibratedRig, cells: Mask) -> Surface:
    """Return a surface as it was measured, else as rendered; `cells` (64, 80) see it."""
    seen = rendering.depth_m.astype(np.float64), rendering.intensity.astype(np.float64)
    if bench.reference is not None:
        seen = as_measured(*seen, bench.reference, bench.range_offset_m)
    return Surface(*seen, cells)
