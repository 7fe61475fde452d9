"""Frame-by-frame pose of the wall from a few hundred pixels, most of which may show something
else.
"""

from math import asin, atan2, degrees, hypot, inf, sqrt
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float32, Float64, Mask
from nlos_calibration.noise import depth_noise_m, measured_noise
from nlos_calibration.plane import MIN_SCALE
from nlos_calibration.reference import BareWall

GRID = 18, 24
"""Rows and columns of a grid over the view, with one watched pixel per cell."""
NOISY = 3.0
"""Largest spread of a watched pixel, in what the noise of the others predicts."""
INSIDE_SIGMAS = 3.0
GATE_SIGMAS = 4.5
"""Up to the first a pixel is an inlier; beyond the second it has no weight (Tukey's biweight)."""
MIN_SHARE = 0.05
"""Share of the pixels that must agree on a wall."""
HOME_SHARE = 0.5
HOME_SIGMAS = 6.0
"""If at least this share of the inliers also agrees with the reference, only pixels count at which
the plane is that near to the reference: at a grazing angle a detour of some centimetres looks like
a wall turned by a degree, and the few pixels that show the wall itself hardly contradict it."""
HIDDEN_SHARE = 0.5
PATCH_SHARE = 0.5
"""If fewer than the first share of the pixels show the wall, only those count around which the
second share of the returns does."""
FARTHEST_M = 0.1
FARTHEST_DEG = 20.0
"""Largest move that is searched: at right angles to the wall stands the occluder."""
WIDENED = 8.0
"""Initial widening of the gate when a lost wall is searched."""
NARROWING = 0.7
"""Factor on that widening in each frame of a search."""
PATIENCE = 8
"""Frames until a plane with too few inliers is given up for the next search: while it converges,
they grow.
"""
NOWHERE = 1e9
RIDGE = 1e-6
"""Added information, where a pixel has about 1000: makes the step zero in directions without
any.
"""


class WallObservation(NamedTuple):
    """Change of the wall against the reference in one frame; positive distances are farther."""

    distance_m: float
    yaw_deg: float
    pitch_deg: float
    range_m: float
    """The alternative: one constant change of every depth."""
    misfit: float
    """Sum of squares, in standard deviations, that this alternative leaves beyond those of a moved
    lidar.
    """


def watched_pixels(reference: BareWall) -> NDArray[np.intp]:
    """Return flat indices of good pixels of the bare wall, in each cell of GRID the one nearest to
    its centre.
    """
    # One pixel a cell spreads a few hundred over the view: as many as a pose needs, at 0.06 ms a
    # frame.
    height, width = reference.depth_m.shape
    usual_m = noise_scale(reference) * depth_noise_m(reference.depth_m.astype(np.float64))
    steady = ~(reference.depth_std_m > NOISY * usual_m)  # NaN, the spread of a single frame, passes
    good = (
        reference.inliers & np.isfinite(reference.depth_m) & steady & (reference.saturated == 0.0)
    )
    rows, columns = np.nonzero(good)
    across = columns * GRID[1] / width
    down = rows * GRID[0] / height
    off = np.hypot(across % 1.0 - 0.5, down % 1.0 - 0.5)
    order = np.argsort(off, kind="stable")
    cells = (down.astype(np.intp) * GRID[1] + across.astype(np.intp))[order]
    first = order[np.unique(cells, return_index=True)[1]]
    return rows[first] * width + columns[first]


def noise_scale(reference: BareWall) -> float:
    """Return the noise of a sample of the reference over nominal."""
    depth_m, spread_m = (
        array.ravel().astype(np.float64) for array in (reference.depth_m, reference.depth_std_m)
    )
    scale = measured_noise(depth_m, spread_m, np.full(depth_m.size, reference.frames)).scale
    # Simulated frames may have no noise at all, and errors are divided by it.
    return max(scale, MIN_SCALE)


class WallTrack:
    """Robust plane tracker: one weighted step per frame from the previous frame's plane. Feed
    frames in order.

    Stateful, one thread. Light by way of a hidden object and sheets before the wall are outliers,
    weighted down by their distance from the previous plane. If hardly any pixel is near, the gate
    widens and narrows again over frames.
    """

    # A plane is linear in inverse depth, 1 / z = slopes . ray, and so is the change of the slopes
    # against the reference: (1 / z - 1 / z_ref) = change . ray, in which ripples and whatever else
    # both share cancel. An error of dz is dz / z^2 in inverse depth, so dividing by the noise means
    # multiplying by z^2 / sigma (`_per_inverse_m`).

    def __init__(self, reference: BareWall, wall_from_lidar: Float64) -> None:
        self.pixels = watched_pixels(reference)
        height, width = reference.depth_m.shape
        depth_m = reference.depth_m.ravel()[self.pixels].astype(np.float64)
        rays = reference.intrinsics.rays().reshape(height * width, 3)[self.pixels]
        self._depth_m = depth_m
        self._inverse = 1.0 / depth_m
        self._per_m = 1.0 / (noise_scale(reference) * depth_noise_m(depth_m))
        self._per_inverse_m = self._per_m * depth_m**2
        self._rows = rays * self._per_inverse_m[:, np.newaxis]
        self._columns = np.ascontiguousarray(self._rows.T)
        rows, columns = np.divmod(self.pixels, width)
        self._cells = rows * GRID[0] // height * GRID[1] + columns * GRID[1] // width
        self._grid = np.zeros(GRID, np.float32)
        self._slopes = -wall_from_lidar[2, :3] / wall_from_lidar[2, 3]
        self._pose = _pose(self._slopes)
        self._change = np.zeros(3)
        self._widened = 1.0
        self._lost = 0
        self.share = 0.0
        """Share of the pixels that showed the wall in the last frame."""

    def follow(self, depth_m: Float32) -> WallObservation | None:
        """Track the wall into a frame (height, width); None where too few pixels agree on a
        wall.
        """
        if len(self.pixels) == 0:
            return None
        now_m = depth_m.take(self.pixels).astype(np.float64)
        returned = (now_m > 0.0) & (now_m < inf)
        # A pixel without a return is put so far off that no gate holds it.
        off = np.divide(1.0, now_m, out=np.full(len(now_m), NOWHERE), where=returned)
        off = (off - self._inverse) * self._per_inverse_m
        errors, near = self._begin(off)
        # Tukey's biweight (1 - (e / gate)^2)^2, then one step of iteratively reweighted least
        # squares
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
        return self._observation(np.where(returned, now_m, self._depth_m), weight)

    def _begin(self, off: Float64) -> tuple[Float64, Mask | float]:
        """Return errors from the plane to start at (previous, reference or search) and which pixels
        count (1: all).
        """
        # Three starts: the previous plane as a rule; the reference, where more of it is visible
        # than of the previous plane; a search from the reference with a wide gate, after frames
        # without a wall.
        if self._lost == PATIENCE:
            self._widened = WIDENED
            self._change = np.zeros(3)
            self._lost = 0
        predicted = self._rows @ self._change
        errors = off - predicted
        inside = np.abs(errors) < INSIDE_SIGMAS
        at_home = np.abs(off) < INSIDE_SIGMAS
        self.share = _share(inside)
        home = _share(at_home)
        if self._widened > 1.0 or home < max(MIN_SHARE, HOME_SHARE * self.share):
            return errors, 1.0
        near = np.abs(predicted) < HOME_SIGMAS
        if _share(inside & near) < HOME_SHARE * home:
            self._change = np.zeros(3)
            self.share = home
            return off, 1.0
        return errors, near

    def _in_patches(self, inside: Mask, returned: Mask) -> Mask:
        """Return the pixels with enough inliers around them: an object's surface crosses the wall
        only in a line.
        """
        self._grid.flat[self._cells] = inside - PATCH_SHARE * returned
        return cv2.blur(self._grid, (3, 3), borderType=cv2.BORDER_CONSTANT).flat[self._cells] >= 0.0

    def _observation(self, now_m: Float64, weight: Float64) -> WallObservation | None:
        """Compare the tracked plane with the reference; None, and a frame closer to a new search,
        if it is lost.
        """
        distance_m, yaw_deg, pitch_deg = _pose(self._slopes + self._change)
        distance_m = distance_m - self._pose[0]
        yaw_deg = yaw_deg - self._pose[1]
        pitch_deg = pitch_deg - self._pose[2]
        turn_deg = hypot(yaw_deg, pitch_deg)
        lost = abs(distance_m) > FARTHEST_M or turn_deg > FARTHEST_DEG or not weight.any()
        if lost or self.share < MIN_SHARE:
            self._lost += 1
            return None
        self._lost = 0
        # the alternative hypothesis, one constant for all depths, is their weighted mean change
        gain = weight * self._per_m
        longer = (now_m - self._depth_m) * self._per_m
        range_m = float(gain @ longer) / float(gain @ self._per_m)
        # Both hypotheses are compared by the depths they leave unexplained, weighted alike.
        plane_m = 1.0 / (self._inverse + self._rows @ self._change / self._per_inverse_m)
        misfit = float(
            weight
            @ ((longer - range_m * self._per_m) ** 2 - ((now_m - plane_m) * self._per_m) ** 2)
        )
        return WallObservation(distance_m, yaw_deg, pitch_deg, range_m, misfit)


def _share(chosen: Mask) -> float:
    return np.count_nonzero(chosen) / len(chosen)


def _pose(slopes: Float64) -> tuple[float, float, float]:
    """Return distance (m), yaw and pitch (degrees): `geometry.angles_from_normal` in plain floats,
    for speed.
    """
    x, y, z = slopes.tolist()
    distance_m = 1.0 / sqrt(x * x + y * y + z * z)
    return distance_m, degrees(atan2(-x, z)), degrees(asin(max(-1.0, min(1.0, y * distance_m))))
