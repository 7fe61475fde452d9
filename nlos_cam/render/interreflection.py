"""Inter-reflection: light that goes from patch to patch, straight or by way of the wall, before it comes back.

Both only lengthen what follows the first patch. So they are added to the patches' tables: a patch gives, beside its own
returns, those of every patch that it lights, that much later and by the form factor weaker.
"""

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int64
from numpy.typing import NDArray

from nlos_cam.render.geometry import contact_m2, softened
from nlos_cam.render.job import TransportJob
from nlos_cam.render.visibility import HeightField, occluded, segment_blocked, visible

WALL_CELLS = 24
"""Along each side of the wall that the light may go over."""
SAMPLE_PATCHES = 256
AROUND_M = 0.4
"""How far about the object that wall reaches: beyond, less than a hundredth of a patch's light arrives."""


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
    """What part of the light that leaves at a is given on at b, but for what stands between."""
    leg = b - a
    squared = (leg**2).sum()
    length = np.sqrt(squared)
    cos_out, cos_in = (normal_a * leg).sum(), -(normal_b * leg).sum()
    if cos_out <= 0 or cos_in <= 0:
        return 0.0
    factor = strength * cos_in / length / ((np.pi if lambertian else 2 * np.pi) * (softened(squared, soft, near_m)))
    return factor * cos_out / length if lambertian else factor


@numba.njit(cache=True)
def _between_patches(
    a: int,
    b: int,
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft: Float64,
    rows: Int64,
    columns: Int64,
    field: HeightField,
    near_m: float,
    lambertian: bool,
) -> float:
    """The form factor from patch a to patch b, 0 where the object stands between."""
    factor = form_factor(points[a], normals[a], points[b], normals[b], strength[b], soft[b], near_m, lambertian)
    if factor > 0 and segment_blocked(field, rows[a], columns[a], points[a, 2], rows[b], columns[b], points[b, 2]):
        return 0.0
    return factor


@numba.njit(cache=True, parallel=True)
def patch_to_patch(
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft: Float64,
    rows: Int64,
    columns: Int64,
    field: HeightField,
    near_m: float,
    lambertian: bool,
) -> Float64:
    """Form factors (n, n) from patch to patch, 0 where the object stands between."""
    n = len(points)
    table = np.zeros((n, n))
    for a in numba.prange(n):
        for b in range(n):
            table[a, b] = _between_patches(
                a, b, points, normals, strength, soft, rows, columns, field, near_m, lambertian
            )
    return table


@numba.njit(cache=True, parallel=True)
def patch_to_wall(
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft: Float64,
    rows: Int64,
    columns: Int64,
    x: Float64,
    y: Float64,
    cell_m2: float,
    soft_wall: float,
    edge_x: float,
    edge_z: float,
    field: HeightField,
    near_m: float,
    lambertian: bool,
) -> tuple[Float64, Float64]:
    """Form factors (n, m) from patches to cells of the wall, and from the cells to the patches."""
    there, back = np.zeros((len(points), len(x))), np.zeros((len(points), len(x)))
    up = np.array([0.0, 0.0, 1.0])
    for s in numba.prange(len(points)):
        for w in range(len(x)):
            cell = np.array([x[w], y[w], 0.0])
            factor = form_factor(points[s], normals[s], cell, up, cell_m2, soft_wall, near_m, lambertian)
            if factor == 0 or occluded(points[s, 0], points[s, 2], x[w], 0.0, edge_x, edge_z):
                continue
            if not visible(field, rows[s], columns[s], points[s], x[w], y[w]):
                continue
            there[s, w] = factor
            back[s, w] = form_factor(cell, up, points[s], normals[s], strength[s], soft[s], near_m, lambertian)
    return there, back


@numba.njit(cache=True)
def _add(target: Float32, at: int, weight: float, source: Float32) -> None:
    start, scale = max(at, 0), np.float32(weight)
    for k in range(min(len(source), len(target) - start)):
        target[start + k] += scale * source[k]


@numba.njit(cache=True, parallel=True)
def _over_the_object(
    points: Float64,
    normals: Float64,
    strength: Float64,
    soft: Float64,
    rows: Int64,
    columns: Int64,
    field: HeightField,
    near_m: float,
    lambertian: bool,
    per_m: float,
    start: Int64,
    histogram: Float32,
    width: int,
) -> Float32:
    """Of every other patch its histogram, as much later as it is away."""
    out = np.zeros((len(points), width), np.float32)
    for a in numba.prange(len(points)):
        for b in range(len(points)):
            factor = _between_patches(a, b, points, normals, strength, soft, rows, columns, field, near_m, lambertian)
            if factor > 0:
                away = np.sqrt(((points[b] - points[a]) ** 2).sum())
                _add(out[a], int(np.rint(away * per_m)) + start[b] - start[a], factor, histogram[b])
    return out


@numba.njit(cache=True, parallel=True)
def _carry(factor: Float64, steps: Int64, histogram: Float32, width: int) -> Float32:
    """Histograms (n, width): of every other (m,) the histogram (m, k), shifted by steps (n, m) and weighted."""
    out = np.zeros((len(factor), width), np.float32)
    for a in numba.prange(len(factor)):
        for b in range(factor.shape[1]):
            if factor[a, b] > 0:
                _add(out[a], steps[a, b], factor[a, b], histogram[b])
    return out


def with_inter_reflection(job: TransportJob, first: NDArray[np.int32], histogram: Float32) -> Float32:
    """The patches' histograms (n, k) in sub-bins, from their bins `first` (n,) on, with one bounce more on the object.

    They come out wider by the longest detour.
    """
    per_bin, point = job.accuracy.sub_bins, job.patches.point_m
    per_m, start = per_bin / job.bin_m, first.astype(np.int64) * per_bin
    cells = wall_cells(job)
    away = np.sqrt(sum((point[:, None, axis] - cells[None, :, axis]) ** 2 for axis in range(3)))
    there, back = wall_factors(job, cells)
    longest_m = 2 * away.max() + float(np.linalg.norm(np.ptp(point, axis=0)))
    width = histogram.shape[1] + per_bin * (int(longest_m / job.bin_m) + 2)
    steps = np.rint(away * per_m).astype(np.int64)
    on_wall = _carry(back.T.copy(), steps.T + start - start.min(), histogram, width)
    by_wall = _carry(there, steps + (start.min() - start)[:, None], on_wall, width)
    straight = _over_the_object(*_patches(job), per_m, start, histogram, width)
    return np.pad(histogram, [(0, 0), (0, width - histogram.shape[1])]) + by_wall + straight


def _patches(job: TransportJob) -> tuple[Float64, Float64, Float64, Float64, Int64, Int64, HeightField, float, bool]:
    p = job.patches
    where = p.point_m, p.normal, job.strength, job.soft_patch_m2, p.row, p.column
    return *where, job.field, job.near_m, job.lambertian


def object_factors(job: TransportJob) -> Float64:
    """Form factors (n, n) from patch to patch of a job."""
    return patch_to_patch(*_patches(job))


def wall_factors(job: TransportJob, cells: Float64) -> tuple[Float64, Float64]:
    """Form factors (n, m) from the patches of a job to cells of the wall (m, 3), and back."""
    p, cell_m2 = job.patches, wall_cell_m2(job)
    where = p.point_m, p.normal, job.strength, job.soft_patch_m2, p.row, p.column
    wall = cells[:, 0].copy(), cells[:, 1].copy(), cell_m2, contact_m2(cell_m2, job.solid_angle)
    return patch_to_wall(*where, *wall, *job.edge_m, job.field, job.near_m, job.lambertian)


def _wall_extent(job: TransportJob) -> Float64:
    """(2, 2); least and most x and y of the wall that inter-reflection goes over."""
    wall = np.array(job.wall_m)
    low, high = job.patches.point_m[:, :2].min(0) - AROUND_M, job.patches.point_m[:, :2].max(0) + AROUND_M
    return np.stack([np.maximum(low, wall[[0, 2]]), np.minimum(high, wall[[1, 3]])])


def wall_cell_m2(job: TransportJob) -> float:
    """Area of a cell of that wall."""
    return float(np.prod(np.maximum(np.diff(_wall_extent(job), axis=0), 0.0)) / WALL_CELLS**2)


def wall_cells(job: TransportJob) -> Float64:
    """The middles (m, 3) of its cells."""
    low, high = _wall_extent(job)
    steps = (np.arange(WALL_CELLS) + 0.5) / WALL_CELLS
    x, y = np.meshgrid(low[0] + steps * (high[0] - low[0]), low[1] + steps * (high[1] - low[1]))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def share_of_more_bounces(job: TransportJob, taken: Float64, given: Float64) -> float:
    """How much energy one bounce more carries, against three bounces, told from some of the patches.

    `taken` and `given` (n,) are the light that each patch gives on, and what the lidar gets of it.
    """
    step = -(-len(taken) // SAMPLE_PATCHES)
    some = slice(None, None, step)
    p = job.patches
    where = p.point_m[some].copy(), p.normal[some].copy(), step * job.strength[some], step * job.soft_patch_m2[some]
    taken, given, sites = taken[some], given[some], (p.row[some].copy(), p.column[some].copy())
    straight = patch_to_patch(*where, *sites, job.field, job.near_m, job.lambertian) @ given
    cells, cell_m2 = wall_cells(job), wall_cell_m2(job)
    wall = cells[:, 0].copy(), cells[:, 1].copy(), cell_m2, contact_m2(cell_m2, job.solid_angle)
    there, back = patch_to_wall(*where, *sites, *wall, *job.edge_m, job.field, job.near_m, job.lambertian)
    by_wall = there @ (back.T @ given)
    whole = float((taken * given).sum())
    return float((taken * (straight + by_wall)).sum()) / whole if whole > 0 else 0.0
