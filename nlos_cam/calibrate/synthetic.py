"""Walls as a lidar's depth maps, bare and otherwise, and frames of them by the sensor's noise model.

A scene is a depth map (height, width) with the pose of the wall that holds most of the view. Walls that are not flat
are given by how far they stand out from that wall, or by a second plane.

A bench with its occluder as a lidar's depth map: rays cast on a wall and a sheet, and what else may stand there.

A printed board on the wall as the lidar's infrared would see it: what tests and the study of the board look at.

Modelled: perspective, each pixel's own area, the laser's spot, the falloff with distance and incidence, toner that
still reflects, a print that is scaled and stretched, gain, saturation, shot and read noise, 8 bits. Not modelled:
speckle, gloss, a mirror that does not scan evenly, paper that bows (of which the corners alone know).

A measured bare wall and frames of it afterwards, without a camera; only watched pixels have depth, to be fast.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from nlos_calibration import (
    QUANTUM_M,
    BareWall,
    Board,
    DepthMean,
    DriftCheck,
    Intrinsics,
    depth_noise_m,
    facing_angle_rad,
    load_rig,
    normal_from_angles,
    wall_depth,
    wall_from_plane,
    watched_pixels,
)
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.render import ripples, smooth_patches

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
    return seen.depth_m + rms_m * smooth_patches((seen.pinhole.height, seen.pinhole.width), generator)


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


WALL_EXTENT_M = 2.0


@dataclass(frozen=True)
class Sheet:
    """A flat occluder: the paper's, and how it may be set up badly."""

    x_m: float = 0.2
    """Of the edge at y = 0."""
    gap_m: float = 0.1
    lean_deg: float = 0.0
    """About y; positive leans away from the lidar's foot."""
    twist_deg: float = 0.0
    """About z; positive where x grows with y."""
    edge_deg: float = 0.0
    """Positive where the gap grows with y."""
    height_m: float = np.inf
    bottom_m: float = -np.inf
    top_m: float = np.inf
    """The y that it ends at."""


def bench(seen: View, sheet: Sheet | None, *, beams: int = 1) -> Float64:
    """Depth (height, width) of wall and sheet, inf where a ray meets neither.

    With more than one beam across a pixel it reads their mean: one on the edge flies between sheet and wall.
    """
    pinhole = seen.pinhole.scaled(seen.pinhole.width * beams, seen.pinhole.height)
    rays = pinhole.rays() @ seen.pose[:3, :3].T
    lidar = seen.pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall_m = np.where(rays[..., 2] < 0.0, -lidar[2] / rays[..., 2], np.inf)
        wall_m[wall_m * rays[..., 0] > WALL_EXTENT_M] = np.inf
        depth_m = wall_m if sheet is None else np.minimum(wall_m, _sheet_depth(sheet, lidar, rays))
    return depth_m.reshape(pinhole.height, seen.pinhole.width, beams).mean(axis=-1)


def _sheet_depth(sheet: Sheet, lidar: Float64, rays: Float64) -> Float64:
    """Along each ray, as far as it meets the sheet: normal . (p - edge) = 0."""
    lean, twist = np.tan(np.radians([sheet.lean_deg, sheet.twist_deg]))
    normal, edge = np.array([1.0, -twist, -lean]), np.array([sheet.x_m, 0.0, sheet.gap_m])
    depth_m = (normal @ (edge - lidar)) / (rays @ normal)
    y, z = (lidar[axis] + depth_m * rays[..., axis] for axis in (1, 2))
    above_m = z - sheet.gap_m - np.tan(np.radians(sheet.edge_deg)) * y
    on = (above_m >= 0.0) & (above_m <= sheet.height_m) & (y >= sheet.bottom_m) & (y <= sheet.top_m)
    return np.where((depth_m > 0.0) & on, depth_m, np.inf)


def ball(seen: View, centre_m: tuple[float, float, float], radius_m: float) -> Float64:
    """Depth (height, width) of a ball in the wall frame, inf beside it."""
    rays = seen.pinhole.rays() @ seen.pose[:3, :3].T
    towards = np.asarray(centre_m) - seen.pose[:3, 3]
    square, along = (rays**2).sum(axis=-1), rays @ towards
    inside = along**2 - square * (towards @ towards - radius_m**2)
    return np.where((inside > 0.0) & (along > 0.0), (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)


TEXTURE_PER_SQUARE = 240
SUPERSAMPLED = 4
TONER = 0.08
"""Albedo of the black squares, where the paper's is that of the wall."""
EDGE_PX = 8.0


@dataclass(frozen=True)
class Light:
    """What happens to the light between wall and image."""

    brightest_counts: float = 48.0
    """Of the bare wall."""
    read_noise_counts: float = 0.7
    shot_noise: float = 0.3
    spot_mm: float = 1.0
    """Full width at half maximum of the laser's spot: not known of an L515, whose infrared is seen to be blurred."""


@dataclass(frozen=True)
class Placed:
    """Where the pattern's middle is on the wall, how the sheet is turned, and what the printer did to it."""

    x_m: float
    y_m: float = 0.0
    turn_rad: float = 0.0
    """Of the board's x axis from the wall's x axis to its y axis."""
    scale: float = 1.0
    stretch: float = 1.0
    """Of width over height."""

    def wall_from_board(self, board: Board) -> Float64:
        """Points (x, y, 1) of the drawing to points (x, y, z, 1) of the wall, as a matrix (4, 3)."""
        cos, sin = np.cos(self.turn_rad), np.sin(self.turn_rad)
        turn = np.array([[cos, sin], [sin, -cos]]) * self.scale * np.sqrt([self.stretch, 1.0 / self.stretch])
        origin_m = np.array([self.x_m, self.y_m]) - turn @ board.size_mm * 0.5e-3
        return np.array([[*turn[0], origin_m[0]], [*turn[1], origin_m[1]], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def at_near_edge(board: Board, seen: View) -> Placed:
    """An upright board that begins where the lidar's view of the wall begins, on the side where the wall is near."""
    ray = np.array([(EDGE_PX - seen.pinhole.ppx) / seen.pinhole.fx, 0.0, 1.0])
    direction = seen.pose[:3, :3] @ ray
    edge_m = float(-direction[0] / direction[2] * seen.pose[2, 3])
    return Placed(edge_m + board.size_mm[0] * 0.5e-3)


def in_the_middle(seen: View) -> Placed:
    """An upright board where the optical axis meets the wall."""
    axis = seen.pose[:3, 2]
    return Placed(*(-axis[:2] / axis[2] * seen.pose[2, 3]))


def corners_px(board: Board, seen: View, placed: Placed, bow_m: tuple[float, float] = (0.0, 0.0)) -> Float64:
    """Where the chessboard corners (n, 2) truly are in the image, whether in it or not.

    `bow_m` is how far the middle of the sheet stands off the wall, seen along its x and its y axis.
    """
    flat = np.column_stack([board.corners_m[:, :2], np.ones(len(board.corners_m))])
    wall_m = placed.wall_from_board(board) @ flat.T
    wall_m[2] = (1.0 - (2e3 * flat[:, :2] / board.size_mm - 1.0) ** 2) @ bow_m
    x_m, y_m, z_m, _ = np.linalg.inv(seen.pose) @ wall_m
    lidar = seen.pinhole
    return np.column_stack([lidar.fx * x_m / z_m + lidar.ppx, lidar.fy * y_m / z_m + lidar.ppy])


def clean_view(board: Board, seen: View, placed: Placed, light: Light | None = None) -> Float64:
    """The mean counts (height, width) before saturation, noise and rounding; the wall about the sheet is white."""
    light = light or Light()
    rays, distance_m = seen.pinhole.rays(), float(seen.pose[2, 3])
    away = -(rays @ seen.pose[2, :3])
    length_m = distance_m * np.linalg.norm(rays, axis=-1) / np.maximum(away, 1e-6)
    falloff = np.where(away > 1e-6, distance_m / length_m**3, 0.0)  # cos(incidence) / length^2
    counts = light.brightest_counts * falloff / falloff.max() * _albedo(board, seen, placed)
    if light.spot_mm <= 0.0:
        return counts
    sigma_px = light.spot_mm * 1e-3 / 2.355 / float(np.quantile(length_m, 0.25)) * seen.pinhole.fx
    return cv2.GaussianBlur(counts, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE).astype(np.float64)


def frames_of(
    clean: Float64, generator: np.random.Generator, count: int, light: Light | None = None
) -> NDArray[np.uint8]:
    """Frames (count, height, width) of what the lidar delivers of a view."""
    light = light or Light()
    noise = generator.standard_normal((count, *clean.shape), np.float32)
    spread = np.sqrt(light.read_noise_counts**2 + light.shot_noise**2 * clean).astype(np.float32)
    return np.clip(np.rint(clean.astype(np.float32) + noise * spread), 0, 255).astype(np.uint8)


@lru_cache(maxsize=8)
def _texture(board: Board) -> NDArray[np.float32]:
    """The pattern's albedo, with a square of paper about it."""
    pattern = board.pattern(TEXTURE_PER_SQUARE).astype(np.float32) / 255.0
    return np.pad(TONER + (1.0 - TONER) * pattern, TEXTURE_PER_SQUARE, constant_values=1.0).astype(np.float32)


def _albedo(board: Board, seen: View, placed: Placed) -> Float64:
    """The albedo (height, width), averaged over each pixel's area."""
    fine = seen.pinhole.scaled(SUPERSAMPLED * seen.pinhole.width, SUPERSAMPLED * seen.pinhole.height)
    camera = np.array([[fine.fx, 0.0, fine.ppx], [0.0, fine.fy, fine.ppy], [0.0, 0.0, 1.0]])
    texel_m = board.square_mm * 1e-3 / TEXTURE_PER_SQUARE
    first_m = (0.5 - TEXTURE_PER_SQUARE) * texel_m
    board_from_texture = np.array([[texel_m, 0.0, first_m], [0.0, texel_m, first_m], [0.0, 0.0, 1.0]])
    lidar_from_board = (np.linalg.inv(seen.pose) @ placed.wall_from_board(board))[:3]
    warp = camera @ lidar_from_board @ board_from_texture
    texture = _texture(board)  # pyright: ignore[reportArgumentType]  a frozen model is hashable at run time
    sharp = cv2.warpPerspective(texture, warp, (fine.width, fine.height), borderValue=1.0)
    shape = seen.pinhole.width, seen.pinhole.height
    return cv2.resize(sharp, shape, interpolation=cv2.INTER_AREA).astype(np.float64)


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
        self.check.observe(self._frame, {})
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
