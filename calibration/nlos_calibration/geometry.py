"""Wall frame, lidar frame, the pose between them, and pinhole rays of the lidar.

Wall frame: origin at the foot of the perpendicular from the lidar to the wall, z into the room, x =
the lidar's x axis projected on the wall, y = z cross x. Lidar frame: x right, y down, z along the
optical axis. A wall plane in the lidar frame (unit normal towards the lidar, distance) therefore
defines a complete pose. The pinhole has no distortion: the L515's depth model has none.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from nlos_calibration.arrays import Float64


def normal_from_angles(yaw_rad: float, pitch_rad: float) -> Float64:
    """Return the wall's normal (3,) in the lidar frame; positive yaw turns the axis to wall +x,
    positive pitch up.
    """
    return np.array(
        [
            np.sin(yaw_rad) * np.cos(pitch_rad),
            -np.sin(pitch_rad),
            -np.cos(yaw_rad) * np.cos(pitch_rad),
        ]
    )


def angles_from_normal(normal_lidar: Float64) -> tuple[float, float]:
    """Return (yaw_rad, pitch_rad) of a wall with the unit normal `normal_lidar` (3,) in the lidar
    frame.
    """
    x, y, z = normal_lidar
    return float(np.arctan2(x, -z)), float(np.arcsin(np.clip(-y, -1.0, 1.0)))


def plane_from_slopes(slopes: Float64) -> tuple[Float64, float]:
    """Return (normal (3,), distance_m) of the plane with `slopes` (3,) = -normal / distance_m."""
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    return -slopes * distance_m, distance_m


def plane_gradients(normal: Float64, distance_m: float) -> tuple[Float64, Float64]:
    """Return the derivatives of a plane's distance (3,) and normal (3, 3) with respect to its
    slopes.
    """
    # distance = 1 / |s|, so its gradient is -s / |s|^3 = distance^2 normal: only a change along the
    # normal moves it; normal = -s / |s|, so it turns by -distance times the part of the change
    # across the normal
    return distance_m**2 * normal, -distance_m * (np.eye(3) - np.outer(normal, normal))


def propagated_std(gradient: Float64, covariance: Float64) -> float:
    """Return sqrt(g' C g), to first order the standard uncertainty of a quantity with gradient g
    (n,).
    """
    return sqrt(max(float(gradient @ covariance @ gradient), 0.0))


def wall_from_plane(normal_lidar: Float64, distance_m: float) -> Float64:
    """Return the pose wall_from_lidar (4, 4) of a plane normal . p + distance_m = 0, the normal
    (3,) to the lidar.

    Raises ValueError where the lidar's x axis is the normal itself, which leaves the wall's x
    undefined.
    """
    # The rows of the rotation are the wall's axes in the lidar frame: z = normal, x = the lidar's x
    # without its component along z (one Gram-Schmidt step), y = z cross x. The lidar is at wall (0,
    # 0, distance).
    z_axis = normal_lidar / np.linalg.norm(normal_lidar)
    x_axis = np.array([1.0, 0.0, 0.0]) - z_axis[0] * z_axis
    if np.linalg.norm(x_axis) < 1e-9:
        message = (
            "the lidar's x axis is along the wall's normal: the wall frame's x is undefined; turn"
            " the lidar"
        )
        raise ValueError(message)
    x_axis /= np.linalg.norm(x_axis)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    pose[2, 3] = distance_m
    return pose


def facing_angle_rad(wall_from_lidar: Float64) -> float:
    """Return the angle between the optical axis and the wall's normal, from the pose (4, 4)."""
    return float(np.arccos(np.clip(-wall_from_lidar[2, 2], -1.0, 1.0)))


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels, as in librealsense: (ppx, ppy) in pixel centres, x right, y
    down.
    """

    width: int
    height: int
    fx: float
    fy: float
    ppx: float
    ppy: float

    def scaled(self, width: int, height: int) -> "Intrinsics":
        """Return the intrinsics of the same field of view at another resolution."""
        # pixel (0, 0) is centred on (0, 0), so the image's edge, which must stay, is at -0.5
        sx = width / self.width
        sy = height / self.height
        ppx = (self.ppx + 0.5) * sx - 0.5
        ppy = (self.ppy + 0.5) * sy - 0.5
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, ppx, ppy)

    @property
    def matrix(self) -> Float64:
        """OpenCV's camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.ppx], [0.0, self.fy, self.ppy], [0.0, 0.0, 1.0]])

    def rays(self) -> Float64:
        """Return rays (height, width, 3) in the lidar frame with unit z: a point is depth_m *
        ray.
        """
        x = (np.arange(self.width) - self.ppx) / self.fx
        y = (np.arange(self.height) - self.ppy) / self.fy
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1).astype(np.float64)
