"""Three-bounce light between points of the relay wall: laser points, the hidden surface, and cells
of the wall that a detector sees, in the radiometry of the renderer (S2 to S4).

The lidar lights one point and sees all cells at once; other captures of the field pair points and
cells: each with itself (confocal), one with all, all with all. A cell weighs as much in every one
of them, so that they can be compared, and added.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numba
import numpy as np
from nlos_calibration import Extent
from nlos_calibration.arrays import Float32, Float64, Int64, Mask

from nlos_cam.errors import SceneError
from nlos_cam.render import backend_reference
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.geometry import Relay, behind, occluder_edge
from nlos_cam.render.job import TransportJob
from nlos_cam.render.line_of_sight import first_hits
from nlos_cam.render.material import Brdf
from nlos_cam.render.renderer import transport
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

BLOCK = 4096
"""Pairs in one compiled call, between which progress is reported and Ctrl-C works."""
OnProgress = Callable[[int, int], None]


class Arms(NamedTuple):
    """Both halves of every path, which meet at a patch."""

    incident: Float64
    """(laser points, patches); light that the patch gives on."""
    returned: Float64
    """(cells, patches); share of it that reaches the lidar."""
    first_m: Float64
    """(laser points,); d1, or 0 where the first leg does not count."""
    last_m: Float64
    """(cells,); d4, or 0."""
    there_m: Float64
    """(laser points, patches); d2."""
    back_m: Float64
    """(cells, patches); d3."""


@dataclass(frozen=True)
class WallGrid:
    """Rectangle of the wall in columns x rows cells of equal size."""

    extent: Extent
    columns: int
    rows: int

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1:
            raise SceneError(f"a wall grid of {self.columns} x {self.rows} cells: give at least 1")

    @property
    def pitch_m(self) -> tuple[float, float]:
        """Width and height of a cell."""
        extent = self.extent
        return (
            (extent.x_max_m - extent.x_min_m) / self.columns,
            (extent.y_max_m - extent.y_min_m) / self.rows,
        )

    @cached_property
    def points_m(self) -> Float64:
        """(columns, rows, 3); middles of the cells in the wall frame, first index along x."""
        width, height = self.pitch_m
        x_m = self.extent.x_min_m + (np.arange(self.columns) + 0.5) * width
        y_m = self.extent.y_min_m + (np.arange(self.rows) + 0.5) * height
        x, y = np.meshgrid(x_m, y_m, indexing="ij")
        return np.stack([x, y, np.zeros_like(x)], -1).astype(np.float64)

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.columns * self.rows


@dataclass(frozen=True)
class WallPaths:
    """Paths of a scene from laser points over the hidden surface to the cells of a wall grid.

    Includes tilt, BRDF, self-occlusion, the occluder, and parts of the wall that the lidar does not
    see; not the wall's own return, and no light of more than three bounces. Colored surfaces count
    by their mean albedo.
    """

    job: TransportJob | None
    """Transport of all laser points to all cells; None where nothing is hidden."""
    lit: Mask
    """(n,); laser points that the lidar's beam reaches."""
    seen: Mask
    """(m,); cells that the lidar's detector sees."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        laser_m: Float64,
        cells: WallGrid,
        bin_m: float,
        accuracy: str | Accuracy = "standard",
    ) -> Self:
        """Return the paths from laser points (n, 3) on the wall, in bins of `bin_m` meters of path.

        Raises SceneError for a scene that cannot be rendered.
        """
        device = scene.rig.device.model_copy(update={"bin_m": bin_m})
        scene = replace(scene, rig=scene.rig.model_copy(update={"device": device}))
        facts = SceneFacts(scene, accuracy_named(accuracy))
        beams = facts.beams()
        relay = _relay(cells, beams.lidar_m)
        if facts.patches is None:
            return cls(None, np.zeros(len(laser_m), np.bool_), np.zeros(cells.size, np.bool_))
        length_m = np.linalg.norm(laser_m - beams.lidar_m, axis=-1)
        whole = facts.job(beams, facts.patches, relay, occluder_edge(scene.rig), facts.field)
        job = replace(
            whole,
            laser_spot_m=np.ascontiguousarray(laser_m),
            length_m=length_m,
            cos_incidence=beams.lidar_m[2] / length_m,
            brdf=scene.surface.brdf,
        )
        cell_m = cells.points_m.reshape(-1, 3)
        return cls(job, _in_sight(scene, job, laser_m), _in_sight(scene, job, cell_m))

    @property
    def table_bytes(self) -> int:
        """Memory of the tables of lengths and of light between patches, laser points and cells."""
        patches = 0 if self.job is None else len(self.job.patches.point_m)
        return 2 * 8 * patches * (len(self.lit) + len(self.seen))

    @cached_property
    def _lengths_m(self) -> tuple[Float64, Float64]:
        """d2 (laser points, patches) and d3 (cells, patches)."""
        if (job := self.job) is None:
            none = np.zeros((0, 0))
            return none, none
        relay = np.stack([job.relay.x_m, job.relay.y_m, np.zeros_like(job.relay.x_m)], 1)
        point = job.patches.point_m
        return (
            np.linalg.norm(job.laser_spot_m[:, None] - point, axis=-1),
            np.linalg.norm(relay[:, None] - point, axis=-1),
        )

    def range_m(self, *, first_and_last: bool = True) -> tuple[float, float]:
        """Return bounds of the length of all paths, with or without the legs from and to the
        lidar; (0, 0) without a path.
        """
        if self.job is None or not (self.lit.any() and self.seen.any()):
            return 0.0, 0.0
        there, back = self._lengths_m
        if first_and_last:
            there = there + self.job.length_m[:, None]
            back = back + self.job.relay.length_m[:, None]
        there = there[self.lit]
        back = back[self.seen]
        # Both halves meet at one patch.
        shortest = (there.min(0) + back.min(0)).min()
        longest = (there.max(0) + back.max(0)).max()
        return float(shortest), float(longest)

    def summed(self, first: int, count: int, backend: str = "cpu") -> Float32:
        """Return what one detector that sees all cells gets of each laser point: (n, count) bins,
        from bin `first` on.
        """
        sums = np.zeros((len(self.lit), count), np.float32)
        if self.job is None or not (self.lit.any() and self.seen.any()):
            return sums
        # The fast kernels add into every bin that a path can reach, so they get them all.
        bins = max(int(self.range_m()[1] / self.job.bin_m) + 3, first + count)
        job = self.job.select(np.flatnonzero(self.lit))
        job = replace(job, relay=job.relay.select(self.seen), bins=bins)
        found = transport(job, backend)
        if found is not None:
            sums[self.lit] = found[:, first : first + count]
        return sums

    def paired(
        self,
        pairs: Int64,
        first: int,
        count: int,
        *,
        first_and_last: bool = True,
        on_progress: OnProgress | None = None,
    ) -> Float32:
        """Return the light of pairs (k, 2) of a laser point and a cell: (k, count) bins, from bin
        `first` on, path by path in float64.
        """
        sums = np.zeros((len(pairs), count), np.float32)
        if self.job is None:
            return sums
        incident, returned = backend_reference.path_ends(self.job)
        incident[~self.lit] = 0
        returned[:, ~self.seen] = 0
        there, back = self._lengths_m
        legs = float(first_and_last)
        brdf = self.job.brdf or Brdf(1.0, 0.0, 1.0, mirrored=False)
        glossy = self.job.brdf is not None
        arms = Arms(
            incident,
            np.ascontiguousarray(returned.T),
            legs * self.job.length_m,
            legs * self.job.relay.length_m,
            there,
            back,
        )
        cell_m = np.stack([self.job.relay.x_m, self.job.relay.y_m], 1)
        directions = self.job.laser_spot_m, cell_m, self.job.patches.point_m
        normal = self.job.patches.normal
        for start in range(0, len(pairs), BLOCK):
            block = np.ascontiguousarray(pairs[start : start + BLOCK])
            sums[start : start + BLOCK] = _pair_sums(
                block,
                arms,
                directions,
                normal,
                brdf,
                brdf.gain,
                glossy,
                self.job.bin_m,
                first,
                count,
            )
            if on_progress:
                on_progress(min(start + BLOCK, len(pairs)), len(pairs))
        return sums


def _relay(cells: WallGrid, lidar_m: Float64) -> Relay:
    """Return the cells of a grid with the leg from each to the lidar."""
    x_m, y_m, _ = (np.ascontiguousarray(column) for column in cells.points_m.reshape(-1, 3).T)
    length_m = np.sqrt((x_m - lidar_m[0]) ** 2 + (y_m - lidar_m[1]) ** 2 + lidar_m[2] ** 2)
    width, height = cells.pitch_m
    cosine = lidar_m[2] / length_m
    return Relay(x_m, y_m, length_m, cosine, width * height, float(np.hypot(width, height)))


def _in_sight(scene: Scene, job: TransportJob, point_m: Float64) -> Mask:
    """Return a mask (n,) of the points of the wall that a straight line joins with the lidar."""
    x_m = np.ascontiguousarray(point_m[:, 0])
    hidden = behind(job.edge_m, x_m, np.zeros_like(x_m), job.lidar_m)
    way = point_m - job.lidar_m
    length_m = np.linalg.norm(way, axis=-1)
    level = np.zeros((2, *job.field.depth_m.shape))
    hit = first_hits(job.field, level, job.lidar_m, way / length_m[:, None], length_m)[0]
    return scene.rig.wall.contains(point_m) & ~hidden & ~np.isfinite(hit)


@numba.njit(cache=True, parallel=True)
def _pair_sums(
    pairs: Int64,
    arms: Arms,
    directions: tuple[Float64, Float64, Float64],
    normal: Float64,
    brdf: Brdf,
    gain: float,
    glossy: bool,
    bin_m: float,
    first: int,
    count: int,
) -> Float64:
    """Return histograms (k, count) of pairs: over each patch the product of both ends (S2), in the
    bin of the whole path (S4).
    """
    laser_m, cell_m, point_m = directions
    sums = np.zeros((len(pairs), count))
    for k in numba.prange(len(pairs)):
        p = pairs[k, 0]
        q = pairs[k, 1]
        for s in range(len(point_m)):
            light = arms.incident[p, s] * arms.returned[q, s]
            if light == 0:
                continue
            # The order of the sum is that of the reference, and so is its rounding.
            length = arms.first_m[p] + arms.there_m[p, s] + arms.back_m[q, s] + arms.last_m[q]
            at = int(np.floor(length / bin_m)) - first
            if at < 0 or at >= count:
                continue
            if glossy:
                d2 = max(arms.there_m[p, s], 1e-12)
                d3 = max(arms.back_m[q, s], 1e-12)
                ux = (laser_m[p, 0] - point_m[s, 0]) / d2
                uy = (laser_m[p, 1] - point_m[s, 1]) / d2
                uz = -point_m[s, 2] / d2
                vx = (cell_m[q, 0] - point_m[s, 0]) / d3
                vy = (cell_m[q, 1] - point_m[s, 1]) / d3
                vz = -point_m[s, 2] / d3
                axis = ux * vx + uy * vy + uz * vz
                # The lobe is about the mirror image r = 2 (n . u) n - u of the incoming light, or
                # about that light itself: r . v = 2 cos_in cos_out - u . v.
                if brdf.mirrored:
                    cos_in = ux * normal[s, 0] + uy * normal[s, 1] + uz * normal[s, 2]
                    cos_out = vx * normal[s, 0] + vy * normal[s, 1] + vz * normal[s, 2]
                    axis = 2 * max(cos_in, 0.0) * max(cos_out, 0.0) - axis
                light *= brdf.diffuse + gain * max(axis, 0.0) ** brdf.exponent
            sums[k, at] += light
    return sums
