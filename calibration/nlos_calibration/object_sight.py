"""Who sees the hidden object's box past the occluder: the lidar, which must not, and the wall, which must."""

import numpy as np

from nlos_calibration.arrays import Float64
from nlos_calibration.footprint import Footprint
from nlos_calibration.rig import ObjectBox, Occluder, Rig

SLICES = 24
"""Of the box along y, in which the share of it that the lidar sees is added up."""


def lidar_sees(rig: Rig, box: ObjectBox) -> float:
    """The share of the box's volume inside the lidar's field that the occluder does not hide."""
    edges = (np.arange(SLICES) + 0.5) / SLICES
    across_m = box.y_min_m + edges * (box.y_max_m - box.y_min_m)
    past = [_past_edge(rig.occluder, (0.0, rig.lidar.distance_m))] if rig.occluder else []
    return float(np.mean([_share(box, [*past, *_field(rig, y_m)]) for y_m in across_m]))


def wall_sees(rig: Rig, box: ObjectBox, seen: Footprint) -> float:
    """The share of the box's volume that is seen from the lit wall, by the cell that sees most of it.

    That is the farthest from the lidar's foot: no cell before it sees what it does not.
    """
    x_m = seen.cells_m[..., 0][seen.on_wall]
    occluder = rig.occluder
    if occluder is not None:
        # a cell beyond the sheet is lit if the beam passes below the edge: z = distance (1 - x_m / x) there
        distance_m = rig.lidar.distance_m
        x_m = x_m[(x_m <= occluder.x_m) | (distance_m * (x_m - occluder.x_m) < occluder.z_min_m * x_m)]
    if len(x_m) == 0:
        return 0.0
    farthest_m = float(x_m.max())
    if occluder is None or farthest_m >= occluder.x_m:
        return 1.0
    return _share(box, [_past_edge(occluder, (farthest_m, 0.0))])


def _past_edge(occluder: Occluder, eye: tuple[float, float]) -> Float64:
    """Half plane (a, b, c), a x + b z + c >= 0, of what is seen below the edge from an eye (x, z) before the sheet.

    The sight to (x, z) meets the sheet at eye_z + (z - eye_z) (x_m - eye_x) / (x - eye_x), to be below the edge.
    """
    run_m, rise_m = occluder.x_m - eye[0], occluder.z_min_m - eye[1]
    return np.array([rise_m, -run_m, run_m * eye[1] - rise_m * eye[0]])


def _field(rig: Rig, y_m: float) -> list[Float64]:
    """The half planes (a, b, c) that the four sides of the lidar's field of view leave of a slice at y."""
    pinhole, pose = rig.pinhole.scaled(1, 1), rig.wall_from_lidar
    left, right = (np.array([-0.5, 0.5]) - pinhole.ppx) / pinhole.fx
    top, bottom = (np.array([-0.5, 0.5]) - pinhole.ppy) / pinhole.fy
    inward = np.array([[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]])
    sides = inward @ pose[:3, :3].T
    return [np.array([x, z, y * y_m - side @ pose[:3, 3]]) for side in sides for x, y, z in [side]]


def _share(box: ObjectBox, half_planes: list[Float64]) -> float:
    """Of the box's cross-section in x and z, what all half planes leave."""
    x, z = (box.x_min_m, box.x_max_m), (box.z_near_m, box.z_far_m)
    corners = np.array([[x[0], z[0]], [x[1], z[0]], [x[1], z[1]], [x[0], z[1]]])
    left = corners
    for half_plane in half_planes:
        left = _cut(left, half_plane)
    return _area(left) / _area(corners)


def _cut(corners: Float64, half_plane: Float64) -> Float64:
    """A convex polygon (n, 2) cut by a half plane (Sutherland and Hodgman); (0, 2) where nothing is left."""
    inside = corners @ half_plane[:2] + half_plane[2]
    kept: list[Float64] = []
    for here, there, at, to in zip(corners, np.roll(corners, -1, 0), inside, np.roll(inside, -1), strict=True):
        if at >= 0.0:
            kept.append(here)
        if (at >= 0.0) != (to >= 0.0):
            kept.append(here + at / (at - to) * (there - here))
    return np.array(kept).reshape(-1, 2)


def _area(corners: Float64) -> float:
    """By the shoelace formula."""
    x, z = corners.T
    return float(abs(x @ np.roll(z, -1) - z @ np.roll(x, -1)) / 2.0)
