"""Cells at the occluder's edge, where a bench that is a little off its record differs most from it.

A column of cells there sees the wall in place of the occluder, or the other way round, as soon as
the lidar or the occluder stands some millimetres elsewhere. The error of these few cells is then
far larger than the change by any object, and networks answer with nonsense. But their right values
are known: an occluder's cell holds no information, and a wall's cell about that of its neighbors.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Literal, NamedTuple, Self

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED, LidarMaps
from nlos_cam.reconstruct.bare_bench import bare_rendering
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.consistency import OFF_WALL_M
from nlos_cam.reconstruct.flat_field import MIN_WALL_CELLS, as_measured
from nlos_cam.render import Rendering, cast

BEAMS_PER_CELL = 4
"""Along a row: an edge within a cell counts, not only one that passes its middle."""
SIGNS = -1, 1
REACH_M = 0.005
REACH_DEG = 1.0
"""Largest error of a bench's record up to which its edge is repaired, in place and in angle."""
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
"""Share of the step between the two columns before, by which a repaired column of the wall goes on.
On benches 2 mm and half a degree off their record, 1 is as good; at 5 mm and a degree, where an
echo may end, 1 costs 0.02 of IoU."""


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
    """Wall or occluder as a bench's record has it, and the cells that see it."""

    depth_m: Float64
    """(64, 80); along the optical axis."""
    light: Float64
    """(64, 80); in units of the renderer's."""
    cells: Mask
    """(64, 80); cells that see it at the edge."""
    apart: Mask
    """(64, 80); cells that see it away from the edge, by which the units of its light are found."""


Reason = Literal["other surface", "echoes end", "light of both"]


class Fault(NamedTuple):
    """Column of a surface's cells that the edge is in, against the record."""

    column: int
    surface: Surface
    reason: Reason
    """Cells see the other surface; or their echoes end, as where half of a cell sees the occluder;
    or their light is of both surfaces."""


class Edge(NamedTuple):
    """Occluder's edge in the maps of a bench, by its record."""

    wall: Surface
    occluder: Surface
    step: int
    """Direction from the wall to the occluder along a row of the maps: 1 or -1 columns."""
    columns: list[int]
    """Columns that the edge can pass, from the wall to the occluder. Repaired in this order, the
    wall's cells of a column go on from the two columns before it, `column - step` and
    `column - 2 * step`; columns without two before them are left out."""

    @classmethod
    def of(cls, bench: CalibratedRig) -> Self | None:
        """Return the edge of a bench; None where its maps have none."""
        rig = bench.rig
        band = edge_cells(rig, REACH_M, REACH_DEG)
        if not band.any():
            return None
        occluded = _occluded(rig, 1)[:, :, 0]
        step = 1 if _mean_column(occluded) > _mean_column(~occluded) else -1
        columns = np.flatnonzero(band.any(0))[::step].tolist()
        return cls(
            _surface(_bare(rig.model_copy(update={"occluder": None})), bench, band, ~occluded),
            _surface(_bare(rig), bench, band, occluded),
            step,
            [each for each in columns if 0 <= each - 2 * step < MAP_COLUMNS],
        )

    def columns_of(self, surface: Surface) -> list[int]:
        """Return the columns at the edge that have cells of a surface."""
        return [column for column in self.columns if surface.cells[:, column].any()]

    def faults(
        self, maps: LidarMaps, wall_gain: float | None, occluder_gain: float | None
    ) -> list[Fault]:
        """Return the faults of maps in the order of `columns`.

        Gains are counts for a unit of a surface's light, None where they are not known: then a
        column's light is not judged.
        """
        found: list[Fault] = []
        for column in self.columns:
            for surface, gain in ((self.occluder, occluder_gain), (self.wall, wall_gain)):
                if reason := self._reason(maps, surface, gain, column):
                    found.append(Fault(column, surface, reason))
        return found

    def is_elsewhere(self, faults: Sequence[Fault]) -> bool:
        """Return True if a surface has faults in all its columns: not a little off, but another
        bench, or one without its occluder.
        """
        for surface in (self.wall, self.occluder):
            off = [fault.column for fault in faults if fault.surface is surface]
            if off and off == self.columns_of(surface):
                return True
        return False

    def restore_occluder(self, maps: LidarMaps, column: int, gain: float) -> None:
        """Write the occluder's own depth and light into its cells of a column, in place."""
        rows = self.occluder.cells[:, column]
        maps.depth_m[rows, column] = self.occluder.depth_m[rows, column]
        counts = gain * self.occluder.light[rows, column]
        maps.intensity[rows, column] = np.minimum(counts, SATURATED)
        maps.valid[rows, column] = True

    def extend_wall(self, maps: LidarMaps, column: int) -> None:
        """Continue the two columns before into the wall's cells of a column, in place: depth by a
        share of their difference, light by one of its logarithm's.
        """
        rows = self.wall.cells[:, column]
        before = column - self.step
        earlier = column - 2 * self.step
        last_m = maps.depth_m[rows, before]
        maps.depth_m[rows, column] = last_m + SLOPE * (last_m - maps.depth_m[rows, earlier])
        last = maps.intensity[rows, before]
        brighter = last / np.maximum(maps.intensity[rows, earlier], 1)
        known = maps.valid[rows, before] & maps.valid[rows, earlier]
        counts = np.minimum(last * brighter**SLOPE, SATURATED)
        maps.intensity[rows, column] = np.where(known, counts, 0)
        maps.valid[rows, column] = known

    def _reason(
        self, maps: LidarMaps, surface: Surface, gain: float | None, column: int
    ) -> Reason | None:
        """Return the reason why the edge is within a column of a surface's cells; None where it is
        not.
        """
        rows = surface.cells[:, column] & maps.valid[:, column] & (surface.light[:, column] > 0)
        if not rows.any():
            return None
        beyond_m = maps.depth_m[rows, column] - surface.depth_m[rows, column]
        # an echo's path is longer than the wall's, so only nearer cells see the occluder
        off_m = -beyond_m if surface is self.wall else np.abs(beyond_m)
        if (off_m > OTHER_SURFACE_M).mean() > OTHER_CELLS:
            return "other surface"
        if surface is self.wall and self._falls_back(maps, column):
            return "echoes end"

        same = np.abs(beyond_m) < OFF_WALL_M
        if gain is None or same.sum() < MIN_CELLS:
            return None
        expected = gain * surface.light[rows, column][same]
        log_ratio = np.log((maps.intensity[rows, column][same] + 1) / (expected + 1))
        return "light of both" if abs(float(np.median(log_ratio))) > OTHER_LIGHT else None

    def _falls_back(self, maps: LidarMaps, column: int) -> bool:
        """Return True if echoes end at a column of the wall, as where half of each cell sees the
        occluder.
        """
        pair = [column - self.step, column]
        rows = self.wall.cells[:, column] & maps.valid[:, pair].all(1)
        if rows.sum() < MIN_CELLS:
            return False
        beyond_m = maps.depth_m[rows][:, pair] - self.wall.depth_m[rows][:, pair]
        falling = beyond_m[:, 1] < beyond_m[:, 0] - FALL_M
        return float(falling.mean()) > FALLING_CELLS


class EdgeRepair:
    """Repair of the cells at the occluder's edge, where it is not where the record has it.

    A column is repaired if some of its cells see the other surface, or if their light is of both:
    the occluder's cells get its own depth and light, the wall's go on as the two columns before
    them do. Frames of a bench as it was recorded stay as they are.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        self._edge = Edge.of(bench)
        """None for a bench without an occluder's edge in its maps, which are never repaired."""

    def repair(self, maps: LidarMaps) -> LidarMaps:
        """Return maps (64, 80), their range offset corrected, as the record's edge gives them."""
        edge = self._edge
        if edge is None:
            return maps
        wall_gain = _gain(maps, edge.wall, OFF_WALL_M)
        # of its own: no record says how dark an occluder is
        occluder_gain = _gain(maps, edge.occluder, OTHER_SURFACE_M)
        faults = edge.faults(maps, wall_gain, occluder_gain)
        if not faults or edge.is_elsewhere(faults):
            return maps

        repaired = replace(
            maps,
            depth_m=maps.depth_m.copy(),
            intensity=maps.intensity.copy(),
            valid=maps.valid.copy(),
        )
        for fault in faults:
            if fault.surface is edge.wall:
                edge.extend_wall(repaired, fault.column)
            elif occluder_gain is not None:  # else its light is not known
                edge.restore_occluder(repaired, fault.column, occluder_gain)
        return repaired


def _mean_column(cells: Mask) -> float:
    """Return the mean column of some cells; 0 for none."""
    columns = np.arange(MAP_COLUMNS)
    return float(cells.sum(0) @ columns / max(cells.sum(), 1))


def _bare(rig: Rig) -> Rendering:
    """Return the rendering of a rig with nothing hidden."""
    return bare_rendering(rig)  # pyright: ignore[reportArgumentType]  hashable


def _gain(maps: LidarMaps, surface: Surface, within_m: float) -> float | None:
    """Return a frame's counts for each unit of a surface's light, by the cells away from the edge
    whose depth is within a limit of it; None where they are too few.
    """
    seen = surface.apart & maps.valid & (surface.light > 0)
    seen &= np.abs(maps.depth_m - surface.depth_m) < within_m
    if seen.sum() < MIN_WALL_CELLS:
        return None
    return float(np.median(maps.intensity[seen] / surface.light[seen]))


def _surface(rendering: Rendering, bench: CalibratedRig, band: Mask, sees: Mask) -> Surface:
    """Return a surface as it was measured, else as rendered; `band` (64, 80) are the cells at the
    edge, and `sees` (64, 80) those that see the surface.
    """
    depth_and_light = rendering.depth_m.astype(np.float64), rendering.intensity.astype(np.float64)
    if bench.reference is not None:
        depth_and_light = as_measured(*depth_and_light, bench.reference, bench.range_offset_m)
    return Surface(*depth_and_light, cells=band & sees, apart=~band & sees)
