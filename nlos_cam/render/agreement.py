"""How far one rendering of a scene is from another, echo by echo."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from nlos_cam.render.beams import cast
from nlos_cam.render.renderer import Rendering
from nlos_cam.render.scene import Scene

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Echoes:
    """What is compared, one entry (n,) for each beam or each cell."""

    intensity: Array
    path_m: Array
    """NaN where nothing comes back."""
    depth_m: Array
    """What the lidar reports; NaN where nothing comes back."""

    @classmethod
    def of_beams(cls, rendering: Rendering) -> Self:
        """The strongest three-bounce bin of each beam, one per cell: stricter than maps, which a direct one may win."""
        multi = rendering.multi
        return cls(multi.peak.ravel(), multi.path_m.ravel(), rendering.depth_m.ravel())

    @classmethod
    def of_cells(cls, rendering: Rendering, scene: Scene) -> Self:
        """The maps (64, 80), for renderings with different numbers of beams per cell."""
        depth = rendering.depth_m.ravel()
        cos_axis = cast(scene.rig, scene.cell_intrinsics).cos_axis
        return cls(rendering.intensity.ravel(), 2 * depth / cos_axis, depth)

    def some(self, which: Mask) -> "Echoes":
        """Only some of them."""
        return Echoes(self.intensity[which], self.path_m[which], self.depth_m[which])


@dataclass(frozen=True)
class Agreement:
    """One rendering against another that is taken to be the truth."""

    intensity_error_median: float
    """Relative."""
    intensity_error_p99: float
    intensity_error_max: float
    bin_exact: float
    """Share of echoes in the same bin of path length."""
    bin_within_1: float
    depth_error_mm: float
    """Median, where both report a depth."""
    depth_error_mean_mm: float


def relative_error(found: Array, truth: Array) -> Array:
    """|found - truth| / truth (n,); where nothing should come back, 0 if nothing does and else 1."""
    off = np.abs(found - truth)
    return np.divide(off, truth, out=(off > 0).astype(off.dtype), where=truth > 0)


def agreement(found: Echoes, truth: Echoes, bin_m: float) -> Agreement:
    """Hold echoes (at least one) against the true ones."""
    error = relative_error(found.intensity, truth.intensity)
    bins = np.abs(found.path_m - truth.path_m) / bin_m
    bins[np.isnan(found.path_m) & np.isnan(truth.path_m)] = 0  # NaN of one alone is in no bin of the other
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
