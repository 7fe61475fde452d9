"""Two measurements of one plane, by the lidar's depth and by a board: how far apart they are, and what to make of both.

Both are slopes = -normal / distance_m (3,) with a covariance. Where they agree, each counts by its weight. Where they
do not, an average of the two would be neither: one is taken, and the likely causes are told with their amounts.
"""

from dataclasses import dataclass
from math import degrees, sqrt
from typing import Literal

import numpy as np

from nlos_calibration.arrays import Float64

Used = Literal["both", "depth", "board"]

AGREE_SIGMAS = 4.0
"""Chance alone puts two planes farther apart once in 900 times (chi-square of three unknowns)."""
MAX_OFFSET_M, MAX_SCALE = 0.03, 0.2
"""No lidar is farther off, and no printer."""


@dataclass(frozen=True)
class Plane:
    """A plane in the lidar frame with its uncertainty."""

    slopes: Float64
    """(3,); -normal / distance_m, the normal towards the lidar."""
    covariance: Float64
    """(3, 3) of the slopes."""

    @property
    def distance_m(self) -> float:
        """From the lidar along the normal."""
        return 1.0 / float(np.linalg.norm(self.slopes))

    @property
    def normal(self) -> Float64:
        """(3,), unit, towards the lidar."""
        return -self.slopes * self.distance_m


@dataclass(frozen=True)
class Disagreement:
    """How far the board's plane is from the depth's."""

    distance_m: float
    """The board's less the depth's."""
    angle_deg: float
    """Between the normals."""
    sigmas: float
    """Of both together, by the uncertainties of both."""
    distance_sigmas: float
    angle_sigmas: float


@dataclass(frozen=True)
class Combined:
    """The plane to use, and why."""

    plane: Plane
    used: Used
    disagreement: Disagreement
    causes: tuple[str, ...]
    """What may lie behind a disagreement, each with its amount; empty where they agree."""


def combine(depth: Plane, board: Plane, *, measured: bool) -> Combined:
    """Both planes as one where they agree; else the board's if its squares were `measured` by hand, or the depth's."""
    apart = disagreement(depth, board)
    if apart.sigmas <= AGREE_SIGMAS:
        return Combined(_weighted(depth, board), "both", apart, ())
    used: Used = "board" if measured else "depth"
    return Combined(board if measured else depth, used, apart, _causes(depth, board, apart, measured=measured))


def disagreement(depth: Plane, board: Plane) -> Disagreement:
    """How far apart two planes are, and how far that is by their uncertainties."""
    difference, covariance = board.slopes - depth.slopes, board.covariance + depth.covariance
    along = depth.distance_m * depth.slopes  # a change of the slopes along them is one of the distance
    across = np.linalg.svd(along[np.newaxis])[2][1:]  # and across them one of the angle
    angle_rad = np.arctan2(np.linalg.norm(np.cross(depth.normal, board.normal)), depth.normal @ board.normal)
    return Disagreement(
        distance_m=board.distance_m - depth.distance_m,
        angle_deg=degrees(angle_rad),
        sigmas=_sigmas(np.eye(3), difference, covariance),
        distance_sigmas=_sigmas(along[np.newaxis], difference, covariance),
        angle_sigmas=_sigmas(across, difference, covariance),
    )


def _sigmas(axes: Float64, difference: Float64, covariance: Float64) -> float:
    """The length of the difference along `axes` (k, 3), in standard deviations."""
    off = axes @ difference
    return sqrt(max(float(off @ np.linalg.solve(axes @ covariance @ axes.T, off)), 0.0))


def _weighted(depth: Plane, board: Plane) -> Plane:
    """By the inverse of the covariances, written so that a plane known exactly does no harm."""
    gain = depth.covariance @ np.linalg.inv(depth.covariance + board.covariance)
    slopes = depth.slopes + gain @ (board.slopes - depth.slopes)
    return Plane(slopes, depth.covariance - gain @ depth.covariance)


def _causes(depth: Plane, board: Plane, apart: Disagreement, *, measured: bool) -> tuple[str, ...]:
    causes: list[str] = []
    scale = depth.distance_m / board.distance_m
    offset_m = apart.distance_m / max(-float(depth.normal[2]), 1e-3)
    if apart.distance_sigmas > AGREE_SIGMAS:
        if abs(scale - 1.0) <= MAX_SCALE and not measured:
            causes.append(
                f"the print's scale: squares of {100.0 * scale:.1f} % of their size would explain the distance; "
                "measure the printed bar and give --square-mm",
            )
        if abs(offset_m) <= MAX_OFFSET_M:
            causes.append(
                f"the lidar's range offset: {1e3 * offset_m:+.1f} mm along its axis would explain the distance; "
                "measure with a tape and give --tape-m",
            )
    if apart.angle_sigmas > AGREE_SIGMAS:
        causes.append(
            f"the angle: the normals are {apart.angle_deg:.2f} degrees apart; glue the board flat on the same wall, "
            "and let the lidar warm up (ripples turn the depth's plane)",
        )
    return tuple(causes) or ("distance and angle together: none of the usual causes stands out; measure again",)
