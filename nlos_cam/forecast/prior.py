"""Prior over hidden objects: mean and covariance of outline and depth in a smooth basis.

Outline and depth are images of GRID x GRID cells over the object box. The outline is 1 inside and
0 outside; the depth is a share of the box's depth (0 near, 1 far), and goes on beyond the outline
with the nearest surface's. Both are written in cosines (the two-dimensional DCT), whose low modes
have a full covariance, outline with depth, and whose higher modes a variance each.
"""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64, Mask
from numpy.typing import NDArray

GRID = 32
"""Cells along a side: two of the depth maps' 64, which no forecast here resolves."""
OUTLINE_RADIUS = 13.0
DEPTH_RADIUS = 9.0
"""Modes with sqrt(kx^2 + ky^2) below these have a full covariance: 150 and 76."""
MIN_VARIANCE = 1e-6
"""Floor of a mode's variance: a mode that no object has would be known for certain."""
FILE = Path(__file__).with_name("prior.npz")


@dataclass(frozen=True)
class Shape:
    """Outline and depth of an object in the cells of the forecast."""

    outline: Mask
    """(GRID, GRID)."""
    depth: Float64
    """(GRID, GRID); share of the box's depth, going on beyond the outline."""

    @classmethod
    def of(cls, depth_m: Float32, box: ObjectBox) -> Self:
        """Return the shape of a depth map (n, n) over the box, NaN for background.

        n is a multiple of GRID, or any number: other sizes take each cell's nearest value.
        """
        coarse = _coarse(depth_m)
        share = (coarse - box.z_near_m) / (box.z_far_m - box.z_near_m)
        return cls(~np.isnan(coarse), _extended(share).astype(np.float64))

    def depth_m(self, box: ObjectBox) -> Float32:
        """Return the depth in meters, beyond the outline too."""
        depth_m = box.z_near_m + self.depth * (box.z_far_m - box.z_near_m)
        return depth_m.astype(np.float32)


@dataclass(frozen=True)
class Prior:
    """Mean and covariance of outline and depth, in modes of the cosine basis."""

    outline: Float64
    """(GRID, GRID); mean outline: the share of objects that cover each cell."""
    depth: Float64
    """(GRID, GRID); mean depth."""
    covariance: Float64
    """(2 GRID^2, 2 GRID^2) of the modes in `modes()`: outlines first, then depths."""
    objects: int
    """Number of objects that it was fitted to."""

    def dump(self) -> bytes:
        """Return the prior as a compressed file of half floats."""
        full = _full()
        block = self.covariance[np.ix_(full, full)]
        scale = np.sqrt(np.diag(block))
        correlation = (block / np.outer(scale, scale))[np.tril_indices(len(full), -1)]
        target = io.BytesIO()
        np.savez_compressed(
            target,
            allow_pickle=False,
            outline=self.outline.astype(np.float16),
            depth=self.depth.astype(np.float16),
            # Correlations to 1 / 127: half a percent is below what 6,000 objects determine.
            correlation=np.round(correlation * 127).astype(np.int8),
            deviation=np.sqrt(np.diag(self.covariance)).astype(np.float32),
            objects=np.array(self.objects),
        )
        return target.getvalue()

    @classmethod
    def load(cls, content: bytes) -> Self:
        """Return the prior that `dump` wrote."""
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            deviation = file["deviation"].astype(np.float64)
            full = _full()
            block = np.eye(len(full))
            lower = np.tril_indices(len(full), -1)
            block[lower] = file["correlation"] / 127.0
            block = np.tril(block) + np.tril(block, -1).T
            covariance = np.diag(deviation**2)
            scaled = _positive(block) * np.outer(deviation[full], deviation[full])
            covariance[np.ix_(full, full)] = scaled
            outline = file["outline"].astype(np.float64)
            depth = file["depth"].astype(np.float64)
            return cls(outline, depth, covariance, int(file["objects"]))


@cache
def shipped_prior() -> Prior:
    """Return the prior that comes with the program."""
    return Prior.load(FILE.read_bytes())


def fit_prior(depths_m: Iterable[Float32], box: ObjectBox) -> Prior:
    """Return the prior of objects given as depth maps over a box."""
    shapes = [Shape.of(depth_m, box) for depth_m in depths_m]
    shapes = [shape for shape in shapes if shape.outline.any()]
    outlines = np.stack([shape.outline.ravel() for shape in shapes]).astype(np.float64)
    depths = np.stack([shape.depth.ravel() for shape in shapes])
    by_outline, by_depth = modes(OUTLINE_RADIUS), modes(DEPTH_RADIUS)
    mean_outline = outlines.mean(0)
    mean_depth = depths.mean(0)
    # The basis is orthonormal: a product with its transpose gives the coefficients.
    both = np.hstack([(outlines - mean_outline) @ by_outline, (depths - mean_depth) @ by_depth])
    covariance = np.cov(both.T)
    high = np.setdiff1d(np.arange(len(covariance)), _full())
    own = np.diag(covariance)[high]
    covariance[high] = 0
    covariance[:, high] = 0
    covariance[high, high] = own
    covariance += MIN_VARIANCE * np.eye(len(covariance))
    shape = GRID, GRID
    return Prior(mean_outline.reshape(shape), mean_depth.reshape(shape), covariance, len(shapes))


@cache
def modes(radius: float) -> Float64:
    """Return the cosines (GRID^2, GRID^2) as orthonormal columns, those below the radius first."""
    place = (np.arange(GRID) + 0.5) / GRID
    along = np.cos(np.pi * np.outer(place, np.arange(GRID))) * np.sqrt(2 / GRID)
    along[:, 0] = np.sqrt(1 / GRID)
    every = np.einsum("ri,cj->rcij", along, along).reshape(GRID * GRID, GRID * GRID)
    low = _low(radius).ravel()
    return np.hstack([every[:, low], every[:, ~low]])


def _full() -> NDArray[np.int64]:
    """Return the numbers of the modes that have a full covariance."""
    outlines = int(_low(OUTLINE_RADIUS).sum())
    depths = int(_low(DEPTH_RADIUS).sum())
    cells = GRID * GRID
    return np.r_[:outlines, cells : cells + depths]


def _low(radius: float) -> Mask:
    """Return the mask (GRID, GRID) of the modes below a radius."""
    k = np.arange(GRID)
    return np.hypot(*np.meshgrid(k, k, indexing="ij")) < radius


def _coarse(depth_m: Float32) -> Float32:
    """Return a depth map in GRID x GRID cells: means of the surface where half of a cell has one,
    or more.
    """
    rows, columns = depth_m.shape
    if rows % GRID or columns % GRID:
        row = (np.arange(GRID) + 0.5) * rows / GRID
        column = (np.arange(GRID) + 0.5) * columns / GRID
        return depth_m[np.ix_(row.astype(int), column.astype(int))]
    parts = depth_m.reshape(GRID, rows // GRID, GRID, columns // GRID)
    seen = ~np.isnan(parts)
    count = seen.sum((1, 3))
    mean = np.where(seen, parts, 0).sum((1, 3)) / np.maximum(count, 1)
    enough = 2 * count >= parts.shape[1] * parts.shape[3]
    return np.where(enough, mean, np.nan).astype(np.float32)


def _extended(values: Float32) -> Float32:
    """Return an image whose background has the value of the nearest surface; the middle of the box
    if there is none.
    """
    seen = ~np.isnan(values)
    if not seen.any():
        return np.full_like(values, 0.5)
    _, labels = cv2.distanceTransformWithLabels(
        (~seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(labels, np.intp)
    nearest = np.zeros(label.max() + 1, np.float32)
    nearest[label[seen]] = values[seen]
    return nearest[label]


def _positive(correlation: Float64) -> Float64:
    """Return the nearest correlation matrix whose rounding leaves no eigenvalue at or below 0."""
    value, axis = np.linalg.eigh(correlation)
    fixed = (axis * np.maximum(value, 1e-3)) @ axis.T
    scale = np.sqrt(np.diag(fixed))
    return fixed / np.outer(scale, scale)
