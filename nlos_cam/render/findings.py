"""What each effect would change in a scene: a bound and a reason, from the scene's facts alone."""

from math import sqrt

import numpy as np

from nlos_cam.render.echo import pulse_bins
from nlos_cam.render.effects import Effects, Plan, decide
from nlos_cam.render.relay import occluder_edge
from nlos_cam.render.stage import Stage
from nlos_cam.render.survey import CAUTION, occluder_meets, shaded

Finding = tuple[str, float, str]
"""Name, bound and reason."""


def plan(stage: Stage, effects: Effects = "auto") -> Plan:
    """The verdicts for a scene at an accuracy, in the order in which light meets the effects."""
    findings = [verdict(stage) for verdict in (_direct, _three_bounce, _line_of_sight, _occluder, _self_occlusion)]
    findings += [verdict(stage) for verdict in (_tilt, _brdf, _colour, _inter_reflection, _pulse)]
    return decide(findings, stage.accuracy.tolerance, effects)


def _direct(stage: Stage) -> Finding:
    count = int((stage.beams().direct > 0).sum())
    return "direct", float(count > 0), f"{count} beams return from wall or occluder inside the gate"


def _three_bounce(stage: Stage) -> Finding:
    if stage.patches is None:
        return "three-bounce", 0.0, "nothing is hidden inside the gate, or no beam lights the wall"
    return "three-bounce", 1.0, f"{len(stage.patches.beta)} patches lie inside the gate"


def _line_of_sight(stage: Stage) -> Finding:
    if stage.sight is None:
        return "line-of-sight", 0.0, "no part of the object is in the lidar's sight"
    beams, cells = len(stage.sight.beam), int(stage.sight.hidden.sum())
    return "line-of-sight", 1.0, f"the object stops {beams} beams and hides {cells} relay cells"


def _occluder(stage: Stage) -> Finding:
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


def _self_occlusion(stage: Stage) -> Finding:
    if stage.patches is None or stage.light is None:
        return "self-occlusion", 0.0, "nothing to shade"
    behind = shaded(stage.patches, stage.field)
    if not behind.any():
        return "self-occlusion", 0.0, "the surface is its own lower convex hull"
    share = stage.light.share(stage.light.energy * behind)
    bound = min(share / (1 - share), 1.0) if share < 1 else 1.0  # of what is left when all of it is shaded
    return "self-occlusion", bound, f"{int(behind.sum())} of {len(behind)} patches have another rise above their plane"


def _tilt(stage: Stage) -> Finding:
    if stage.patches is None or stage.light is None:
        return "tilt", 0.0, "nothing to tilt"
    steepest = sqrt(max(float(stage.patches.beta.max()) ** 2 - 1, 0.0))
    low, high = stage.brdf_range
    bound = stage.light.tilt if low == high else 1.0  # a lobe turns by twice the tilt, and away from where it was seen
    return "tilt", bound if steepest else 0.0, f"steepest slope {steepest:.3g}"


def _brdf(stage: Stage) -> Finding:
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


def _colour(stage: Stage) -> Finding:
    if stage.patches is None or not stage.scene.surface.coloured:
        return "colour", 0.0, "the albedo has one channel"
    albedo = np.asarray(stage.scene.surface.albedo, np.float64)
    grey = albedo.mean(-1, keepdims=True)
    apart = float((np.abs(albedo - grey).max(-1) / np.where(grey > 0, grey, 1)[..., 0]).max())
    return "colour", min(apart, 1.0), f"channels differ by up to {apart:.3g} of their mean"


def _inter_reflection(stage: Stage) -> Finding:
    if stage.patches is None:
        return "inter-reflection", 0.0, "nothing is hidden"
    if not stage.lambertian:
        return "inter-reflection", 0.0, "S1 to S5 leave higher orders out; lambertian radiometry decides by their share"
    share = CAUTION * stage.more_bounces
    return "inter-reflection", min(share, 1.0), f"five bounces and object to object carry up to {share:.3g} of three"


def _pulse(stage: Stage) -> Finding:
    if stage.scene.pulse_ns == 0:
        return "pulse", 0.0, "the pulse has no width"
    sigma = pulse_bins(stage.scene.pulse_ns, stage.rig.device.bin_m)
    return "pulse", min(4 * sigma, 1.0), f"{stage.scene.pulse_ns:g} ns spread an echo by {sigma:.3g} bins"
