"""A printed board on the wall as the lidar's infrared would see it: what tests and the study of the board look at.

Modelled: perspective, each pixel's own area, the laser's spot, the falloff with distance and incidence, toner that
still reflects, a print that is scaled and stretched, gain, saturation, shot and read noise, 8 bits. Not modelled:
speckle, gloss, a mirror that does not scan evenly, paper that bows (of which the corners alone know).
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.board import Board
from numpy.typing import NDArray
from wall_scenes import View

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
    sharp = cv2.warpPerspective(_texture(board), warp, (fine.width, fine.height), borderValue=1.0)
    shape = seen.pinhole.width, seen.pinhole.height
    return cv2.resize(sharp, shape, interpolation=cv2.INTER_AREA).astype(np.float64)
