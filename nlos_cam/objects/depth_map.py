"""Orthographic depth of a triangle mesh as the wall sees it: the surface nearest the wall, cell by cell.

Hidden depth in its two forms: metres over the object box, and the image v in [0, 1] that the networks speak.
"""

import numba
import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from nlos_models import BACKGROUND_BELOW_V, MIN_V
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS


def object_box(rig: Rig) -> ObjectBox:
    """The box that hidden objects live in. Raises SceneError where the rig has none."""
    if rig.object_box is None:
        raise SceneError(f"rig {rig.name!r} has no object_box to hide an object in: add [object_box] to its record")
    return rig.object_box


def image_from_depth(depth_m: NDArray[np.floating], box: ObjectBox) -> Float32:
    """Depth (..., 64, 64) in metres, NaN for background, as v: 0 background, else 0.1 (far) to 1 (near the wall)."""
    v = MIN_V + (1 - MIN_V) * (box.z_far_m - depth_m) / (box.z_far_m - box.z_near_m)
    return np.where(np.isnan(depth_m), 0.0, np.clip(v, MIN_V, 1.0)).astype(np.float32)


def depth_from_image(v: NDArray[np.floating], box: ObjectBox) -> Float32:
    """The way back: v (..., 64, 64) as depth in metres, NaN where v < 0.05."""
    share = np.clip((v - MIN_V) / (1 - MIN_V), 0.0, 1.0)
    depth_m = box.z_far_m - share * (box.z_far_m - box.z_near_m)
    return np.where(v < BACKGROUND_BELOW_V, np.nan, depth_m).astype(np.float32)


def cell_centres_m(box: ObjectBox, pixels: int = OBJECT_PIXELS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wall x of the columns (pixels,) and wall y of the rows (pixels,): row 0 is at the top, the largest y."""
    steps = (np.arange(pixels) + 0.5) / pixels
    x_m = box.x_min_m + steps * (box.x_max_m - box.x_min_m)
    y_m = box.y_max_m - steps * (box.y_max_m - box.y_min_m)
    return x_m, y_m


FINE_PIXELS = 256
EDGE = 1e-9
"""Of a triangle: an edge that two triangles share leaves no hole, whichever way rounding falls."""


@numba.njit(cache=True)
def _fill(
    triangles: NDArray[np.float64],
    x_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    depth = np.full((y_m.size, x_m.size), np.inf)
    pitch_x, pitch_y = x_m[1] - x_m[0], y_m[0] - y_m[1]
    for t in range(triangles.shape[0]):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = triangles[t]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-14:  # seen edge on
            continue
        j0 = max(int(np.ceil((min(ax, bx, cx) - x_m[0]) / pitch_x)), 0)
        j1 = min(int(np.floor((max(ax, bx, cx) - x_m[0]) / pitch_x)), x_m.size - 1)
        i0 = max(int(np.ceil((y_m[0] - max(ay, by, cy)) / pitch_y)), 0)
        i1 = min(int(np.floor((y_m[0] - min(ay, by, cy)) / pitch_y)), y_m.size - 1)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                u = ((bx - x_m[j]) * (cy - y_m[i]) - (cx - x_m[j]) * (by - y_m[i])) / area
                v = ((cx - x_m[j]) * (ay - y_m[i]) - (ax - x_m[j]) * (cy - y_m[i])) / area
                if u >= -EDGE and v >= -EDGE and u + v <= 1 + EDGE:
                    depth[i, j] = min(depth[i, j], u * az + v * bz + (1 - u - v) * cz)
    return depth


def orthographic_depth(triangles_m: NDArray[np.float64], box: ObjectBox, pixels: int = OBJECT_PIXELS) -> Float32:
    """Depth (pixels, pixels) in metres of triangles (n, 3, 3) given in the wall frame; NaN where there is none.

    A cell is sampled at its centre, and what lies beside the box is cut off. Surfaces outside the box's depths are not
    clipped: place the mesh first.
    """
    depth = _fill(np.ascontiguousarray(triangles_m, np.float64), *cell_centres_m(box, pixels))
    return np.where(np.isinf(depth), np.nan, depth).astype(np.float32)


def share_outside(triangles_m: NDArray[np.float64], box: ObjectBox) -> float:
    """The share of the silhouette of triangles (n, 3, 3) that lies beside the box, to about 1 %.

    0 where all of it is inside, or it is seen edge on and has none.
    """
    points = triangles_m.reshape(-1, 3)
    (x0, y0, _), (x1, y1, _) = points.min(0), points.max(0)
    inside = min(x0 - box.x_min_m, box.x_max_m - x1, y0 - box.y_min_m, box.y_max_m - y1) >= -EDGE
    if inside:
        return 0.0
    around = box.model_copy(update={"x_min_m": x0, "x_max_m": x1, "y_min_m": y0, "y_max_m": y1})
    x_m, y_m = cell_centres_m(around, FINE_PIXELS)
    beside_x, beside_y = (x_m < box.x_min_m) | (x_m > box.x_max_m), (y_m < box.y_min_m) | (y_m > box.y_max_m)
    silhouette = ~np.isnan(orthographic_depth(triangles_m, around, FINE_PIXELS))
    return float((beside_x | beside_y[:, None])[silhouette].sum() / max(silhouette.sum(), 1))
