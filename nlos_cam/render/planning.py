"""What each effect would change in a scene: a bound and a reason, from the scene's facts alone.

A scene as its plan wants it: beams, relay wall and patches with the included effects, and the jobs made of them.
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Self

import numpy as np

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_ROWS
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.echoes import pulse_bins
from nlos_cam.render.effects import Effects, Plan, decide, included
from nlos_cam.render.energy_survey import CAUTION, occluder_meets, shaded
from nlos_cam.render.geometry import NO_OCCLUDER, Beams, Relay, gate_bins, occluder_edge, solid_angle
from nlos_cam.render.interreflection import AROUND_M
from nlos_cam.render.job import TransportJob
from nlos_cam.render.patches import Patches
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

Finding = tuple[str, float, str]
"""Name, bound and reason."""


def plan(stage: SceneFacts, effects: Effects = "auto") -> Plan:
    """The verdicts for a scene at an accuracy, in the order in which light meets the effects."""
    findings = [verdict(stage) for verdict in (_direct, _three_bounce, _line_of_sight, _occluder, _self_occlusion)]
    findings += [verdict(stage) for verdict in (_tilt, _brdf, _colour, _inter_reflection, _pulse)]
    return decide(findings, stage.accuracy.tolerance, effects)


def _direct(stage: SceneFacts) -> Finding:
    count = int((stage.beams().direct > 0).sum())
    return "direct", float(count > 0), f"{count} beams return from wall or occluder inside the gate"


def _three_bounce(stage: SceneFacts) -> Finding:
    if stage.patches is None:
        return "three-bounce", 0.0, "nothing is hidden inside the gate, or no beam lights the wall"
    return "three-bounce", 1.0, f"{len(stage.patches.beta)} patches lie inside the gate"


def _line_of_sight(stage: SceneFacts) -> Finding:
    if stage.sight is None:
        return "line-of-sight", 0.0, "no part of the object is in the lidar's sight"
    beams, cells = len(stage.sight.beam), int(stage.sight.hidden.sum())
    return "line-of-sight", 1.0, f"the object stops {beams} beams and hides {cells} relay cells"


def _occluder(stage: SceneFacts) -> Finding:
    if stage.rig.occluder is None:
        return "occluder", 0.0, "the rig has none"
    beams = stage.beams()
    met = int((~beams.on_wall & np.isfinite(beams.length_m)).sum())
    if met:
        return "occluder", 1.0, f"{met} beams return from it"
    if stage.patches is None or stage.light is None:
        return "occluder", 0.0, "no beam meets it, and nothing is hidden"
    if not occluder_meets(occluder_edge(stage.rig), stage.patches, beams, stage.relay):
        return "occluder", 0.0, "it stands in the way of no leg"
    return "occluder", max(stage.light.occluder, 1 / len(beams.length_m)), "legs cross it"


def _self_occlusion(stage: SceneFacts) -> Finding:
    if stage.patches is None or stage.light is None:
        return "self-occlusion", 0.0, "nothing to shade"
    behind = shaded(stage.patches, stage.field)
    if not behind.any():
        return "self-occlusion", 0.0, "the surface is its own lower convex hull"
    share = stage.light.share(stage.light.energy * behind)
    bound = min(share / (1 - share), 1.0) if share < 1 else 1.0  # of what is left when all of it is shaded
    return "self-occlusion", bound, f"{int(behind.sum())} of {len(behind)} patches have another rise above their plane"


def _tilt(stage: SceneFacts) -> Finding:
    if stage.patches is None or stage.light is None:
        return "tilt", 0.0, "nothing to tilt"
    steepest = sqrt(max(float(stage.patches.beta.max()) ** 2 - 1, 0.0))
    low, high = stage.brdf_range
    bound = stage.light.tilt if low == high else 1.0  # a lobe turns by twice the tilt, and away from where it was seen
    return "tilt", bound if steepest else 0.0, f"steepest slope {steepest:.3g}"


def _brdf(stage: SceneFacts) -> Finding:
    brdf = stage.scene.surface.brdf
    if stage.patches is None or brdf is None:
        return "brdf", 0.0, "the surface is Lambertian" if brdf is None else "nothing is hidden"
    low, high = stage.brdf_range
    cost = "tables for every direction that light comes from, some dozens times the cost"
    return (
        "brdf",
        min((high - low) / (2 * low), 1.0) if low > 0 else float(high > 0),  # the mean of both takes its place
        f"the BRDF runs from {low:.3g} to {high:.3g}: {cost}",
    )


def _colour(stage: SceneFacts) -> Finding:
    if stage.patches is None or not stage.scene.surface.coloured:
        return "colour", 0.0, "the albedo has one channel"
    albedo = np.asarray(stage.scene.surface.albedo, np.float64)
    grey = albedo.mean(-1, keepdims=True)
    apart = float((np.abs(albedo - grey).max(-1) / np.where(grey > 0, grey, 1)[..., 0]).max())
    return "colour", min(apart, 1.0), f"channels differ by up to {apart:.3g} of their mean"


def _inter_reflection(stage: SceneFacts) -> Finding:
    if stage.patches is None:
        return "inter-reflection", 0.0, "nothing is hidden"
    if not stage.lambertian:
        return "inter-reflection", 0.0, "S1 to S5 leave higher orders out; lambertian radiometry decides by their share"
    share = CAUTION * stage.more_bounces
    return "inter-reflection", min(share, 1.0), f"five bounces and object to object carry up to {share:.3g} of three"


def _pulse(stage: SceneFacts) -> Finding:
    if stage.scene.pulse_ns == 0:
        return "pulse", 0.0, "the pulse has no width"
    sigma = pulse_bins(stage.scene.pulse_ns, stage.rig.device.bin_m)
    return "pulse", min(4 * sigma, 1.0), f"{stage.scene.pulse_ns:g} ns spread an echo by {sigma:.3g} bins"


MAX_BYTES = 4 << 30
"""Of histograms: more than this is refused before it is tried."""


@dataclass(frozen=True)
class Prepared:
    """A plan carried out up to the histograms."""

    stage: SceneFacts
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
        stage = SceneFacts(scene, accuracy)
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

    def job(self, channel: int | None = None) -> TransportJob | None:
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

    def _of_rows(self, job: TransportJob) -> TransportJob:
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

    def _bins_with_detours(self, job: TransportJob) -> int:
        """By way of another patch, or of the wall about it, a path is longer by at most twice across that wall."""
        most = 2 * np.linalg.norm(np.ptp(job.patches.point_m, axis=0) + 2 * AROUND_M)
        return min(job.bins + int(np.ceil(most / job.bin_m)), gate_bins(self.stage.rig.device))


def _refuse_too_large(job: TransportJob) -> None:
    """Raise SceneError where the histograms alone would take more than MAX_BYTES."""
    size = len(job.foot_m) * job.bins * (8 if job.accuracy.sub_bins == 0 else 4)
    if size > MAX_BYTES:
        raise SceneError(
            f"{len(job.foot_m)} beams of {job.bins} bins need {size / 2**30:.1f} GiB, at most {MAX_BYTES >> 30}: "
            f"lower beams_per_cell ({job.accuracy.beams_per_cell}), widen bin_m ({job.bin_m:g}) or shorten gate_s"
        )
