"""Consistency of a frame's two maps: with each other, and with the bare bench, cell by cell.

A network answers whatever it is given, and a physics check that renders its answer again cannot
tell a wrong answer from maps that no object can cause. This check needs no answer. Each cell
returns the stronger of two echoes (S5): that of the bare wall, or that of three bounces. So,
whatever is hidden:

1. a three-bounce path is longer than the direct one, so no cell measures less than the wall; nor
   does a path over an object in the box have any length (`echo_range_m`);
2. a cell that measures the wall's depth returns the wall's light;
3. a cell that measures more returns at least the wall's light, or its echo would not have won; and
   since the echo's lead grows from zero at the region's outline, it returns more inside;
4. the scene is one exposure, so light does not jump from one row to the next along the whole row;
5. the wall's light falls off as from the lidar's place: seen from elsewhere it is tilted.

And a frame is worth what its cells are worth: `objects_on_bench` says how often a cell tells anything
about objects in the box, so that missing cells count by what is lost with them.
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED, LidarMaps
from nlos_cam.objects import object_box, object_depth
from nlos_cam.reconstruct.bare_bench import brightest_light, interior, wall_as_rendered
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.flat_field import MIN_WALL_CELLS, as_measured
from nlos_cam.render import Rendering, Scene, SensorModel, cast, render

OFF_WALL_M = 0.009
"""Depth beyond the wall's from which on a cell shows an echo: three times the error of a bench's
record, and far below the shortest detour over an object in a box (0.1 m).
"""
NO_ECHO_M = 0.03
"""Depth beyond the wall's below which no echo of an object in a box lies: cells between OFF_WALL_M
and this show a wall that is farther away than its record."""
LOST_SHARE = 0.03
"""Share of the information from which on a frame is no longer judged by its networks. With a tenth
of the rows missing a share of 0.09 is lost, and the silhouette IoU falls from 0.64 to 0.42.
"""
MOVED_M = 0.006
"""Largest median distance of the wall's cells from their record, by the error of a record and the
drift of a range over an hour's warming: beyond it the wall is not where it was calibrated."""
NEARER_CELLS = 4
NEARER_M = 0.01
"""The wall is not where it was calibrated either if more than NEARER_CELLS cells read nearer than
it by NEARER_M: half a degree of an unnoticed turn moves the farthest cells that far."""
UNLIKE_WALL_CELLS = 4
UNLIKE_WALL = 0.2
"""Rule 2 is broken by this number of cells at the wall's depth whose light differs from the wall's
by this logarithm. Without texture, cells differ by 0.01."""
BRIGHT_INSIDE_CELLS = 8
BRIGHT_INSIDE = 0.06
"""Rule 2 is also broken by more cells than these that are brighter than the wall by this logarithm,
well inside a region at the wall's depth."""
TOO_DARK_CELLS = 4
TOO_DARK = 0.15
"""Rule 3 is broken by this number of cells with an echo that are darker than the wall by this
logarithm."""
DARK_INSIDE_CELLS = 30
DARK_INSIDE = 0.05
"""Rule 3 is also broken by more cells than these, well inside a region of echoes, that are not
brighter than the wall by this logarithm. 97 % of unharmed frames have at most 17 of them."""
DARK_INSIDE_SHARE = 0.05
"""Share of the cells inside that may be dark if it is more than DARK_INSIDE_CELLS, as in a large
region."""
ECHO_OVERLAP = 0.9
"""Smallest `_overlap` of the cells that are deeper than the wall with those that are brighter, on a
bench whose echoes are strong."""
OVERLAP_BY_TEXTURE = 0.5
"""Overlap that a textured wall may take, for each unit by which TEXTURE_SPREADS of its light exceed
BRIGHTER."""
OVERLAP_MARGIN = 0.04
"""Overlap that noise may take from that of rendered objects."""
MIN_ECHO_CELLS = 100
"""Cells with an echo below which the overlap is not judged."""
BRIGHTER = 0.1
"""Logarithm of light over the wall's above which a cell counts as brighter."""
SEAM = 0.07
"""Mean jump of the light between two rows, in units of the largest that counts: 0.028 at most where
nothing moves, 0.064 where an airplane flies while the rows are scanned, 0.12 mostly where the rows
below are of another object."""
SEAM_LIMIT = 0.3
"""Largest jump that counts, as a logarithm of light."""
TILT = 0.06
"""Change of the wall's light over the height of the view, as a logarithm: three rows of shift cause
0.09, one row 0.03."""
NOISE_SIGMAS = 4.0
"""A limit on the light is at least this number of standard deviations of the sensor's noise, which
counts in cells of a few counts."""
CELL_PIXELS = 60
"""Pixels of a cell, of 640 x 480 of a frame."""
SENSOR = SensorModel()
TEXTURE_SPREADS = 5.0
"""A limit on the light is at least this number of standard deviations of the wall's own light, for
walls with texture."""
INFORMATION_OBJECTS = 16
INFORMATION_SEED = 910_000


class MapProblem(StrEnum):
    """Reason why a frame's maps cannot be those of any hidden object on this bench."""

    LOST = "cells that tell about the hidden object have no depth"
    OFF_RECORD = "the wall is not where it was calibrated"
    UNLIKE = "infrared and depth do not belong together"
    TORN = "the frame joins two exposures"
    TILTED = "the wall's light falls off as from another place"


@dataclass(frozen=True)
class MapFindings:
    """Findings of one frame's maps."""

    missing_share: float
    """Share of the cells that see the wall and have no depth."""
    lost_share: float
    """The same, each cell by the information it carries."""
    problems: tuple[MapProblem, ...] = ()

    @property
    def kept_share(self) -> float:
        """Factor from 0 to 1 on a predicted quality: it falls with every missing cell."""
        return (1 - self.missing_share) * (1 - self.lost_share)


COMPLETE = MapFindings(0.0, 0.0)


class MapConsistency:
    """Check of maps against the bare wall of a bench, as it was measured, else as rendered.

    The measured light holds the wall's texture and the room's light, the rendered one does not.
    Cells that see the occluder, or its edge, take no part: its depth and its light are not known.
    A rig without an object box weighs all cells alike.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        rig = bench.rig
        usual = objects_on_bench(rig)  # pyright: ignore[reportArgumentType]  frozen, hashable
        self._information, self._overlap = usual
        wall = wall_as_rendered(rig)
        if bench.reference is not None:
            wall = as_measured(*wall, bench.reference, bench.range_offset_m)
        self._depth_m, self._light = wall
        self._nearest_echo_m, self._farthest_echo_m = echo_range_m(rig)

    def examine(self, maps: LidarMaps) -> MapFindings:
        """Return the findings of maps (64, 80) with the range offset corrected."""
        sees_wall = self._light > 0
        absent = sees_wall & ~maps.valid
        missing_share = float(absent.sum() / max(sees_wall.sum(), 1))
        lost_share = float(self._information[absent].sum())

        problems: list[MapProblem] = []
        if lost_share >= LOST_SHARE:
            problems.append(MapProblem.LOST)
        both = sees_wall & maps.valid
        if both.sum() >= MIN_WALL_CELLS:
            problems += self._contradictions(maps, both)
        return MapFindings(missing_share, lost_share, tuple(problems))

    def _contradictions(self, maps: LidarMaps, both: Mask) -> list[MapProblem]:
        """Return what is wrong in the cells that have a depth and see the wall."""
        beyond_m = np.where(both, maps.depth_m - self._depth_m, 0.0)
        at_wall = both & (np.abs(beyond_m) < OFF_WALL_M)
        echo = both & (beyond_m >= OFF_WALL_M)
        nearer = (beyond_m < -NEARER_M).sum() > NEARER_CELLS
        if at_wall.sum() < MIN_WALL_CELLS:
            # An object may win in every cell. Or the lidar looks at something else.
            too_near = beyond_m < self._nearest_echo_m
            no_path = echo & (too_near | (beyond_m > self._farthest_echo_m))
            elsewhere = nearer or no_path.sum() >= MIN_WALL_CELLS
            return [MapProblem.OFF_RECORD] if elsewhere else []

        light, noise = self._log_light(maps, both, at_wall)
        spread = _spread(light[at_wall])
        unsaturated = maps.intensity < SATURATED
        problems: list[MapProblem] = []
        if nearer or abs(np.median(beyond_m[at_wall])) > MOVED_M:
            problems.append(MapProblem.OFF_RECORD)
        if _unlike(light, noise, spread, at_wall, echo, unsaturated, self._overlap):
            problems.append(MapProblem.UNLIKE)
        if _largest_seam(light, both) > max(SEAM, TEXTURE_SPREADS * spread / SEAM_LIMIT / 2):
            problems.append(MapProblem.TORN)
        if abs(_tilt(light, at_wall)) > max(TILT, spread):
            problems.append(MapProblem.TILTED)
        return problems

    def _log_light(self, maps: LidarMaps, both: Mask, at_wall: Mask) -> tuple[Float64, Float64]:
        """Return the logarithm of each cell's light over the bare wall's, 0 where it has no depth,
        and what noise may do to it.

        The device's gain and the room's light are fitted to the cells that show the wall, twice:
        the second time without those that the first fit explains least.
        """
        counts = maps.intensity.astype(np.float64)
        used = at_wall & (counts > 0)
        light = np.zeros(counts.shape)
        expected = light
        for _ in range(2):
            expected = np.maximum(_fitted(self._light, counts, used), 0)
            # one count is added to both, so that dark cells, known to a count, differ by less
            light = np.log((counts + 1) / (expected + 1))
            used &= np.abs(light) < max(3 * _spread(light[used]), BRIGHTER)
        variance = (SENSOR.read_noise_counts**2 + SENSOR.shot_noise**2 * expected) / CELL_PIXELS
        return np.where(both, light, 0.0), NOISE_SIGMAS * np.sqrt(variance) / (expected + 1)


def echo_range_m(rig: Rig) -> tuple[Float64, Float64]:
    """Return the least and the largest depth beyond the wall's, each (64, 80), that a path of three
    bounces over a point of a rig's box can have in each cell.

    At least NO_ECHO_M; without an object box any depth from there on.
    """
    shape = MAP_ROWS, MAP_COLUMNS
    if rig.object_box is None:
        return np.full(shape, NO_ECHO_M), np.full(shape, np.inf)

    beams = cast(rig, rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS))
    spot_m = beams.laser_spot_m
    seen_m = spot_m[beams.on_wall]
    last_m = np.linalg.norm(seen_m - beams.lidar_m, axis=1)

    # The path beyond the wall's is d2 + d3 + d4 - d1: from the spot to the box, from there to a
    # point of the wall that the lidar sees, and back. Least and largest values of d2 and of d3 + d4
    # apart bound their sum, whatever the object.
    nearest_m, farthest_m = _box_distances_m(rig, spot_m)
    back_near_m, back_far_m = _box_distances_m(rig, seen_m)
    shortest_m = nearest_m - beams.length_m + (back_near_m + last_m).min()
    longest_m = farthest_m - beams.length_m + (back_far_m + last_m).max()
    half_cos = beams.cos_axis / 2  # of depth along the optical axis
    return (
        np.maximum(half_cos * shortest_m, NO_ECHO_M).reshape(shape),
        (half_cos * longest_m).reshape(shape),
    )


def _box_distances_m(rig: Rig, points_m: Float64) -> tuple[Float64, Float64]:
    """Return the distances (n,) of points (n, 3) to the nearest and farthest point of a rig's box."""
    box = object_box(rig)
    low_m = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
    high_m = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
    nearest_m = points_m - np.clip(points_m, low_m, high_m)
    farthest_m = np.maximum(np.abs(points_m - low_m), np.abs(points_m - high_m))
    return np.linalg.norm(nearest_m, axis=1), np.linalg.norm(farthest_m, axis=1)


def _fitted(light: Float64, counts: Float64, used: Mask) -> Float64:
    """Return gain * light + room (64, 80) by least squares over some of the cells.

    The room's light is at least 0: a negative one would let any fall-off pass.
    """
    if used.sum() < 2:
        return light
    design = np.stack([light[used], np.ones(used.sum())], 1)
    (gain, room), *_ = np.linalg.lstsq(design, counts[used], rcond=None)
    if room < 0 or gain <= 0:
        room = 0.0
        gain = float(np.median(counts[used] / light[used]))
    return gain * light + room


def _spread(values: Float64) -> float:
    """Return the standard deviation, by the median of the absolute deviations; 0 for none."""
    if not values.size:
        return 0.0
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _unlike(
    light: Float64,
    noise: Float64,
    spread: float,
    at_wall: Mask,
    echo: Mask,
    unsaturated: Mask,
    min_overlap: float,
) -> bool:
    """Return True if light and depth name different echoes as the stronger one (rules 2 and 3).

    `light` (64, 80) is the logarithm of each cell's light over the bare wall's, `noise` (64, 80) a
    bound on its noise, and `spread` its standard deviation over the wall. `min_overlap` is the
    least overlap of brighter with deeper cells that objects on this bench have.
    """
    texture = TEXTURE_SPREADS * spread
    allowed = np.maximum(noise, texture)

    # Rule 2: a cell at the wall's depth returns the wall's light.
    other_light = at_wall & (np.abs(light) > np.maximum(UNLIKE_WALL, allowed))
    if other_light.sum() >= UNLIKE_WALL_CELLS:
        return True
    bright_inside = interior(at_wall) & (light > np.maximum(BRIGHT_INSIDE, allowed))
    if bright_inside.sum() > BRIGHT_INSIDE_CELLS:
        return True

    # Rule 3: a cell with an echo returns at least the wall's light, and more inside its region.
    too_dark = echo & (light < -np.maximum(TOO_DARK, allowed))
    if too_dark.sum() >= TOO_DARK_CELLS:
        return True
    # Texture makes some inner cells darker by chance, so the limit falls by two of its spreads,
    # counted from the spread at which texture begins to raise BRIGHT_INSIDE.
    lowered = DARK_INSIDE + 2 * BRIGHT_INSIDE / TEXTURE_SPREADS - 2 * spread
    inside = interior(echo)
    dark_inside = inside & unsaturated & (light < min(DARK_INSIDE, lowered))
    if dark_inside.sum() > max(DARK_INSIDE_CELLS, DARK_INSIDE_SHARE * inside.sum()):
        return True

    # Both rules together: the same cells are brighter and deeper.
    if echo.sum() < MIN_ECHO_CELLS:
        return False
    brighter = (at_wall | echo) & unsaturated & (light > max(BRIGHTER, texture))
    by_texture = OVERLAP_BY_TEXTURE * max(texture - BRIGHTER, 0.0)
    return _overlap(brighter, echo & unsaturated) < min_overlap - by_texture


def _overlap(brighter: Mask, deeper: Mask) -> float:
    """Return the overlap, 0 to 1, of the cells that are brighter than the wall with those that are
    deeper: 1 less the cells that are only one of both, over those that are either.

    A difference of one cell in the outline does not count: an echo's lead grows from zero there, so
    that its rim is deeper and hardly brighter, and small regions are mostly rim.
    """
    beside = ~interior(~deeper)
    unlike = (brighter & ~beside) | (interior(deeper) & ~brighter)
    return 1.0 - float(unlike.sum() / max((brighter | deeper).sum(), 1))


def _largest_seam(light: Float64, both: Mask) -> float:
    """Return the largest mean jump between two rows, beyond that of the rows around, 0 to 1.

    |l[r+1] - l[r]| less half the jumps above and below: a smooth field, however steep, gives about
    zero; an edge of an object's echo crosses rows at a few columns only, a seam at all of them.
    """
    columns = both.any(0)
    if not columns.any():
        return 0.0
    limited = np.clip(light[:, columns], -1.0, 3.0)
    jumps = np.abs(np.diff(limited, axis=0))  # (63, columns)
    jumps[~(both[1:, columns] & both[:-1, columns])] = 0.0
    excess = jumps[1:-1] - 0.5 * (jumps[:-2] + jumps[2:])
    return float(np.clip(excess, -SEAM_LIMIT, SEAM_LIMIT).mean(1).max()) / SEAM_LIMIT


def _tilt(light: Float64, at_wall: Mask) -> float:
    """Return the slope of the wall's light over the height of the view, by least squares."""
    row, column = np.nonzero(at_wall)
    design = np.stack([np.ones(len(row)), row / MAP_ROWS - 0.5, column / MAP_COLUMNS - 0.5], 1)
    solved, *_ = np.linalg.lstsq(design, np.clip(light[at_wall], -0.5, 0.5), rcond=None)
    return float(solved[1])


class ObjectsOnBench(NamedTuple):
    """What random objects in a rig's box do to its maps."""

    information: Float64
    """(64, 80); share of what a frame tells about objects that each cell carries: how often the
    echo of one wins there (S5), whose path is then measured. The sum is 1."""
    overlap: float
    """Least overlap of brighter with deeper cells, less what noise takes of it; at most
    ECHO_OVERLAP. Where the lidar is turned or far, echoes win by little."""


@lru_cache(maxsize=4)
def objects_on_bench(rig: Rig) -> ObjectsOnBench:
    """Return what INFORMATION_OBJECTS random objects show; without an object box all cells are
    alike.
    """
    cells = np.zeros((MAP_ROWS, MAP_COLUMNS))
    overlaps = [ECHO_OVERLAP + OVERLAP_MARGIN]
    if rig.object_box is not None:
        box = object_box(rig)
        bare = wall_as_rendered(rig)
        counts_per_light = SensorModel().bare_wall_counts / brightest_light(rig)
        for seed in range(INFORMATION_SEED, INFORMATION_SEED + INFORMATION_OBJECTS):
            _, depth_m = object_depth(seed, box)
            rendering = render(Scene(rig, depth_m), "draft")
            echo = rendering.multi.peak
            cells += (echo > 0) & (rendering.intensity <= echo)
            overlaps.append(_overlap_of(rendering, *bare, counts_per_light))
    if not cells.any():
        cells += 1
    return ObjectsOnBench(cells / max(cells.sum(), 1.0), min(overlaps) - OVERLAP_MARGIN)


def _overlap_of(
    rendering: Rendering, wall_m: Float64, wall_light: Float64, counts_per_light: float
) -> float:
    """Return the overlap of the cells that an object makes brighter and deeper; 1 where they are
    too few.
    """
    sees_wall = (wall_light > 0) & np.isfinite(rendering.depth_m)
    echo = sees_wall & (rendering.depth_m - wall_m >= OFF_WALL_M)
    if echo.sum() < MIN_ECHO_CELLS:
        return 1.0
    # in the sensor's counts, of which one is added as to measured ones
    seen = counts_per_light * rendering.intensity + 1
    ratio = seen / (counts_per_light * wall_light + 1)
    return _overlap(sees_wall & (np.log(ratio) > BRIGHTER), echo)
