"""Reference backend, which defines the others: every three-bounce path by itself, in float64 (S2 to
S4).

Slow on purpose (compiled, and still a minute or two for a whole map): each line is an equation.
Interreflection is summed path by path too, for small scenes only.
"""

from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.errors import SceneError
from nlos_cam.render.geometry import softened_leg
from nlos_cam.render.interreflection import object_factors, wall_cells, wall_factors
from nlos_cam.render.job import PatchArrays, TransportJob
from nlos_cam.render.material import Brdf
from nlos_cam.render.visibility import HeightField, occluded, visible

MAX_PATHS = 3e10
"""Some minutes of computing."""


class PathRules(NamedTuple):
    """Constants of every path."""

    near_m: float
    lambertian: bool
    bin_m: float
    bins: int


class Ends(NamedTuple):
    """Both ends of the paths that meet the object twice."""

    incident: Float64
    """(beams, patches); light that the first patch gives on."""
    there_m: Float64
    """(beams, patches); d1 + d2."""
    returned: Float64
    """(patches, cells); share that reaches the lidar from the second patch over a relay cell."""
    back_m: Float64
    """(patches, cells); d3 + d4."""


class Detours(NamedTuple):
    """Ways between two patches, directly or over the wall."""

    point_m: Float64
    """(patches, 3)."""
    factor: Float64
    """(patches, patches); form factors from patch to patch."""
    there: Float64
    """(patches, wall cells); form factors to the wall."""
    back: Float64
    """(patches, wall cells); form factors from the wall."""
    to_wall_m: Float64
    """(patches, wall cells)."""


def more_paths(job: TransportJob, incident: Float64, returned: Float64) -> Float64:
    """Return histograms (n, bins) of the paths that meet the object twice.

    `incident` (n, patches) is the light of each beam that each patch gives on, `returned` (patches,
    m) the share of it that reaches the lidar over each relay cell. Raises SceneError for more than
    MAX_PATHS.
    """
    # Two ends that are known, joined by a form factor: one term of the Neumann series more.
    point = job.patches.point_m
    cells = wall_cells(job)
    count = incident.size * returned.size * len(cells)
    if count > MAX_PATHS:
        raise SceneError(
            f"inter-reflection path by path would sum {count:.1g} paths (limit {MAX_PATHS:.0e}):"
            " choose fine, or drop inter-reflection from the effects"
        )
    relay = np.stack([job.relay.x_m, job.relay.y_m, np.zeros_like(job.relay.x_m)], 1)
    there, back = wall_factors(job, cells)
    # Both ends with their constant legs: d1 + d2 up to the first patch, d3 + d4 from the second.
    d2 = np.linalg.norm(job.laser_spot_m[:, None] - point, axis=-1) + job.length_m[:, None]
    d3 = np.linalg.norm(point[:, None] - relay, axis=-1) + job.relay.length_m
    to_wall = np.linalg.norm(point[:, None] - cells, axis=-1)
    detours = Detours(point, object_factors(job), there, back, to_wall)
    return _sum(Ends(incident, d2, returned, d3), detours, _rules(job))


@numba.njit(cache=True, parallel=True)
def _sum(paths: Ends, detours: Detours, rules: PathRules) -> Float64:
    """Return histograms (n, bins) of all paths spot -> a -> b -> relay cell, and over the wall."""
    incident = paths.incident
    returned = paths.returned
    points = detours.point_m
    to_wall = detours.to_wall_m
    bins = rules.bins
    histogram = np.zeros((len(incident), bins))
    for p in numba.prange(len(incident)):
        for a in range(len(points)):
            if incident[p, a] == 0:
                continue
            for b in range(len(points)):
                away = np.sqrt(((points[a] - points[b]) ** 2).sum())
                for q in range(returned.shape[1]):
                    ends = paths.there_m[p, a] + paths.back_m[b, q]
                    light = incident[p, a] * returned[b, q]
                    if light == 0:
                        continue
                    k = int(np.floor((ends + away) / rules.bin_m))
                    if k < bins:
                        # Spot -> a -> b -> relay cell, and below spot -> a -> wall -> b -> relay
                        # cell.
                        histogram[p, k] += light * detours.factor[a, b]
                    for w in range(to_wall.shape[1]):
                        k = int(np.floor((ends + to_wall[a, w] + to_wall[b, w]) / rules.bin_m))
                        if k < bins:
                            histogram[p, k] += light * detours.there[a, w] * detours.back[b, w]
    return histogram


BEAM_GROUP = 256
"""Beams summed in one compiled call."""


class Spots(NamedTuple):
    """Laser spots of some beams (n), with the patches that each lights."""

    point_m: Float64
    length_m: Float64
    weight: Float64
    lit: Mask
    """(patches, n)."""


class Cells(NamedTuple):
    """Relay cells (m), with the patches that each is visible from."""

    x_m: Float64
    y_m: Float64
    length_m: Float64
    weight: Float64
    soft_m2: float
    visible: Mask
    """(patches, m)."""


@numba.njit(cache=True, parallel=True)
def legs(
    patches: PatchArrays, x: Float64, y: Float64, edge_x: float, edge_z: float, field: HeightField
) -> Mask:
    """Return V (n, m) of the legs between patches and points of the wall: lit side, occluder, the
    object itself.
    """
    # V of S2 is 0 or 1, and the same in both directions: one table serves spots and relay cells.
    table = np.zeros((len(patches.row), len(x)), np.bool_)
    for s in numba.prange(len(patches.row)):
        point = patches.point_m[s]
        normal = patches.normal[s]
        for w in range(len(x)):
            # The sheet is lit from one side only: n . (wall point - patch) > 0.
            facing = (
                normal[0] * (x[w] - point[0]) + normal[1] * (y[w] - point[1]) - normal[2] * point[2]
            )
            if facing > 0 and not occluded(point[0], point[2], x[w], 0.0, edge_x, edge_z):
                table[s, w] = visible(field, patches.row[s], patches.column[s], point, x[w], y[w])
    return table


@numba.njit(cache=True, error_model="numpy")
def _incident(spot: Float64, patches: PatchArrays, s: int, rules: PathRules) -> float:
    """Return the factors of S2 on the leg from a laser spot to a patch: the light that the patch
    gives on.
    """
    # S2: strength cos t2 / d2^2, with d2^2 limited at contact.
    to_spot = spot - patches.point_m[s]
    d2 = np.sqrt((to_spot**2).sum())
    cos_2 = (patches.normal[s] * to_spot).sum() / d2
    incident = patches.strength[s] * cos_2 / softened_leg(d2**2, patches.soft_m2[s], rules.near_m)
    # The rendering equation has the cosine at which the light leaves the wall too: z / d2.
    return incident * patches.point_m[s, 2] / d2 if rules.lambertian else incident


@numba.njit(cache=True, error_model="numpy")
def _returned(
    patches: PatchArrays, s: int, cells: Cells, q: int, rules: PathRules
) -> tuple[float, float]:
    """Return the factors of S2 on the leg from a patch over a relay cell to the lidar, and d3."""
    # Number by number: numba counts references to each array that is unpacked, ten times a path's
    # own time.
    px = patches.point_m[s, 0]
    py = patches.point_m[s, 1]
    z = patches.point_m[s, 2]
    nx = patches.normal[s, 0]
    ny = patches.normal[s, 1]
    nz = patches.normal[s, 2]
    dx = cells.x_m[q] - px
    dy = cells.y_m[q] - py
    facing = nx * dx + ny * dy - nz * z
    # S2: cos t3 / d3^2 with the wall's cosine z / d3, and d3^2 limited at contact. The rendering
    # equation has the patch's cosine too.
    squared = dx**2 + dy**2 + z**2
    d3 = np.sqrt(squared)
    returned = cells.weight[q] * (z / d3) / softened_leg(squared, cells.soft_m2, rules.near_m)
    return (returned * facing / d3 if rules.lambertian else returned), d3


@numba.njit(cache=True, parallel=True)
def scattering(
    brdf: Brdf, gain: float, spot: Float64, patches: PatchArrays, x: Float64, y: Float64
) -> Float64:
    """Return the BRDF (n, m) on the ways from one laser spot over patches to points of the wall."""
    table = np.empty((len(patches.row), len(x)))
    for s in numba.prange(len(patches.row)):
        point = patches.point_m[s]
        normal = patches.normal[s]
        to_spot = spot - point
        # Lengths are limited above 0 for objects that touch the wall.
        to_spot = to_spot / max(np.sqrt((to_spot**2).sum()), 1e-12)
        cos_in = max((to_spot * normal).sum(), 0.0)
        for q in range(len(x)):
            dx = x[q] - point[0]
            dy = y[q] - point[1]
            d3 = max(np.sqrt(dx**2 + dy**2 + point[2] ** 2), 1e-12)
            cos_out = max((normal[0] * dx + normal[1] * dy - normal[2] * point[2]) / d3, 0.0)
            # The lobe is about the incoming direction itself (retroreflective), or about its mirror
            # image r = 2 (n . u) n - u: r . v = 2 cos_in cos_out - u . v.
            axis = (to_spot[0] * dx + to_spot[1] * dy - to_spot[2] * point[2]) / d3
            if brdf.mirrored:
                axis = 2 * cos_in * cos_out - axis
            table[s, q] = brdf.diffuse + gain * max(axis, 0.0) ** brdf.exponent
    return table


@numba.njit(cache=True, parallel=True)
def _paths(
    spots: Spots,
    patches: PatchArrays,
    cells: Cells,
    factor: Float64,
    rules: PathRules,
) -> Float64:
    """Return histograms (n, bins): for each path p, s, q its weight (S2) in the bin of its length
    (S4). `factor` (patches, cells) is the BRDF, empty for a Lambertian surface.
    """
    histogram = np.zeros((len(spots.point_m), rules.bins))
    for p in numba.prange(len(spots.point_m)):
        for s in range(len(patches.row)):
            if not spots.lit[s, p]:
                continue
            # A(p, s) B(s, q) is S2 in two factors; here no sum uses that they separate.
            a = spots.weight[p] * _incident(spots.point_m[p], patches, s, rules)
            d2 = np.sqrt(((spots.point_m[p] - patches.point_m[s]) ** 2).sum())
            for q in range(len(cells.x_m)):
                if not cells.visible[s, q]:
                    continue
                b, d3 = _returned(patches, s, cells, q, rules)
                if factor.size:
                    b *= factor[s, q]
                # S4: the bin is the floor of the whole path over the bin's width.
                k = int(np.floor((spots.length_m[p] + d2 + d3 + cells.length_m[q]) / rules.bin_m))
                if k < rules.bins:
                    histogram[p, k] += a * b
    return histogram


@numba.njit(cache=True)
def _ends(
    spots: Spots, patches: PatchArrays, cells: Cells, rules: PathRules
) -> tuple[Float64, Float64]:
    """Return both ends of every path: incident (beams, patches) and returned (patches, cells)."""
    incident = np.zeros((len(spots.point_m), len(patches.row)))
    returned = np.zeros((len(patches.row), len(cells.x_m)))
    for s in range(len(patches.row)):
        for p in range(len(spots.point_m)):
            if spots.lit[s, p]:
                light = _incident(spots.point_m[p], patches, s, rules)
                incident[p, s] = spots.weight[p] * light
        for q in range(len(cells.x_m)):
            if cells.visible[s, q]:
                returned[s, q], _ = _returned(patches, s, cells, q, rules)
    return incident, returned


def histograms(job: TransportJob) -> Float64:
    """Return histograms (n, bins) of I_multi over path length, for the job's beams."""
    cells = _cells(job)
    more: Float64 | float = 0.0
    if job.more_bounces:  # first: it refuses jobs that would take too long
        ends = _ends(_spots(job, slice(None)), job.patch_arrays, cells, _rules(job))
        more = more_paths(job, *ends)
    return _three_bounces(job, cells) + more


def path_ends(job: TransportJob) -> tuple[Float64, Float64]:
    """Return both ends of every path of a Lambertian surface: the light (beams, patches) that each
    patch gives on, and the share (patches, relay cells) of it that reaches the lidar.
    """
    return _ends(_spots(job, slice(None)), job.patch_arrays, _cells(job), _rules(job))


def _three_bounces(job: TransportJob, cells: Cells) -> Float64:
    """Return the three-bounce histograms in groups of beams so that Ctrl-C works; single beams with
    a BRDF.
    """
    patches = job.patch_arrays
    count = len(job.laser_spot_m)
    histogram = np.zeros((count, job.bins))
    group = BEAM_GROUP if job.brdf is None else 1
    for which in (slice(start, start + group) for start in range(0, count, group)):
        # A BRDF couples both legs at the patch: its factor depends on the spot, so each beam has a
        # table of its own.
        factor = np.empty((0, 0))
        if job.brdf is not None:
            spot = job.laser_spot_m[which.start]
            gain = job.brdf.gain
            factor = scattering(job.brdf, gain, spot, patches, cells.x_m, cells.y_m)
        spots = _spots(job, which)
        histogram[which] = _paths(spots, patches, cells, factor, _rules(job))
    return histogram


def _rules(job: TransportJob) -> PathRules:
    return PathRules(job.near_m, job.lambertian, job.bin_m, job.bins)


def _spots(job: TransportJob, which: slice) -> Spots:
    spot = np.ascontiguousarray(job.laser_spot_m[which])
    return Spots(
        spot,
        job.length_m[which],
        job.beam_weight[which],
        _visible(job, spot[:, 0].copy(), spot[:, 1].copy()),
    )


def _cells(job: TransportJob) -> Cells:
    relay = job.relay
    columns = relay.x_m, relay.y_m, relay.length_m, job.relay_weight, job.soft_wall_m2
    return Cells(*columns, _visible(job, relay.x_m, relay.y_m))


def _visible(job: TransportJob, x_m: Float64, y_m: Float64) -> Mask:
    """Return V (n, m) of the legs between the job's patches and points of the wall."""
    return legs(job.patch_arrays, x_m, y_m, *job.edge_m, job.field)
