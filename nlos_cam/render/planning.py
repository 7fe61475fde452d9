"""Plan of effects, and the render problem that results when the plan is applied to a scene.

Each finding bounds the relative change (L1) of the transient if its effect is left out, from the
scene's facts alone.
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Self

import numpy as np
from nlos_calibration.arrays import Float64, Mask

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_ROWS
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.echoes import pulse_bins, pulse_tail
from nlos_cam.render.effects import Effects, Plan, decide, included, requested
from nlos_cam.render.energy_survey import CAUTION, occluder_meets, shaded
from nlos_cam.render.geometry import (
    NO_OCCLUDER,
    Beams,
    Relay,
    gate_bins,
    occluder_edge,
    solid_angle,
)
from nlos_cam.render.interreflection import longest_detour_m
from nlos_cam.render.job import TransportJob
from nlos_cam.render.line_of_sight import DirectVisibility
from nlos_cam.render.material import Surface, without_lobe
from nlos_cam.render.patches import Patches
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

Finding = tuple[str, float, str]
"""Name, bound and reason."""


def plan(facts: SceneFacts, effects: Effects = "auto") -> Plan:
    """Return the verdicts on all effects, in the order in which light meets them."""
    findings = [finding(facts) for finding in FINDINGS]
    return decide(findings, facts.accuracy.tolerance, effects)


def _direct(facts: SceneFacts) -> Finding:
    count = int((facts.beams().direct > 0).sum())
    return "direct", float(count > 0), f"{count} beams return from wall or occluder inside the gate"


def _three_bounce(facts: SceneFacts) -> Finding:
    if facts.patches is None:
        return "three-bounce", 0.0, "nothing is hidden inside the gate, or no beam lights the wall"
    return "three-bounce", 1.0, f"{len(facts.patches.beta)} patches lie inside the gate"


def _line_of_sight(facts: SceneFacts) -> Finding:
    if facts.line_of_sight is None:
        return "line-of-sight", 0.0, "no part of the object is visible to the lidar"
    beams = len(facts.line_of_sight.beam)
    cells = int(facts.line_of_sight.hidden.sum())
    return "line-of-sight", 1.0, f"the object stops {beams} beams and hides {cells} relay cells"


def _occluder(facts: SceneFacts) -> Finding:
    if facts.rig.occluder is None:
        return "occluder", 0.0, "the rig has none"
    beams = facts.beams()
    if stopped := facts.stopped_by_occluder:
        return "occluder", 1.0, f"{stopped} beams return from it"
    if facts.patches is None or facts.light is None:
        return "occluder", 0.0, "no beam meets it, and nothing is hidden"
    if not occluder_meets(occluder_edge(facts.rig), facts.patches, beams, facts.relay):
        return "occluder", 0.0, "it blocks no leg"
    # The survey samples points of the wall and may miss a thin shadow: one beam's share is the
    # least that may be lost.
    return "occluder", max(facts.light.occluder, 1 / len(beams.length_m)), "legs cross it"


def _self_occlusion(facts: SceneFacts) -> Finding:
    if facts.patches is None or facts.light is None:
        return "self-occlusion", 0.0, "nothing to shade"
    behind = shaded(facts.patches, facts.field)
    if not behind.any():
        return "self-occlusion", 0.0, "the surface is its own lower convex hull"
    # The share is of the unshaded energy E; at worst all of it is lost, and the true energy is E (1
    # - share).
    share = facts.light.share(facts.light.energy * behind)
    bound = min(share / (1 - share), 1.0) if share < 1 else 1.0
    return (
        "self-occlusion",
        bound,
        f"{int(behind.sum())} of {len(behind)} patches have another above their plane",
    )


def _tilt(facts: SceneFacts) -> Finding:
    if facts.patches is None or facts.light is None:
        return "tilt", 0.0, "nothing to tilt"
    steepest = sqrt(max(float(facts.patches.beta.max()) ** 2 - 1, 0.0))  # beta^2 = 1 + slope^2 (S3)
    low, high = facts.brdf_range
    # A lobe turns by twice the tilt, even out of view, which the cosines of the survey do not show:
    # no bound but 1.
    bound = facts.light.tilt if low == high else 1.0
    return "tilt", bound if steepest else 0.0, f"steepest slope {steepest:.3g}"


def _brdf(facts: SceneFacts) -> Finding:
    brdf = facts.scene.surface.brdf
    if facts.patches is None or brdf is None:
        return "brdf", 0.0, "the surface is Lambertian" if brdf is None else "nothing is hidden"
    low, high = facts.brdf_range
    # Without the effect a matt surface of value m replaces the BRDF f: |f - m| / f is largest at
    # one of its ends.
    matt = without_lobe(brdf)
    bound = max(abs(matt / low - 1), abs(matt / high - 1)) if low > 0 else float(high > 0)
    bound = min(bound, 1.0)
    cost = "needs tables for a lattice of directions, 20 times the cost and more"
    return "brdf", bound, f"the BRDF ranges from {low:.3g} to {high:.3g}: {cost}"


def _color(facts: SceneFacts) -> Finding:
    if facts.patches is None or not facts.scene.surface.colored:
        return "colour", 0.0, "the albedo has one channel"
    albedo = np.asarray(facts.scene.surface.albedo, np.float64)
    # Light of three bounces is linear in albedo: with the mean in place of a channel, each patch
    # errs by |channel - mean| / mean, and a sum of patches by no more than the worst of them.
    grey = albedo.mean(-1, keepdims=True)
    apart = float((np.abs(albedo - grey).max(-1) / np.where(grey > 0, grey, 1)[..., 0]).max())
    return "colour", min(apart, 1.0), f"channels differ by up to {apart:.3g} of their mean"


def _interreflection(facts: SceneFacts) -> Finding:
    if facts.patches is None:
        return "inter-reflection", 0.0, "nothing is hidden"
    if not facts.lambertian:
        return (
            "inter-reflection",
            0.0,
            "S1 to S5 have no higher orders; only lambertian radiometry includes them",
        )
    # Light that meets the object twice is quadratic in albedo: its share is that of the brightest
    # channel.
    grey = facts.albedo
    brightest = facts.channels.max(-1)
    brighter = np.max(brightest / np.where(grey > 0, grey, 1), initial=1.0)
    share = CAUTION * facts.interreflection * float(brighter)
    return (
        "inter-reflection",
        min(share, 1.0),
        f"five bounces and object to object carry up to {share:.3g} of three",
    )


def _pulse(facts: SceneFacts) -> Finding:
    if facts.scene.pulse_ns == 0:
        return "pulse", 0.0, "the pulse has no width"
    sigma = pulse_bins(facts.scene.pulse_ns, facts.rig.device.bin_m)
    # A Gaussian moves a share of about sigma / bin of an echo over each edge of its bin; L1 counts
    # it on both sides.
    return (
        "pulse",
        min(4 * sigma, 1.0),
        f"{facts.scene.pulse_ns:g} ns spread an echo by {sigma:.3g} bins",
    )


FINDINGS = (
    _direct,
    _three_bounce,
    _line_of_sight,
    _occluder,
    _self_occlusion,
    _tilt,
    _brdf,
    _color,
    _interreflection,
    _pulse,
)
MAX_BYTES = 4 << 30
"""Largest histograms, in bytes, that are tried at all."""


@dataclass(frozen=True)
class RenderProblem:
    """Scene with its plan applied: all that transport, echoes and maps need, handed forward as one
    value.
    """

    scene: Scene
    accuracy: Accuracy
    plan: Plan
    beams: Beams
    """Beams of the rows to render."""
    job: TransportJob | None
    """Three-bounce transport with the mean albedo, for the beams that light the wall; None if no
    path is possible.
    """
    color_jobs: tuple[TransportJob | None, ...]
    """The same for red, green and blue if the plan includes color; else empty."""
    tint: Float64 | None = None
    """(n, 3); direct return of each beam in red, green and blue, relative to the mean; None where
    all of them return from something white."""
    stopped: Mask | None = None
    """(n,); True for beams that the object stops; None where it stops none."""

    @classmethod
    def of(cls, facts: SceneFacts, verdicts: Plan, rows: tuple[int, int] | None = None) -> Self:
        """Apply a plan to beams, wall and patches, for some rows of the map. Raises SceneError if
        it is too large.
        """
        scene = facts.scene
        per_cell = facts.accuracy.beams_per_cell
        with_occluder = included(verdicts, "occluder")
        # What is left out is left out everywhere: beams, relay cells and legs see the same edge. An
        # occluder that no beam meets has no part in the facts themselves.
        if not with_occluder and facts.stopped_by_occluder:
            facts = facts.without_occluder()
        edge_m = occluder_edge(scene.rig) if with_occluder else NO_OCCLUDER
        beams = facts.beams(occluder=with_occluder)
        hidden = facts.relay.behind(edge_m, beams.lidar_m)
        tint = None
        stopped = None
        if included(verdicts, "line-of-sight") and (blocked := facts.line_of_sight) is not None:
            albedo = facts.albedo[blocked.row, blocked.column] * _returned_by(
                scene.surface, blocked, with_brdf=included(verdicts, "brdf")
            )
            solid = solid_angle(lambertian=facts.lambertian)
            beams = beams.with_hits(
                scene.rig, blocked.beam, blocked.length_m, blocked.cosine, albedo, solid
            )
            hidden |= blocked.hidden
            tint = _tint(facts, blocked, len(beams.direct))
            stopped = np.zeros_like(beams.on_wall)
            stopped[blocked.beam] = True
        if not included(verdicts, "direct"):
            beams = beams.without_direct()
        relay = facts.relay.select(~hidden)
        start, end = (row * per_cell for row in rows or (0, MAP_ROWS))
        colored = scene.surface.colored and included(verdicts, "colour")
        jobs = [
            _job(facts, verdicts, beams, (start, end), relay, edge_m, channel)
            for channel in (None, *range(3 if colored else 0))
        ]
        wanted = slice(start * beams.shape[1], end * beams.shape[1])
        return cls(
            scene,
            facts.accuracy,
            verdicts,
            beams.rows(start, end),
            jobs[0],
            tuple(jobs[1:]),
            tint=None if tint is None else tint[wanted],
            stopped=None if stopped is None else stopped[wanted],
        )

    @property
    def mixes_colors(self) -> bool:
        """True where the mean albedo does not render the channels' mean: light that meets the
        object twice is quadratic in albedo.
        """
        return bool(self.color_jobs) and self.includes("inter-reflection")

    @property
    def channels(self) -> list[Self]:
        """The problems of red, green and blue light alone, with their transport and their direct
        returns, if the plan includes color; else none.
        """
        found: list[Self] = []
        for channel, job in enumerate(self.color_jobs):
            beams = self.beams
            if self.tint is not None:
                beams = replace(beams, direct=beams.direct * self.tint[:, channel])
            found.append(replace(self, beams=beams, job=job, color_jobs=(), tint=None))
        return found

    def includes(self, effect: str) -> bool:
        """Return whether the plan includes an effect."""
        return included(self.plan, effect)


def prepare(
    scene: Scene, accuracy: Accuracy, effects: Effects = "auto", *, bounded: bool = True
) -> RenderProblem:
    """Return the render problem of a scene with the effects that it calls for, or exactly those
    named.

    Bounds of named effects can take longer than the transport; without `bounded` they are NaN.
    """
    facts = SceneFacts(scene, accuracy)
    if bounded or effects == "auto":
        verdicts = plan(facts, effects)
    else:
        verdicts = requested(effects)
    return RenderProblem.of(facts, verdicts)


def _job(
    facts: SceneFacts,
    verdicts: Plan,
    beams: Beams,
    rows: tuple[int, int],
    relay: Relay,
    edge_m: tuple[float, float],
    channel: int | None,
) -> TransportJob | None:
    """Return the transport of the beams in some rows with the albedo of one channel, or with the
    mean of all.

    Bins come from the beams of the whole map, so that they do not depend on the rows.
    """
    # Rows of the image are runs of the flattened beams.
    ends = (row * beams.shape[1] for row in rows)
    wanted = np.zeros_like(beams.on_wall)
    wanted[slice(*ends)] = True
    if not (
        included(verdicts, "three-bounce") and relay.x_m.size and (beams.on_wall & wanted).any()
    ):
        return None
    if (patches := _patches(facts, verdicts, channel)) is None:
        return None
    field = facts.field._replace(shades=included(verdicts, "self-occlusion"))
    job = facts.job(beams, patches, relay, edge_m, field)
    if included(verdicts, "brdf"):
        job = replace(job, brdf=facts.scene.surface.brdf)
    if included(verdicts, "inter-reflection"):
        longer = int(np.ceil(longest_detour_m(patches.point_m) / job.bin_m))
        bins = min(job.bins + longer, gate_bins(facts.rig.device))
        job = replace(job, more_bounces=True, bins=bins)
    if not wanted.all():
        job = job.select(np.flatnonzero(wanted[beams.on_wall]))
    bins = job.bins
    if included(verdicts, "pulse"):
        tail = pulse_tail(facts.scene.pulse_ns, job.bin_m)
        bins = min(bins + tail, gate_bins(facts.rig.device))
    size = len(job.laser_spot_m) * bins * (8 if job.accuracy.sub_bins == 0 else 4)
    if size > MAX_BYTES:
        raise SceneError(
            f"{len(job.laser_spot_m)} beams of {bins} bins need {size / 2**30:.1f} GiB, at most"
            f" {MAX_BYTES >> 30}: lower beams_per_cell ({job.accuracy.beams_per_cell}), widen bin_m"
            f" ({job.bin_m:g}) or shorten gate_s"
        )
    return job


def _returned_by(
    surface: Surface, blocked: DirectVisibility, *, with_brdf: bool
) -> Float64 | float:
    """Return what the BRDF sends straight back to the lidar of each beam that the object stops,
    relative to a diffuse surface.
    """
    if surface.brdf is None:
        return 1.0
    if not with_brdf:
        return without_lobe(surface.brdf)
    return surface.brdf(blocked.cosine, blocked.cosine, 1.0)


def _tint(facts: SceneFacts, blocked: DirectVisibility, beams: int) -> Float64 | None:
    """Return RenderProblem's `tint` of the beams that the object stops."""
    if not facts.scene.surface.colored:
        return None
    found = facts.channels[blocked.row, blocked.column]
    mean = found.mean(-1, keepdims=True)
    tint = np.ones((beams, found.shape[-1]))
    tint[blocked.beam] = np.where(mean > 0, found / np.where(mean > 0, mean, 1), 1.0)
    return tint


def _patches(facts: SceneFacts, verdicts: Plan, channel: int | None) -> Patches | None:
    """Return the patches with tilt and BRDF as the plan includes them."""
    patches = facts.patches
    if patches is not None and channel is not None:
        patches = facts.patches_of(channel)
    if patches is None:
        return None
    if not included(verdicts, "tilt"):
        patches = patches.level()
    if facts.scene.surface.brdf is not None and not included(verdicts, "brdf"):
        given_back = without_lobe(facts.scene.surface.brdf)
        patches = replace(patches, albedo=patches.albedo * given_back)
    return patches
