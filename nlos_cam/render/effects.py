"""Which effects a scene calls for: pure verdicts, gathered into a plan that the renderer reads."""

from dataclasses import dataclass

import numpy as np
from nlos_calibration.rig import Rig

from nlos_cam.errors import SceneError
from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, Beams
from nlos_cam.render.scene import Patches, Scene


@dataclass(frozen=True)
class Effect:
    """A verdict on one effect."""

    name: str
    included: bool
    reason: str
    bound: float
    """At most this much of the transient (relative L1) changes without the effect."""


Plan = tuple[Effect, ...]


def plan(scene: Scene, beams: Beams, tolerance: float) -> Plan:
    """The verdicts for a scene, in the order in which light meets the effects.

    Raises SceneError where the scene calls for an effect that this renderer does not have.
    """
    patches = scene.patches
    hidden = patches is not None and _shortest_m(patches) < SPEED_OF_LIGHT_M_PER_S * scene.rig.device.gate_s
    if patches is not None:
        _refuse_line_of_sight(scene.rig, patches, beams)
    return (
        _direct(beams),
        _verdict("three-bounce", hidden, "a surface lies inside the gate", "nothing is hidden inside the gate"),
        _self_occlusion(patches if hidden else None),
        _tilt(patches if hidden else None, tolerance),
        _occluder(scene.rig, beams, patches if hidden else None),
    )


def included(verdicts: Plan, name: str) -> bool:
    """Whether a plan includes an effect."""
    return next(effect.included for effect in verdicts if effect.name == name)


def _verdict(name: str, needed: bool, why: str, why_not: str, bound: float = 1.0) -> Effect:
    return Effect(name, needed, why if needed else why_not, bound if needed else 0.0)


def _direct(beams: Beams) -> Effect:
    count = int((beams.direct > 0).sum())
    return _verdict("direct", count > 0, f"{count} beams return from wall or occluder", "no beam returns in the gate")


def _shortest_m(patches: Patches) -> float:
    """No three-bounce path is shorter than twice down to the nearest patch."""
    return 2 * float(patches.point_m[:, 2].min())


def _self_occlusion(patches: Patches | None) -> Effect:
    flat = patches is None or float(np.ptp(patches.point_m[:, 2])) == 0.0
    return _verdict("self-occlusion", not flat, "the surface is not flat: parts may shade parts", "nothing to shade")


def _tilt(patches: Patches | None, tolerance: float) -> Effect:
    """Without tilt, beta is 1 and t2 is taken to the wall's normal: at most beta - 1 + the slope itself changes."""
    slope = 0.0 if patches is None else float(np.sqrt(patches.beta.max() ** 2 - 1))
    bound = min(1.0, np.sqrt(1 + slope**2) - 1 + slope)
    reason = f"steepest slope {slope:.2f}"
    return Effect("tilt", bound > tolerance, reason, float(bound))


def _occluder(rig: Rig, beams: Beams, patches: Patches | None) -> Effect:
    if rig.occluder is None:
        return Effect("occluder", included=False, reason="the rig has none", bound=0.0)
    met = int((~beams.on_wall & np.isfinite(beams.length_m)).sum())
    reaches = patches is not None
    return _verdict("occluder", met > 0 or reaches, f"{met} beams return from it, legs may cross it", "no leg meets it")


def _refuse_line_of_sight(rig: Rig, patches: Patches, beams: Beams) -> None:
    """A patch that a beam of the lidar meets would return by itself, which is not rendered: say so, never hide it."""
    to_patch = patches.point_m - beams.lidar_m
    in_lidar = to_patch @ rig.wall_from_lidar[:3, :3]
    pinhole = rig.pinhole
    with np.errstate(divide="ignore", invalid="ignore"):
        column = in_lidar[:, 0] / in_lidar[:, 2] * pinhole.fx + pinhole.ppx
        row = in_lidar[:, 1] / in_lidar[:, 2] * pinhole.fy + pinhole.ppy
    aimed = (in_lidar[:, 2] > 0) & (np.abs(column + 0.5 - pinhole.width / 2) <= pinhole.width / 2)
    aimed &= np.abs(row + 0.5 - pinhole.height / 2) <= pinhole.height / 2
    seen = aimed & ~_behind_occluder(rig, beams.lidar_m, patches)
    if seen.any():
        raise SceneError(
            f"{int(seen.sum())} of {len(seen)} surface cells are in the lidar's own sight, whose direct return is not "
            "rendered: hide the object behind an occluder, or move it out of the field of view",
        )


def _behind_occluder(rig: Rig, lidar_m: np.ndarray, patches: Patches) -> np.ndarray:  # pyright: ignore[reportMissingTypeArgument, reportUnknownParameterType]
    if rig.occluder is None:
        return np.zeros(len(patches.point_m), bool)
    x, z = patches.point_m[:, 0], patches.point_m[:, 2]
    share = (rig.occluder.x_m - lidar_m[0]) / (x - lidar_m[0])
    height = lidar_m[2] + share * (z - lidar_m[2])
    return (share > 0) & (share < 1) & (height >= rig.occluder.z_min_m)
