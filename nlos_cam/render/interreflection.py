"""Interreflection: light that goes from patch to patch, directly or over the wall, before it comes
back.

Both detours only delay the part of the path after the first patch. So they are added to the
patches' tables: patch a gives, beside its own returns, those of every patch b that it lights, later
by the detour's length and weaker by the form factor F(a, b). One detour is the next term of the
Neumann series of the rendering equation (Kajiya 1986).
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int64
from numpy.typing import NDArray

from nlos_cam.frames import inner
from nlos_cam.render.geometry import contact_m2, softened_leg, spread
from nlos_cam.render.job import PatchArrays, TransportJob
from nlos_cam.render.visibility import HeightField, occluded, segment_blocked, visible

WALL_CELLS = 24
"""Cells along each side of the wall that the light may go over."""
SAMPLE_PATCHES = 256
"""Patches, at most, from which the share of interreflection is estimated."""
AROUND_M = 0.4
"""Margin of that wall around the object: beyond, less than a hundredth of a patch's light
arrives.
"""


class WallCells(NamedTuple):
    """Cells (m) of the wall that the light may go over."""

    point_m: Float64
    """(m, 3)."""
    cell_m2: float
    soft_m2: float
    """Near-contact term of a cell as the receiver."""
    edge_x_m: float
    edge_z_m: float


class SubBins(NamedTuple):
    """Sub-bins of the patches' histograms."""

    per_m: float
    start: Int64
    """(n,); sub-bin with which each patch's histogram begins."""
    width: int


@numba.njit(cache=True)
def form_factor(
    a: Float64,
    normal_a: Float64,
    b: Float64,
    normal_b: Float64,
    strength: float,
    soft: float,
    near_m: float,
    lambertian: bool,
) -> float:
    """Return the share of the light leaving a that b gives on, without what stands between."""
    leg = b - a
    squared = (leg**2).sum()
    length = np.sqrt(squared)
    cos_out = (normal_a * leg).sum()
    cos_in = -(normal_b * leg).sum()
    if cos_out <= 0 or cos_in <= 0:
        return 0.0

    # Receiving area x cosine / (solid angle x d^2), with the strength as albedo x area; the
    # sender's cosine is part of the rendering equation only. near_m limits 1 / d^2 at contact as in
    # S2.
    factor = (
        strength
        * cos_in
        / length
        / ((np.pi if lambertian else 2 * np.pi) * softened_leg(squared, soft, near_m))
    )
    return factor * cos_out / length if lambertian else factor


@inner()
def _between_patches(
    a: int, b: int, patches: PatchArrays, field: HeightField, near_m: float, lambertian: bool
) -> float:
    """Return the form factor from patch a to patch b, 0 if the object stands between."""
    points = patches.point_m
    normals = patches.normal
    rows = patches.row
    columns = patches.column
    strength = patches.strength[b]
    soft = patches.soft_m2[b]
    factor = form_factor(
        points[a], normals[a], points[b], normals[b], strength, soft, near_m, lambertian
    )
    if factor > 0 and segment_blocked(
        field, rows[a], columns[a], points[a, 2], rows[b], columns[b], points[b, 2]
    ):
        return 0.0
    return factor


@numba.njit(cache=True, parallel=True)
def patch_to_patch(
    patches: PatchArrays, field: HeightField, near_m: float, lambertian: bool
) -> Float64:
    """Return form factors (n, n) from patch to patch, 0 if the object stands between."""
    # Both directions apart: F(a, b) has the area of b, so F(a, b) != F(b, a).
    n = len(patches.row)
    table = np.zeros((n, n))
    for a in numba.prange(n):
        for b in range(n):
            table[a, b] = _between_patches(a, b, patches, field, near_m, lambertian)
    return table


@numba.njit(cache=True, parallel=True)
def patch_to_wall(
    patches: PatchArrays, wall: WallCells, field: HeightField, near_m: float, lambertian: bool
) -> tuple[Float64, Float64]:
    """Return form factors (n, m) from patches to cells of the wall, and from the cells to the
    patches.
    """
    cells = wall.point_m
    edge_x = wall.edge_x_m
    edge_z = wall.edge_z_m
    # The wall has no horizon of its own: V is that of the leg from the patch, the same both ways.
    there = np.zeros((len(patches.row), len(cells)))
    back = np.zeros((len(patches.row), len(cells)))
    up = np.array([0.0, 0.0, 1.0])
    for s in numba.prange(len(patches.row)):
        point = patches.point_m[s]
        normal = patches.normal[s]
        for w in range(len(cells)):
            x = cells[w, 0]
            y = cells[w, 1]
            factor = form_factor(
                point, normal, cells[w], up, wall.cell_m2, wall.soft_m2, near_m, lambertian
            )
            if factor == 0 or occluded(point[0], point[2], x, 0.0, edge_x, edge_z):
                continue
            if not visible(field, patches.row[s], patches.column[s], point, x, y):
                continue
            # Both ways differ in the receiver alone: its area, its cosine and its near contact.
            there[s, w] = factor
            strength = patches.strength[s]
            soft = patches.soft_m2[s]
            back[s, w] = form_factor(
                cells[w], up, point, normal, strength, soft, near_m, lambertian
            )
    return there, back


@inner()
def _add(target: Float32, at: int, weight: float, source: Float32) -> None:
    """Add a histogram to another from bin `at` on, scaled."""
    # Histograms begin at different bins, so a source may begin before its target. A detour only
    # delays, so that its bins there are empty but for rounding; past the last one light is cut.
    scale = np.float32(weight)
    for k in range(min(len(source), len(target) - at)):
        target[max(at + k, 0)] += scale * source[k]


@numba.njit(cache=True, parallel=True)
def _over_the_object(
    patches: PatchArrays,
    field: HeightField,
    near_m: float,
    lambertian: bool,
    sub_bins: SubBins,
    histogram: Float32,
) -> Float32:
    """Return histograms (n, width): for each patch those of every other, later by its distance and
    scaled by F.
    """
    points = patches.point_m
    start = sub_bins.start
    out = np.zeros((len(patches.row), sub_bins.width), np.float32)
    for a in numba.prange(len(points)):
        for b in range(len(points)):
            # Neumann series, one term: L(a) = E(a) + sum_b F(a, b) L(b), with L(b) on the right cut
            # to its own returns.
            factor = _between_patches(a, b, patches, field, near_m, lambertian)
            if factor > 0:
                away = np.sqrt(((points[b] - points[a]) ** 2).sum())
                later = int(np.rint(away * sub_bins.per_m)) + start[b] - start[a]
                _add(out[a], later, factor, histogram[b])
    return out


@numba.njit(cache=True, parallel=True)
def _carry(factor: Float64, steps: Int64, histogram: Float32, width: int) -> Float32:
    """Return histograms (n, width): the sum of others (m, k), shifted by steps (n, m) and scaled by
    factors (n, m).
    """
    # One thread sums one histogram in a fixed order: the bits do not depend on the threads.
    out = np.zeros((len(factor), width), np.float32)
    for a in numba.prange(len(factor)):
        for b in range(factor.shape[1]):
            if factor[a, b] > 0:
                _add(out[a], steps[a, b], factor[a, b], histogram[b])
    return out


def add_interreflection(job: TransportJob, first: NDArray[np.int32], histogram: Float32) -> Float32:
    """Return the patches' sub-bin histograms (n, k), from their bins `first` (n,) on, with one more
    bounce.

    The histograms get wider by the longest detour.
    """
    per_bin = job.accuracy.sub_bins
    point = job.patches.point_m
    per_m = per_bin / job.bin_m
    start = first.astype(np.int64) * per_bin
    cells = wall_cells(job)
    away = np.sqrt(sum((point[:, None, axis] - cells[None, :, axis]) ** 2 for axis in range(3)))
    there, back = wall_factors(job, cells)
    # No detour is longer than twice the longest leg to the wall plus the object's diagonal.
    longest_m = 2 * away.max() + float(np.linalg.norm(np.ptp(point, axis=0)))
    width = histogram.shape[1] + per_bin * (int(longest_m / job.bin_m) + 2)
    steps = np.rint(away * per_m).astype(np.int64)

    # Over the wall in two passes, n m each instead of n^2 m: first every wall cell collects the
    # histograms of the patches that it lights, then every patch collects those of the cells. All
    # are aligned to the earliest start in between. Patch b's sub-bins count from start[b], the
    # wall's from the earliest start: b's come later by the difference.
    on_wall = _carry(back.T.copy(), steps.T + start - start.min(), histogram, width)
    by_wall = _carry(there, steps + (start.min() - start)[:, None], on_wall, width)
    over_object = _over_the_object(*_object(job), SubBins(per_m, start, width), histogram)
    return np.pad(histogram, [(0, 0), (0, width - histogram.shape[1])]) + by_wall + over_object


def _object(job: TransportJob) -> tuple[PatchArrays, HeightField, float, bool]:
    return job.patch_arrays, job.field, job.near_m, job.lambertian


def object_factors(job: TransportJob) -> Float64:
    """Return form factors (n, n) from patch to patch of a job."""
    return patch_to_patch(*_object(job))


def wall_factors(
    job: TransportJob, cells: Float64, patches: PatchArrays | None = None
) -> tuple[Float64, Float64]:
    """Return form factors (n, m) from the patches of a job, or from others, to cells of the wall
    (m, 3), and back.
    """
    cell_m2 = wall_cell_m2(job)
    wall = WallCells(cells, cell_m2, contact_m2(cell_m2, job.solid_angle), *job.edge_m)
    return patch_to_wall(patches or job.patch_arrays, wall, job.field, job.near_m, job.lambertian)


def _wall_extent(job: TransportJob) -> Float64:
    """Return the corners (2, 2), low and high x and y, of the wall for interreflection."""
    # As far as the wall reaches, and no farther than AROUND_M from the object.
    wall = np.array(job.wall_m)
    low = job.patches.point_m[:, :2].min(0) - AROUND_M
    high = job.patches.point_m[:, :2].max(0) + AROUND_M
    return np.stack([np.maximum(low, wall[[0, 2]]), np.minimum(high, wall[[1, 3]])])


def longest_detour_m(point_m: Float64) -> float:
    """Return a bound on the way from one of some patches (n, 3) to another, directly or over the
    wall for interreflection.
    """
    # The wall reaches no farther than AROUND_M beyond the object, so that a leg between the two
    # goes at most that much farther than across the object, and as deep as the deepest patch. Over
    # the wall there are two such legs; straight from patch to patch is shorter than one.
    width, height, _ = np.ptp(point_m, axis=0)
    depth = point_m[:, 2].max()
    return 2 * float(np.linalg.norm([width + AROUND_M, height + AROUND_M, depth]))


def wall_cell_m2(job: TransportJob) -> float:
    """Return the area of a cell of that wall."""
    return float(np.prod(np.maximum(np.diff(_wall_extent(job), axis=0), 0.0)) / WALL_CELLS**2)


def wall_cells(job: TransportJob) -> Float64:
    """Return the centers (m, 3) of its cells."""
    low, high = _wall_extent(job)
    steps = (np.arange(WALL_CELLS) + 0.5) / WALL_CELLS
    x, y = np.meshgrid(low[0] + steps * (high[0] - low[0]), low[1] + steps * (high[1] - low[1]))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def interreflection_share(job: TransportJob, incident: Float64, returned: Float64) -> float:
    """Return the energy of one more bounce over that of three bounces, estimated from a sample of
    the patches.

    `incident` and `returned` (n,) are the light that each patch gives on, and the share of it that
    reaches the lidar.
    """
    some = spread(len(incident), SAMPLE_PATCHES)
    # Energy of three bounces: sum_a I_a R_a. With one more: sum_a I_a sum_b F(a, b) R_b. A patch of
    # the sample stands for `each` of them, so its area counts as often.
    each = len(incident) / max(len(some), 1)
    patches = PatchArrays._make(column[some].copy() for column in job.patch_arrays)
    patches = patches._replace(strength=each * patches.strength, soft_m2=each * patches.soft_m2)
    incident = incident[some]
    returned = returned[some]
    over_object = patch_to_patch(patches, job.field, job.near_m, job.lambertian) @ returned
    there, back = wall_factors(job, wall_cells(job), patches)
    # Over the wall the energy goes by two matrices, n m each, as in `add_interreflection`.
    by_wall = there @ (back.T @ returned)
    whole = float((incident * returned).sum())
    # Where the sample finds no light, as for the survey: nothing is known.
    return float((incident * (over_object + by_wall)).sum()) / whole if whole > 0 else 1.0
