"""The fast renderer on tensors (torch): the factorisation of `cpu`, for a batch of objects, on a GPU or the CPU.

Patches of all objects stand one after another. Their legs are worked out in a few large kernels, the tables of patches
are counted in integers, and each beam of an object sums windows of that object's tables, where they lie. No sum depends
on the order in which threads arrive.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool1d, embedding_bag, pad

from nlos_cam.errors import SceneError
from nlos_cam.frames import Float32
from nlos_cam.render.between import with_inter_reflection
from nlos_cam.render.cpu import table_width
from nlos_cam.render.cuda_legs import Optics, Surface, Wall, legs, scattered
from nlos_cam.render.cuda_visibility import Sites, lay_out
from nlos_cam.render.job import Job
from nlos_cam.render.scatter import nodes

Array = NDArray[np.float64]

CPU_CHUNK = 1 << 18
"""Elements of a tensor that stay in a CPU's cache."""
CUDA_CHUNK = 1 << 27
"""Elements that keep a GPU busy; fewer where they would take more than half of its memory."""
BYTES_PER_ELEMENT = 160
"""Of all tensors of legs together."""
WHOLE_STEPS = 2.0**44
"""That the largest weight of a table counts: 2^18 of them still fit an integer of 64 bits."""


def device_named(backend: str) -> torch.device:
    """The device of a backend: "torch" is the CPU, "cuda" the GPU. Raises SceneError where there is none."""
    if backend == "cuda" and not torch.cuda.is_available():
        raise SceneError(
            "backend is 'cuda', and no CUDA device is here: choose cpu, or torch for the same code on the CPU"
        )
    return torch.device("cuda" if backend == "cuda" else "cpu")


def chunk_for(device: torch.device) -> int:
    """How many legs to work out at a time."""
    if device.type == "cpu":
        return CPU_CHUNK
    half = torch.cuda.get_device_properties(device).total_memory // 2
    return min(half // BYTES_PER_ELEMENT, CUDA_CHUNK)


def histograms(job: Job, device: torch.device) -> Float32:
    """Histograms (n, bins) of I_multi over path length, for the job's beams."""
    return histograms_of_all([job], device)[0]


def histograms_of_all(jobs: Sequence[Job], device: torch.device) -> list[Float32]:
    """The same of many jobs; those that differ in the object alone are worked out together."""
    alike: dict[object, list[int]] = {}
    for index, job in enumerate(jobs):
        alike.setdefault(_shared(job) or index, []).append(index)
    found: dict[int, Float32] = {}
    for which in alike.values():
        batch = _Batch([jobs[index] for index in which], device)
        found.update(zip(which, batch.histograms(), strict=True))
    return [found[index] for index in range(len(jobs))]


def _shared(job: Job) -> tuple[object, ...] | None:
    """What jobs of one batch have in common; None for a job that is worked out alone."""
    if job.brdf is not None or job.more_bounces:
        return None
    relay, field = job.relay, job.field
    feet = job.foot_m, job.length_m, job.beam_weight
    columns = [column.tobytes() for column in (*feet, relay.x_m, relay.y_m, relay.length_m, job.relay_weight)]
    numbers = job.edge_m, job.near_m, job.soft_wall_m2, job.lambertian, job.bin_m, job.accuracy
    return *columns, *numbers, field.depth_m.shape, field.pitch_x_m, field.pitch_y_m


class _Batch:
    """Jobs that differ in the object alone, on a device."""

    def __init__(self, jobs: Sequence[Job], device: torch.device) -> None:
        job = self.job = jobs[0]
        self.jobs, self.device, self.chunk = jobs, device, chunk_for(device)
        fields, self.sites = lay_out(jobs, device) if any(j.field.shades for j in jobs) else (None, None)
        self.surface = Surface.of(jobs, device)
        relay = job.relay
        self.relay = Wall.of(relay.x_m, relay.y_m, relay.length_m, job.relay_weight, device=device)
        near = min(one.patches.point_m[:, 2].min() for one in jobs) < job.near_m
        self.optics = Optics(
            job.edge_m, bool(near), job.near_m**2, job.soft_wall_m2, job.lambertian, fields, self.chunk
        )
        self.per_bin, self.width = job.accuracy.sub_bins, max(map(table_width, jobs))
        self.per_m = self.per_bin / job.bin_m

    def histograms(self) -> list[Float32]:
        """Of each job, (n, bins)."""
        job = self.job
        if job.brdf is None:
            found = self._sums(*self._tables(None), self._feet(np.ones(len(job.foot_m))))
            return [histogram.cpu().numpy() for histogram in found]
        total = torch.zeros((len(job.foot_m), job.bins), device=self.device)
        for foot, share in nodes(job, job.brdf):
            lit = torch.as_tensor(np.flatnonzero(share), device=self.device)
            total[lit] += self._sums(*self._tables(foot), self._feet(share))[0]
        return [total.cpu().numpy()]

    def _feet(self, share: Array) -> Wall:
        """The feet of beams that are taken to some share (n,)."""
        job, lit = self.job, np.flatnonzero(share)
        weight = job.beam_weight[lit] * share[lit]
        return Wall.of(job.foot_m[lit, 0], job.foot_m[lit, 1], job.length_m[lit], weight, device=self.device)

    def _parts(self, points: int) -> Iterator[tuple[Surface, Sites | None]]:
        """Patches, as many at a time as their legs to so many points may be."""
        count = max(self.chunk // points, 1)
        for start in range(0, len(self.surface.x_m), count):
            ends = start, start + count
            yield self.surface.part(*ends), self.sites.part(*ends) if self.sites else None

    def _tables(self, foot: Array | None) -> tuple[Tensor, Tensor]:
        """The bins (n, 1) at which tables start, and the tables (n, per_bin, width): for light from a foot, or any."""
        counts = [self._counts(*part, foot) for part in self._parts(len(self.relay.x_m))]
        first, fine = (torch.cat(parts) for parts in zip(*counts, strict=True))
        if self.job.more_bounces:
            more = with_inter_reflection(self.job, first[:, 0].cpu().numpy(), fine.cpu().numpy())
            fine = torch.as_tensor(more, device=self.device)
        return first, tables(fine, self.per_bin)

    def _counts(self, surface: Surface, sites: Sites | None, foot: Array | None) -> tuple[Tensor, Tensor]:
        """The first bin (n, 1) of some patches, and B over d3 + d4 in sub-bins from there on."""
        weight, length = legs(surface, sites, self.relay, self.optics, outgoing=True)
        if foot is not None and self.job.brdf is not None:
            weight *= scattered(self.job.brdf, foot, surface, self.relay)
        at = (length + self.relay.length_m) * self.per_m
        first = at.amin(1, keepdim=True).int() // self.per_bin
        return first, counted((at - first * self.per_bin).long(), weight, self.width * self.per_bin)

    def _sums(self, first: Tensor, table: Tensor, feet: Wall) -> list[Tensor]:
        """Histograms (n, bins) of each job: its patches' tables, times A, shifted by d1 + d2."""
        found = [torch.zeros((len(feet.x_m), job.bins), device=self.device) for job in self.jobs]
        sizes = [len(job.patches.beta) for job in self.jobs]
        count = max(self.chunk // len(first), 1)
        for start in range(0, len(feet.x_m), count):
            some = feet.part(start, start + count)
            weight, length = legs(self.surface, self.sites, some, self.optics, outgoing=False)
            sub_bin = torch.add(some.length_m * self.per_m + 0.5, length, alpha=self.per_m).int()
            columns = table, sub_bin % self.per_bin, sub_bin // self.per_bin + first, weight * self.surface.strength
            by_job = zip(*(column.split(sizes) for column in columns), strict=True)
            for histogram, (rows, shift, at, a) in zip(found, by_job, strict=True):
                histogram[start : start + count] = shifted_sum(rows, shift, at, a, histogram.shape[1])
        return found


def counted(at: Tensor, weight: Tensor, size: int) -> Tensor:
    """Histograms (n, size) of weights (n, m) that fall into cells `at` (n, m).

    In whole steps: integers add up to the same in whatever order a GPU's threads come.
    """
    step = weight.amax(1, keepdim=True).double().clamp_(min=1e-300) / WHOLE_STEPS
    total = torch.zeros((len(at), size), dtype=torch.int64, device=at.device)
    return (total.scatter_add_(1, at, (weight / step).long()) * step).float()


def tables(fine: Tensor, per_bin: int) -> Tensor:
    """Histograms (n, width * per_bin) in sub-bins as sums to bins (n, per_bin, width), one for each shift."""
    sums = avg_pool1d(pad(fine, (per_bin - 1, 0))[:, None], per_bin, 1)[:, 0] * per_bin
    return sums.unflatten(1, (-1, per_bin)).flip(2).transpose(1, 2)


def shifted_sum(table: Tensor, shift: Tensor, at: Tensor, weight: Tensor, bins: int) -> Tensor:
    """Histograms (m, bins): of each patch a row of its table (n, per_bin, width), at a bin and to a weight (n, m).

    Each row stands behind as many zeros as a patch may be late. So what it adds to a beam's histogram, from the bin of
    the earliest patch on, is a window of the rows as they lie.
    """
    earliest = at.amin(0)
    late = at - earliest
    most = int(late.max())
    rows = pad(table, (most, 0))
    span = rows.shape[2]
    row = torch.arange(len(at), device=at.device)[:, None] * (rows.shape[1] * span) + most
    windows = pad(rows.flatten(), (0, most)).unfold(0, span, 1)
    found = window_sums(windows, (row + (shift * span - late)).T.contiguous(), weight.T.contiguous())
    placed = torch.zeros((len(found), bins + span), device=at.device)
    placed.scatter_(1, earliest.clamp(max=bins)[:, None].long() + torch.arange(span, device=at.device), found)
    return placed[:, :bins]


def window_sums(windows: Tensor, start: Tensor, weight: Tensor) -> Tensor:
    """Weighted sums (m, span) of windows (k, span): for each of m its own n, `start` (m, n) and `weight` (m, n).

    A GPU reads windows where they lie, each sum by one thread; that kernel's sibling on the CPU would copy all of them.
    """
    if windows.is_cuda:
        return embedding_bag(start, windows, per_sample_weights=weight, mode="sum")
    few = max(16 * CPU_CHUNK // max(start.shape[1] * windows.shape[1], 1), 1)
    parts = zip(start.split(few), weight.split(few), strict=True)
    return torch.cat([torch.bmm(some[:, None], windows[where])[:, 0] for where, some in parts])
