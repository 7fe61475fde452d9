"""Maps as pictures and surfaces: pure functions from arrays to arrays."""

from dataclasses import dataclass

import cv2
import numpy as np
from nlos_calibration.rig import ObjectBox
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.objects.depth_image import cell_centres_m, image_from_depth

Rgb = NDArray[np.uint8]
BACKGROUND_RGB = (13, 16, 17)
"""The page's own dark: what has no surface has no colour."""
DARKEST = 60
"""Where in the colour map the farthest surface starts, so that it stands out from the background."""
JUMP_M = 0.03
"""Neighbours that differ by more are not one surface."""


def hidden_rgb(depth_m: Float32, box: ObjectBox) -> Rgb:
    """Hidden depth (64, 64) as a picture (64, 64, 3): bright is near the wall, the background dark."""
    v = image_from_depth(depth_m, box)
    rgb = _coloured(DARKEST + v * (255 - DARKEST), cv2.COLORMAP_INFERNO)
    rgb[np.isnan(depth_m)] = BACKGROUND_RGB
    return rgb


def lidar_rgb(depth_m: Float32, near_m: float, far_m: float) -> Rgb:
    """Lidar depth (height, width) as a picture, red (near) to blue (far); no return is dark."""
    share = (depth_m - near_m) / max(far_m - near_m, 1e-6)
    rgb = _coloured(np.nan_to_num(1.0 - np.clip(share, 0.0, 1.0)) * 255, cv2.COLORMAP_TURBO)
    rgb[np.isnan(depth_m)] = BACKGROUND_RGB
    return rgb


def infrared_grey(ir: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """IR counts (height, width) under a square root: weak and strong returns are both visible."""
    return np.sqrt(ir * np.float32(255.0)).astype(np.uint8)


def depth_span_m(depth_m: Float32) -> tuple[float, float]:
    """The range that most of a depth map lies in; (0, 1) for a map without a return."""
    seen = depth_m[np.isfinite(depth_m)]
    if seen.size == 0:
        return 0.0, 1.0
    near_m, far_m = np.percentile(seen, [1, 99])
    return float(near_m), float(far_m)


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in the wall frame."""

    points_m: NDArray[np.float32]
    """(n, 3)."""
    triangles: NDArray[np.uint32]
    """(m, 3)."""
    rgb: Rgb
    """(n, 3)."""


def surface(depth_m: Float32, box: ObjectBox) -> Surface:
    """The mesh of a hidden depth map (64, 64): squares whose corners are surface and do not jump."""
    x_m, y_m = np.meshgrid(*cell_centres_m(box, len(depth_m)))
    points = np.stack([x_m, y_m, depth_m], axis=-1).astype(np.float32)
    corners = np.stack([depth_m[:-1, :-1], depth_m[:-1, 1:], depth_m[1:, :-1], depth_m[1:, 1:]])
    whole = np.ptp(corners, axis=0) < JUMP_M  # false where a corner is NaN
    index = np.arange(depth_m.size).reshape(depth_m.shape)
    a, b, c, d = (part[whole] for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    used, triangles = np.unique(triangles, return_inverse=True)
    rgb = hidden_rgb(depth_m, box).reshape(-1, 3)
    return Surface(points.reshape(-1, 3)[used], triangles.reshape(-1, 3).astype(np.uint32), rgb[used])


def _coloured(values: NDArray[np.floating], colour_map: int) -> Rgb:
    bgr = cv2.applyColorMap(values.astype(np.uint8), colour_map)
    return np.ascontiguousarray(bgr[..., ::-1], dtype=np.uint8)
