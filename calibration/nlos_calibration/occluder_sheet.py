"""What stands before the wall in a lidar's view, and the plane of it in the wall frame."""

from dataclasses import dataclass
from math import degrees, hypot

import cv2
import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.plane import GATE_SIGMAS, PlaneFit, fit_depth, plane_depth_m
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_noise import MeanNoise, depth_noise_m
from nlos_calibration.ripples import ripples

WALL_BAND_M = 0.004
"""What the wall's own pose and the lidar's ripples may put a point of it off the plane, beside noise."""
NEIGHBOURS = 4.5 / 9.0
"""Of a pixel and those around it, more than this share must stand out with it: scattered outliers do not."""


@dataclass(frozen=True)
class Scene:
    """What the lidar saw, by the wall's plane."""

    depth_m: Float64
    """(height, width); NaN is no return."""
    sigma_m: Float64
    """(height, width); the noise of one sample there, since ripples do not fall with the number of samples."""
    rays: Float64
    """(height, width, 3); of unit depth, in the lidar frame."""
    pose: Float64
    """wall_from_lidar (4, 4)."""
    near: Mask
    """Pixels in front of the wall, together with their neighbours."""
    passed: Mask
    """Pixels on the wall, or behind it: nothing before the wall stopped them."""
    behind_share: float
    """Of the depths, those behind the wall."""

    @property
    def direction(self) -> Float64:
        """The rays in the wall frame."""
        return self.rays @ self.pose[:3, :3].T


@dataclass(frozen=True)
class SheetFit:
    """A plane normal . p = 1 + normal . lidar_m in the wall frame, read as x = x_m + lean z + twist y."""

    plane: PlaneFit
    uneven_m: float
    """RMS of the deviation of parts of it from the plane, beyond noise."""
    normal: Float64
    """(3,)."""
    covariance: Float64
    """(3, 3) of `normal`."""
    lidar_m: Float64
    """(3,)."""

    @property
    def lean(self) -> float:
        """Positive where x grows with z."""
        return float(-self.normal[2] / self.normal[0])

    @property
    def lean_std(self) -> float:
        """How surely."""
        return self._std(np.array([-self.lean, 0.0, -1.0]) / self.normal[0])

    @property
    def twist(self) -> float:
        """Positive where x grows with y."""
        return float(-self.normal[1] / self.normal[0])

    @property
    def tilt_deg(self) -> float:
        """Against the plane x = const, whichever way."""
        return degrees(np.arctan2(hypot(self.normal[1], self.normal[2]), abs(self.normal[0])))

    @property
    def tilt_std_deg(self) -> float:
        """How surely, at most."""
        twist_std = self._std(np.array([-self.twist, -1.0, 0.0]) / self.normal[0])
        return degrees(hypot(self.lean_std, twist_std))

    def x_m(self, z_m: float) -> float:
        """Of the plane at a height over the wall and y = 0."""
        return float((1.0 + self.normal @ self.lidar_m - self.normal[2] * z_m) / self.normal[0])

    def x_std_m(self, z_m: float) -> float:
        """How surely."""
        return self._std((self.lidar_m - np.array([self.x_m(z_m), 0.0, z_m])) / self.normal[0])

    def _std(self, gradient: Float64) -> float:
        return float(np.sqrt(max(gradient @ self.covariance @ gradient, 0.0)))

    def met_m(self, scene: Scene) -> Float64:
        """Where each ray meets the plane (height, width, 3), far away where it never does."""
        return scene.pose[:3, 3] + scene.direction * self._depth_m(scene)[..., np.newaxis]

    def met_by(self, scene: Scene) -> Mask:
        """The pixels that may be points of the plane, by their depth (height, width)."""
        return np.abs(scene.depth_m - self._depth_m(scene)) <= GATE_SIGMAS * scene.sigma_m

    def _depth_m(self, scene: Scene) -> Float64:
        return plane_depth_m(scene.rays, self.plane.slopes)


def look(depth_m: Float64, noise: MeanNoise, intrinsics: Intrinsics, pose: Float64) -> Scene:
    """Each pixel before the wall, on it or behind it, by more than noise and the wall's own error explain."""
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan)
    rays = intrinsics.rays()
    along = rays @ pose[2, :3]
    sigma_m = max(noise.scale, 1.0) * depth_noise_m(depth_m)
    height_m, band_m = pose[2, 3] + depth_m * along, WALL_BAND_M + GATE_SIGMAS * sigma_m * np.abs(along)
    near = (height_m > band_m).astype(np.float32)
    together = cv2.boxFilter(near, -1, (3, 3), borderType=cv2.BORDER_REPLICATE) > NEIGHBOURS
    behind = float((height_m < -band_m).sum() / max(int(np.isfinite(depth_m).sum()), 1))
    return Scene(depth_m, sigma_m, rays, pose, (near > 0) & together, height_m <= band_m, behind)


def fit_sheet(scene: Scene, noise: MeanNoise, generator: np.random.Generator) -> SheetFit:
    """The plane of most of what stands before the wall. Raises WallRefusedError where there is none."""
    near_m = np.where(scene.near, scene.depth_m, np.nan)
    plane = fit_depth(scene.rays.reshape(-1, 3), near_m.ravel(), generator, noise, min_extent=0.0)
    turn, rippled = scene.pose[:3, :3], ripples(plane, scene.rays)
    covariance = turn @ rippled.covariance @ turn.T
    return SheetFit(plane, rippled.rms_m, turn @ plane.slopes, covariance, scene.pose[:3, 3])
