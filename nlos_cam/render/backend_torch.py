"""Fast backend on tensors (torch, float32): the factorization of `backend_numba` for a batch, on
GPU or CPU.

Patches of all objects stand one after another. Their legs are computed by a few large kernels, the
patches' tables are counted in integers, and each beam of an object sums windows of that object's
tables, in place. No sum depends on the order in which threads arrive. Self-occlusion is the lookup
of the bounds of `visibility` and its exact walk, for many legs at a time.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from nlos_calibration.arrays import Float32, Float64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool1d, embedding_bag, pad

from nlos_cam.errors import SceneError
from nlos_cam.render import backend_cpu
from nlos_cam.render.backend_numba import check_tables, horizons, table_bins
from nlos_cam.render.interreflection import add_interreflection
from nlos_cam.render.job import TransportJob
from nlos_cam.render.visibility import FACES, bias_m


class TorchFields(NamedTuple):
    """Height fields of a batch, each turned so that a walk along any face goes up its rows; NaN all
    around.
    """

    depth_m: Tensor
    """Flat, in rows of `across` cells."""
    across: int
    along: int
    """Rows of one face of one object: the grid, and the longest walk beyond it."""
    steps: int
    """Steps of the longest walk."""
    columns_per_m: float
    rows_per_m: float
    """Negative: rows run along -y."""
    bias_m: float
    sectors: int


class TorchSites(NamedTuple):
    """Data of patches (n) for visibility."""

    depth_m: Tensor
    """(n, 1)."""
    low: Tensor
    """(n, FACES * sectors); a leg below these bounds is blocked."""
    high: Tensor
    """(n, FACES * sectors); a leg above these bounds is free."""
    start: Tensor
    """(n, FACES); row of the fields in which the patch stands."""
    across: Tensor
    """(n, FACES); position of the patch across the walk."""


def lay_out(jobs: Sequence[TransportJob], device: torch.device) -> tuple[TorchFields, TorchSites]:
    """Return fields and sites of jobs on one grid; an object that shades nothing has bounds of
    0.
    """
    fields = [job.field for job in jobs]
    size = len(fields[0].depth_m)
    steps = max(max(f.last_row - f.first_row, f.last_column - f.first_column) for f in fields)
    rows = torch.as_tensor(np.stack([f.depth_m for f in fields]))
    columns = rows.transpose(1, 2)
    # A walk along -columns goes up the rows of the transposed, flipped map, and so on: one loop
    # serves all four faces.
    faces = torch.stack([columns, columns.flip(1), rows, rows.flip(1)], 1)
    padded = pad(faces, (1, 1, 0, steps), value=torch.nan).flatten().to(device, torch.float32)
    scale = 1 / fields[0].pitch_x_m, -1 / fields[0].pitch_y_m
    sectors = jobs[0].accuracy.sectors
    shared = TorchFields(padded, size + 2, size + steps, steps, *scale, bias_m(fields[0]), sectors)
    sites = [_sites(job, index, shared, size) for index, job in enumerate(jobs)]
    together = (
        torch.as_tensor(np.concatenate(column), device=device)
        for column in zip(*sites, strict=True)
    )
    return shared, TorchSites(*together)


def _sites(
    job: TransportJob, index: int, fields: TorchFields, size: int
) -> tuple[NDArray[Any], ...]:
    """Return the columns of one object's sites: depth, low, high, start and across."""
    row = job.patches.row
    column = job.patches.column
    free = np.zeros((len(row), FACES * fields.sectors), np.float32)
    low, high = horizons(job)[:2] if job.field.shades else (free, free)
    along = np.stack([column, size - 1 - column, row, size - 1 - row], 1)
    across = np.stack([row, row, column, column], 1).astype(np.float32)
    start = (index * FACES + np.arange(FACES)) * fields.along + along
    return job.patches.point_m[:, 2:].astype(np.float32), low, high, start, across


def shade(
    weight: Tensor, dx_m: Tensor, dy_m: Tensor, sites: TorchSites, fields: TorchFields, chunk: int
) -> None:
    """Set the weight (n, m) of legs that the object blocks to 0: looked up if the bounds decide,
    else walked.
    """
    # Offsets in cells; the larger one gives the face, the ratio of both the sector.
    u = dx_m * fields.columns_per_m
    v = dy_m * fields.rows_per_m
    along_columns = u.abs() >= v.abs()
    far = torch.maximum(u.abs(), v.abs())
    tilt = torch.where(along_columns, v, u).div_(far.clamp(min=1e-20))
    sector = _sector(tilt, along_columns, torch.where(along_columns, u, v) < 0, fields.sectors)
    # Along a leg the height falls in proportion to the distance, z / far a cell: blocked below the
    # horizon's lower bound of its sector, free above the upper one, and walked in between.
    meets = (sites.depth_m < sites.high.gather(1, sector).mul_(far)) & (weight != 0)
    # A walk has `steps` numbers for each leg, so that fewer legs go together.
    together = max(chunk // max(fields.steps, 1), 1)
    for some in meets.flatten().nonzero()[:, 0].split(together):
        which = some // weight.shape[1]
        legs = which, sector.flatten()[some], tilt.flatten()[some], far.flatten()[some]
        hidden = sites.depth_m[which, 0] < sites.low[legs[:2]] * legs[3]
        undecided = (~hidden).nonzero()[:, 0]
        hidden[undecided] = blocked(fields, sites, *(column[undecided] for column in legs))
        weight.view(-1)[some[hidden]] = 0


def _sector(tilt: Tensor, along_columns: Tensor, backward: Tensor, sectors: int) -> Tensor:
    """Return the index of the sector, of FACES * sectors, that holds each direction."""
    # Sectors divide a face's tilts from -1 to 1 evenly; the sum is floored when it is made whole.
    # The faces stand in the order of `lay_out`: along columns, back, along rows, back.
    inside = torch.add(sectors / 2, tilt, alpha=sectors / 2).clamp_(max=sectors - 1)
    return (
        inside + torch.where(along_columns, 0.0, 2.0 * sectors) + backward * float(sectors)
    ).long()


def blocked(
    fields: TorchFields, sites: TorchSites, which: Tensor, sector: Tensor, tilt: Tensor, far: Tensor
) -> Tensor:
    """Return whether (k,) the object blocks legs from patches: `far` cells long, by `tilt` across
    per cell.

    The walk of `visibility.blocked` with all steps side by side; beyond its last step there is only
    background.
    """
    face = sector // fields.sectors
    step = torch.arange(1, fields.steps + 1, device=tilt.device)
    # Cell k of the walk: k rows up in the turned map, k tilt cells across, interpolated between two
    # neighbors.
    across = sites.across[which, face][:, None] + tilt[:, None] * step
    below = across.floor()
    share = across - below
    cell = below.long() + 1  # of the margin
    row = (sites.start[which, face][:, None] + step) * fields.across
    near = fields.depth_m[row + cell.clamp(0, fields.across - 1)]
    beyond = fields.depth_m[row + (cell + 1).clamp(0, fields.across - 1)]
    between = near + share * (beyond - near)
    # Beside background (NaN) the nearer of the two cells counts.
    between = torch.where(between.isnan(), torch.where(share < 0.5, near, beyond), between)
    depth = sites.depth_m[which]
    # (z - z' - bias) / k > z / far, multiplied by k. NaN compares false.
    return (depth - between - fields.bias_m > step * (depth / far[:, None])).any(1)


class TorchSurface(NamedTuple):
    """Patches as columns (n, 1)."""

    x_m: Tensor
    y_m: Tensor
    z_m: Tensor
    normal_x: Tensor
    normal_y: Tensor
    normal_z: Tensor
    soft_m2: Tensor
    strength: Tensor

    @classmethod
    def of(cls, jobs: Sequence[TransportJob], device: torch.device) -> "TorchSurface":
        """Return the patches of all jobs, one after another."""
        rows = [
            np.column_stack([j.patches.point_m, j.patches.normal, j.soft_patch_m2, j.strength])
            for j in jobs
        ]
        columns = np.concatenate(rows).T[..., None].astype(np.float32)  # (8, n, 1)
        return cls(*torch.as_tensor(columns, device=device))


class TorchPoints(NamedTuple):
    """Points of the wall (m,), laser spots or relay cells, with the leg from each to the lidar."""

    x_m: Tensor
    y_m: Tensor
    length_m: Tensor
    weight: Tensor

    @classmethod
    def of(cls, *columns: Float64, device: torch.device) -> "TorchPoints":
        """Return the columns as float32 on a device."""
        return cls(*torch.as_tensor(np.stack(columns).astype(np.float32), device=device))


Columns = TypeVar("Columns", TorchSites, TorchSurface, TorchPoints)


def part(columns: Columns, start: int, end: int) -> Columns:
    """Return the rows [start, end) of columns of patches or points."""
    return type(columns)(*(column[start:end] for column in columns))


class TorchOptics(NamedTuple):
    """Constants shared by all legs of a batch."""

    edge_m: tuple[float, float]
    near: bool
    """True if any patch is within near contact of the wall."""
    near_m2: float
    soft_wall_m2: float
    lambertian: bool
    fields: TorchFields | None
    """None if nothing shades."""
    chunk: int
    """Largest number of elements of a tensor."""


def legs(
    surface: TorchSurface,
    sites: TorchSites | None,
    wall: TorchPoints,
    optics: TorchOptics,
    *,
    outgoing: bool,
) -> tuple[Tensor, Tensor]:
    """Return weights (n, m), 0 for blocked legs, and lengths (n, m) of the legs from patches to
    points of the wall.

    Towards the lidar (`outgoing`) the weight has the wall's cosine, from it the patch's; in
    Lambertian radiometry both.
    """
    z = surface.z_m
    dx = wall.x_m - surface.x_m
    dy = wall.y_m - surface.y_m
    # d^2 = dx^2 + dy^2 + z^2 and n . (wall point - patch), with fused multiply-adds in place of
    # temporary tensors.
    squared = torch.addcmul(z * z, dx, dx).addcmul_(dy, dy)
    length = squared.sqrt()
    facing = torch.addcmul(-surface.normal_z * z, surface.normal_x, dx)
    facing.addcmul_(surface.normal_y, dy)
    passes = facing > 0
    if np.isfinite(optics.edge_m[0]):
        passes &= ~_cut(surface, wall, optics.edge_m)

    # S2 has one cosine over d^2: the weight is (cosine d) / (d^2 d), with d^2 limited at contact as
    # in `geometry.softened`.
    if optics.lambertian:
        cosine = z * facing / length
    else:
        cosine = z if outgoing else facing
    if optics.near:
        soft = optics.soft_wall_m2 if outgoing else surface.soft_m2
        squared += soft * (1 - squared / optics.near_m2).clamp_(min=0).square_()
    weight = torch.where(passes, wall.weight * cosine / squared.mul_(length), 0)
    if optics.fields is not None and sites is not None:
        shade(weight, dx, dy, sites, optics.fields, optics.chunk)
    return weight, length


def _cut(surface: TorchSurface, wall: TorchPoints, edge_m: tuple[float, float]) -> Tensor:
    """Return a mask (n, m) of the legs that the occluder blocks: for each patch, the wall from some
    x on.

    From a patch at distance d on this side of the edge to a wall point at distance t beyond it, the
    leg passes the edge at height z t / (t + d). That is at least edge_z from t = edge_z d / (z -
    edge_z) on.
    """
    edge_x, edge_z = edge_m
    z = surface.z_m
    d = surface.x_m - edge_m[0]
    begins = torch.where((z > edge_z) & (d != 0), edge_z * d.abs() / (z - edge_z), torch.inf)
    return (edge_x - wall.x_m) * d.sign() >= begins


CPU_CHUNK = 1 << 18
"""Elements of a tensor that fit in a CPU's cache."""
CUDA_CHUNK = 1 << 27
"""Elements that keep a GPU busy; fewer if they would take more than half of its memory."""
BYTES_PER_ELEMENT = 160
"""Bytes per element of all tensors of legs together."""
WHOLE_STEPS = 2.0**44
"""Integer for the largest weight of a table: 2^18 of them still fit in 64 bits."""


def device_named(backend: str) -> torch.device:
    """Return the device of a backend: "torch" is the CPU, "cuda" the GPU. Raises SceneError if
    there is none.
    """
    if backend == "cuda" and not torch.cuda.is_available():
        raise SceneError(
            "backend 'cuda' needs a CUDA device, and there is none: choose cpu, or torch for the"
            " same code on the CPU"
        )
    return torch.device("cuda" if backend == "cuda" else "cpu")


def chunk_for(device: torch.device) -> int:
    """Return the number of legs to compute at a time."""
    if device.type == "cpu":
        return CPU_CHUNK
    half = torch.cuda.get_device_properties(device).total_memory // 2
    return min(half // BYTES_PER_ELEMENT, CUDA_CHUNK)


def histograms(job: TransportJob, device: torch.device) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the job's beams."""
    return histograms_of_all([job], device)[0]


def histograms_of_all(jobs: Sequence[TransportJob], device: torch.device) -> list[Float32]:
    """Return the histograms of many jobs; those that differ in the object alone are computed
    together.

    Raises SceneError for a job whose tables would take more memory than is tried.
    """
    alike: dict[object, list[int]] = {}
    found: dict[int, Float32] = {}
    # A key that no job shares, its own index, keeps it apart.
    for index, job in enumerate(jobs):
        if job.brdf is None:
            alike.setdefault(_shared(job) or index, []).append(index)
        else:
            # Lobes differ from beam to beam: the CPU's lattices take less time than one table for
            # each of many spots did on a GPU.
            found[index] = backend_cpu.histograms(job)
    for which in alike.values():
        batch = _Batch([jobs[index] for index in which], device)
        found.update(zip(which, batch.histograms(), strict=True))
    return [found[index] for index in range(len(jobs))]


def _shared(job: TransportJob) -> tuple[object, ...] | None:
    """Return a key of all that jobs of one batch have in common; None for a job that is computed
    alone.
    """
    if job.more_bounces:
        return None
    # One relay and one set of beams for all, one kind of leg, and grids of one shape (`lay_out`).
    relay = job.relay
    field = job.field
    feet = job.laser_spot_m, job.length_m, job.beam_weight
    cells = relay.x_m, relay.y_m, relay.length_m, job.relay_weight
    columns = [column.tobytes() for column in (*feet, *cells)]
    numbers = job.edge_m, job.near_m, job.soft_wall_m2, job.lambertian, job.bin_m, job.accuracy
    return *columns, *numbers, field.depth_m.shape, field.pitch_x_m, field.pitch_y_m


class _Batch:
    """Jobs that differ in the object alone, on a device."""

    def __init__(self, jobs: Sequence[TransportJob], device: torch.device) -> None:
        self.job = jobs[0]
        self.jobs = jobs
        self.device = device
        self.chunk = chunk_for(device)
        job = self.job
        fields = None
        self.sites = None
        if any(one.field.shades for one in jobs):
            fields, self.sites = lay_out(jobs, device)
        self.surface = TorchSurface.of(jobs, device)
        relay = job.relay
        self.relay = TorchPoints.of(
            relay.x_m, relay.y_m, relay.length_m, job.relay_weight, device=device
        )
        near = min(one.patches.point_m[:, 2].min() for one in jobs) < job.near_m
        self.optics = TorchOptics(
            job.edge_m,
            bool(near),
            job.near_m**2,
            job.soft_wall_m2,
            job.lambertian,
            fields,
            self.chunk,
        )
        # The widest table of the batch serves all: a window is as wide for each.
        self.per_bin = job.accuracy.sub_bins
        self.width = max(table_bins(one)[1] for one in jobs)
        for one in jobs:
            # sub-bins of each patch, and their sums to bins for each shift
            check_tables(one, len(one.patches.beta), 2 * self.per_bin * self.width)
        self.per_m = self.per_bin / job.bin_m

    def histograms(self) -> list[Float32]:
        """Return the histograms (n, bins) of each job."""
        found = self._sums(*self._tables())
        return [histogram.cpu().numpy() for histogram in found]

    def _parts(self, points: int) -> Iterator[tuple[TorchSurface, TorchSites | None]]:
        """Yield the patches in parts whose legs to a number of points fit in a chunk."""
        count = max(self.chunk // points, 1)
        for start in range(0, len(self.surface.x_m), count):
            end = start + count
            sites = part(self.sites, start, end) if self.sites else None
            yield part(self.surface, start, end), sites

    def _tables(self) -> tuple[Tensor, Tensor]:
        """Return first bins (n, 1) and tables (n, per_bin, width)."""
        counts = [self._counts(*part) for part in self._parts(len(self.relay.x_m))]
        first, fine = (torch.cat(parts) for parts in zip(*counts, strict=True))
        if self.job.more_bounces:
            more = add_interreflection(self.job, first[:, 0].cpu().numpy(), fine.cpu().numpy())
            fine = torch.as_tensor(more, device=self.device)
        return first, tables(fine, self.per_bin)

    def _counts(self, surface: TorchSurface, sites: TorchSites | None) -> tuple[Tensor, Tensor]:
        """Return the first bin (n, 1) of some patches, and B over d3 + d4 in sub-bins from there
        on.
        """
        # B(s, q) over d3 + d4, counted from the patch's own first bin.
        weight, length = legs(surface, sites, self.relay, self.optics, outgoing=True)
        at = (length + self.relay.length_m) * self.per_m
        first = at.amin(1, keepdim=True).int() // self.per_bin
        return first, counted((at - first * self.per_bin).long(), weight, self.width * self.per_bin)

    def _sums(self, first: Tensor, table: Tensor) -> list[Tensor]:
        """Return histograms (n, bins) of each job: the sum of its patches' tables, times A, shifted
        by d1 + d2.
        """
        one = self.job
        spots = one.laser_spot_m
        columns = spots[:, 0], spots[:, 1], one.length_m, one.beam_weight
        feet = TorchPoints.of(*columns, device=self.device)
        found = [torch.zeros((len(feet.x_m), job.bins), device=self.device) for job in self.jobs]
        sizes = [len(job.patches.beta) for job in self.jobs]
        count = max(self.chunk // len(first), 1)
        for start in range(0, len(feet.x_m), count):
            some = part(feet, start, start + count)
            # A(p, s) over d1 + d2: the shift in whole bins and the row of the table, as in
            # `backend_numba`.
            weight, length = legs(self.surface, self.sites, some, self.optics, outgoing=False)
            sub_bin = torch.add(some.length_m * self.per_m + 0.5, length, alpha=self.per_m).int()
            columns = (
                table,
                sub_bin % self.per_bin,
                sub_bin // self.per_bin + first,
                weight * self.surface.strength,
            )
            # Legs of all patches at once; a beam sums the patches of one object at a time.
            by_job = zip(*(column.split(sizes) for column in columns), strict=True)
            for histogram, (rows, shift, at, a) in zip(found, by_job, strict=True):
                histogram[start : start + count] = shifted_sum(
                    rows, shift, at, a, histogram.shape[1]
                )
        return found


def counted(at: Tensor, weight: Tensor, size: int) -> Tensor:
    """Return histograms (n, size) of weights (n, m) that fall into cells `at` (n, m).

    Weights are rounded to whole steps: integers add up to the same in any order of a GPU's threads.
    """
    # Integer addition is associative and float addition is not: atomic adds of integers give the
    # same bits every time.
    # A step is 2^-44 of the row's largest weight: far below the last bit of its float32.
    step = weight.amax(1, keepdim=True).double().clamp_(min=1e-300) / WHOLE_STEPS
    total = torch.zeros((len(at), size), dtype=torch.int64, device=at.device)
    return (total.scatter_add_(1, at, (weight / step).long()) * step).float()


def tables(fine: Tensor, per_bin: int) -> Tensor:
    """Return histograms in sub-bins (n, width * per_bin) as sums to bins (n, per_bin, width), one
    for each shift.
    """
    # A moving sum of per_bin sub-bins with stride 1 has every bin of every shift: shift k takes
    # those ending at k less.
    sums = avg_pool1d(pad(fine, (per_bin - 1, 0))[:, None], per_bin, 1)[:, 0] * per_bin
    return sums.unflatten(1, (-1, per_bin)).flip(2).transpose(1, 2)


def shifted_sum(table: Tensor, shift: Tensor, at: Tensor, weight: Tensor, bins: int) -> Tensor:
    """Return histograms (m, bins): each beam sums a row of every patch's table (n, per_bin, width),
    at a bin, weighted.

    Zeros in front of each row, one for every bin that a patch may be late. So the contribution of a
    row to a beam's histogram, counted from the bin of the earliest patch, is a window of the rows
    in memory: no copy is needed.
    """
    earliest = at.amin(0)
    late = at - earliest
    most = int(late.max())
    rows = pad(table, (most, 0))
    span = rows.shape[2]
    row = torch.arange(len(at), device=at.device)[:, None] * (rows.shape[1] * span) + most
    windows = pad(rows.flatten(), (0, most)).unfold(0, span, 1)
    found = window_sums(
        windows, (row + (shift * span - late)).T.contiguous(), weight.T.contiguous()
    )
    # Bins beyond the histogram land in a margin that is cut off.
    placed = torch.zeros((len(found), bins + span), device=at.device)
    into = earliest.clamp(max=bins)[:, None].long() + torch.arange(span, device=at.device)
    placed.scatter_(1, into, found)
    return placed[:, :bins]


def window_sums(windows: Tensor, start: Tensor, weight: Tensor) -> Tensor:
    """Return weighted sums (m, span) of windows (k, span): for each of m its own n, `start` (m, n)
    and `weight` (m, n).

    On a GPU one thread makes each sum and reads the windows in place; on the CPU that kernel would
    copy them all.
    """
    if windows.is_cuda:
        return embedding_bag(start, windows, per_sample_weights=weight, mode="sum")
    # A batched product of (1, n) by (n, span) for a few beams whose copied windows fit the memory.
    few = max(16 * CPU_CHUNK // max(start.shape[1] * windows.shape[1], 1), 1)
    parts = zip(start.split(few), weight.split(few), strict=True)
    return torch.cat([torch.bmm(some[:, None], windows[where])[:, 0] for where, some in parts])
