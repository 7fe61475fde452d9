"""Agreement of echoes with the true ones: errors of intensity, bin and depth."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from nlos_calibration.arrays import Mask
from numpy.typing import NDArray

from nlos_cam.render.geometry import cast
from nlos_cam.render.renderer import Rendering
from nlos_cam.render.scene import Scene

Floating = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class EchoMaps:
    """Echoes to compare, one entry (n,) for each beam or each cell."""

    intensity: Floating
    path_m: Floating
    """NaN if nothing comes back."""
    depth_m: Floating
    """Depth that the lidar reports; NaN if nothing comes back."""

    @classmethod
    def of_beams(cls, rendering: Rendering) -> Self:
        """Return the strongest three-bounce bin of each beam: stricter than maps, in which a direct
        return may win.
        """
        multi = rendering.multi
        return cls(multi.peak.ravel(), multi.path_m.ravel(), rendering.depth_m.ravel())

    @classmethod
    def of_cells(cls, rendering: Rendering, scene: Scene) -> Self:
        """Return the maps (64, 80), for renderings with different numbers of beams per cell."""
        # The reported depth is along the camera's axis; the path is there and back along the beam.
        depth = rendering.depth_m.ravel()
        cos_axis = cast(scene.rig, scene.cell_intrinsics).cos_axis
        return cls(rendering.intensity.ravel(), 2 * depth / cos_axis, depth)

    def select(self, which: Mask) -> "EchoMaps":
        """Return the entries with True in a mask."""
        return EchoMaps(self.intensity[which], self.path_m[which], self.depth_m[which])


@dataclass(frozen=True)
class Agreement:
    """Difference of one rendering from another that is taken as the truth."""

    intensity_error_median: float
    """Relative."""
    intensity_error_p99: float
    intensity_error_max: float
    bin_exact: float
    """Share of echoes in the same bin of path length."""
    bin_within_1: float
    depth_error_mm: float
    """Median over the entries where both report a depth."""
    depth_error_mean_mm: float


def relative_error(found: Floating, truth: Floating) -> Floating:
    """Return |found - truth| / truth (n,); where the truth is 0, 0 if nothing was found and else
    1.
    """
    # Light where there should be none is wrong by all of it, whatever its amount.
    off = np.abs(found - truth)
    return np.divide(off, truth, out=(off > 0).astype(off.dtype), where=truth > 0)


def agreement(found: EchoMaps, truth: EchoMaps, bin_m: float) -> Agreement:
    """Return the agreement of echoes (at least one) with the true ones."""
    error = relative_error(found.intensity, truth.intensity)
    bins = np.abs(found.path_m - truth.path_m) / bin_m
    # Nothing in both agrees. NaN of one alone stays NaN, which is within no number of bins.
    bins[np.isnan(found.path_m) & np.isnan(truth.path_m)] = 0
    depth = 1000 * np.abs(found.depth_m - truth.depth_m)
    depth = depth[~np.isnan(depth)]
    return Agreement(
        intensity_error_median=float(np.median(error)),
        intensity_error_p99=float(np.quantile(error, 0.99)),
        intensity_error_max=float(error.max()),
        bin_exact=float((bins < 0.5).mean()),
        bin_within_1=float((bins < 1.5).mean()),
        depth_error_mm=float(np.median(depth)) if depth.size else 0.0,
        depth_error_mean_mm=float(depth.mean()) if depth.size else 0.0,
    )
