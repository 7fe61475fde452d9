"""A measured bare wall and frames of it afterwards, without a camera; only watched pixels have depth, to be fast."""

from collections.abc import Callable
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.bare_wall import BareWall
from nlos_calibration.drift import DriftCheck
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_noise import depth_noise_m
from nlos_calibration.rig import load_rig
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_track import watched_pixels

Hide = Callable[[Float64, int], Float64]
"""From the depths of the watched pixels (N,) and a frame's number to what is seen of them."""
Pose = tuple[float, float, float]
"""Distance in metres, yaw and pitch in degrees."""

PINHOLE = load_rig("bare-wall").pinhole
SMALL = PINHOLE.scaled(320, 240)
REFERENCE_FRAMES = 30
WALL_ENDS_M = 1.5
DEAD = 0.01
"""Share of the samples that give no depth."""


def wall_from_lidar(pose: Pose) -> Float64:
    distance_m, yaw_deg, pitch_deg = pose
    return wall_from_plane(normal_from_angles(np.radians(yaw_deg), np.radians(pitch_deg)), distance_m)


def sensed(depth_m: Float64, generator: np.random.Generator) -> Float64:
    """One frame of `depth_m`: noise of 0.5 mm and 2 mm for each metre, steps of 0.25 mm, dead samples."""
    noisy_m = depth_m + generator.standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
    return np.where(generator.random(depth_m.shape) < DEAD, np.nan, np.round(noisy_m / 0.00025) * 0.00025)


def measured(pose: Pose, intrinsics: Intrinsics, generator: np.random.Generator, **facts: Any) -> BareWall:
    """The reference that `BareWallStatistics` would come to, drawn at once; `facts` replace fields."""
    depth_m = wall_depth(wall_from_lidar(pose), intrinsics)
    inliers = depth_m < WALL_ENDS_M
    depth_m[~inliers] = np.nan
    noise_m = depth_noise_m(depth_m)
    mean_m = depth_m + noise_m / np.sqrt(REFERENCE_FRAMES) * generator.standard_normal(depth_m.shape)
    images = {"depth_m": mean_m, "depth_std_m": noise_m} | dict.fromkeys(("ir", "ir_std"), np.full(depth_m.shape, 40.0))
    maps = dict.fromkeys(("map_depth_m", "map_depth_std_m", "map_intensity", "map_intensity_std"), np.zeros((64, 80)))
    arrays = images | maps | {"saturated": np.zeros(depth_m.shape)}
    fields: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
    fields |= {"inliers": inliers, "frames": REFERENCE_FRAMES, "intrinsics": intrinsics}
    return BareWall(**(fields | facts))


class WallStream:
    """Frames of a wall, each looked at by `check`. The same seed gives the same bits."""

    def __init__(self, pose: Pose, intrinsics: Intrinsics = SMALL, seed: int = 0) -> None:
        self.pose, self.intrinsics, self.frames = pose, intrinsics, 0
        self._generator = np.random.default_rng(seed)
        self.reference = measured(pose, intrinsics, self._generator)
        self.check = DriftCheck(self.reference, wall_from_lidar(pose))
        self.pixels = watched_pixels(self.reference)
        rows, columns = np.divmod(self.pixels, intrinsics.width)
        self.places = np.stack([columns / intrinsics.width, rows / intrinsics.height], axis=1)
        """(N, 2); of the watched pixels in the view, 0 to 1."""
        self._frame = np.full((intrinsics.height, intrinsics.width), np.nan, np.float32)

    def moved(self, distance_m: float = 0.0, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Pose:
        """The first pose, moved by so much."""
        return self.pose[0] + distance_m, self.pose[1] + yaw_deg, self.pose[2] + pitch_deg

    def show(self, pose: Pose, count: int = 1, hide: Hide = lambda depth_m, _: depth_m) -> int | None:
        """Look at `count` frames from a pose; after how many the first warning was there, None if there was none."""
        depth_m, told = self.depth_from(pose), None
        for number in range(1, count + 1):
            self.look(hide(depth_m, self.frames))
            told = number if told is None and self.check.warnings else told
        return told

    def depth_from(self, pose: Pose) -> Float64:
        """Of the watched pixels (N,), without noise; NaN where a beam never meets the wall."""
        depth_m = wall_depth(wall_from_lidar(pose), self.intrinsics).ravel()[self.pixels]
        return np.where(np.isfinite(depth_m), depth_m, np.nan)

    def look(self, depth_m: Float64) -> None:
        """Take in a frame of these depths of the watched pixels (N,), which gets its noise here."""
        self._frame.ravel()[self.pixels] = sensed(depth_m, self._generator)
        self.check.look(self._frame, {})
        self.frames += 1


def detours(places: Float64, share: float, seed: int, *, beyond: bool = False) -> Hide:
    """Light that went by way of an object that moves: a share of the pixels is 3 to 40 cm farther, smoothly.

    They are here and there, or `beyond` a line that only sways.
    """
    generator = np.random.default_rng(seed)
    waves = generator.uniform(1, 6, (4, 2)) * generator.choice([-1, 1], (4, 2))
    phases, speeds = generator.uniform(0, 2 * np.pi, 4), generator.uniform(0.02, 0.2, 4)

    def hide(depth_m: Float64, number: int) -> Float64:
        where, length, *_ = np.sin(places @ waves.T + phases + speeds * number).T.reshape(2, 2, -1).sum(axis=1)
        if beyond:
            where = places[:, 0] + 0.05 * np.sin(3.0 * places[:, 1] + speeds[0] * number)
        far = where > np.quantile(where, 1.0 - share)
        return depth_m + far * (0.03 + 0.37 * (length + 2.0) / 4.0)

    return hide


def both(first: Hide, second: Hide) -> Hide:
    """The second on top of the first."""
    return lambda depth_m, number: second(first(depth_m, number), number)


def sheet(places: Float64, nearest: float) -> Hide:
    """An occluder: from that place in the view on (0 to 1) the depth is shorter, by 5 to 50 cm, but never by half."""

    def hide(depth_m: Float64, _: int) -> Float64:
        into = np.clip((places[:, 0] - nearest) / (1.0 - nearest), 0.0, 1.0)
        shorter = np.maximum(depth_m - 0.05 - 0.45 * into, 0.5 * depth_m)
        return np.where(places[:, 0] >= nearest, shorter, depth_m)

    return hide
