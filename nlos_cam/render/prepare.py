"""A scene as its plan wants it: beams, relay wall and patches with the included effects, and the jobs made of them."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_ROWS
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.beams import Beams, gate_bins
from nlos_cam.render.between import AROUND_M
from nlos_cam.render.effects import Effects, Plan, included
from nlos_cam.render.findings import plan
from nlos_cam.render.job import Job
from nlos_cam.render.near import solid_angle
from nlos_cam.render.patches import Patches
from nlos_cam.render.relay import NO_OCCLUDER, Relay, occluder_edge
from nlos_cam.render.scene import Scene
from nlos_cam.render.stage import Stage

Array = NDArray[np.float64]

MOST_BYTES = 4 << 30
"""Of histograms: more than this is refused before it is tried."""


@dataclass(frozen=True)
class Prepared:
    """A plan carried out up to the histograms."""

    stage: Stage
    plan: Plan
    beams: Beams
    """Those of the rows that are wanted."""
    first_beam: int
    map_beams: Beams
    """Of the whole map: what is told from all beams does not depend on the rows."""
    relay: Relay
    edge_m: tuple[float, float]
    channels: int

    @classmethod
    def of(cls, scene: Scene, accuracy: Accuracy, effects: Effects, rows: tuple[int, int] | None = None) -> Self:
        """Plan a scene and apply what the plan says of beams and wall; keep the beams of some rows of the map."""
        stage = Stage(scene, accuracy)
        verdicts = plan(stage, effects)
        stands = included(verdicts, "occluder")
        edge = occluder_edge(scene.rig) if stands else NO_OCCLUDER
        beams = stage.beams(occluder=stands)
        hidden = stage.relay.behind(edge, beams.lidar_m)
        if included(verdicts, "line-of-sight") and (sight := stage.sight) is not None:
            albedo = stage.albedo[sight.row, sight.column]
            spread = solid_angle(lambertian=stage.lambertian)
            beams = beams.met(scene.rig, sight.beam, sight.length_m, sight.cosine, albedo, spread)
            hidden |= sight.hidden
        if not included(verdicts, "direct"):
            beams = beams.without_direct()
        start, end = (row * accuracy.beams_per_cell for row in rows or (0, MAP_ROWS))
        part, first = beams.of_rows(start, end), start * beams.shape[1]
        coloured = scene.surface.coloured and included(verdicts, "colour")
        return cls(stage, verdicts, part, first, beams, stage.relay.kept(~hidden), edge, 3 if coloured else 1)

    def job(self, channel: int | None = None) -> Job | None:
        """The job of one channel of the albedo, or of their mean; None where no three-bounce path is wanted."""
        wanted = included(self.plan, "three-bounce")
        if not (wanted and self.relay.x_m.size and self.beams.on_wall.any()):
            return None
        if (patches := self._patches(channel)) is None:
            return None
        field = self.stage.field._replace(shades=included(self.plan, "self-occlusion"))
        job = self.stage.job(self.map_beams, patches, self.relay, self.edge_m, field)
        if included(self.plan, "brdf"):
            job = replace(job, brdf=self.stage.scene.surface.brdf)
        if included(self.plan, "inter-reflection"):
            job = replace(job, more_bounces=True, bins=self._bins_with_detours(job))
        job = self._of_rows(job)
        _refuse_too_large(job)
        return job

    def _of_rows(self, job: Job) -> Job:
        lit = np.flatnonzero(self.map_beams.on_wall)
        wanted = (lit >= self.first_beam) & (lit < self.first_beam + len(self.beams.on_wall))
        return job if wanted.all() else job.some(np.flatnonzero(wanted))

    def _patches(self, channel: int | None) -> Patches | None:
        stage, surface = self.stage, self.stage.scene.surface
        patches = stage.patches if channel is None or stage.patches is None else stage.patches_of(channel)
        if patches is not None and not included(self.plan, "tilt"):
            patches = patches.level()
        if patches is not None and surface.brdf is not None and not included(self.plan, "brdf"):
            patches = replace(patches, albedo=patches.albedo * np.mean(stage.brdf_range))
        return patches

    def _bins_with_detours(self, job: Job) -> int:
        """By way of another patch, or of the wall about it, a path is longer by at most twice across that wall."""
        most = 2 * np.linalg.norm(np.ptp(job.patches.point_m, axis=0) + 2 * AROUND_M)
        return min(job.bins + int(np.ceil(most / job.bin_m)), gate_bins(self.stage.rig.device))


def _refuse_too_large(job: Job) -> None:
    """Raise SceneError where the histograms alone would take more than MOST_BYTES."""
    size = len(job.foot_m) * job.bins * (8 if job.accuracy.sub_bins == 0 else 4)
    if size > MOST_BYTES:
        raise SceneError(
            f"{len(job.foot_m)} beams of {job.bins} bins need {size / 2**30:.1f} GiB, at most {MOST_BYTES >> 30}: "
            f"lower beams_per_cell ({job.accuracy.beams_per_cell}), widen bin_m ({job.bin_m:g}) or shorten gate_s"
        )
