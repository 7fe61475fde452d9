"""Synthetic walls, flat and not, and their noisy depth, for tests of the wall fit without a camera.

A scene is a depth map (height, width) with the pose of the wall that fills most of the view. Walls
that are not flat are given by their height above that plane, or by a second plane.
"""

from dataclasses import dataclass

import nlos_calibration as walls
import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.render import ripples, smooth_patches

PINHOLE = walls.load_rig("bare-wall").pinhole.scaled(160, 120)
LONGEST_DEPTH_M = 4.0
DEAD_SHARE = 0.03


@dataclass(frozen=True)
class View:
    """Pose of a wall and the lidar that faces it."""

    pose: Float64
    """wall_from_lidar (4, 4)."""
    pinhole: walls.Intrinsics

    @property
    def depth_m(self) -> Float64:
        """(height, width) of the bare wall; inf where a beam never meets it."""
        return walls.wall_depth(self.pose, self.pinhole)

    @property
    def facing_deg(self) -> float:
        return float(np.degrees(walls.facing_angle_rad(self.pose)))

    def on_wall(self) -> tuple[Float64, Float64]:
        """Return wall x and y (height, width) where each pixel's ray meets the wall; far away where
        it does not.
        """
        depth_m = np.minimum(self.depth_m, 50.0)
        points = (self.pinhole.rays() * depth_m[..., np.newaxis]) @ self.pose[:2, :3].T
        return points[..., 0], points[..., 1]


def view(distance_m: float, yaw_deg: float, pitch_deg: float, pinhole: walls.Intrinsics) -> View:
    """Return the view of a wall at a distance and angles."""
    return View(
        walls.wall_from_plane(
            walls.normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m
        ),
        pinhole,
    )


def wall_coordinate(seen: View, direction_rad: float) -> Float64:
    """Return the wall coordinate (height, width) along a direction in the wall."""
    x, y = seen.on_wall()
    return x * np.cos(direction_rad) + y * np.sin(direction_rad)


def bent(
    seen: View, bend_deg: float, share: float, direction_rad: float = 0.0
) -> tuple[Float64, View]:
    """Return the depth of a wall that turns by `bend_deg` along a line, and the view of its larger
    part.

    `share` of the view lies beyond the line. A positive bend turns away from the lidar.
    """
    s = wall_coordinate(seen, direction_rad)
    fold_m = float(np.quantile(s[seen.depth_m < LONGEST_DEPTH_M], 1.0 - share))
    across = np.cos(direction_rad) * seen.pose[0, :3] + np.sin(direction_rad) * seen.pose[1, :3]
    normal = seen.pose[2, :3]
    bend = np.radians(bend_deg)
    turned = np.cos(bend) * normal + np.sin(bend) * across
    # a point of the fold, seen from the lidar: fold_m across the wall from the foot, which lies at
    # -distance * normal; the turned plane goes through it, so its distance is -turned . point
    distance_m = -float(turned @ (fold_m * across - seen.pose[2, 3] * normal))
    if distance_m <= 0.0:
        raise ValueError(f"a bend of {bend_deg} degrees puts the lidar behind the wall")
    other = View(walls.wall_from_plane(turned, distance_m), seen.pinhole)
    depth_m = np.where(s > fold_m, other.depth_m, seen.depth_m)
    returned = (depth_m > 0.0) & (depth_m < LONGEST_DEPTH_M)
    return depth_m, other if (s > fold_m)[returned].mean() > 0.5 else seen


def raised(seen: View, height_m: Float64) -> Float64:
    """Return the depth of a wall raised towards the lidar by `height_m` (height, width), along each
    pixel's ray.
    """
    return seen.depth_m * (1.0 - height_m / seen.pose[2, 3])


def curved(seen: View, radius_m: float, direction_rad: float = 0.0) -> Float64:
    """Return the depth of a cylinder that touches the plane mid-view; a positive radius bulges
    towards the lidar.
    """
    s = wall_coordinate(seen, direction_rad)
    s = s - float(np.median(s))
    reach_m = np.clip(s, -1.0, 1.0)  # parabola, clipped where it would be steep
    return raised(seen, -(reach_m**2) / (2.0 * radius_m))


def stepped(seen: View, height_m: float, share: float, direction_rad: float = 0.0) -> Float64:
    """Return the depth of a wall with a step: `share` of the view is raised."""
    s = wall_coordinate(seen, direction_rad)
    edge_m = float(np.quantile(s[seen.depth_m < LONGEST_DEPTH_M], 1.0 - share))
    return raised(seen, np.where(s > edge_m, height_m, 0.0))


def window(seen: View, gap_m: float, pane: int = 12) -> Float64:
    """Return the depth of a window with bars as wide as its panes: half of the view lies `gap_m`
    behind the frame.
    """
    rows, columns = np.indices(seen.depth_m.shape)
    return raised(seen, np.where((columns // pane + rows // pane) % 2 == 0, 0.0, -gap_m))


def patch(seen: View, share: float) -> NDArray[np.bool_]:
    """Return a mask (height, width): a rectangle in the middle with `share` of the pixels."""
    rows, columns = np.indices(seen.depth_m.shape)
    tall, wide = (
        np.abs(at / size - 0.5) < np.sqrt(share) / 2.0
        for at, size in zip((rows, columns), rows.shape, strict=True)
    )
    return tall & wide


def rippled(
    seen: View, amplitude_m: float, waves: float, generator: np.random.Generator
) -> Float64:
    """Return depth with a sensor ripple: `waves` periods across the image, in a random
    direction.
    """
    return seen.depth_m + amplitude_m * ripples(
        (seen.pinhole.height, seen.pinhole.width), waves, generator
    )


def patchy(seen: View, rms_m: float, generator: np.random.Generator) -> Float64:
    """Return depth with a smooth random error over the image."""
    return seen.depth_m + rms_m * smooth_patches(
        (seen.pinhole.height, seen.pinhole.width), generator
    )


def with_outliers(depth_m: Float64, share: float, generator: np.random.Generator) -> Float64:
    """Return depth with `share` of the returns replaced by random values from 5 cm to 2 m."""
    stray = (generator.random(depth_m.shape) < share) & (depth_m < LONGEST_DEPTH_M)
    return np.where(stray, generator.uniform(0.05, 2.0, depth_m.shape), depth_m)


def depth_frame(
    depth_m: Float64, generator: np.random.Generator, noise: float = 1.0
) -> NDArray[np.float32]:
    """Return one frame with an L515's noise, steps of 0.25 mm, limited range and dead pixels."""
    valid_m = np.where((depth_m > 0.0) & (depth_m < LONGEST_DEPTH_M), depth_m, np.nan)
    noisy_m = valid_m + noise * walls.depth_noise_m(valid_m) * generator.standard_normal(
        valid_m.shape
    )
    dead = generator.random(valid_m.shape) < DEAD_SHARE
    return np.where(dead, np.nan, np.round(noisy_m / walls.QUANTUM_M) * walls.QUANTUM_M).astype(
        np.float32
    )


def depth_statistics(
    depth_m: Float64,
    generator: np.random.Generator,
    *,
    frames: int = 8,
    noise: float = 1.0,
    flicker: float = 0.0,
) -> walls.DepthMean:
    """Return the statistics of frames of `depth_m`; `flicker` is the share of outliers, redrawn in
    each frame.
    """
    mean = walls.DepthMean(*depth_m.shape)
    for _ in range(frames):
        mean.add(depth_frame(with_outliers(depth_m, flicker, generator), generator, noise))
    return mean


def measured(
    depth_m: Float64, seed: int = 0, *, frames: int = 8, noise: float = 1.0
) -> walls.WallFit:
    """Return the wall that noisy frames of a depth map, seen through PINHOLE, are fitted by."""
    generator = np.random.default_rng(seed)
    mean = depth_statistics(depth_m, generator, frames=frames, noise=noise)
    return walls.fit_wall(mean.mean_m(), PINHOLE, generator, mean.noise())
