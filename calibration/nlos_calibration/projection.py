"""Pinhole projection of the lidar: pixels to rays and back (no distortion: the L515's depth model has none)."""

from dataclasses import dataclass

import numpy as np

from nlos_calibration.arrays import Float64


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels, as librealsense gives them: (ppx, ppy) in pixel centres, x right, y down."""

    width: int
    height: int
    fx: float
    fy: float
    ppx: float
    ppy: float

    def scaled(self, width: int, height: int) -> "Intrinsics":
        """The same field of view at another resolution; pixel (0, 0) is centred on (0, 0), so edges are at -0.5."""
        sx, sy = width / self.width, height / self.height
        ppx, ppy = (self.ppx + 0.5) * sx - 0.5, (self.ppy + 0.5) * sy - 0.5
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, ppx, ppy)

    @property
    def matrix(self) -> Float64:
        """The same for OpenCV: (3, 3)."""
        return np.array([[self.fx, 0.0, self.ppx], [0.0, self.fy, self.ppy], [0.0, 0.0, 1.0]])

    def rays(self) -> Float64:
        """Rays (height, width, 3) in the lidar frame with unit z: a point is depth_m * ray."""
        x = (np.arange(self.width) - self.ppx) / self.fx
        y = (np.arange(self.height) - self.ppy) / self.fy
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.ones_like(grid_x)], axis=-1).astype(np.float64)
