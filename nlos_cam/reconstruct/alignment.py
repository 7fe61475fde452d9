"""Maps of a measured bench as the networks' training rig would have seen them.

Networks know one rig, to the millimetre: a cell at the occluder's edge that sees something else
than in training is enough to mislead them. But wherever the lidar stands, a point of the wall lit
by it returns the same paths beyond the point, so most of what a bench's maps differ by is known
from its calibration. Object boxes are laid on each other, and each cell of the training rig takes
what the bench measured at the cell's point of the wall:

- an echo of the wall is as much longer than the wall's distance there as on the bench;
- an echo over three bounces, d1 + d2 + d3 + d4, changes by d1 to the point and by the mean change
  of d4;
- intensities keep their ratio to the wall's own return, less the gain of the whole frame; over
  three bounces they do not fall with d1.

Cells that the bench does not see past its occluder are extrapolated from their neighbors, a few
cells far. Networks for many rigs are trained on a grid on the wall in place of a rig's cells
(`wall_grid`): there such cells have no return, and the rig's numbers stand in the last column.
"""

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from nlos_calibration import BareWall, ObjectBox, Occluder, Rig, load_rig
from nlos_calibration.arrays import Float32, Float64, Int64, Mask
from nlos_calibration.errors import RecordFileError
from nlos_models import CheckpointRecord
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps
from nlos_cam.objects import object_box
from nlos_cam.reconstruct.bare_bench import brightest_light
from nlos_cam.reconstruct.wall_grid import (
    NUMBERS_COLUMN,
    WALL_GRID,
    grid_of,
    is_wall_grid,
    numbers_column,
    rig_numbers,
)
from nlos_cam.render import SensorModel, cast

if TYPE_CHECKING:  # MapSet imports torch, which `live` does without
    from nlos_models.training import MapSet

    from nlos_cam.render import Beams

SHAPE = MAP_ROWS, MAP_COLUMNS
THREE_BOUNCES_M = 0.02
"""Path beyond the wall's own from which on an echo counts as one over three bounces: two bins."""
SAME_ECHO_M = 0.08
"""Spread of four neighbors' paths below which they are of one echo, and interpolated."""
BEYOND_CELLS = 3
"""Columns over which maps are extrapolated at most, towards the occluder, where intensities rise;
farther ones, and rows outside the view, repeat the last."""
SEEN_CELLS = 0.5
"""Cells past the last one that sees the wall which still count as seen, where maps are not
extrapolated."""
MIN_SEEN = 0.04
"""Share of the wall grid that a bench must see: less holds too little of a hidden object."""
HIDDEN_CELLS = 4
"""Columns that the bench's occluder may hide of those that the training rig sees."""
BEAMS = 8
"""Beams along each axis of a cell that tell whether all of it sees the wall."""
SAME_BOX_M = 0.001
"""Largest difference between the sizes of two object boxes that count as one."""
MIN_COUNTS = 0.5
"""Intensity that stands for less, whose logarithm tells nothing."""


Cells = tuple[Int64, Int64]
"""Rows and columns of cells."""


class Neighbors(NamedTuple):
    """Cells of a bench's maps from which n cells of the training rig take their values."""

    around: Cells
    """(4, n): the four cells around each point of the wall."""
    shares: Float64
    """(4, n): their bilinear shares, which extrapolate past the last cell that sees the wall."""
    nearest: Cells
    """(n,): the nearest cell that sees the wall."""
    seen: Mask
    """(n,): true where the bench itself sees the wall there, to half a cell."""


class MapAlignment:
    """Alignment of the maps of one bench with the rig that networks were trained for; see the
    module.

    With the bench's own bare wall, its reflectance and a constant error of range are taken out as
    well; `range_offset_m` is what is added to the lidar's depths (`CalibratedRig.range_offset_m`).
    `bare_wall_counts` are those of the brightest bare wall in training (default: the simulated
    sensor's).
    """

    def __init__(
        self,
        bench: Rig,
        trained: Rig,
        bare: BareWall | None = None,
        bare_wall_counts: float | None = None,
        range_offset_m: float = 0.0,
    ) -> None:
        bench, shift_m, spot_m = _spots_of(bench, trained)
        here = cast(bench, bench.pinhole.scaled(MAP_COLUMNS, MAP_ROWS), occluder=False)
        there = cast(trained, trained.pinhole.scaled(MAP_COLUMNS, MAP_ROWS))
        sees_wall = _cells_wholly_on_wall(bench)
        self._neighbors = _neighbors_of(bench, spot_m, sees_wall)
        self._numbers = numbers_column(rig_numbers(bench)) if is_wall_grid(trained) else None
        self._keep_training_rig(trained, there, bare_wall_counts)
        self._unseen = np.ones(SHAPE, bool)
        self._unseen.flat[self._cells] = ~self._neighbors.seen
        self._keep_bare_wall(here, bare, range_offset_m)

        # An echo over three bounces ends at the lidar too, from wherever on the wall that the
        # lidar sees: its last leg d4 differs between the rigs by the mean over those points.
        seen = sees_wall.ravel()
        last_m = here.length_m[seen]
        away_m = here.laser_spot_m[seen] - shift_m - there.lidar_m
        wanted_m = np.linalg.norm(away_m, axis=1)

        # Its first leg d1 is known for each point: the distance from either lidar to it.
        first_m = np.linalg.norm(spot_m - here.lidar_m, axis=1)
        wanted_first_m = there.length_m[self._cells]
        self._longer_m = first_m - wanted_first_m + (wanted_m - last_m).mean()

        # A narrow beam puts the same light on the wall from any distance, so an echo's intensity
        # does not fall with d1^2, but the wall's own return, to which it is related here, does.
        # Of the last leg both rigs collect light in proportion to 1 / d4^2.
        self._log_brighter = 2 * np.log(wanted_first_m / first_m) + np.log(
            (wanted_m**-2).mean() / (last_m**-2).mean()
        )

    def _keep_training_rig(self, trained: Rig, there: "Beams", brightest: float | None) -> None:
        """Keep the cells of the training rig that see the wall, and its bare bench's maps."""
        self._cells = np.flatnonzero(there.on_wall)
        # A sensor's gain is given by the counts of the brightest bare wall (SensorModel).
        counts = (brightest or SensorModel().bare_wall_counts) / brightest_light(trained)
        self._depth_m = (there.length_m * there.cos_axis).astype(np.float32)
        self._light = np.nan_to_num(there.direct * counts).astype(np.float32)
        # Maps hold depth along the optical axis: depth = path / 2 * cos.
        self._wall_path_m = 2 * there.length_m[self._cells]
        self._half_cos = there.cos_axis[self._cells] / 2

    def _keep_bare_wall(self, here: "Beams", bare: BareWall | None, range_offset_m: float) -> None:
        """Keep the bench's bare wall, as measured, or by its geometry where it was not."""
        wall_m = (here.length_m * here.cos_axis).reshape(SHAPE)
        light = here.direct.reshape(SHAPE)
        # Counts for a unit of the light that the maps are compared with. A frame in which no cell
        # sees the wall has no gain of its own: then the simulated sensor's counts.
        usual_gain = SensorModel().bare_wall_counts / light.max()
        if bare:
            known = (bare.map_intensity > 0) & np.isfinite(bare.map_depth_m)
            wall_m = np.where(known, bare.map_depth_m + range_offset_m, wall_m)
            # in the reference's counts, so that cells without a measurement fit the others
            lit = known & (light > 0)
            counts = np.median(bare.map_intensity[lit] / light[lit]) if lit.any() else usual_gain
            light = np.where(known, bare.map_intensity, counts * light)
            usual_gain = 1.0
        self._usual_log_gain = float(np.log(usual_gain))
        self._wall_m = wall_m
        self._path_per_depth = (2 / here.cos_axis).reshape(SHAPE)
        with np.errstate(divide="ignore"):
            self._log_light = np.log(light)

    def counts_behind(self, maps: LidarMaps) -> Float32:
        """Return the bench's own intensities (64, 80) behind the cells of `align`: they decide the
        noise there.
        """
        counts = np.zeros(SHAPE, np.float32)
        counts.flat[self._cells] = maps.intensity[self._neighbors.nearest]
        return counts

    def align(self, maps: LidarMaps) -> LidarMaps:
        """Return maps of the bench, with the range offset corrected, as those of the training
        rig.
        """
        # The path beyond the wall's own, and the logarithm of the light's ratio to the wall's: the
        # wall's slope, reflectance and a constant range error are in neither.
        beyond_m = maps.depth_m - self._wall_m
        cell_beyond_m = beyond_m * self._path_per_depth  # (64, 80), cells of the bench
        cell_log_ratio = np.log(np.maximum(maps.intensity, MIN_COUNTS)) - self._log_light

        # (n,) from here on: cells of the training rig that see the wall, still from the bench.
        spot_beyond_m, spot_log_ratio = self._interpolate(cell_beyond_m, cell_log_ratio)
        with np.errstate(invalid="ignore"):
            of_wall = np.abs(spot_beyond_m) < THREE_BOUNCES_M

        # As from the training rig's lidar: echoes over three bounces change, the wall's do not.
        trained_beyond_m = np.where(of_wall, spot_beyond_m, spot_beyond_m + self._longer_m)
        trained_log_ratio = np.where(of_wall, spot_log_ratio, spot_log_ratio + self._log_brighter)
        # Where cells see the bare wall, the light's ratio to the wall's should be 1.
        seen_gain = spot_log_ratio[of_wall]
        log_gain = float(np.median(seen_gain)) if of_wall.any() else self._usual_log_gain
        return self._maps_of(trained_beyond_m, trained_log_ratio - log_gain)

    def _interpolate(self, beyond_m: Float64, log_ratio: Float64) -> tuple[Float64, Float64]:
        """Return paths beyond the wall's in m and logarithms of the light's ratio to the wall's at
        the training rig's cells, both (n,), from those of the bench's cells, both (64, 80).
        """
        around = self._neighbors.around
        nearest = self._neighbors.nearest
        shares = self._neighbors.shares
        around_m = beyond_m[around]  # (4, n)
        with np.errstate(invalid="ignore"):
            # Between cells of different echoes a mean would be an echo that nothing returned:
            # there the nearest cell counts. NaN (no return) compares false and does the same.
            one_echo = around_m.max(0) - around_m.min(0) < SAME_ECHO_M
            return (
                np.where(one_echo, (shares * around_m).sum(0), beyond_m[nearest]),
                np.where(one_echo, (shares * log_ratio[around]).sum(0), log_ratio[nearest]),
            )

    def _maps_of(self, beyond_m: Float64, log_ratio: Float64) -> LidarMaps:
        """Return the training rig's maps with the given paths beyond the wall's in m and logarithms
        of the light's ratio to the wall's, both (n,), in its cells that see the wall.
        """
        # Cells that see no wall in training (but the occluder) keep the training rig's own value.
        depth_m = self._depth_m.copy()  # (64 * 80,)
        light = self._light.copy()
        depth_m[self._cells] = (self._wall_path_m + beyond_m) * self._half_cos
        light[self._cells] *= np.exp(log_ratio)
        depth_m = depth_m.reshape(SHAPE)
        light = light.reshape(SHAPE)
        if not np.isfinite(beyond_m).any():
            # a frame without a return, not even the wall's, has no picture either
            depth_m[:] = np.nan
        elif self._numbers is not None:
            depth_m[self._unseen] = np.nan
            depth_m[:, NUMBERS_COLUMN] = self._numbers
            light[:, NUMBERS_COLUMN] = 0.0
        valid = np.isfinite(depth_m)
        return LidarMaps(depth_m, np.where(valid, light, np.float32(0)), valid)


def alignment(
    bench: Rig,
    trained: CheckpointRecord,
    bare: BareWall | None = None,
    range_offset_m: float = 0.0,
) -> MapAlignment | None:
    """Return the alignment of a bench with the rig of weights, `bare` and `range_offset_m` as for
    `MapAlignment`; None where `rig_to_align_with` has none.
    """
    rig = rig_to_align_with(bench, trained)
    if rig is None:
        return None
    return MapAlignment(bench, rig, bare, trained.bare_wall_counts, range_offset_m)


def align_all(maps: "MapSet", benches: Iterable[Rig], trained: CheckpointRecord) -> "MapSet":
    """Return samples, each of its own bench, as the rig of weights sees them; as they are where
    that is not possible.

    There may be more benches than samples. Raises SceneError for weights on the wall grid and a
    bench that cannot be aligned with it.
    """
    wanted = training_rig(trained) if trained.input == "raw maps" else None
    if wanted is None:
        return maps
    its_bench = list(islice(benches, len(maps.image)))
    aligned, seen, _ = align_samples(maps, its_bench, wanted, trained.bare_wall_counts)
    if is_wall_grid(wanted) and not seen.all():
        first = its_bench[int(np.argmin(seen))]
        raise SceneError(
            f"the weights cannot see {(~seen).sum()} of {len(seen)} maps: of {first.name},"
            f" {grid_refusal(first)}; choose other weights"
        )
    return aligned


def align_samples(
    maps: "MapSet", benches: Iterable[Rig], wanted: Rig, bare_wall_counts: float | None = None
) -> tuple["MapSet", Mask, Float32]:
    """Return samples, each of its own bench, as the rig `wanted` sees them (`bare_wall_counts` as
    for `MapAlignment`), a mask (n,) of those that it can see, and the benches' own intensities (n,
    64, 80) behind them.

    The others, of benches that cannot be aligned with it, stay as they are.
    """
    depth_m = maps.depth_m.copy()
    intensity = maps.intensity.copy()
    counts = maps.intensity
    seen = np.ones(len(maps.image), bool)
    bench = wanted
    aligned: MapAlignment | None = None
    possible = True
    for n, its_bench in zip(range(len(seen)), benches, strict=False):
        # An alignment casts rays through every cell; samples of one bench follow each other.
        if its_bench is not bench and its_bench != bench:
            bench = its_bench
            possible = bench == wanted or can_align(bench, wanted)
            aligned = None
            if possible and bench != wanted:
                aligned = MapAlignment(bench, wanted, bare_wall_counts=bare_wall_counts)
        seen[n] = possible
        if aligned:
            sensed = LidarMaps(depth_m[n], intensity[n], np.isfinite(depth_m[n]))
            one = aligned.align(sensed)
            if counts is maps.intensity:
                counts = counts.copy()
            counts[n] = aligned.counts_behind(sensed)
            depth_m[n] = one.depth_m
            intensity[n] = one.intensity
    return replace(maps, depth_m=depth_m, intensity=intensity), seen, counts


def rig_to_align_with(bench: Rig, trained: CheckpointRecord) -> Rig | None:
    """Return the rig of weights where a bench's maps can be aligned with it and have to be.

    None where both are the same, where the rig of the weights is not known here, where `can_align`
    says no, and for difference maps.
    """
    if trained.input != "raw maps" or trained.rig_checksum == bench.checksum:
        return None
    rig = training_rig(trained)
    return rig if rig and can_align(bench, rig) else None


def can_align(bench: Rig, trained: Rig) -> bool:
    """Return whether two rigs have object boxes of one size, and the bench's occluder hides little
    more of the wall.
    """
    if is_wall_grid(trained):
        return not grid_refusal(bench)
    if not (bench.object_box and trained.object_box):
        return False
    return _have_one_size(bench.object_box, trained.object_box) and _is_in_view(bench, trained)


def grid_refusal(bench: Rig) -> str:
    """Return why maps of a bench cannot be aligned with the wall grid; empty where they can."""
    box = bench.object_box
    if box is None:
        return "it has no object box"
    if bench.occluder is None:
        return "its occluder's place is not known (`nlos-cam calibrate --occluder` measures it)"
    if not _have_one_size(box, object_box(WALL_GRID)):
        return "its object box has another size than in training"
    return "" if _sees_grid(bench) else "its lidar sees too little of the wall past the occluder"


def check_alignable(bench: Rig, trained: CheckpointRecord) -> None:
    """Raise SceneError for weights on the wall grid and a bench whose maps cannot be aligned with it.

    They cannot read the bench's own cells.
    """
    if grid_of(trained) and (why := grid_refusal(bench)):
        raise SceneError(
            f"the weights cannot see {bench.name}: {why}; choose others with --weights"
        )


def training_rig(trained: CheckpointRecord) -> Rig | None:
    """Return the rig that weights were trained for; None where it is the rig of a file on another
    machine.
    """
    if grid := grid_of(trained):
        return grid
    rig = own_rig(trained)
    if trained.rig is None:
        try:
            rig = load_rig(trained.rig_name)
        except RecordFileError:
            return None
    return rig if rig and rig.checksum == trained.rig_checksum else None


def own_rig(trained: CheckpointRecord) -> Rig | None:
    """Return the rig that a record of weights holds: a bench's, also of weights on the wall grid that
    were trained on for it. None without one, or for one of another version of the program.
    """
    try:
        return Rig.model_validate(trained.rig) if trained.rig else None
    except ValidationError:
        return None


def rig_fields(rig: Rig, *, packaged: bool = False) -> dict[str, Any] | None:
    """Return the fields of a rig for the record of weights, so that `training_rig` finds it on any
    machine.

    None for the wall grid, and for a packaged rig, which is known by its name. With `packaged`, a
    packaged rig has fields too: weights on the wall grid bear the grid's checksum, not the rig's.
    """
    if is_wall_grid(rig):
        return None
    if packaged:
        return rig.model_dump(mode="json")
    try:
        is_packaged = load_rig(rig.name).checksum == rig.checksum
    except RecordFileError:
        is_packaged = False
    return None if is_packaged else rig.model_dump(mode="json")


def recorded_counts(sensor: SensorModel) -> float | None:
    """Return the counts of the brightest bare wall for the record of weights; None for those of the
    simulated sensor, with which weights without a number were trained.
    """
    counts = sensor.bare_wall_counts
    return None if counts == SensorModel().bare_wall_counts else counts


def _is_in_view(bench: Rig, trained: Rig) -> bool:
    """Return whether the bench sees the wall of the training rig to within HIDDEN_CELLS of its
    occluder's edge.
    """
    bench, _, spot_m = _spots_of(bench, trained)
    sees_wall = _cells_wholly_on_wall(bench)
    if not sees_wall.any():
        return False
    row, column = _cells_at(bench, spot_m)
    top, bottom = _rows_on_wall(sees_wall)
    _, last = _columns_on_wall(sees_wall)
    nearest_row = np.clip(np.rint(row).astype(int), top, bottom)
    hidden_cells = (column - last[nearest_row]).max()
    return bool(hidden_cells <= HIDDEN_CELLS)


def _sees_grid(bench: Rig) -> bool:
    """Return whether the bench sees some of the wall grid past its occluder."""
    sees_wall = _cells_wholly_on_wall(bench)
    if not sees_wall.any():
        return False
    _, _, spot_m = _spots_of(bench, WALL_GRID)
    return bool(_neighbors_of(bench, spot_m, sees_wall).seen.mean() >= MIN_SEEN)


def _rows_on_wall(sees_wall: Mask) -> tuple[int, int]:
    """Return the first and last row with a cell that sees the wall."""
    rows = np.flatnonzero(sees_wall.any(1))
    return rows[0], rows[-1]


def _columns_on_wall(sees_wall: Mask) -> tuple[Int64, Int64]:
    """Return the first and last column (64,) that sees the wall in each row."""
    return sees_wall.argmax(1), MAP_COLUMNS - 1 - sees_wall[:, ::-1].argmax(1)


def _spots_of(bench: Rig, trained: Rig) -> tuple[Rig, Float64, Float64]:
    """Return the bench with an occluder, the move (3,) that lays the training rig's box on its own,
    and the training rig's laser spots (n, 3) on the wall after that move.
    """
    box = object_box(bench)
    wanted = object_box(trained)
    shift_m = np.array([box.x_min_m - wanted.x_min_m, box.y_min_m - wanted.y_min_m, 0.0])
    there = cast(trained, trained.pinhole.scaled(MAP_COLUMNS, MAP_ROWS))
    return (
        _with_occluder(bench, trained.occluder, shift_m[0]),
        shift_m,
        there.laser_spot_m[there.on_wall] + shift_m,
    )


def _cells_at(bench: Rig, spot_m: Float64) -> tuple[Float64, Float64]:
    """Return the rows and columns (n,) of the bench's maps at which points (n, 3) lie, in parts of
    a cell.
    """
    pinhole = bench.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)
    pose = bench.wall_from_lidar
    x, y, z = ((spot_m - pose[:3, 3]) @ pose[:3, :3]).T
    z = np.maximum(z, 1e-9)  # points behind the lidar are far out of view
    return pinhole.ppy + pinhole.fy * y / z, pinhole.ppx + pinhole.fx * x / z


def _have_one_size(one: ObjectBox, other: ObjectBox) -> bool:
    """Return whether two boxes have the same size, at the same distance from the wall."""
    # The networks' image spans the box: in a box of another size every pixel would be elsewhere.
    return bool(np.abs(np.subtract(_size_m(one), _size_m(other))).max() <= SAME_BOX_M)


def _size_m(box: ObjectBox) -> tuple[float, ...]:
    """Return a box's width, height, and distances from the wall: all but its place along the
    wall.
    """
    return box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m, box.z_near_m, box.z_far_m


def _with_occluder(bench: Rig, usual: Occluder | None, along_m: float) -> Rig:
    """Return the bench, with the training rig's occluder where its own was not measured."""
    # The occluder decides which cells see the hidden side: without one, all would count as seen.
    if bench.occluder or not usual:
        return bench
    return bench.model_copy(
        update={"occluder": usual.model_copy(update={"x_m": usual.x_m + along_m})}
    )


def _cells_wholly_on_wall(rig: Rig) -> Mask:
    """Return a mask (64, 80) of the cells all of whose BEAMS x BEAMS beams meet the wall, past the
    occluder.

    `bare_bench.cells_on_wall` is another rule: by the cells' middle beams, less a margin of a cell.
    """
    # A cell is the mean over its beams: one at an edge mixes wall and occluder. The beams that meet
    # the wall lie within its four sides and below the occluder's edge, which are planes through the
    # lidar: a convex cone, which holds all beams of a cell where it holds those at its corners.
    fine = rig.pinhole.scaled(BEAMS * MAP_COLUMNS, BEAMS * MAP_ROWS)
    coarse = rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)
    found = np.ones((MAP_ROWS, MAP_COLUMNS), np.bool_)
    for right, down in product((0, BEAMS - 1), repeat=2):
        corner = replace(coarse, ppx=(fine.ppx - right) / BEAMS, ppy=(fine.ppy - down) / BEAMS)
        found &= cast(rig, corner).on_wall.reshape(found.shape)
    return found


def _neighbors_of(bench: Rig, spot_m: Float64, sees_wall: Mask) -> Neighbors:
    """Return the bench's cells around points (n, 3) of the wall, in the bench's wall frame.

    Past the last cells that see the wall the shares extrapolate.
    """
    row, column = _cells_at(bench, spot_m)
    first_row, last_row = _rows_on_wall(sees_wall)
    first, last = _columns_on_wall(sees_wall)

    # Rows outside the view repeat its first or last row, so their share is 0 or 1.
    in_view = (row > first_row - SEEN_CELLS) & (row < last_row + SEEN_CELLS)
    row = np.clip(row, first_row, last_row)
    top = np.clip(np.floor(row).astype(int), first_row, max(last_row - 1, first_row))
    bottom = np.minimum(top + 1, last_row)

    # Columns must see the wall in both rows. Shares outside 0 to 1 extrapolate linearly, which
    # follows the rise of intensity towards the occluder; far out they would only amplify noise.
    low = np.maximum(first[top], first[bottom])
    high = np.minimum(last[top], last[bottom])
    in_view &= (column > low - SEEN_CELLS) & (column < high + SEEN_CELLS)
    column = np.clip(column, low - BEYOND_CELLS, high + BEYOND_CELLS)
    left = np.clip(np.floor(column).astype(int), low, np.maximum(high - 1, low))
    right = np.minimum(left + 1, MAP_COLUMNS - 1)

    down = row - top
    across = column - left
    shares = np.stack(
        [(1 - across) * (1 - down), across * (1 - down), (1 - across) * down, across * down]
    )
    around = np.stack([top, top, bottom, bottom]), np.stack([left, right, left, right])
    nearest_row = np.clip(np.rint(row).astype(int), first_row, last_row)
    nearest_column = np.clip(np.rint(column).astype(int), first[nearest_row], last[nearest_row])
    return Neighbors(around, shares, (nearest_row, nearest_column), in_view)
