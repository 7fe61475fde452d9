"""A scene at an accuracy: the facts that verdicts and jobs are made of, each worked out at most once."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from nlos_calibration import DeviceConstants, Rig
from nlos_calibration.arrays import Float64

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.energy_survey import EnergySurvey, survey
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, Beams, Relay, cast, gate_bins, occluder_edge, relay_cells
from nlos_cam.render.interreflection import share_of_more_bounces
from nlos_cam.render.job import TransportJob
from nlos_cam.render.line_of_sight import DirectVisibility, look
from nlos_cam.render.material import brdf_range
from nlos_cam.render.patches import Patches, clustered, coarser
from nlos_cam.render.scene import Scene
from nlos_cam.render.visibility import HeightField, height_field


@dataclass(frozen=True)
class SceneFacts:
    """The facts."""

    scene: Scene
    accuracy: Accuracy

    @property
    def albedo(self) -> Float64:
        """The albedo of every cell of the accuracy's grid, the mean of channels and block."""
        size, stride = len(self.depth_m), self.stride
        every = self.scene.surface.over((size * stride, size * stride)).mean(-1)
        return every.reshape(size, stride, size, stride).mean((1, 3))

    @property
    def lambertian(self) -> bool:
        """Whether the scene's radiometry is that of the rendering equation."""
        return self.scene.radiometry == "lambertian"

    @property
    def rig(self) -> Rig:
        """The scene's rig."""
        return self.scene.rig

    def beams(self, *, occluder: bool = True) -> Beams:
        """The beams before the object is looked at."""
        intrinsics = self.scene.intrinsics(self.accuracy.beams_per_cell)
        return cast(self.rig, intrinsics, lambertian=self.lambertian, occluder=occluder)

    @property
    def stride(self) -> int:
        """The accuracy's stride, where the depth map divides by it; else 1."""
        depth = self.scene.object_depth_m
        return 1 if depth is None or len(depth) % self.accuracy.object_stride else self.accuracy.object_stride

    @cached_property
    def depth_m(self) -> Float64:
        """The depth map on the accuracy's grid; (0, 0) where there is none."""
        depth = self.scene.object_depth_m
        if depth is None:
            return np.empty((0, 0))
        return coarser(depth.astype(np.float64), self.stride) if self.stride > 1 else depth.astype(np.float64)

    @cached_property
    def patches(self) -> Patches | None:
        """The patches; None where nothing is hidden inside the gate, or no beam lights the wall."""
        if np.isnan(self.depth_m).all() or not self.beams().on_wall.any():
            return None
        if 2 * np.nanmin(self.depth_m) >= SPEED_OF_LIGHT_M_PER_S * self.rig.device.gate_s:
            return None
        return self.patches_of(None)

    def patches_of(self, channel: int | None) -> Patches | None:
        """The patches with the albedo of one channel, None for the mean."""
        patches = self.scene.patches_of(channel)
        return clustered(patches, self.stride, len(self.depth_m)) if patches and self.stride > 1 else patches

    @cached_property
    def field(self) -> HeightField:
        """The depth map laid out for walking."""
        return height_field(self.depth_m, self.scene.box, shades=True)

    @cached_property
    def relay(self) -> Relay:
        """The whole relay wall, with nothing in front of it."""
        return relay_cells(self.rig, self.beams().lidar_m, self.accuracy.relay_columns, self.accuracy.relay_rows)

    @cached_property
    def _whole_job(self) -> TransportJob | None:
        """What is looked at for verdicts: every effect in, the whole relay wall."""
        if self.patches is None:
            return None
        return self.job(self.beams(), self.patches, self.relay, occluder_edge(self.rig), self.field)

    @cached_property
    def light(self) -> EnergySurvey | None:
        """The coarse look at the patches."""
        low, high = self.brdf_range
        return None if self._whole_job is None else survey(self._whole_job, high / max(low, 1e-9))

    @cached_property
    def brdf_range(self) -> tuple[float, float]:
        """The least and the largest value of the surface's BRDF."""
        brdf = self.scene.surface.brdf
        return (1.0, 1.0) if brdf is None else brdf_range(brdf)

    @cached_property
    def sight(self) -> DirectVisibility | None:
        """What of the object stands in the lidar's own sight; None where nothing does."""
        if np.isnan(self.depth_m).all():  # or there is none
            return None
        return look(self.beams(), self.relay, self.field, self.depth_m, self.scene.jump_m)

    @cached_property
    def more_bounces(self) -> float:
        """How much energy inter-reflection carries, against three bounces."""
        if self._whole_job is None or self.light is None:
            return 0.0
        return share_of_more_bounces(self._whole_job, self.light.taken, self.light.given)

    def job(
        self, beams: Beams, patches: Patches, relay: Relay, edge_m: tuple[float, float], field: HeightField
    ) -> TransportJob:
        """The three-bounce histograms of all beams that light the wall, as a job."""
        lit, device, wall = beams.on_wall, self.rig.device, self.rig.wall
        return TransportJob(
            foot_m=beams.foot_m[lit],
            length_m=beams.length_m[lit],
            cos_incidence=beams.cos_incidence[lit],
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
            map_foot_m=beams.foot_m[lit],
            wall_m=(wall.x_min_m, wall.x_max_m, wall.y_min_m, wall.y_max_m),
        )


def bins_of(beams: Beams, patches: Patches, relay: Relay, device: DeviceConstants) -> int:
    """Bins up to the gate or the longest three-bounce path: lengths are convex, longest at corners."""
    x, y, z = ((column.min(), column.max()) for column in patches.point_m.T)
    corners = np.array([(a, b, z[1]) for a in x for b in y])
    feet = beams.foot_m[beams.on_wall]
    there = beams.length_m[beams.on_wall, None] + np.linalg.norm(feet[:, None] - corners[None], axis=-1)
    ends = np.array(
        [(a, b, 0.0) for a in (relay.x_m.min(), relay.x_m.max()) for b in (relay.y_m.min(), relay.y_m.max())]
    )
    back = np.linalg.norm(ends - beams.lidar_m, axis=-1) + np.linalg.norm(ends[:, None] - corners[None], axis=-1).max(1)
    longest_bin = int((there.max() + back.max()) / device.bin_m)  # of a path on a bin's edge, the bin beyond it
    return min(longest_bin + 2, gate_bins(device))  # one to spare: the fast renderers round lengths
