"""Patches: the hidden surface for the renderer, one patch for each cell of the depth map that holds
a surface.
"""

from dataclasses import dataclass, replace

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.objects import JUMP_M, cell_centers_m


@dataclass(frozen=True)
class Patches:
    """Active cells of a hidden surface, one row each: center, normal towards the wall, beta
    (S3).
    """

    point_m: Float64
    """(n, 3)."""
    normal: Float64
    """(n, 3), unit."""
    beta: Float64
    """(n,); true area over projected area."""
    albedo: Float64
    """(n,); share of the light that a patch gives back, times the share of its cell that it
    fills.
    """
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    cell_m2: float
    """S_unit_target: projected area of a cell."""
    diagonal_m: float
    """Diagonal of a cell."""

    @property
    def area_m2(self) -> Float64:
        """(n,); true area."""
        return self.beta * self.cell_m2

    @property
    def slope(self) -> Float64:
        """(n, 2); dz/dx and dz/dy."""
        return -self.normal[:, :2] / self.normal[:, 2:]

    def level(self) -> "Patches":
        """Return the patches without tilt: facing the wall squarely, beta 1."""
        normal = np.zeros_like(self.normal)
        normal[:, 2] = -1.0
        return replace(self, normal=normal, beta=np.ones_like(self.beta))


def slope_along(depth: Float64, axis: int, pitch_m: float, jump_m: float = JUMP_M) -> Float64:
    """Return the forward difference along an axis; backward at an edge or a jump; 0 without
    neighbors.
    """
    # Forward as S3 takes it; a difference over a jump would tilt both patches towards a curtain
    # that is not there.
    step = np.diff(depth, axis=axis)
    slope = np.zeros_like(depth)
    step = np.moveaxis(step, axis, 0)
    near = np.abs(step) <= jump_m  # not of NaN
    along = np.moveaxis(slope, axis, 0)  # a view
    # First each cell takes the step behind it, then the step ahead where there is one.
    along[1:][near] = step[near]
    along[:-1][near] = step[near]
    return slope / pitch_m


def make_patches(
    depth: Float64, box: ObjectBox, albedo: Float64, jump_m: float = JUMP_M
) -> Patches:
    """Return the patches of a depth map (rows, columns), NaN for background, with its cells' albedo
    (rows, columns).
    """
    x_m, y_m = cell_centers_m(box, len(depth))
    pitch_x, pitch_y = cell_pitch_m(box, depth.shape)
    # Contiguous, as those of `clustered`: kernels are compiled for one layout.
    row, column = (np.ascontiguousarray(index) for index in np.nonzero(~np.isnan(depth)))
    slope_x = slope_along(depth, 1, pitch_x, jump_m)[row, column]
    slope_y = -slope_along(depth, 0, pitch_y, jump_m)[row, column]  # rows run along -y
    # The surface z(x, y) has tangents (1, 0, zx) and (0, 1, zy). Their cross product (-zx, -zy, 1)
    # has the length of true over projected area; its negative points towards the wall.
    beta = np.sqrt(1 + slope_x**2 + slope_y**2)  # S3, divided through by dx dy
    normal = np.stack([slope_x, slope_y, -np.ones_like(beta)], axis=-1) / beta[:, None]
    point = np.stack([x_m[column], y_m[row], depth[row, column]], axis=-1)
    diagonal_m = float(np.hypot(pitch_x, pitch_y))
    return Patches(
        point, normal, beta, albedo[row, column], row, column, pitch_x * pitch_y, diagonal_m
    )


def cell_pitch_m(box: ObjectBox, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return width and height of a cell of a depth map (rows, columns) over a box."""
    return (box.x_max_m - box.x_min_m) / shape[1], (box.y_max_m - box.y_min_m) / shape[0]


def clustered(patches: Patches, stride: int, size: int) -> Patches:
    """Return blocks of stride x stride cells of a grid (size, size) as one patch each.

    The light that a block receives is exact for its cells' own tilt, since S2 is linear in area
    times normal; the error is that all its cells stand at their mean point.
    """
    block = patches.row // stride * size + patches.column // stride
    found = np.unique(block, return_inverse=True, return_counts=True)
    blocks, which, count = (column.astype(np.int64) for column in found)

    def summed(columns: Float64) -> Float64:
        return np.stack(
            [np.bincount(which, column, len(blocks)).astype(np.float64) for column in columns.T], -1
        )

    # S2 is linear in albedo * true area * normal: their sum lights the wall as the cells do.
    area = summed((patches.albedo * patches.beta)[:, None] * patches.normal)
    albedo = summed(patches.albedo[:, None])[:, 0] / stride**2
    # beta is what is left of the sum's length beside albedo and projected area.
    length = np.linalg.norm(area, axis=-1)
    beta = np.divide(length / stride**2, albedo, out=np.ones_like(albedo), where=albedo > 0)
    level = np.array([0.0, 0.0, -1.0])
    return Patches(
        summed(patches.point_m) / count[:, None],
        np.where(length[:, None] > 0, area / np.maximum(length, 1e-30)[:, None], level),
        beta,
        albedo,
        blocks // size,
        blocks % size,
        patches.cell_m2 * stride**2,
        patches.diagonal_m * stride,
    )


def coarser(depth: Float64, stride: int) -> Float64:
    """Return the mean depth of blocks of stride x stride cells, NaN for blocks without a
    surface.
    """
    size = len(depth) // stride
    blocks = depth.reshape(size, stride, size, stride)
    count = (~np.isnan(blocks)).sum((1, 3))
    return np.nansum(blocks, axis=(1, 3)) / np.where(count > 0, count, np.nan)
