"""Scene at one instant: rig, depth map of the hidden object, its surface, and the radiometry."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from nlos_calibration import Intrinsics, ObjectBox, Rig
from nlos_calibration.arrays import Float32

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS
from nlos_cam.objects import JUMP_M, object_box
from nlos_cam.render.material import Surface
from nlos_cam.render.patches import Patches, make_patches

Radiometry = Literal["paper", "lambertian"]
""""paper" is S1 to S5 to the letter, "lambertian" the rendering equation with every cosine for the
same paths.
"""
MAX_PULSE_NS = 100
FINEST_GRID = 256
"""Cells along a side of a depth map: sixteen times the default's number, and tables of some
gigabytes in `fine`.
"""


@dataclass(frozen=True, eq=False)  # arrays have no single truth value
class Scene:
    """Scene at one instant. Raises SceneError if the object cannot be rendered."""

    rig: Rig
    object_depth_m: Float32 | None = None
    """(n, n) over the rig's object box, NaN for background; None hides nothing."""
    surface: Surface = field(default_factory=Surface)
    radiometry: Radiometry = "paper"
    jump_m: float = JUMP_M
    """Neighbors farther apart in depth than this are separate surfaces."""
    pulse_ns: float = 0.0
    """Full width of the laser's pulse at half maximum; 1 ns is 0.3 m of path. 0 is no width."""

    def __post_init__(self) -> None:
        if self.radiometry not in get_args(Radiometry):
            raise SceneError(
                f"no radiometry {self.radiometry!r}: choose one of"
                f" {', '.join(get_args(Radiometry))}"
            )
        if not 0 <= self.jump_m < np.inf:
            raise SceneError(f"jump_m is {self.jump_m}: it must be finite and at least 0")
        if not 0 <= self.pulse_ns <= MAX_PULSE_NS:
            raise SceneError(
                f"pulse_ns is {self.pulse_ns}: give 0 to {MAX_PULSE_NS} (30 m of path)"
            )
        if self.object_depth_m is not None:
            _check_depth(self.object_depth_m)
            self.surface.over(self.object_depth_m.shape)
            _ = self.box  # refuse a rig that has none

    def intrinsics(self, beams_per_cell: int = 1) -> Intrinsics:
        """Return intrinsics with beams_per_cell x beams_per_cell beams, evenly spread over each map
        cell.
        """
        return self.rig.pinhole.scaled(MAP_COLUMNS * beams_per_cell, MAP_ROWS * beams_per_cell)

    @property
    def cell_intrinsics(self) -> Intrinsics:
        """Intrinsics with one beam through the center of each map cell."""
        return self.intrinsics()

    @property
    def box(self) -> ObjectBox:
        """Object box of the rig. Raises SceneError if it has none."""
        return object_box(self.rig)

    @property
    def patches(self) -> Patches | None:
        """Hidden surface as patches with the mean albedo of the channels; None if nothing is
        hidden.
        """
        return self.patches_of(None)

    def patches_of(self, channel: int | None) -> Patches | None:
        """Return the patches with the albedo of one channel, None for the mean; None if nothing is
        hidden.
        """
        if self.object_depth_m is None or np.isnan(self.object_depth_m).all():
            return None
        # Light of three bounces is linear in albedo: the mean of the channels renders their mean.
        every = self.surface.over(self.object_depth_m.shape)
        albedo = every.mean(-1) if channel is None else every[..., channel]
        return make_patches(self.object_depth_m.astype(np.float64), self.box, albedo, self.jump_m)


def _check_depth(depth: Float32) -> None:
    if not isinstance(depth, np.ndarray):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(
            f"object depth is a {type(depth).__name__}: give an array, as numpy.array makes it"
        )
    if depth.ndim != 2 or depth.shape[0] != depth.shape[1] or not 1 <= len(depth) <= FINEST_GRID:
        raise SceneError(
            f"object depth has shape {depth.shape}: it must be (n, n) with n from 1 to"
            f" {FINEST_GRID}"
        )
    if not np.issubdtype(depth.dtype, np.floating):
        raise SceneError(
            f"object depth has type {depth.dtype}: use floating point, with NaN for background"
        )
    # The wall is z = 0: what lies behind it no light reaches.
    surface = depth[~np.isnan(depth)]
    if surface.size and not (np.isfinite(surface).all() and surface.min() >= 0):
        where = "behind the wall" if surface.min() < 0 else "not finite"
        raise SceneError(
            f"object depth ranges from {surface.min():.3g} to {surface.max():.3g} m, {where}: every"
            " surface must be finite and at least 0 m off the wall (use NaN for background)"
        )
