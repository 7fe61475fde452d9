"""Legs between the patches of a batch and points of the wall, on tensors of float32: weight, length, scattering."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlos_cam.render.cuda_visibility import Fields, Sites, shade
from nlos_cam.render.job import Job
from nlos_cam.render.surface import Brdf

Array = NDArray[np.float64]


class Surface(NamedTuple):
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
    def of(cls, jobs: Sequence[Job], device: torch.device) -> "Surface":
        """The patches of all jobs, one after another."""
        columns = [
            np.column_stack([j.patches.point_m, j.patches.normal, j.soft_patch_m2, j.strength]).T[..., None]
            for j in jobs
        ]
        return cls(*torch.as_tensor(np.concatenate(columns, 1).astype(np.float32), device=device))

    def part(self, start: int, end: int) -> "Surface":
        """Only some, one after another."""
        return Surface(*(column[start:end] for column in self))


class Wall(NamedTuple):
    """Points of the wall (m,): the feet of beams, or relay cells; with the rest of their way to the lidar."""

    x_m: Tensor
    y_m: Tensor
    length_m: Tensor
    weight: Tensor

    @classmethod
    def of(cls, *columns: Array, device: torch.device) -> "Wall":
        """The same on a device."""
        return cls(*torch.as_tensor(np.stack(columns).astype(np.float32), device=device))

    def part(self, start: int, end: int) -> "Wall":
        """Only some, one after another."""
        return Wall(*(column[start:end] for column in self))


class Optics(NamedTuple):
    """What all legs of a batch share."""

    edge_m: tuple[float, float]
    near: bool
    """Whether any patch is within near contact of the wall."""
    near_m2: float
    soft_wall_m2: float
    lambertian: bool
    fields: Fields | None
    """None where nothing shades."""
    chunk: int
    """Elements that a tensor may have."""


def legs(surface: Surface, sites: Sites | None, wall: Wall, optics: Optics, *, outgoing: bool) -> tuple[Tensor, Tensor]:
    """Weights (n, m), 0 where nothing passes, and lengths (n, m) of the legs from patches to points of the wall.

    Towards the lidar (`outgoing`) the weight has the wall's cosine, from it the patch's; in Lambertian radiometry both.
    """
    z = surface.z_m
    dx, dy = wall.x_m - surface.x_m, wall.y_m - surface.y_m
    squared = torch.addcmul(z * z, dx, dx).addcmul_(dy, dy)
    length = squared.sqrt()
    facing = torch.addcmul(-surface.normal_z * z, surface.normal_x, dx).addcmul_(surface.normal_y, dy)
    passes = facing > 0
    if np.isfinite(optics.edge_m[0]):
        passes &= ~_cut(surface, wall, optics.edge_m)
    cosine = z * facing / length if optics.lambertian else z if outgoing else facing
    if optics.near:
        soft = optics.soft_wall_m2 if outgoing else surface.soft_m2
        squared += soft * (1 - squared / optics.near_m2).clamp_(min=0).square_()
    weight = torch.where(passes, wall.weight * cosine / squared.mul_(length), 0)
    if optics.fields is not None and sites is not None:
        shade(weight, dx, dy, sites, optics.fields, optics.chunk)
    return weight, length


def _cut(surface: Surface, wall: Wall, edge_m: tuple[float, float]) -> Tensor:
    """Whether (n, m) the occluder stands in the way: for each patch, the wall from some place on beyond the edge.

    A leg passes the edge at height z t / (t + d), from a patch at d this side of the edge to a wall point t beyond.
    """
    (edge_x, edge_z), z, d = edge_m, surface.z_m, surface.x_m - edge_m[0]
    begins = torch.where((z > edge_z) & (d != 0), edge_z * d.abs() / (z - edge_z), torch.inf)
    return (edge_x - wall.x_m) * d.sign() >= begins


def scattered(brdf: Brdf, foot_m: Array, surface: Surface, wall: Wall) -> Tensor:
    """The factor (n, m) of a BRDF on the ways from one foot (3,) over patches to points of the wall."""
    x, y, z = (float(place) - column for place, column in zip(foot_m, surface[:3], strict=True))
    d2 = (x * x + y * y + z * z).sqrt().clamp(min=1e-12)  # where the object touches the wall
    x, y, z = x / d2, y / d2, z / d2
    dx, dy, dz = wall.x_m - surface.x_m, wall.y_m - surface.y_m, -surface.z_m
    d3 = (dx * dx + dy * dy + dz * dz).sqrt().clamp(min=1e-12)
    cos_in = surface.normal_x * x + surface.normal_y * y + surface.normal_z * z
    cos_out = (surface.normal_x * dx + surface.normal_y * dy + surface.normal_z * dz) / d3
    cos_between = (x * dx + y * dy + z * dz) / d3
    value = brdf(cos_in.clamp(min=0), cos_out.clamp(min=0), cos_between)  # legs cut the dark side off themselves
    return torch.as_tensor(value, dtype=torch.float32, device=d3.device).expand(d3.shape)
