"""A printed board on the wall as the lidar's infrared would see it: what tests and the study of the board look at.

Modelled: perspective, each pixel's own area, the laser's spot, the falloff with distance and incidence, toner that
still reflects, gain, saturation, shot and read noise, 8 bits. Not modelled: speckle, gloss, a mirror that does not scan
evenly, crosstalk between pixels.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from nlos_calibration.board import Board
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray

Array = NDArray[np.float64]

TEXTURE_PER_SQUARE = 240
SUPERSAMPLED = 4
TONER = 0.08
"""Albedo of the black squares, where the paper's is that of the wall."""
SPOT_MM = 1.0
"""Full width at half maximum of the laser's spot; not known of an L515, whose IR is seen to be blurred close by."""


@dataclass(frozen=True)
class Light:
    """What happens to the light between wall and image."""

    brightest_counts: float = 48.0
    """Of the bare wall."""
    read_noise_counts: float = 0.7
    shot_noise: float = 0.3
    spot_mm: float = SPOT_MM


@dataclass(frozen=True)
class Placed:
    """Where the pattern's middle is on the wall, and how the sheet is turned."""

    x_m: float
    y_m: float = 0.0
    turn_rad: float = 0.0
    """Of the board's x axis from the wall's x axis to its y axis."""


def at_near_edge(board: Board, wall_from_lidar: Array, intrinsics: Intrinsics, margin_px: float = 8.0) -> Placed:
    """An upright board that begins where the lidar's view of the wall begins, on the side where the wall is near."""
    ray = np.array([(margin_px - intrinsics.ppx) / intrinsics.fx, 0.0, 1.0])
    direction = wall_from_lidar[:3, :3] @ ray
    edge_m = float(-direction[0] / direction[2] * wall_from_lidar[2, 3])
    return Placed(edge_m + board.size_mm[0] * 0.5e-3)


def clean_view(
    board: Board, wall_from_lidar: Array, intrinsics: Intrinsics, placed: Placed, light: Light | None = None
) -> Array:
    """The mean counts (height, width) before saturation, noise and rounding; the wall about the sheet is white."""
    light = light or Light()
    rays, distance_m = intrinsics.rays(), float(wall_from_lidar[2, 3])
    away = -(rays @ wall_from_lidar[2, :3])
    length_m = distance_m * np.linalg.norm(rays, axis=-1) / np.maximum(away, 1e-6)
    falloff = np.where(away > 1e-6, distance_m / length_m**3, 0.0)  # cos(incidence) / length^2
    counts = light.brightest_counts * falloff / falloff.max() * _albedo(board, wall_from_lidar, intrinsics, placed)
    if light.spot_mm <= 0.0:
        return counts
    sigma_px = light.spot_mm * 1e-3 / 2.355 / float(np.quantile(length_m, 0.25)) * intrinsics.fx
    return cv2.GaussianBlur(counts, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE).astype(np.float64)


def frames_of(clean: Array, generator: np.random.Generator, count: int, light: Light | None = None) -> NDArray[np.uint8]:
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


def _albedo(board: Board, wall_from_lidar: Array, intrinsics: Intrinsics, placed: Placed) -> Array:
    """The albedo (height, width), averaged over each pixel's area; on the sheet y runs down."""
    fine = intrinsics.scaled(SUPERSAMPLED * intrinsics.width, SUPERSAMPLED * intrinsics.height)
    camera = np.array([[fine.fx, 0.0, fine.ppx], [0.0, fine.fy, fine.ppy], [0.0, 0.0, 1.0]])
    cos, sin = np.cos(placed.turn_rad), np.sin(placed.turn_rad)
    origin_m = np.array([placed.x_m, placed.y_m]) - _turned(board, cos, sin)
    wall_from_sheet = np.array([[cos, sin, origin_m[0]], [sin, -cos, origin_m[1]], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    lidar_from_sheet = (np.linalg.inv(wall_from_lidar) @ wall_from_sheet)[:3]
    texel_m = board.square_mm * 1e-3 / TEXTURE_PER_SQUARE
    first_m = (0.5 - TEXTURE_PER_SQUARE) * texel_m
    sheet_from_texture = np.array([[texel_m, 0.0, first_m], [0.0, texel_m, first_m], [0.0, 0.0, 1.0]])
    texture, shape = _texture(board), (fine.width, fine.height)
    image_from_texture = camera @ lidar_from_sheet @ sheet_from_texture
    seen = cv2.warpPerspective(texture, image_from_texture, shape, borderValue=1.0)
    return cv2.resize(seen, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_AREA).astype(np.float64)


def _turned(board: Board, cos: float, sin: float) -> Array:
    """From the sheet's origin to the pattern's middle, on the wall."""
    half_x_m, half_y_m = (size * 0.5e-3 for size in board.size_mm)
    return np.array([cos * half_x_m + sin * half_y_m, sin * half_x_m - cos * half_y_m])
