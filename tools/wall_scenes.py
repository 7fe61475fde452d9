"""Walls as a lidar's depth maps, bare and otherwise, and frames of them by the sensor's noise model.

A scene is a depth map (height, width) with the pose of the wall that holds most of the view. Walls that are not flat
are given by how far they stand out from that wall, or by a second plane.
"""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.depth_mean import DepthMean
from nlos_calibration.geometry import facing_angle_rad, normal_from_angles, wall_from_plane
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_noise import QUANTUM_M, depth_noise_m
from nlos_calibration.wall import wall_depth
from numpy.typing import NDArray

from nlos_cam.render.sensor.bias import patches, ripples

LONGEST_DEPTH_M = 4.0
DEAD_SHARE = 0.03


@dataclass(frozen=True)
class View:
    """A wall's pose and the lidar that looks at it."""

    pose: Float64
    """wall_from_lidar (4, 4)."""
    pinhole: Intrinsics

    @property
    def depth_m(self) -> Float64:
        """(height, width) of the bare wall; inf where a beam never meets it."""
        return wall_depth(self.pose, self.pinhole)

    @property
    def facing_deg(self) -> float:
        return float(np.degrees(facing_angle_rad(self.pose)))

    def on_wall(self) -> tuple[Float64, Float64]:
        """Wall x and y (height, width) of what each pixel sees, far away where it sees no wall."""
        depth_m = np.minimum(self.depth_m, 50.0)
        points = (self.pinhole.rays() * depth_m[..., np.newaxis]) @ self.pose[:2, :3].T
        return points[..., 0], points[..., 1]


def view(distance_m: float, yaw_deg: float, pitch_deg: float, pinhole: Intrinsics) -> View:
    """A view of a wall."""
    return View(wall_from_plane(normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m), pinhole)


def along(seen: View, direction_rad: float) -> Float64:
    """The wall coordinate (height, width) along a direction in the wall."""
    x, y = seen.on_wall()
    return x * np.cos(direction_rad) + y * np.sin(direction_rad)


def bent(seen: View, bend_deg: float, share: float, direction_rad: float = 0.0) -> tuple[Float64, View]:
    """A wall that turns by `bend_deg` along a line, beyond which `share` of the view lies.

    Returns the depth and the view of the wall that fills more of it. A positive bend turns away from the lidar.
    """
    s = along(seen, direction_rad)
    fold_m = float(np.quantile(s[seen.depth_m < LONGEST_DEPTH_M], 1.0 - share))
    across = np.cos(direction_rad) * seen.pose[0, :3] + np.sin(direction_rad) * seen.pose[1, :3]
    normal, bend = seen.pose[2, :3], np.radians(bend_deg)
    turned = np.cos(bend) * normal + np.sin(bend) * across
    # a point of the fold: s across the wall from its foot, which lies distance along the normal behind the lidar
    distance_m = -float(turned @ (fold_m * across - seen.pose[2, 3] * normal))
    if distance_m <= 0.0:
        raise ValueError(f"a bend of {bend_deg} degrees puts the lidar behind the wall")
    other = View(wall_from_plane(turned, distance_m), seen.pinhole)
    # of two planes the one in front is seen where the wall bends towards the lidar, the one behind where it bends away
    depth_m = np.where(s > fold_m, other.depth_m, seen.depth_m)
    returned = (depth_m > 0.0) & (depth_m < LONGEST_DEPTH_M)
    return depth_m, other if (s > fold_m)[returned].mean() > 0.5 else seen


def raised(seen: View, height_m: Float64) -> Float64:
    """A wall that stands out (height, width) towards the lidar from the plane, as each pixel's own beam finds it."""
    return seen.depth_m * (1.0 - height_m / seen.pose[2, 3])


def curved(seen: View, radius_m: float, direction_rad: float = 0.0) -> Float64:
    """A cylinder that touches the plane in the middle of the view; positive radius bulges towards the lidar."""
    s = along(seen, direction_rad)
    s = s - float(np.median(s))
    reach_m = np.clip(s, -1.0, 1.0)  # parabola, cut where it would be steep
    return raised(seen, -(reach_m**2) / (2.0 * radius_m))


def stepped(seen: View, height_m: float, share: float, direction_rad: float = 0.0) -> Float64:
    """A wall of which `share` of the view stands out by a step."""
    s = along(seen, direction_rad)
    edge_m = float(np.quantile(s[seen.depth_m < LONGEST_DEPTH_M], 1.0 - share))
    return raised(seen, np.where(s > edge_m, height_m, 0.0))


def window(seen: View, gap_m: float, pane: int = 12) -> Float64:
    """Panes as wide as their bars: half of the view lies `gap_m` behind the frame that holds them."""
    rows, columns = np.indices(seen.depth_m.shape)
    return raised(seen, np.where((columns // pane + rows // pane) % 2 == 0, 0.0, -gap_m))


def patch(seen: View, share: float) -> NDArray[np.bool_]:
    """A rectangle (height, width) in the middle of the view, that takes `share` of it."""
    rows, columns = np.indices(seen.depth_m.shape)
    tall, wide = (
        np.abs(at / size - 0.5) < np.sqrt(share) / 2.0 for at, size in zip((rows, columns), rows.shape, strict=True)
    )
    return tall & wide


def rippled(seen: View, amplitude_m: float, waves: float, generator: np.random.Generator) -> Float64:
    """Depth with a wave of the lidar's own over the image, `waves` of them across it, any way."""
    return seen.depth_m + amplitude_m * ripples((seen.pinhole.height, seen.pinhole.width), waves, generator)


def patchy(seen: View, rms_m: float, generator: np.random.Generator) -> Float64:
    """Depth that drifts here this way and there that way."""
    return seen.depth_m + rms_m * patches((seen.pinhole.height, seen.pinhole.width), generator)


def with_outliers(depth_m: Float64, share: float, generator: np.random.Generator) -> Float64:
    """Depth of which `share` of the returns read anything from 5 cm to 2 m."""
    stray = (generator.random(depth_m.shape) < share) & (depth_m < LONGEST_DEPTH_M)
    return np.where(stray, generator.uniform(0.05, 2.0, depth_m.shape), depth_m)


def frame_of(depth_m: Float64, generator: np.random.Generator, noise: float = 1.0) -> NDArray[np.float32]:
    """One frame as an L515 would give it: noise, steps of 0.25 mm, a limited range, dead pixels."""
    seen_m = np.where((depth_m > 0.0) & (depth_m < LONGEST_DEPTH_M), depth_m, np.nan)
    noisy_m = seen_m + noise * depth_noise_m(seen_m) * generator.standard_normal(seen_m.shape)
    dead = generator.random(seen_m.shape) < DEAD_SHARE
    return np.where(dead, np.nan, np.round(noisy_m / QUANTUM_M) * QUANTUM_M).astype(np.float32)


def looked_at(
    depth_m: Float64,
    generator: np.random.Generator,
    *,
    frames: int = 8,
    noise: float = 1.0,
    flicker: float = 0.0,
) -> DepthMean:
    """The statistics of frames of `depth_m`; `flicker` is the share of samples that stray in each frame anew."""
    mean = DepthMean(*depth_m.shape)
    for _ in range(frames):
        mean.add(frame_of(with_outliers(depth_m, flicker, generator), generator, noise))
    return mean
