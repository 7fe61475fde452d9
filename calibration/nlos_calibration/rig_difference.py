"""How one rig differs from another, in words, where it is by more than a calibration may err."""

from math import atan, degrees

from nlos_calibration.rig import PinholeRecord, Rig
from nlos_calibration.verdict import TOLERANCE_DEG, TOLERANCE_M


def rig_difference(rig: Rig, other: Rig) -> tuple[str, ...]:
    """What `rig` is or has against `other`, each with its amount; empty where a network would not notice."""
    lidar, theirs = rig.lidar, other.lidar
    told = [
        _moved("the lidar", lidar.distance_m - theirs.distance_m, "farther from the wall", "closer to the wall"),
        _turned("yaw", lidar.yaw_deg - theirs.yaw_deg),
        _turned("pitch", lidar.pitch_deg - theirs.pitch_deg),
        *_occluder(rig, other),
        _field(rig.intrinsics, other.intrinsics),
        "another object box" if rig.object_box != other.object_box else "",
        "other device constants" if rig.device != other.device else "",
    ]
    return tuple(difference for difference in told if difference)


def _moved(what: str, by_m: float, more: str, less: str) -> str:
    return f"{what} {abs(by_m) * 1e3:.0f} mm {more if by_m > 0 else less}" if abs(by_m) > TOLERANCE_M else ""


def _turned(angle: str, by_deg: float) -> str:
    return f"{angle} {by_deg:+.1f} degrees" if abs(by_deg) > TOLERANCE_DEG else ""


def _occluder(rig: Rig, other: Rig) -> tuple[str, ...]:
    here, there = rig.occluder, other.occluder
    if here is None or there is None:
        return () if here is there else ("no occluder" if here is None else "an occluder",)
    place = _moved("the occluder", here.x_m - there.x_m, "farther along the wall", "nearer along the wall")
    return place, _moved("its gap", here.z_min_m - there.z_min_m, "wider", "narrower")


def _field(here: PinholeRecord, there: PinholeRecord) -> str:
    (across, down), (across_there, down_there) = (_field_deg(pinhole) for pinhole in (here, there))
    if max(abs(across - across_there), abs(down - down_there)) <= TOLERANCE_DEG:
        return ""
    return f"a field of view of {across:.1f} x {down:.1f} degrees, not {across_there:.1f} x {down_there:.1f}"


def _field_deg(pinhole: PinholeRecord) -> tuple[float, float]:
    """Across and down, from edge to edge."""
    spans = (
        (pinhole.ppx + 0.5, pinhole.width - pinhole.ppx - 0.5, pinhole.fx),
        (pinhole.ppy + 0.5, pinhole.height - pinhole.ppy - 0.5, pinhole.fy),
    )
    across, down = (degrees(atan(before / focal) + atan(after / focal)) for before, after, focal in spans)
    return across, down
