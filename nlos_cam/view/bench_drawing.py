"""The bench as Rerun data, in the wall frame: wall, occluder, object box, lidar and the way of the light."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr
from nlos_calibration.rig import ObjectBox, Rig
from numpy.typing import NDArray

from nlos_cam.objects.depth_map import object_box

WALL_RGBA, OCCLUDER_RGBA, LIGHT_RGBA = (120, 130, 140, 70), (90, 150, 255, 90), (255, 210, 80, 200)
BOX_RGB, LIDAR_RGB = (150, 150, 150), (255, 110, 90)
OCCLUDER_HEIGHT_M = 0.3
"""How much is drawn of what has no end."""
MARGIN_M = 0.1
FRUSTUM_M = 0.12

Corners = list[tuple[float, float, float]]


def bench_parts(rig: Rig) -> Iterator[tuple[str, Any]]:
    """What there is, by path; none of it moves. Raises SceneError for a rig without an object box."""
    low, high = _seen_of_wall(rig)
    on_wall = [(x_m, y_m, 0.0) for x_m, y_m in _around((low[0], high[0]), (low[1], high[1]))]
    yield "bench/wall", _rectangle(on_wall, WALL_RGBA)
    if rig.occluder is not None:
        ends_m = rig.occluder.z_min_m, rig.occluder.z_min_m + OCCLUDER_HEIGHT_M
        corners = [(rig.occluder.x_m, y_m, z_m) for y_m, z_m in _around((low[1], high[1]), ends_m)]
        yield "bench/occluder", _rectangle(corners, OCCLUDER_RGBA)
    box = object_box(rig)
    yield "bench/box", _edges(box)
    yield "bench/light", rr.LineStrips3D([_light_path(rig, box)], colors=[LIGHT_RGBA], radii=0.002)
    yield from _lidar(rig)


def _lidar(rig: Rig) -> Iterator[tuple[str, Any]]:
    pose, pinhole = rig.wall_from_lidar, rig.pinhole
    yield "bench/lidar", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
    camera = rr.Pinhole(
        focal_length=(pinhole.fx, pinhole.fy),
        principal_point=(pinhole.ppx, pinhole.ppy),
        resolution=(pinhole.width, pinhole.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_M,
    )
    yield "bench/lidar/view", camera
    yield "bench/lidar/body", rr.Points3D([[0, 0, 0]], radii=0.012, labels=["lidar"], colors=[LIDAR_RGB])


def _edges(box: ObjectBox) -> rr.Boxes3D:
    low = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
    high = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
    return rr.Boxes3D(mins=[low], sizes=[high - low], colors=[BOX_RGB], radii=0.001, fill_mode="MajorWireframe")


def _seen_of_wall(rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (x, y) of the part of the wall that is drawn: what matters to light, not the endless plane."""
    relay = rig.relay
    low = np.array([relay.x_min_m - MARGIN_M, relay.y_min_m])
    return low, np.array([relay.x_max_m + MARGIN_M, relay.y_max_m])


def _light_path(rig: Rig, box: ObjectBox) -> NDArray[np.float64]:
    """The way of one three-bounce echo (5, 3): lidar, wall, hidden object, wall, lidar."""
    eye = rig.wall_from_lidar[:3, 3]
    middle = np.array([(box.x_min_m + box.x_max_m) / 2, (box.y_min_m + box.y_max_m) / 2, box.z_near_m])
    there, back = (np.array([middle[0] * 0.6, y_m, 0.0]) for y_m in (-0.04, 0.04))
    return np.stack([eye, there, middle, back, eye])


def _around(first: tuple[float, float], second: tuple[float, float]) -> list[tuple[float, float]]:
    (a, b), (c, d) = first, second
    return [(a, c), (b, c), (b, d), (a, d)]


def _rectangle(corners: Corners, rgba: tuple[int, int, int, int]) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=[(0, 1, 2), (0, 2, 3)], albedo_factor=rgba)
