"""Derivatives of legs, beams and slopes: the factorized transport, reversed and linearized
(compiled, float32).

A winner's intensity is h_p = sum_s a(p, s) [F_s(k + 1 - t) - F_s(k - t)]: for beam p, patch s, the
winner's bin k and t = d1 + d2 in bins, with F_s the running sum of the returned light b(s, q) over
d3 + d4. One pass over the patches, each with its table in the first cache, gives the derivative
with respect to every leg. To have a smooth F_s, each relay cell spreads its light over the path
lengths that its own size covers; the renderer counts it at its middle.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float32, Float64, Int32, Int64, Mask

from nlos_cam.render.geometry import NEAR_DIAGONALS, softened, solid_angle
from nlos_cam.render.job import TransportJob
from nlos_cam.render.legs import (
    FAST,
    NumbaLegs,
    NumbaOptics,
    NumbaPoints,
    NumbaSurface,
    fill_all,
    scratch,
)
from nlos_cam.render.planning import RenderProblem
from nlos_cam.render.visibility import HeightField

CONTACT_M2 = np.float32(1e-20)
"""Smallest square of a leg's length that is divided by."""
CHUNKS = 16
"""Parts of the patches, each summed by one thread: the result does not depend on the number of
threads.
"""


class Winners(NamedTuple):
    """Winning bins of the beams (n), and the relay's spread."""

    edge: Float32
    """(n,); sub-bin at which each winner's bin begins."""
    per_bin: int
    lidar_x_m: np.float32
    lidar_y_m: np.float32
    pitch_m: np.float32
    """Side of a relay cell."""


class PatchChange(NamedTuple):
    """Rates of change of the patches (n), or derivatives with respect to them."""

    point: Float32
    """(n, 3)."""
    normal: Float32
    """(n, 3); each component by itself."""
    strength: Float32
    """(n,)."""


class PointChange(NamedTuple):
    """Rates of change of the wall's points (n) and their legs to the lidar, or derivatives with
    respect to them.
    """

    x: Float32
    y: Float32
    length: Float32
    light: Float32
    """Of the logarithm of the weight."""


class GradientScene(NamedTuple):
    """Everything on the way of the winners' light."""

    feet: NumbaPoints
    surface: NumbaSurface
    relay: NumbaPoints
    optics: NumbaOptics
    field: HeightField
    winners: Winners


class _Table(NamedTuple):
    """Sub-bins (high excluded) that each relay cell's light covers, from `begin` on."""

    low: Int32
    high: Int32
    begin: int
    size: int


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _spread(
    s: int,
    legs: NumbaLegs,
    surface: NumbaSurface,
    relay: NumbaPoints,
    inverse_bin: np.float32,
    winners: Winners,
) -> _Table:
    """Return the sub-bins of d3 + d4 over which each relay cell spreads its light."""
    x = surface.x_m[s]
    y = surface.y_m[s]
    half = np.float32(0.5)
    one = np.float32(1)
    cells = len(relay.x_m)
    low = np.empty(cells, np.int32)
    high = np.empty(cells, np.int32)
    first = np.float32(np.inf)
    last = np.float32(0)
    scale = winners.pitch_m * inverse_bin
    for q in range(cells):
        # The gradient of d3 + d4 over the wall is the sum of the unit vectors to the cell, cut to
        # the wall's plane. Lengths over a square cell of side w have the variance |gradient|^2 w^2
        # / 12, whatever its direction; a box as wide as |gradient| w has the same.
        to_patch = one / legs.length_m[q]
        to_lidar = one / relay.length_m[q]
        gx = (relay.x_m[q] - x) * to_patch + (relay.x_m[q] - winners.lidar_x_m) * to_lidar
        gy = (relay.y_m[q] - y) * to_patch + (relay.y_m[q] - winners.lidar_y_m) * to_lidar
        # At least one sub-bin: where both legs are shortest the gradient is 0.
        width = max(np.sqrt(gx * gx + gy * gy) * scale, one)
        at = (legs.length_m[q] + relay.length_m[q]) * inverse_bin
        start = np.floor(at - half * width + half)
        end = max(np.floor(at + half * width + half), start + one)
        low[q] = np.int32(start)
        high[q] = np.int32(end)
        first = min(first, start)
        last = max(last, end)
    # Empty sub-bins on both sides: `_edges` clamps to the outermost, where the running sum is 0 or
    # the whole and its rate 0. A bin that no light reaches then has no derivative.
    begin = int(first) - 2
    for q in range(cells):
        low[q] -= begin
        high[q] -= begin
    return _Table(low, high, begin, int(last) - begin + 3)


@numba.njit(cache=True)
def _sums(table: _Table, values: Float32) -> tuple[Float32, Float32]:
    """Return the running sum over sub-bins of values spread by a table, and its rate per sub-bin,
    at each edge.
    """
    density = np.zeros(table.size, np.float32)
    total = np.zeros(table.size, np.float32)
    rate = np.zeros(table.size, np.float32)
    # Each box is a step up and a step down: its cost does not depend on its width.
    for q in range(len(values)):
        each = values[q] / np.float32(table.high[q] - table.low[q])
        density[table.low[q]] += each
        density[table.high[q]] -= each
    level = 0.0
    running = 0.0
    before = 0.0
    # The running sum F is linear within a sub-bin and bends at its edges: its rate at an edge is
    # the mean of the densities on both sides. float64, so that small steps are not lost.
    for i in range(table.size):
        level += density[i]
        total[i] = running
        rate[i] = 0.5 * (before + level)
        running = running + level
        before = level
    return total, rate


@numba.njit(cache=True)
def _means(
    table: _Table, edges: Float32, edge_rates: Float32, inverse_bin: np.float32
) -> tuple[Float32, Float32]:
    """Return for each relay cell the mean over its sub-bins of two functions that beams have left
    at edges.

    The first is the running sum of `edges`, the transpose of reading differences of `_sums`; the
    second is the transpose of reading its rates, times sub-bins per meter, plus the running sum of
    `edge_rates`.
    """
    size = table.size
    value = np.zeros(size + 1)
    rate = np.zeros(size + 1)
    level = 0.0
    other = 0.0
    # F at edge e sums the sub-bins below e, so sub-bin i counts in all edges above i. A beam reads
    # F(high) - F(low), which cancel over all edges: the sum over those above i is minus that up to
    # i. `edges` has its signs turned, + at low and - at high. The rate at edge e is half of
    # sub-bin e - 1 and half of e.
    for i in range(size):
        level += edges[i]
        other += edge_rates[i]
        following = edges[i + 1] if i + 1 < size else np.float32(0)
        value[i + 1] = value[i] + level
        rate[i + 1] = rate[i] + other + 0.5 * inverse_bin * (edges[i] + following)
    values = np.empty(len(table.low), np.float32)
    rates = np.empty(len(table.low), np.float32)
    # A second running sum makes the mean over any box a difference of two entries.
    for q in range(len(values)):
        start = table.low[q]
        end = table.high[q]
        share = 1 / (end - start)
        values[q] = (value[end] - value[start]) * share
        rates[q] = (rate[end] - rate[start]) * share
    return values, rates


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _edges(
    legs: NumbaLegs, feet: NumbaPoints, table: _Table, winners: Winners, inverse_bin: np.float32
) -> tuple[Int32, Int32]:
    """Return for each beam the edges of the table between which a path falls into the winner's
    bin.
    """
    half = np.float32(0.5)
    last = np.float32(table.size - 1)
    low = np.empty(len(legs.length_m), np.int32)
    high = np.empty(len(legs.length_m), np.int32)
    for p in range(len(low)):
        # d1 + d2 + d3 + d4 in [edge, edge + per_bin) sub-bins, with d1 + d2 rounded to a whole
        # sub-bin as in `beam_sums`.
        at = np.floor(
            winners.edge[p] - (feet.length_m[p] + legs.length_m[p]) * inverse_bin + half
        ) - np.float32(table.begin)
        low[p] = np.int32(min(max(at, np.float32(0)), last))
        high[p] = np.int32(min(max(at + np.float32(winners.per_bin), np.float32(0)), last))
    return low, high


@numba.njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _fall(squared: np.float32, soft: np.float32, optics: NumbaOptics) -> np.float32:
    """Return minus twice the derivative of the logarithm of a leg's weight with respect to d^2,
    cosines' ends held.
    """
    one = np.float32(1)
    two = np.float32(2)
    # The weight is [cosines' ends] d^-k / g, with g = d^2 + soft ramp^2 (S2, limited at contact)
    # and ramp = 1 - d^2 / near^2. So -2 d log / d(d^2) = k / d^2 + 2 g' / g, and
    # g' = 1 - 2 soft ramp / near^2. Each of k cosines divides by d once.
    ramp = max(one - squared / optics.near_m2, np.float32(0))
    lengths = two if optics.lambertian else one
    return lengths / squared + two * (one - two * soft * ramp / optics.near_m2) / (
        squared + soft * ramp * ramp
    )


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _pull_legs(
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    optics: NumbaOptics,
    outgoing: bool,
    light: Float32,
    longer: Float32,
    patch: Float64,
    points_out: Float32,
) -> None:
    """Add to a patch (6,) and its points (4, n) the derivative by way of each leg's weight and
    length.

    `light` and `longer` are the derivatives with respect to the logarithm of each leg's weight, and
    to its length.
    """
    x = surface.x_m[s]
    y = surface.y_m[s]
    z = surface.z_m[s]
    nx = surface.normal_x[s]
    ny = surface.normal_y[s]
    nz = surface.normal_z[s]
    soft = points.soft_m2 if outgoing else surface.soft_m2[s]
    # S2 has the patch's cosine on the leg from the spot alone, and the wall's on that to the relay
    # cell; the rendering equation has both on both.
    faces = optics.lambertian or not outgoing
    nothing = np.float32(0)
    total = nothing
    facing = nothing
    facing_x = nothing
    facing_y = nothing
    away = nothing
    away_x = nothing
    away_y = nothing
    for i in range(len(light)):
        # v = point - patch. With weight = [n . v] [z] f(v^2): d log / d patch = -n / n . v + fall v
        # + e_z / z.
        dx = points.x_m[i] - x
        dy = points.y_m[i] - y
        squared = dx * dx + dy * dy + z * z
        across = nx * dx + ny * dy - nz * z
        # A leg behind the patch has no weight, and must not divide by its cosine.
        front = light[i] / across if faces and across > nothing else nothing
        # d length / d patch = -v / length, in the same direction as the weight's fall.
        length = np.sqrt(max(squared, CONTACT_M2))
        pulled = light[i] * _fall(squared, soft, optics) - longer[i] / length
        total += light[i]
        facing += front
        facing_x += front * dx
        facing_y += front * dy
        away += pulled
        away_x += pulled * dx
        away_y += pulled * dy
        points_out[0, i] += nx * front - pulled * dx
        points_out[1, i] += ny * front - pulled * dy
        points_out[2, i] += longer[i]
        points_out[3, i] += light[i]
    # v_z = -z for every leg, so that the z components come out of the sums.
    # Where the object touches the wall, its cosine is 0, and the derivative is left out.
    height = total / z if (outgoing or optics.lambertian) and z > nothing else nothing
    patch[0] += away_x - nx * facing
    patch[1] += away_y - ny * facing
    patch[2] += height - z * away - nz * facing
    patch[3] += facing_x
    patch[4] += facing_y
    patch[5] -= z * facing


@numba.njit(cache=True, error_model="numpy", fastmath=FAST)
def _push_legs(
    s: int,
    surface: NumbaSurface,
    points: NumbaPoints,
    optics: NumbaOptics,
    outgoing: bool,
    change: PatchChange,
    moved: PointChange,
    light: Float32,
    longer: Float32,
) -> None:
    """Fill in the rates of each leg's logarithm of the weight and of its length: the transpose of
    `_pull_legs`.
    """
    x = surface.x_m[s]
    y = surface.y_m[s]
    z = surface.z_m[s]
    nx = surface.normal_x[s]
    ny = surface.normal_y[s]
    nz = surface.normal_z[s]
    px, py, pz = change.point[s]
    tx, ty, tz = change.normal[s]
    soft = points.soft_m2 if outgoing else surface.soft_m2[s]
    # As in `_pull_legs`: v = point - patch changes by (vx, vy, -pz), as the wall's points stay in
    # its plane.
    faces = optics.lambertian or not outgoing
    nothing = np.float32(0)
    height = pz / z if (outgoing or optics.lambertian) and z > nothing else nothing
    for i in range(len(light)):
        dx = points.x_m[i] - x
        dy = points.y_m[i] - y
        vx = moved.x[i] - px
        vy = moved.y[i] - py
        squared = dx * dx + dy * dy + z * z
        across = nx * dx + ny * dy - nz * z
        along = dx * vx + dy * vy + z * pz
        # (n . v)' by the product rule, the normal's own turn included.
        turned = nx * vx + ny * vy - nz * pz + tx * dx + ty * dy - tz * z
        front = turned / across if faces and across > nothing else nothing
        light[i] = front - _fall(squared, soft, optics) * along + height + moved.light[i]
        longer[i] = along / np.sqrt(max(squared, CONTACT_M2)) + moved.length[i]


@numba.njit(cache=True)
def _legs(
    s: int,
    points: NumbaPoints,
    outgoing: bool,
    surface: NumbaSurface,
    optics: NumbaOptics,
    field: HeightField,
) -> NumbaLegs:
    """Return the legs between patch `s` and all points, with their shadows."""
    legs = scratch(len(points.x_m))
    fill_all(legs, s, surface, points, optics, field, outgoing)
    return legs


@numba.njit(cache=True)
def _pull_patch(
    s: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    winners: Winners,
    light: Float32,
    path: Float32,
    patch: Float64,
    beams: Float32,
    cells: Float32,
) -> None:
    back = _legs(s, relay, True, surface, optics, field)
    there = _legs(s, feet, False, surface, optics, field)
    table = _spread(s, back, surface, relay, optics.inverse_bin, winners)
    total, rate = _sums(table, back.weight)
    low, high = _edges(there, feet, table, winners, optics.inverse_bin)

    # First the beams' side: h = a [F(high) - F(low)] by a, by the edges, and by F (left at the
    # edges for the cells' side).
    edges = np.zeros(table.size, np.float32)
    edge_rates = np.zeros(table.size, np.float32)
    strength = surface.strength[s]
    shorter = np.empty(len(low), np.float32)
    for p in range(len(low)):
        a = there.weight[p] * light[p]
        inside = total[high[p]] - total[low[p]]
        b = there.weight[p] * strength * path[p]
        patch[6] += a * inside
        a *= strength
        # A longer d1 + d2 adds to every path in the bin (b), and moves the bin's edges towards
        # shorter d3 + d4 (a): the light that crosses them is the difference of F's rates.
        shorter[p] = b * inside - a * (rate[high[p]] - rate[low[p]]) * optics.inverse_bin
        edges[low[p]] += a
        edges[high[p]] -= a
        edge_rates[low[p]] += b
        edge_rates[high[p]] -= b
        # The derivative by the logarithm of a weight is the weight's own share of the light.
        there.weight[p] = a * inside
    _pull_legs(s, surface, feet, optics, False, there.weight, shorter, patch, beams)

    # Then the cells' side: what all beams left at the edges, averaged over each cell's sub-bins.
    values, rates = _means(table, edges, edge_rates, optics.inverse_bin)
    for q in range(len(values)):
        values[q] *= back.weight[q]
        rates[q] *= back.weight[q]
    _pull_legs(s, surface, relay, optics, True, values, rates, patch, cells)


@numba.njit(cache=True, parallel=True)
def pull(
    feet: NumbaPoints,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    winners: Winners,
    light: Float32,
    path: Float32,
) -> tuple[Float64, Float32, Float32]:
    """Return the derivatives of sum(light * h) + sum(path * light-weighted path sums) with respect
    to every leg's ends.

    They are those of the patches (n, 7: point, normal, strength), and by chunk those of the beams
    and the relay's cells (chunks, 4, n: x, y, length, logarithm of the weight).
    """
    count = len(surface.x_m)
    patches = np.zeros((count, 7))
    beams = np.zeros((CHUNKS, 4, len(feet.x_m)), np.float32)
    cells = np.zeros((CHUNKS, 4, len(relay.x_m)), np.float32)
    for chunk in numba.prange(CHUNKS):
        for s in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            _pull_patch(
                s,
                feet,
                surface,
                relay,
                optics,
                field,
                winners,
                light,
                path,
                patches[s],
                beams[chunk],
                cells[chunk],
            )
    return patches, beams, cells


@numba.njit(cache=True)
def _push_patch(
    s: int,
    feet: NumbaPoints,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    winners: Winners,
    change: PatchChange,
    spots: PointChange,
    cells: PointChange,
    light: Float32,
    path: Float32,
) -> None:
    back = _legs(s, relay, True, surface, optics, field)
    there = _legs(s, feet, False, surface, optics, field)
    table = _spread(s, back, surface, relay, optics.inverse_bin, winners)
    total, rate = _sums(table, back.weight)

    # F' has two parts: cells get brighter, and their light moves along F by the cells' d3 + d4.
    brighter = np.empty_like(back.weight)
    longer = np.empty_like(back.weight)
    _push_legs(s, surface, relay, optics, True, change, cells, brighter, longer)
    for q in range(len(brighter)):
        brighter[q] *= back.weight[q]
        longer[q] *= back.weight[q]
    total_light, _ = _sums(table, brighter)
    total_path, rate_path = _sums(table, longer)

    brighter = np.empty_like(there.weight)
    longer = np.empty_like(there.weight)
    _push_legs(s, surface, feet, optics, False, change, spots, brighter, longer)
    low, high = _edges(there, feet, table, winners, optics.inverse_bin)
    stronger = change.strength[s]
    strength = surface.strength[s]
    for p in range(len(low)):
        a = there.weight[p] * strength
        i = low[p]
        j = high[p]
        inside = total[j] - total[i]
        # Light leaves the bin as paths grow, at the rate of F at its far edge, and enters at the
        # near one.
        crossing = longer[p] * (rate[j] - rate[i]) + rate_path[j] - rate_path[i]
        light[p] += a * (
            brighter[p] * inside + total_light[j] - total_light[i] - crossing * optics.inverse_bin
        )
        light[p] += there.weight[p] * stronger * inside
        path[p] += a * (longer[p] * inside + total_path[j] - total_path[i])


@numba.njit(cache=True, parallel=True)
def push(
    feet: NumbaPoints,
    surface: NumbaSurface,
    relay: NumbaPoints,
    optics: NumbaOptics,
    field: HeightField,
    winners: Winners,
    change: PatchChange,
    spots: PointChange,
    cells: PointChange,
    each: bool,
) -> tuple[Float32, Float32]:
    """Return the rates (rows, beams) of the winners' intensity and light-weighted path sums.

    One row for each patch's own change (`each`), else one for each chunk of patches: their sum is
    the rate.
    """
    count = len(surface.x_m)
    rows = count if each else CHUNKS
    light = np.zeros((rows, len(feet.x_m)), np.float32)
    path = np.zeros((rows, len(feet.x_m)), np.float32)
    for chunk in numba.prange(CHUNKS):
        for s in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            row = np.int64(s) if each else np.int64(chunk)
            _push_patch(
                s,
                feet,
                surface,
                relay,
                optics,
                field,
                winners,
                change,
                spots,
                cells,
                light[row],
                path[row],
            )
    return light, path


def softened_slope(squared_m2: Float64, soft_m2: Float64 | float, near_m: float) -> Float64:
    """Return the derivative of `softened` with respect to d^2."""
    return 1 - 2 * soft_m2 * np.maximum(1 - squared_m2 / near_m**2, 0) / near_m**2


@dataclass(frozen=True)
class BeamRates:
    """Rates of the beams (n) for unit motions (6) of the lidar, along and about the wall frame's
    axes.
    """

    spot: Float64
    """(6, n, 2); x and y."""
    length: Float64
    """(6, n); d1."""
    cosine: Float64
    """(6, n); cos t1."""
    direct: Float64
    """(6, k); direct return of chosen beams."""

    @classmethod
    def of(cls, problem: RenderProblem, chosen: Mask) -> "BeamRates":
        """Return the rates of a problem's beams; those that miss the wall have none."""
        beams = problem.beams
        rig = problem.scene.rig
        lit = beams.on_wall
        shift = np.eye(6)[:, None, :3]
        turn = np.eye(6)[:, None, 3:]
        length = np.where(lit, beams.length_m, 0.0)[:, None]
        rate = np.cross(turn, beams.direction[None])
        # The wall is z = 0: lidar_z + length direction_z = 0 stays true, so that
        # shift_z + length' direction_z + length rate_z = 0.
        longer = (
            -(shift[..., 2:] + length * rate[..., 2:])
            / np.where(lit, beams.direction[:, 2], -1.0)[:, None]
        )
        spot = (shift + longer * beams.direction + length * rate)[..., :2]
        longer = longer[..., 0] * lit
        # cos t1 = -direction_z.
        cosine = -rate[..., 2] * lit
        # I_direct goes with cos t1 / softened(d1^2) (S1), as in `geometry.returned`: its logarithm
        # changes by cos' / cos - 2 d1 d1' softened' / softened.
        cell_m2 = rig.device.receiver_cell_m2
        squared = beams.length_m[chosen] ** 2
        soft = cell_m2 / solid_angle(lambertian=problem.scene.radiometry == "lambertian")
        near_m = NEAR_DIAGONALS * np.sqrt(2 * cell_m2)
        fall = (
            2
            * beams.length_m[chosen]
            * softened_slope(squared, soft, near_m)
            / softened(squared, soft, near_m)
        )
        direct = beams.direct[chosen] * (
            cosine[:, chosen] / beams.cos_incidence[chosen] - fall * longer[:, chosen]
        )
        return cls(spot, longer, np.asarray(cosine, np.float64), direct)


@dataclass(frozen=True)
class Tilts:
    """Slopes of a depth map's cells (n) as linear functions of their depths, as
    `patches.slope_along` has them.
    """

    pairs: tuple[tuple[Int64, Int64], tuple[Int64, Int64]]
    """For x and y, the cells (n,) whose depths are added and subtracted: twice the same for a cell
    without a slope.
    """
    pitch_m: tuple[float, float]
    normal: Float64
    beta: Float64
    strength: Float64

    @classmethod
    def of(cls, job: TransportJob, jump_m: float, *, tilted: bool) -> "Tilts":
        """Return the slopes of a job's patches, none if the plan left the tilt out."""
        patches = job.patches
        depth = job.field.depth_m
        # Numbers of the patches in the image, -1 for background, with a margin all around.
        number = np.full(np.add(depth.shape, 2), -1)
        row = patches.row + 1
        column = patches.column + 1
        own = np.arange(len(patches.row))
        number[row, column] = own
        z = patches.point_m[:, 2]
        pairs: list[tuple[Int64, Int64]] = []
        for down, right in ((0, 1), (-1, 0)):  # rows run along -y
            # Along an image's rows and columns the difference is forward, else backward: along y it
            # is the other way.
            forward, backward = (
                number[row + sign * abs(down), column + sign * right] for sign in (1, -1)
            )
            # Neighbors across a jump are separate surfaces, and a plan without tilt joins none.
            usable = [tilted & (n >= 0) & (np.abs(z[n] - z) <= jump_m) for n in (forward, backward)]
            after = np.where(usable[0], forward, own)
            before = np.where(usable[0], own, np.where(usable[1], backward, own))
            pairs.append((before, after) if down else (after, before))
        pitch = job.field.pitch_x_m, job.field.pitch_y_m
        return cls((pairs[0], pairs[1]), pitch, patches.normal, patches.beta, job.strength)

    def slopes(self, depth: Float64) -> Float64:
        """Return the rates (n, 2) of the slopes along x and y for rates (n,) of the depths."""
        along = [
            (depth[more] - depth[less]) / pitch
            for (more, less), pitch in zip(self.pairs, self.pitch_m, strict=True)
        ]
        return np.stack(along, -1)

    def turned(self, slopes: Float64) -> tuple[Float64, Float64]:
        """Return the rates of normal (n, 3) and strength (n,) for rates of the slopes (n, 2)."""
        # beta normal = (slope_x, slope_y, -1) (S3). Its length is beta, so that beta' = normal .
        # slopes'; the rest of the change, across the normal, turns it: normal' = (slopes' - normal
        # beta') / beta. The strength is albedo times area, which grows with beta.
        rate = np.pad(slopes, ((0, 0), (0, 1)))  # (n, 3)
        steeper = (self.normal * rate).sum(-1)
        turned = (rate - self.normal * steeper[:, None]) / self.beta[:, None]
        return turned, self.strength * steeper / self.beta

    def transposed(self, normal: Float64, strength: Float64) -> Float64:
        """Return the derivative (n,) with respect to the depths, from that with respect to normals
        and strengths.
        """
        # The transpose of `turned`: (I - n n^T) / beta is symmetric, and the strength's row is
        # strength n^T / beta.
        along = (self.normal * normal).sum(-1) - self.strength * strength
        slopes = ((normal - self.normal * along[:, None]) / self.beta[:, None])[:, :2]
        # The transpose of `slopes`: a cell gets from every pair that it is part of.
        depth = np.zeros(len(self.beta))
        for axis, (more, less) in enumerate(self.pairs):
            rate = slopes[:, axis] / self.pitch_m[axis]
            depth += np.bincount(more, rate, len(depth)) - np.bincount(less, rate, len(depth))
        return depth
