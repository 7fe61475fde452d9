"""Where the wall is, frame after frame, from a few hundred pixels of which most may show something else."""

from math import asin, atan2, degrees, hypot, inf, sqrt
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.noise import depth_noise_m, measured_noise
from nlos_calibration.reference import BareWall

GRID = 18, 24
"""One pixel of each cell of such a grid of the view is watched."""
NOISY = 3.0
"""A pixel whose spread is so many times what the others' noise lets expect is not watched."""
INSIDE_SIGMAS, GATE_SIGMAS = 3.0, 4.5
"""Within the first a pixel is the wall's; beyond the second it has no weight (Tukey's biweight)."""
MIN_SHARE = 0.05
"""Of the pixels, how many must agree on a wall."""
HOME_SHARE, HOME_SIGMAS = 0.5, 6.0
"""Where at least this share of those that agree agrees with the reference as well, only pixels count at which the plane
is so near to it: seen at a grazing angle, a detour of some centimetres is a wall turned by a degree, and the few pixels
that show the wall itself hardly object."""
HIDDEN_SHARE, PATCH_SHARE = 0.5, 0.5
"""Where less than the first of the pixels show the wall, those count about which the second of the returns does."""
FARTHEST_M, FARTHEST_DEG = 0.1, 20.0
"""A wall that moved by more is not looked for: at right angles to it stands the occluder."""
WIDENED = 8.0
"""The gate at first, in a search for a wall that is lost."""
NARROWING = 0.7
"""Of the gate, in each frame of a search."""
PATIENCE = 8
"""Frames until a plane that too few pixels agree on is given up for the next search: while it is found, they grow."""
NOWHERE = 1e9
RIDGE = 1e-6
"""Of information, in units in which a pixel has some 1000: enough to solve for no step where there is none."""


class WallObservation(NamedTuple):
    """What one frame says of the wall, as changes against the reference; positive distances are farther."""

    distance_m: float
    yaw_deg: float
    pitch_deg: float
    range_m: float
    """The change instead, if each depth had changed by the same."""
    misfit: float
    """By how much more that leaves of the depths than a lidar that moved: sums of squares, in standard deviations."""


def watched_pixels(reference: BareWall) -> NDArray[np.intp]:
    """Flat indices of good pixels of the bare wall, each the one nearest to the middle of its cell of GRID."""
    height, width = reference.depth_m.shape
    usual_m = noise_scale(reference) * depth_noise_m(reference.depth_m.astype(np.float64))
    steady = ~(reference.depth_std_m > NOISY * usual_m)  # a single frame has no spread, and is let pass
    good = reference.inliers & np.isfinite(reference.depth_m) & steady & (reference.saturated == 0.0)
    rows, columns = np.nonzero(good)
    across, down = columns * GRID[1] / width, rows * GRID[0] / height
    off = np.hypot(across % 1.0 - 0.5, down % 1.0 - 0.5)
    order = np.argsort(off, kind="stable")
    cells = (down.astype(np.intp) * GRID[1] + across.astype(np.intp))[order]
    first = order[np.unique(cells, return_index=True)[1]]
    return rows[first] * width + columns[first]


def noise_scale(reference: BareWall) -> float:
    """The noise of a sample over the nominal."""
    depth_m, spread_m = (array.ravel().astype(np.float64) for array in (reference.depth_m, reference.depth_std_m))
    return measured_noise(depth_m, spread_m, np.full(depth_m.size, reference.frames)).scale


class WallTrack:
    """The wall's plane in each frame by a robust fit, begun where the frame before ended.

    A plane is linear in inverse depth: 1 / z = slopes . ray. Fitted is the change of the slopes against the reference,
    so that ripples and what else is the same in both drops out. Light that went by way of a hidden object and sheets
    before the wall are outliers: each step weighs the pixels by how near they are to the plane of the step before. If
    hardly any is near, the gate is widened and narrows from frame to frame.
    """

    def __init__(self, reference: BareWall, wall_from_lidar: Float64) -> None:
        self.pixels = watched_pixels(reference)
        height, width = reference.depth_m.shape
        depth_m = reference.depth_m.ravel()[self.pixels].astype(np.float64)
        rays = reference.intrinsics.rays().reshape(height * width, 3)[self.pixels]
        self._depth_m, self._inverse = depth_m, 1.0 / depth_m
        self._per_m = 1.0 / (noise_scale(reference) * depth_noise_m(depth_m))
        self._per_inverse_m = self._per_m * depth_m**2
        self._rows = rays * self._per_inverse_m[:, np.newaxis]
        self._columns = np.ascontiguousarray(self._rows.T)
        rows, columns = np.divmod(self.pixels, width)
        self._cells = rows * GRID[0] // height * GRID[1] + columns * GRID[1] // width
        self._grid = np.zeros(GRID, np.float32)
        self._slopes = -wall_from_lidar[2, :3] / wall_from_lidar[2, 3]
        self._pose = _pose(self._slopes)
        self._change, self._widened, self._lost = np.zeros(3), 1.0, 0
        self.share = 0.0
        """Of the pixels, those that showed the wall in the last frame."""

    def follow(self, depth_m: Float32) -> WallObservation | None:
        """What a frame (height, width) says; None where too few pixels agree on a wall."""
        if len(self.pixels) == 0:
            return None
        seen_m = depth_m.take(self.pixels).astype(np.float64)
        returned = (seen_m > 0.0) & (seen_m < inf)
        off = np.divide(1.0, seen_m, out=np.full(len(seen_m), NOWHERE), where=returned)
        off = (off - self._inverse) * self._per_inverse_m
        errors, near = self._begin(off)
        weight = np.maximum(1.0 - (errors / (GATE_SIGMAS * self._widened)) ** 2, 0.0) ** 2 * near
        if self.share < HIDDEN_SHARE and self._widened == 1.0:
            weight *= self._in_patches(np.abs(errors) < INSIDE_SIGMAS, returned)
        weighted = self._columns * weight
        information = weighted @ self._rows
        information.flat[::4] += RIDGE
        step = np.linalg.solve(information, weighted @ errors)
        self._change = self._change + step
        if self._widened > 1.0:
            self._widened = max(1.0, NARROWING * self._widened)
            return None
        return self._sight(np.where(returned, seen_m, self._depth_m), weight)

    def _begin(self, off: Float64) -> tuple[Float64, NDArray[np.bool_] | float]:
        """The errors from the plane to begin with: the last frame's, the reference's or a search's.

        And which pixels may count, 1 for all.
        """
        if self._lost == PATIENCE:
            self._widened, self._change, self._lost = WIDENED, np.zeros(3), 0
        predicted = self._rows @ self._change
        errors = off - predicted
        inside, at_home = np.abs(errors) < INSIDE_SIGMAS, np.abs(off) < INSIDE_SIGMAS
        self.share, home = _share(inside), _share(at_home)
        if self._widened > 1.0 or home < max(MIN_SHARE, HOME_SHARE * self.share):
            return errors, 1.0
        near = np.abs(predicted) < HOME_SIGMAS
        if _share(inside & near) < HOME_SHARE * home:
            self._change, self.share = np.zeros(3), home
            return off, 1.0
        return errors, near

    def _in_patches(self, inside: NDArray[np.bool_], returned: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which pixels have enough that show the wall about them: what only crosses it does so in a line."""
        self._grid.flat[self._cells] = inside - PATCH_SHARE * returned
        return cv2.blur(self._grid, (3, 3), borderType=cv2.BORDER_CONSTANT).flat[self._cells] >= 0.0

    def _sight(self, seen_m: Float64, weight: Float64) -> WallObservation | None:
        distance_m, yaw_deg, pitch_deg = _pose(self._slopes + self._change)
        distance_m, yaw_deg, pitch_deg = distance_m - self._pose[0], yaw_deg - self._pose[1], pitch_deg - self._pose[2]
        turn_deg = hypot(yaw_deg, pitch_deg)
        lost = abs(distance_m) > FARTHEST_M or turn_deg > FARTHEST_DEG or not weight.any()
        if lost or self.share < MIN_SHARE:
            self._lost += 1
            return None
        self._lost = 0
        gain, longer = weight * self._per_m, (seen_m - self._depth_m) * self._per_m
        range_m = float(gain @ longer) / float(gain @ self._per_m)
        plane_m = 1.0 / (self._inverse + self._rows @ self._change / self._per_inverse_m)
        misfit = float(weight @ ((longer - range_m * self._per_m) ** 2 - ((seen_m - plane_m) * self._per_m) ** 2))
        return WallObservation(distance_m, yaw_deg, pitch_deg, range_m, misfit)


def _share(chosen: NDArray[np.bool_]) -> float:
    return np.count_nonzero(chosen) / len(chosen)


def _pose(slopes: Float64) -> tuple[float, float, float]:
    """Distance, yaw and pitch of a wall (`geometry.angles_from_normal` with normal = -slopes x distance)."""
    x, y, z = slopes.tolist()
    distance_m = 1.0 / sqrt(x * x + y * y + z * z)
    return distance_m, degrees(atan2(-x, z)), degrees(asin(max(-1.0, min(1.0, y * distance_m))))
