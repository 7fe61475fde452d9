"""Self-occlusion V on tensors: the lookup of `visibility`'s bounds and its exact walk, for many legs at a time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from nlos_cam.render.cpu import horizons
from nlos_cam.render.job import Job
from nlos_cam.render.visibility import FACES, bias_m


class Fields(NamedTuple):
    """The height fields of a batch, each turned so that a walk along any face goes up its rows; NaN all around."""

    depth_m: Tensor
    """Flat, rows of `across` cells."""
    across: int
    along: int
    """Rows of one face of one object: the grid, and the longest walk beyond it."""
    steps: int
    """Of the longest walk."""
    columns_per_m: float
    rows_per_m: float
    """Negative: rows run along -y."""
    bias_m: float
    sectors: int


class Sites(NamedTuple):
    """What visibility needs of patches (n)."""

    depth_m: Tensor
    """(n, 1)."""
    low: Tensor
    """(n, FACES * sectors); a leg below these is blocked."""
    high: Tensor
    """(n, FACES * sectors); a leg above these is free."""
    start: Tensor
    """(n, FACES); row of the fields that the patch stands in."""
    across: Tensor
    """(n, FACES); its place across."""

    def part(self, start: int, end: int) -> "Sites":
        """Only some patches, one after another."""
        return Sites(*(column[start:end] for column in self))


def lay_out(jobs: Sequence[Job], device: torch.device) -> tuple[Fields, Sites]:
    """The fields and sites of jobs that share a grid; an object that shades nothing has bounds of 0."""
    fields = [job.field for job in jobs]
    size = len(fields[0].depth_m)
    steps = max(max(f.last_row - f.first_row, f.last_column - f.first_column) for f in fields)
    rows = torch.as_tensor(np.stack([f.depth_m for f in fields]))
    columns = rows.transpose(1, 2)
    faces = torch.stack([columns, columns.flip(1), rows, rows.flip(1)], 1)
    padded = pad(faces, (1, 1, 0, steps), value=torch.nan).flatten().to(device, torch.float32)
    scale = 1 / fields[0].pitch_x_m, -1 / fields[0].pitch_y_m
    sectors = jobs[0].accuracy.sectors
    shared = Fields(padded, size + 2, size + steps, steps, *scale, bias_m(fields[0]), sectors)
    sites = [_sites(job, index, shared, size) for index, job in enumerate(jobs)]
    together = (torch.as_tensor(np.concatenate(column), device=device) for column in zip(*sites, strict=True))
    return shared, Sites(*together)


def _sites(job: Job, index: int, fields: Fields, size: int) -> tuple[np.ndarray, ...]:
    """The columns of one object's sites: depth, low, high, start and across."""
    row, column = job.patches.row, job.patches.column
    free = np.zeros((len(row), FACES * fields.sectors), np.float32)
    low, high = horizons(job) if job.field.shades else (free, free)
    along = np.stack([column, size - 1 - column, row, size - 1 - row], 1)
    across = np.stack([row, row, column, column], 1).astype(np.float32)
    start = (index * FACES + np.arange(FACES)) * fields.along + along
    return job.patches.point_m[:, 2:].astype(np.float32), low, high, start, across


def shade(weight: Tensor, dx_m: Tensor, dy_m: Tensor, sites: Sites, fields: Fields, chunk: int) -> None:
    """Set the weight (n, m) of legs that the object blocks to 0: looked up where the bounds decide, else walked."""
    u, v = dx_m * fields.columns_per_m, dy_m * fields.rows_per_m
    along_columns = u.abs() >= v.abs()
    far = torch.maximum(u.abs(), v.abs())
    tilt = torch.where(along_columns, v, u).div_(far.clamp(min=1e-20))
    sector = _sector(tilt, along_columns, torch.where(along_columns, u, v) < 0, fields.sectors)
    meets = (sites.depth_m < sites.high.gather(1, sector).mul_(far)) & (weight != 0)
    for some in meets.flatten().nonzero()[:, 0].split(max(chunk // max(fields.steps, 1), 1)):
        which = some // weight.shape[1]
        legs = which, sector.flatten()[some], tilt.flatten()[some], far.flatten()[some]
        hidden = sites.depth_m[which, 0] < sites.low[legs[:2]] * legs[3]
        undecided = (~hidden).nonzero()[:, 0]
        hidden[undecided] = blocked(fields, sites, *(column[undecided] for column in legs))
        weight.view(-1)[some[hidden]] = 0


def _sector(tilt: Tensor, along_columns: Tensor, backward: Tensor, sectors: int) -> Tensor:
    """Which of the FACES * sectors holds a direction."""
    inside = torch.add(sectors / 2, tilt, alpha=sectors / 2).clamp_(max=sectors - 1)  # floored when made whole
    return (inside + torch.where(along_columns, 0.0, 2.0 * sectors) + backward * float(sectors)).long()


def blocked(fields: Fields, sites: Sites, which: Tensor, sector: Tensor, tilt: Tensor, far: Tensor) -> Tensor:
    """Whether (k,) the object blocks legs from patches through sectors, `far` cells long, by `tilt` across for each.

    `visibility.blocked` with all steps side by side; beyond its last step there is only background.
    """
    face, step = sector // fields.sectors, torch.arange(1, fields.steps + 1, device=tilt.device)
    across = sites.across[which, face][:, None] + tilt[:, None] * step
    below = across.floor()
    share = across - below
    cell = below.long() + 1  # of the margin
    row = (sites.start[which, face][:, None] + step) * fields.across
    near = fields.depth_m[row + cell.clamp(0, fields.across - 1)]
    beyond = fields.depth_m[row + (cell + 1).clamp(0, fields.across - 1)]
    between = near + share * (beyond - near)
    between = torch.where(between.isnan(), torch.where(share < 0.5, near, beyond), between)
    depth = sites.depth_m[which]
    return (depth - between - fields.bias_m > step * (depth / far[:, None])).any(1)
