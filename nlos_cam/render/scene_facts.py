"""Facts of a scene at an accuracy, each computed at most once: the input of the effect plan."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from nlos_calibration import DeviceConstants, Rig
from nlos_calibration.arrays import Float64

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.energy_survey import EnergySurvey, survey
from nlos_cam.render.geometry import (
    SPEED_OF_LIGHT_M_PER_S,
    Beams,
    Relay,
    cast,
    gate_bins,
    occluder_edge,
    relay_cells,
)
from nlos_cam.render.interreflection import interreflection_share
from nlos_cam.render.job import TransportJob
from nlos_cam.render.line_of_sight import DirectVisibility, direct_visibility
from nlos_cam.render.material import brdf_range
from nlos_cam.render.patches import Patches, clustered, coarser
from nlos_cam.render.scene import Scene
from nlos_cam.render.visibility import HeightField, height_field


@dataclass(frozen=True)
class SceneFacts:
    """Scene and accuracy with everything that the plan of effects depends on, computed on first
    use.
    """

    scene: Scene
    accuracy: Accuracy

    @property
    def channels(self) -> Float64:
        """Albedo (rows, columns, channels) of the accuracy's grid: mean of each block of cells."""
        size = len(self.depth_m)
        stride = self.stride
        every = self.scene.surface.over((size * stride, size * stride))
        return every.reshape(size, stride, size, stride, -1).mean((1, 3))

    @property
    def albedo(self) -> Float64:
        """Albedo (rows, columns) of the accuracy's grid: mean of the channels and of each block of
        cells.
        """
        return self.channels.mean(-1)

    @property
    def lambertian(self) -> bool:
        """True for the radiometry of the rendering equation, False for the paper's."""
        return self.scene.radiometry == "lambertian"

    @property
    def rig(self) -> Rig:
        """Rig of the scene."""
        return self.scene.rig

    def beams(self, *, occluder: bool = True) -> Beams:
        """Return the beams as they land on occluder and wall, before the object stops any of
        them.
        """
        intrinsics = self.scene.intrinsics(self.accuracy.beams_per_cell)
        return cast(self.rig, intrinsics, lambertian=self.lambertian, occluder=occluder)

    @cached_property
    def stopped_by_occluder(self) -> int:
        """Number of beams that return from the occluder."""
        beams = self.beams()
        return int((~beams.on_wall & np.isfinite(beams.length_m)).sum())

    def without_occluder(self) -> "SceneFacts":
        """Return the facts of the same scene with the occluder taken away."""
        rig = self.rig.model_copy(update={"occluder": None})
        return replace(self, scene=replace(self.scene, rig=rig))

    @property
    def stride(self) -> int:
        """Cells along each axis that form one patch: as the accuracy has it if that divides the
        depth map; else 1.
        """
        depth = self.scene.object_depth_m
        accuracy = self.accuracy
        if depth is None:
            return 1
        finer = len(depth) // accuracy.finest_cells if accuracy.finest_cells else 1
        strides = accuracy.object_stride * max(finer, 1), accuracy.object_stride, 1
        # The first that divides the map: blocks must not reach beyond its edge. 1 always does.
        return next(stride for stride in strides if len(depth) % stride == 0)

    @cached_property
    def depth_m(self) -> Float64:
        """Depth map on the accuracy's grid; (0, 0) for a scene without an object."""
        depth = self.scene.object_depth_m
        if depth is None:
            return np.empty((0, 0))
        fine = depth.astype(np.float64)
        return coarser(fine, self.stride) if self.stride > 1 else fine

    @cached_property
    def patches(self) -> Patches | None:
        """Patches with the mean albedo; None if nothing is hidden inside the gate, or no beam
        lights the wall.
        """
        if np.isnan(self.depth_m).all() or not self.beams().on_wall.any():
            return None
        if not self.relay.x_m.size:
            return None
        # The shortest path of three bounces goes twice between wall and object: at least 2 z.
        if 2 * np.nanmin(self.depth_m) >= SPEED_OF_LIGHT_M_PER_S * self.rig.device.gate_s:
            return None
        return self.patches_of(None)

    def patches_of(self, channel: int | None) -> Patches | None:
        """Return the patches with the albedo of one channel; None for the mean of the channels."""
        patches = self.scene.patches_of(channel)
        return (
            clustered(patches, self.stride, len(self.depth_m))
            if patches and self.stride > 1
            else patches
        )

    @cached_property
    def field(self) -> HeightField:
        """Depth map laid out for walks along rays."""
        return height_field(self.depth_m, self.scene.box, shades=True)

    @cached_property
    def relay(self) -> Relay:
        """Relay wall with nothing in front of it: the cells that lie on the physical wall."""
        columns = self.accuracy.relay_columns
        cells = relay_cells(self.rig, self.beams().lidar_m, columns, self.accuracy.relay_rows)
        wall = self.rig.wall
        on_wall = (cells.x_m >= wall.x_min_m) & (cells.x_m <= wall.x_max_m)
        on_wall &= (cells.y_m >= wall.y_min_m) & (cells.y_m <= wall.y_max_m)
        return cells if on_wall.all() else cells.select(on_wall)

    @cached_property
    def _whole_job(self) -> TransportJob | None:
        """Transport with every effect included and the whole relay wall: the basis of the
        surveys.
        """
        if self.patches is None:
            return None
        return self.job(self.beams(), self.patches, self.relay, occluder_edge(self.rig), self.field)

    @cached_property
    def light(self) -> EnergySurvey | None:
        """Coarse survey of the light over each patch."""
        # The survey samples a coarse grid: a lobe can be brighter between its points by high / low.
        low, high = self.brdf_range
        return None if self._whole_job is None else survey(self._whole_job, high / max(low, 1e-9))

    @cached_property
    def brdf_range(self) -> tuple[float, float]:
        """Smallest and largest value of the surface's BRDF."""
        brdf = self.scene.surface.brdf
        return (1.0, 1.0) if brdf is None else brdf_range(brdf)

    @cached_property
    def line_of_sight(self) -> DirectVisibility | None:
        """Beams and relay cells that the object blocks from the lidar; None if it blocks none."""
        # An empty map has no surface: all() of nothing is True.
        if np.isnan(self.depth_m).all():
            return None
        return direct_visibility(
            self.beams(), self.relay, self.field, self.depth_m, self.scene.jump_m
        )

    @cached_property
    def interreflection(self) -> float:
        """Energy of one more bounce as a share of the energy of three bounces."""
        if self._whole_job is None or self.light is None:
            return 0.0
        return interreflection_share(self._whole_job, self.light.incident, self.light.returned)

    def job(
        self,
        beams: Beams,
        patches: Patches,
        relay: Relay,
        edge_m: tuple[float, float],
        field: HeightField,
    ) -> TransportJob:
        """Return the transport of all beams that light the wall over the patches to the relay
        cells.
        """
        spots, length, cosine = beams.lit
        device = self.rig.device
        wall = self.rig.wall
        return TransportJob(
            laser_spot_m=spots,
            length_m=length,
            cos_incidence=cosine,
            patches=patches,
            relay=relay,
            lidar_m=beams.lidar_m,
            edge_m=edge_m,
            field=field,
            lambertian=self.lambertian,
            receiver_cell_m2=device.receiver_cell_m2,
            bin_m=device.bin_m,
            bins=bins_of(beams, patches, relay, device),
            accuracy=self.accuracy,
            wall_m=(wall.x_min_m, wall.x_max_m, wall.y_min_m, wall.y_max_m),
        )


def bins_of(beams: Beams, patches: Patches, relay: Relay, device: DeviceConstants) -> int:
    """Return the number of bins up to the gate or the longest three-bounce path, whichever is
    less.
    """
    # The distance to a fixed point is a convex function, and so is a sum of two: over a box of
    # patches or a rectangle of relay cells it is largest at a corner. The far corners (largest z)
    # suffice, as the wall lies at z = 0.
    x, y, z = ((column.min(), column.max()) for column in patches.point_m.T)
    # d1 + d2 is convex over the wall as well: longest for a beam at the edge of the map.
    spots, length = beams.outermost
    ends = [
        (a, b)
        for a in (relay.x_m.min(), relay.x_m.max())
        for b in (relay.y_m.min(), relay.y_m.max())
    ]
    there = 0.0
    back = np.zeros(len(ends))
    for corner_x, corner_y in ((a, b) for a in x for b in y):
        to_corner = np.sqrt(
            (spots[:, 0] - corner_x) ** 2 + (spots[:, 1] - corner_y) ** 2 + z[1] ** 2
        )
        there = max(there, float((length + to_corner).max()))
        back = np.maximum(
            back, [np.sqrt((a - corner_x) ** 2 + (b - corner_y) ** 2 + z[1] ** 2) for a, b in ends]
        )
    back += [np.linalg.norm(np.subtract((*end, 0.0), beams.lidar_m)) for end in ends]
    # A path on a bin's edge lies in the bin beyond it; one more, as the fast backends round
    # lengths.
    longest_bin = int((there + back.max()) / device.bin_m)
    return min(longest_bin + 2, gate_bins(device))
