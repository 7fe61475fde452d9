"""Depth maps of hidden objects: an orthographic rasteriser, and conversion between metres and the
networks' image v.

A depth map covers the x and y of the object box, row 0 at the top; a cell holds the depth of the
surface nearest the wall, sampled at the cell's centre. The image v in [0, 1] is the same map scaled
over the depths of the box.
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
    """Return the box that holds hidden objects. Raises SceneError where the rig has none."""
    if rig.object_box is None:
        raise SceneError(
            f"rig {rig.name!r} has no object_box for hidden objects: add [object_box] to its record"
        )
    return rig.object_box


def image_from_depth(depth_m: NDArray[np.floating], box: ObjectBox) -> Float32:
    """Return the image v of depth (..., 64, 64) in metres: 0 where it is NaN, else 0.1 (far) to 1
    (near the wall).
    """
    v = MIN_V + (1 - MIN_V) * (box.z_far_m - depth_m) / (box.z_far_m - box.z_near_m)
    return np.where(
        np.isnan(depth_m),
        0.0,
        np.clip(v, MIN_V, 1.0),
    ).astype(np.float32)


def depth_from_image(v: NDArray[np.floating], box: ObjectBox) -> Float32:
    """Return the depth in metres of an image v (..., 64, 64): NaN where v < 0.05."""
    # v falls linearly from 1 at z_near to MIN_V at z_far, so the share of the depth is the inverse.
    share = np.clip((v - MIN_V) / (1 - MIN_V), 0.0, 1.0)
    depth_m = box.z_far_m - share * (box.z_far_m - box.z_near_m)
    return np.where(v < BACKGROUND_BELOW_V, np.nan, depth_m).astype(np.float32)


def cell_centers_m(
    box: ObjectBox, pixels: int = OBJECT_PIXELS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wall x of the columns (pixels,) and wall y of the rows (pixels,); row 0 is at the top,
    the largest y.
    """
    steps = (np.arange(pixels) + 0.5) / pixels
    x_m = box.x_min_m + steps * (box.x_max_m - box.x_min_m)
    y_m = box.y_max_m - steps * (box.y_max_m - box.y_min_m)
    return x_m, y_m


FINE_PIXELS = 256
"""Cells along each axis when the cut-off share of a silhouette is measured: an edge cell is then
0.4 % of its width.
"""
EDGE = 1e-9
"""Tolerance of barycentric coordinates: rounding leaves no hole along an edge that two triangles
share.
"""


@numba.njit(cache=True)
def _fill(
    triangles: NDArray[np.float64], x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    # Cell centres inside a triangle (a, b, c) in x and y have barycentric coordinates u, v, 1 - u -
    # v >= 0: signed areas of the sub-triangles (b, c, p) and (c, a, p) over the area of (a, b, c).
    # Depth is linear in them. Rows i0..i1 and columns j0..j1 are the centres within the triangle's
    # bounding box (y falls as the row grows).
    depth = np.full((y_m.size, x_m.size), np.inf)
    pitch_x = x_m[1] - x_m[0]
    pitch_y = y_m[0] - y_m[1]
    for t in range(triangles.shape[0]):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = triangles[t]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-14:  # edge on: its projection has no area
            continue
        j0 = max(
            int(np.ceil((min(ax, bx, cx) - x_m[0]) / pitch_x)),
            0,
        )
        j1 = min(
            int(np.floor((max(ax, bx, cx) - x_m[0]) / pitch_x)),
            x_m.size - 1,
        )
        i0 = max(
            int(np.ceil((y_m[0] - max(ay, by, cy)) / pitch_y)),
            0,
        )
        i1 = min(
            int(np.floor((y_m[0] - min(ay, by, cy)) / pitch_y)),
            y_m.size - 1,
        )
        # The depth buffer keeps the surface nearest the wall: the smallest z of all triangles.
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                u = ((bx - x_m[j]) * (cy - y_m[i]) - (cx - x_m[j]) * (by - y_m[i])) / area
                v = ((cx - x_m[j]) * (ay - y_m[i]) - (ax - x_m[j]) * (cy - y_m[i])) / area
                if u >= -EDGE and v >= -EDGE and u + v <= 1 + EDGE:
                    depth[i, j] = min(
                        depth[i, j],
                        u * az + v * bz + (1 - u - v) * cz,
                    )
    return depth


def orthographic_depth(
    triangles_m: NDArray[np.float64], box: ObjectBox, pixels: int = OBJECT_PIXELS
) -> Float32:
    """Return the depth (pixels, pixels) in metres of triangles (n, 3, 3) in the wall frame; NaN for
    background.

    Surfaces beside the box are cut off; those in front of it or behind it are not: place the mesh
    first.
    """
    depth = _fill(np.ascontiguousarray(triangles_m, np.float64), *cell_centers_m(box, pixels))
    return np.where(np.isinf(depth), np.nan, depth).astype(np.float32)


def share_outside(triangles_m: NDArray[np.float64], box: ObjectBox) -> float:
    """Return the share of the silhouette of triangles (n, 3, 3) beside the box, to about 1 %; 0 if
    it has no area.
    """
    points = triangles_m.reshape(-1, 3)
    (x0, y0, _) = points.min(0)
    (x1, y1, _) = points.max(0)
    if (
        min(
            x0 - box.x_min_m,
            box.x_max_m - x1,
            y0 - box.y_min_m,
            box.y_max_m - y1,
        )
        >= -EDGE
    ):
        return 0.0
    # The silhouette is counted on its own extent: what lies outside the box has no cell in it.
    around = box.model_copy(update={"x_min_m": x0, "x_max_m": x1, "y_min_m": y0, "y_max_m": y1})
    x_m, y_m = cell_centers_m(around, FINE_PIXELS)
    beside_x = (x_m < box.x_min_m) | (x_m > box.x_max_m)
    beside_y = (y_m < box.y_min_m) | (y_m > box.y_max_m)
    silhouette = ~np.isnan(orthographic_depth(triangles_m, around, FINE_PIXELS))
    return float((beside_x | beside_y[:, None])[silhouette].sum() / max(silhouette.sum(), 1))
