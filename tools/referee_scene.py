"""What both renderers are told of the referee's scenes: a bench, and a hidden object made of slanted rectangles."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.rig import Extent, LidarPose, ObjectBox, Rig
from numpy.typing import NDArray

from nlos_cam.objects.depth_map import cell_centres_m
from nlos_cam.render.scene import Radiometry, Scene

SLOPE_X, SLOPE_Y = 0.3, 0.2
"""dz/dx and dz/dy of every face."""
WALL = Extent(x_min_m=0.05, x_max_m=0.45, y_min_m=-0.2, y_max_m=0.2)
BOX = ObjectBox(x_min_m=0.25, x_max_m=0.45, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.12, z_far_m=0.4)
RIG = Rig(name="referee", lidar=LidarPose(distance_m=0.2, yaw_deg=45.0), wall=WALL, relay=WALL, object_box=BOX)
"""The paper's lidar without its occluder, in front of a wall that ends where the relay wall does."""


@dataclass(frozen=True)
class Face:
    """A rectangle of the object box, seen along z, on a slanted plane."""

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float
    z_m: float
    """Of the plane, at the middle of the object box."""

    def depth_m(self, x_m: Float64, y_m: Float64) -> Float64:
        """The plane's depth at points of the wall."""
        middle = (BOX.x_min_m + BOX.x_max_m) / 2, (BOX.y_min_m + BOX.y_max_m) / 2
        return self.z_m + SLOPE_X * (x_m - middle[0]) + SLOPE_Y * (y_m - middle[1])

    def covers(self, x_m: Float64, y_m: Float64) -> NDArray[np.bool_]:
        """Which points of the wall lie before the face."""
        return (x_m > self.x_min_m) & (x_m < self.x_max_m) & (y_m > self.y_min_m) & (y_m < self.y_max_m)

    @property
    def corners_m(self) -> Float64:
        """(4, 3); in the order that makes the face look at the wall."""
        x = np.array([self.x_min_m, self.x_min_m, self.x_max_m, self.x_max_m])
        y = np.array([self.y_min_m, self.y_max_m, self.y_max_m, self.y_min_m])
        return np.stack([x, y, self.depth_m(x, y)], axis=-1)

    @property
    def sides_m(self) -> Float64:
        """(4, 4, 3); the walls of the column that a depth map makes of the face, down to the box's far end."""
        rim = self.corners_m
        foot = np.concatenate([rim[:, :2], np.full((4, 1), BOX.z_far_m)], axis=1)
        return np.stack([rim, np.roll(rim, -1, 0), np.roll(foot, -1, 0), foot], axis=1)


PLATE = (Face(0.25, 0.45, -0.1, 0.1, 0.22),)
"""No part of it shades another."""
STEP = (*PLATE, Face(0.3, 0.35, -0.05, 0.05, 0.18))
"""The plate with a block on it, whose shadow falls on the plate."""


def depth_map(faces: tuple[Face, ...], cells: int) -> NDArray[np.float32]:
    """Depth (cells, cells) of whatever face is nearest to the wall; NaN for none."""
    x, y = np.meshgrid(*cell_centres_m(BOX, cells))
    depths = [np.where(face.covers(x, y), face.depth_m(x, y), np.nan) for face in faces]
    return np.fmin.reduce(depths).astype(np.float32)


def hidden(
    faces: tuple[Face, ...], cells: int, *, nearer_m: float = 0.0, radiometry: Radiometry = "lambertian"
) -> Scene:
    """The scene for our side; the changes are there to see whether the referee notices them."""
    return Scene(RIG, depth_map(faces, cells) - np.float32(nearer_m), radiometry=radiometry)
