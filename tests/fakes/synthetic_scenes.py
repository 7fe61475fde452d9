"""Synthetic benches with an occluder, printed boards and drifting streams, beside the walls of
`synthetic_walls`.

The image of a board has perspective, pixel area, the laser's spot, falloff with distance and
incidence, toner that reflects, a print that is scaled and stretched, gain, saturation, shot and
read noise, 8 bits. Not modelled: speckle, gloss, a mirror that scans unevenly, bowed paper (only in
`corners_px`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from nlos_calibration import (
    BareWall,
    Board,
    DriftCheck,
    Intrinsics,
    depth_noise_m,
    load_rig,
    wall_depth,
)
from nlos_calibration.arrays import Float64
from nlos_calibration.wall_tracker import watched_pixels
from numpy.typing import NDArray
from synthetic_walls import View, view

WALL_EXTENT_M = 2.0


@dataclass(frozen=True)
class Sheet:
    """Flat occluder: the paper's by default, with the errors of a bad set-up."""

    x_m: float = 0.2
    """Place of the edge at y = 0."""
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
    """Range of y."""


def bench_depth(
    seen: View,
    occluding_sheet: Sheet | None,
    *,
    beams: int = 1,
) -> Float64:
    """Return the depth (height, width) of wall and sheet, inf where a ray meets neither.

    A pixel reads the mean of its `beams`, so on the edge it lies between sheet and wall (a flying
    pixel).
    """
    pinhole = seen.pinhole.scaled(seen.pinhole.width * beams, seen.pinhole.height)
    rays = pinhole.rays() @ seen.pose[:3, :3].T
    lidar = seen.pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall_m = np.where(
            rays[..., 2] < 0.0,
            -lidar[2] / rays[..., 2],
            np.inf,
        )
        wall_m[wall_m * rays[..., 0] > WALL_EXTENT_M] = np.inf
        depth_m = (
            wall_m
            if occluding_sheet is None
            else np.minimum(wall_m, _sheet_depth(occluding_sheet, lidar, rays))
        )
    return depth_m.reshape(
        pinhole.height,
        seen.pinhole.width,
        beams,
    ).mean(axis=-1)


def _sheet_depth(occluding_sheet: Sheet, lidar: Float64, rays: Float64) -> Float64:
    """Return the depth along each ray to the sheet: t with normal . (lidar + t ray - edge) = 0; inf
    without a hit.
    """
    lean, twist = np.tan(
        np.radians(
            [
                occluding_sheet.lean_deg,
                occluding_sheet.twist_deg,
            ]
        )
    )
    normal = np.array([1.0, -twist, -lean])
    edge = np.array([occluding_sheet.x_m, 0.0, occluding_sheet.gap_m])
    depth_m = (normal @ (edge - lidar)) / (rays @ normal)
    y, z = (lidar[axis] + depth_m * rays[..., axis] for axis in (1, 2))
    above_m = z - occluding_sheet.gap_m - np.tan(np.radians(occluding_sheet.edge_deg)) * y
    on = (
        (above_m >= 0.0)
        & (above_m <= occluding_sheet.height_m)
        & (y >= occluding_sheet.bottom_m)
        & (y <= occluding_sheet.top_m)
    )
    return np.where((depth_m > 0.0) & on, depth_m, np.inf)


def ball(
    seen: View,
    centre_m: tuple[float, float, float],
    radius_m: float,
) -> Float64:
    """Return the depth (height, width) of a ball in the wall frame, inf beside it."""
    rays = seen.pinhole.rays() @ seen.pose[:3, :3].T
    towards = np.asarray(centre_m) - seen.pose[:3, 3]
    square = (rays**2).sum(axis=-1)
    along = rays @ towards
    # |t ray - towards|^2 = radius^2, solved for the smaller t
    inside = along**2 - square * (towards @ towards - radius_m**2)
    return np.where(
        (inside > 0.0) & (along > 0.0), (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf
    )


TEXTURE_PER_SQUARE = 240
SUPERSAMPLED = 4
TONER = 0.08
"""Albedo of the black squares relative to the paper, which is as bright as the wall."""
EDGE_PX = 8.0


@dataclass(frozen=True)
class Illumination:
    """Brightness, noise and laser spot of the infrared image."""

    brightest_counts: float = 48.0
    """Brightest counts of the bare wall."""
    read_noise_counts: float = 0.7
    shot_noise: float = 0.3
    spot_mm: float = 1.0
    """Full width at half maximum of the laser's spot; assumed: no value is published for the
    L515.
    """


@dataclass(frozen=True)
class Placement:
    """Placement of a printed board on the wall: middle, rotation, and the printer's scale
    errors.
    """

    x_m: float
    y_m: float = 0.0
    turn_rad: float = 0.0
    """Rotation of the board's x axis from the wall's x axis to its y axis."""
    scale: float = 1.0
    stretch: float = 1.0
    """Ratio of width to height."""

    def wall_from_board(self, board: Board) -> Float64:
        """Return the matrix (4, 3) from points (x, y, 1) of the drawing to points (x, y, z, 1) of
        the wall.
        """
        cos = np.cos(self.turn_rad)
        sin = np.sin(self.turn_rad)
        turn = (
            np.array([[cos, sin], [sin, -cos]])
            * self.scale
            * np.sqrt([self.stretch, 1.0 / self.stretch])
        )
        origin_m = np.array([self.x_m, self.y_m]) - turn @ board.size_mm * 0.5e-3
        return np.array(
            [
                [*turn[0], origin_m[0]],
                [*turn[1], origin_m[1]],
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 1.0],
            ]
        )


def at_near_edge(board: Board, seen: View) -> Placement:
    """Return an upright board at the edge of the lidar's view, on the side where the wall is
    near.
    """
    ray = np.array(
        [
            (EDGE_PX - seen.pinhole.ppx) / seen.pinhole.fx,
            0.0,
            1.0,
        ]
    )
    direction = seen.pose[:3, :3] @ ray
    edge_m = float(-direction[0] / direction[2] * seen.pose[2, 3])
    return Placement(edge_m + board.size_mm[0] * 0.5e-3)


def corners_px(
    board: Board, seen: View, placed: Placement, bow_m: tuple[float, float] = (0.0, 0.0)
) -> Float64:
    """Return the true places of the chessboard corners (n, 2) in pixels, also outside the image.

    `bow_m` is the height of the sheet's middle above the wall, for a bow along its x and its y
    axis.
    """
    flat = np.column_stack(
        [
            board.corners_m[:, :2],
            np.ones(len(board.corners_m)),
        ]
    )
    wall_m = placed.wall_from_board(board) @ flat.T
    wall_m[2] = (1.0 - (2e3 * flat[:, :2] / board.size_mm - 1.0) ** 2) @ bow_m
    x_m, y_m, z_m, _ = np.linalg.inv(seen.pose) @ wall_m
    lidar = seen.pinhole
    return np.column_stack(
        [
            lidar.fx * x_m / z_m + lidar.ppx,
            lidar.fy * y_m / z_m + lidar.ppy,
        ]
    )


def clean_infrared(
    board: Board, seen: View, placed: Placement, light: Illumination | None = None
) -> Float64:
    """Return the mean counts (height, width) before saturation, noise and rounding; the wall around
    is white.
    """
    light = light or Illumination()
    rays = seen.pinhole.rays()
    distance_m = float(seen.pose[2, 3])
    away = -(rays @ seen.pose[2, :3])
    # irradiance cos(incidence) / length^2, where cos(incidence) = distance / length
    length_m = distance_m * np.linalg.norm(rays, axis=-1) / np.maximum(away, 1e-6)
    falloff = np.where(away > 1e-6, distance_m / length_m**3, 0.0)
    counts = light.brightest_counts * falloff / falloff.max() * _albedo(board, seen, placed)
    if light.spot_mm <= 0.0:
        return counts
    # 2.355 = 2 sqrt(2 ln 2): full width at half maximum over sigma
    sigma_px = light.spot_mm * 1e-3 / 2.355 / float(np.quantile(length_m, 0.25)) * seen.pinhole.fx
    return cv2.GaussianBlur(
        counts,
        (0, 0),
        sigma_px,
        borderType=cv2.BORDER_REPLICATE,
    ).astype(np.float64)


def infrared_frames(
    clean: Float64, generator: np.random.Generator, count: int, light: Illumination | None = None
) -> NDArray[np.uint8]:
    """Return noisy, saturated infrared frames (count, height, width) of a view."""
    light = light or Illumination()
    noise = generator.standard_normal((count, *clean.shape), np.float32)
    spread = np.sqrt(light.read_noise_counts**2 + light.shot_noise**2 * clean).astype(np.float32)
    return np.clip(
        np.rint(clean.astype(np.float32) + noise * spread),
        0,
        255,
    ).astype(np.uint8)


@lru_cache(maxsize=8)
def _texture(board: Board) -> NDArray[np.float32]:
    """Return the pattern's albedo with a margin of one square of paper."""
    pattern = board.pattern(TEXTURE_PER_SQUARE).astype(np.float32) / 255.0
    return np.pad(
        TONER + (1.0 - TONER) * pattern,
        TEXTURE_PER_SQUARE,
        constant_values=1.0,
    ).astype(np.float32)


def _albedo(board: Board, seen: View, placed: Placement) -> Float64:
    """Return the albedo (height, width), averaged over each pixel's area."""
    fine = seen.pinhole.scaled(
        SUPERSAMPLED * seen.pinhole.width, SUPERSAMPLED * seen.pinhole.height
    )
    texel_m = board.square_mm * 1e-3 / TEXTURE_PER_SQUARE
    first_m = (0.5 - TEXTURE_PER_SQUARE) * texel_m
    board_from_texture = np.array(
        [
            [texel_m, 0.0, first_m],
            [0.0, texel_m, first_m],
            [0.0, 0.0, 1.0],
        ]
    )
    lidar_from_board = (np.linalg.inv(seen.pose) @ placed.wall_from_board(board))[:3]
    warp = fine.matrix @ lidar_from_board @ board_from_texture
    texture = _texture(board)
    sharp = cv2.warpPerspective(
        texture,
        warp,
        (fine.width, fine.height),
        borderValue=1.0,
    )
    shape = seen.pinhole.width, seen.pinhole.height
    return cv2.resize(sharp, shape, interpolation=cv2.INTER_AREA).astype(np.float64)


DepthChange = Callable[[Float64, int], Float64]
"""Change of the depths of the watched pixels (N,) in a frame, given its number."""
WallPose = tuple[float, float, float]
"""Distance in metres, yaw and pitch in degrees."""

PINHOLE = load_rig("bare-wall").pinhole
SMALL = PINHOLE.scaled(320, 240)
REFERENCE_FRAMES = 30
WALL_ENDS_M = 1.5
DEAD = 0.01
"""Share of the samples that give no depth."""


def wall_from_lidar(pose: WallPose) -> Float64:
    return view(*pose, PINHOLE).pose


def noisy_depth(depth_m: Float64, generator: np.random.Generator) -> Float64:
    """Return one frame of `depth_m`: noise of 0.5 mm plus 2 mm per metre, steps of 0.25 mm, dead
    samples.
    """
    noisy_m = depth_m + generator.standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
    return np.where(
        generator.random(depth_m.shape) < DEAD, np.nan, np.round(noisy_m / 0.00025) * 0.00025
    )


def reference_of_wall(
    pose: WallPose, intrinsics: Intrinsics, generator: np.random.Generator, **facts: Any
) -> BareWall:
    """Return the reference that `BareWallStatistics` would yield, without its frames; `facts`
    replace fields.
    """
    depth_m = wall_depth(wall_from_lidar(pose), intrinsics)
    inliers = depth_m < WALL_ENDS_M
    depth_m[~inliers] = np.nan
    noise_m = depth_noise_m(depth_m)
    mean_m = depth_m + noise_m / np.sqrt(REFERENCE_FRAMES) * generator.standard_normal(
        depth_m.shape
    )
    images = {"depth_m": mean_m, "depth_std_m": noise_m} | dict.fromkeys(
        ("ir", "ir_std"), np.full(depth_m.shape, 40.0)
    )
    maps = dict.fromkeys(
        ("map_depth_m", "map_depth_std_m", "map_intensity", "map_intensity_std"), np.zeros((64, 80))
    )
    arrays = images | maps | {"saturated": np.zeros(depth_m.shape)}
    fields: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
    fields |= {"inliers": inliers, "frames": REFERENCE_FRAMES, "intrinsics": intrinsics}
    return BareWall(**(fields | facts))


class WallStream:
    """Frames of a wall after its calibration, fed to a drift check. Stateful; deterministic for a
    seed.

    Only watched pixels have depth, to be fast.
    """

    def __init__(
        self,
        pose: WallPose,
        intrinsics: Intrinsics = SMALL,
        seed: int = 0,
    ) -> None:
        self.pose = pose
        self.intrinsics = intrinsics
        self.frames = 0
        self._generator = np.random.default_rng(seed)
        self.reference = reference_of_wall(pose, intrinsics, self._generator)
        self.check = DriftCheck(self.reference, wall_from_lidar(pose))
        self.pixels = watched_pixels(self.reference)
        rows, columns = np.divmod(self.pixels, intrinsics.width)
        self.places = np.stack(
            [columns / intrinsics.width, rows / intrinsics.height],
            axis=1,
        )
        """Places (N, 2) of the watched pixels in the view, 0 to 1."""
        self._frame = np.full(
            (intrinsics.height, intrinsics.width),
            np.nan,
            np.float32,
        )

    def moved(
        self, distance_m: float = 0.0, yaw_deg: float = 0.0, pitch_deg: float = 0.0
    ) -> WallPose:
        """Return the first pose plus a change."""
        return self.pose[0] + distance_m, self.pose[1] + yaw_deg, self.pose[2] + pitch_deg

    def show(
        self, pose: WallPose, count: int = 1, hide: DepthChange = lambda depth_m, _: depth_m
    ) -> int | None:
        """Feed `count` frames from a pose; return the number of the frame with the first warning,
        None without one.
        """
        depth_m = self.depth_from(pose)
        first = None
        for number in range(1, count + 1):
            self.look(hide(depth_m, self.frames))
            first = number if first is None and self.check.warnings else first
        return first

    def depth_from(self, pose: WallPose) -> Float64:
        """Return the depth of the watched pixels (N,) without noise; NaN where a beam misses the
        wall.
        """
        depth_m = wall_depth(wall_from_lidar(pose), self.intrinsics).ravel()[self.pixels]
        return np.where(np.isfinite(depth_m), depth_m, np.nan)

    def look(self, depth_m: Float64) -> None:
        """Feed one frame with these depths of the watched pixels (N,); noise is added here."""
        self._frame.ravel()[self.pixels] = noisy_depth(depth_m, self._generator)
        self.check.observe(self._frame, {})
        self.frames += 1


def multipath(
    places: Float64,
    share: float,
    seed: int,
    *,
    beyond: bool = False,
) -> DepthChange:
    """Return multipath by a moving object: a share of the pixels reads 3 to 40 cm too far,
    smoothly.

    The pixels form moving patches, or lie `beyond` a line that sways.
    """
    generator = np.random.default_rng(seed)
    waves = generator.uniform(1, 6, (4, 2)) * generator.choice([-1, 1], (4, 2))
    phases = generator.uniform(0, 2 * np.pi, 4)
    speeds = generator.uniform(0.02, 0.2, 4)

    def hide(depth_m: Float64, number: int) -> Float64:
        where, length, *_ = (
            np.sin(places @ waves.T + phases + speeds * number).T.reshape(2, 2, -1).sum(axis=1)
        )
        if beyond:
            where = places[:, 0] + 0.05 * np.sin(3.0 * places[:, 1] + speeds[0] * number)
        far = where > np.quantile(where, 1.0 - share)
        return depth_m + far * (0.03 + 0.37 * (length + 2.0) / 4.0)

    return hide


def chained(first: DepthChange, second: DepthChange) -> DepthChange:
    """Return both changes, the second applied to the result of the first."""
    return lambda depth_m, number: second(first(depth_m, number), number)


def occluding_sheet(places: Float64, nearest: float) -> DepthChange:
    """Return an occluder from place `nearest` (0 to 1) of the view on: 5 to 50 cm shorter, by half
    at most.
    """

    def hide(depth_m: Float64, _: int) -> Float64:
        into = np.clip(
            (places[:, 0] - nearest) / (1.0 - nearest),
            0.0,
            1.0,
        )
        shorter = np.maximum(depth_m - 0.05 - 0.45 * into, 0.5 * depth_m)
        return np.where(places[:, 0] >= nearest, shorter, depth_m)

    return hide
