"""The occluder's edge in the view: where, row by row, the sight passes from the wall to the sheet."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64, Mask

MIN_ROW_PIXELS = 2
"""Of the sheet, in a row: fewer may be strays."""
GATE_SCATTERS, REFITS = 3.0, 8
SCATTER_PER_MEDIAN = 1.4826
"""The standard deviation of a normal distribution over its median of |x|."""


@dataclass(frozen=True)
class Edge:
    """The edge as a line z = gap_m + slope x y on the sheet, in the wall frame."""

    gap_m: float
    gap_std_m: float
    """Of the resolution of the view and of the scatter of the rows; neither falls with the number of rows, which share
    what moves them."""
    slope: float
    rows: int
    """In how many rows of the image it is seen."""


def find_edge(met_m: Float64, sheet: Mask, passed: Mask) -> Edge | None:
    """The edge from where each pixel's ray meets the sheet's plane (height, width, 3); None where it is not seen.

    `sheet` are pixels that return from the sheet, `passed` those whose beams went by it. A pixel that mixes both, reads
    anything or nothing is neither: the edge is somewhere between the last that passed and the first that did not.
    Heights must grow along each row.
    """
    height_m, y_m = met_m[..., 2], met_m[..., 1]
    middle_m = np.median(height_m[sheet])  # what is seen past another edge of the sheet says nothing about this one
    votes = np.where(height_m > middle_m, 0, passed.astype(np.int64) - sheet)
    balance = np.cumsum(votes, axis=1)
    best = balance == balance.max(axis=1, keepdims=True)
    last, first = best.argmax(axis=1), votes.shape[1] - best[:, ::-1].argmax(axis=1)
    seen = (balance.max(axis=1) > 0) & (first < votes.shape[1])
    seen[seen] = _follow(votes[seen] < 0, first[seen]) >= MIN_ROW_PIXELS
    if not seen.any():
        return None
    rows = np.flatnonzero(seen)
    low_m, high_m = height_m[rows, last[rows]], height_m[rows, first[rows]]
    across_m = (y_m[rows, last[rows]] + y_m[rows, first[rows]]) / 2.0
    return _line(across_m, (low_m + high_m) / 2.0, high_m - low_m)


def rows_of(sheet: Mask) -> Mask:
    """(height,); the rows in which the sheet is seen."""
    return sheet.sum(axis=1) >= MIN_ROW_PIXELS


def _follow(marked: Mask, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many of each row are marked from its start on."""
    columns = np.arange(marked.shape[1])
    return (marked & (columns >= start[:, np.newaxis])).sum(axis=1)


def _line(y_m: Float64, z_m: Float64, width_m: Float64) -> Edge:
    """A line through the middles of brackets that are `width_m` wide; rows far off it are left out."""
    line, inside = np.array([np.median(z_m), 0.0]), np.ones(len(z_m), np.bool_)
    terms, resolution_m = np.column_stack([np.ones_like(y_m), y_m]), float(np.median(width_m)) / sqrt(12.0)
    for _ in range(REFITS):
        off_m = z_m - terms @ line
        scatter_m = max(SCATTER_PER_MEDIAN * float(np.median(np.abs(off_m))), resolution_m)
        inside = np.abs(off_m) <= GATE_SCATTERS * scatter_m
        line = np.linalg.lstsq(terms[inside] / width_m[inside, None], z_m[inside] / width_m[inside])[0]
    scatter_m = float(np.sqrt(np.mean((z_m - terms @ line)[inside] ** 2)))
    return Edge(float(line[0]), max(resolution_m, scatter_m), float(line[1]), len(z_m))
