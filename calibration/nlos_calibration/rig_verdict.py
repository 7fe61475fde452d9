"""From a whole rig to its problems: occluder, footprint, and who sees the hidden object; each with what to do."""

from collections.abc import Callable

from nlos_calibration.footprint import Footprint, footprint
from nlos_calibration.object_sight import lidar_sees, wall_sees
from nlos_calibration.rig import LidarPose, ObjectBox, Occluder, Rig
from nlos_calibration.verdict import FACING_RANGE_DEG, TOLERANCE_DEG, TOLERANCE_M, Verdict, at_least
from nlos_calibration.wall_record import OccluderRecord

GAP_RANGE_M = 0.05, 0.20
"""The paper's (SI 1): less lets too little light through, more lets the lidar see the object."""
PAPER_X_M = 0.20
TOLD_TILT_DEG = 2.0
MIN_SHARE = 0.55
"""Of the map's cells on the wall. The paper's rig keeps 57 % at its worst: 75 degrees, 0.30 m."""
MAX_LEAK = 0.001
"""Of the box, in the lidar's sight: less is within what a calibrated edge may err by."""
MIN_SEEN = 0.5
"""Of the box, to be seen from some part of the wall that the lidar lights; the paper's rig has all, at any angle."""
FARTHEST_CM, FARTHEST_DEG = 20, 90
"""How far advice goes."""


def judge_rig(rig: Rig, seen: Footprint, occluder: OccluderRecord | None) -> tuple[str, ...]:
    """What keeps the rig from working as the paper's does, each with what to do; what `out_of_range` says is not here.

    `occluder` is how that of the rig is known; None where it is the paper's, assumed.
    """
    name = "the occluder" if occluder or not rig.occluder else "the occluder (not measured, the paper's is assumed)"
    problems = _share(rig, seen)
    if rig.occluder is not None:
        tilt_deg = occluder.tilt_deg if occluder else None
        problems += _stand(rig.occluder, rig.object_box, tilt_deg or 0.0, name)
    if rig.object_box is not None and _between(rig.occluder, rig.object_box):
        problems += _leak(rig, rig.object_box, name) + _aperture(rig, rig.object_box, seen, name)
    return tuple(problems)


def combined(verdict: Verdict, advice: str, problems: tuple[str, ...]) -> tuple[Verdict, str]:
    """The wall's verdict and advice with the rig's problems in them."""
    if not problems:
        return verdict, advice
    return "out of range" if verdict == "good" else verdict, "; ".join((advice, *problems))


def _share(rig: Rig, seen: Footprint) -> list[str]:
    """Too much of the map off the wall; beyond the paper's angles `out_of_range` says to turn."""
    if seen.share >= MIN_SHARE or rig.facing_deg > FACING_RANGE_DEG[1] + TOLERANCE_DEG:
        return []
    turn = _first(FARTHEST_DEG, lambda degrees: _seen(_turned_to_wall(rig, degrees)).share >= MIN_SHARE)
    cure = f"turn the lidar {_degrees(turn)} towards the wall" if turn else "take a larger wall"
    return [f"{seen.share:.0%} of the map's cells meet the wall, {MIN_SHARE:.0%} needed: {cure}"]


def _stand(occluder: Occluder, box: ObjectBox | None, tilt_deg: float, name: str) -> list[str]:
    """The occluder against the paper's ranges."""
    problems: list[str] = []
    (low_m, high_m), gap_m = GAP_RANGE_M, occluder.z_min_m
    if not low_m - TOLERANCE_M <= gap_m <= high_m + TOLERANCE_M:
        short = gap_m < low_m
        by_cm, way = at_least(100.0 * (low_m - gap_m if short else gap_m - high_m)), "away from" if short else "towards"
        needed = f"{low_m:.2f} to {high_m:.2f} needed"
        problems.append(f"{name} has a gap of {gap_m:.3f} m, {needed}: move it {by_cm} cm {way} the wall")
    if not _between(occluder, box):
        by_cm, way = (
            at_least(100.0 * abs(occluder.x_m - PAPER_X_M)),
            "away from" if occluder.x_m < PAPER_X_M else "towards",
        )
        ends = f"the lidar at 0 and the object{f' from {box.x_min_m:.3f} m on' if box else ''}"
        problems.append(
            f"{name} stands at x = {occluder.x_m:.3f} m, not between {ends}: move it {by_cm} cm {way} the lidar, to "
            f"the paper's {PAPER_X_M:.2f} m"
        )
    if abs(tilt_deg) > TOLD_TILT_DEG:
        way = "towards the lidar" if tilt_deg > 0.0 else "away from the lidar"
        problems.append(f"{name} leans by {tilt_deg:+.1f} degrees, 0 assumed: tilt its upper end back {way}")
    return problems


def _between(occluder: Occluder | None, box: ObjectBox | None) -> bool:
    """Whether the sheet, if there is one, stands between lidar and object."""
    return occluder is None or 0.0 < occluder.x_m <= (box.x_min_m if box else float("inf"))


def _leak(rig: Rig, box: ObjectBox, name: str) -> list[str]:
    """The object in the lidar's own sight."""
    if (share := lidar_sees(rig, box)) <= MAX_LEAK:
        return []
    what = f"the lidar sees {share:.1%} of the object's box itself"
    if rig.occluder is None:
        return [f"{what}: put an occluder at x = {PAPER_X_M:.2f} m before it"]

    def hidden(x_cm: int, z_cm: int) -> bool:
        moved = _moved(rig, x_cm, z_cm)
        return moved is not None and lidar_sees(moved, box) <= MAX_LEAK

    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(0, -cm)):
        return [f"{what}, past {name}: move the occluder {by_cm} cm towards the wall"]
    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(-cm, 0)):
        return [f"{what}, past {name}: move the occluder {by_cm} cm towards the lidar"]
    return [f"{what}, past {name}: move the object out of its sight, away from the wall"]


def _aperture(rig: Rig, box: ObjectBox, seen: Footprint, name: str) -> list[str]:
    """No light by way of the wall."""
    if (share := wall_sees(rig, box, seen)) >= MIN_SEEN:
        return []
    what = f"the wall that the lidar lights sees {share:.1%} of the object's box past {name}, {MIN_SEEN:.0%} needed"

    def opened(cm: int) -> bool:
        moved = _moved(rig, 0, cm)
        return moved is not None and wall_sees(moved, box, seen) >= MIN_SEEN

    turned = _first(FARTHEST_DEG, lambda degrees: _sees_when_turned(rig, box, degrees))
    if turned:
        return [f"{what}: turn the lidar {_degrees(turned)} towards the occluder"]
    by_cm = _first(FARTHEST_CM, opened)
    return [f"{what}: " + (f"move the occluder {by_cm} cm away from the wall" if by_cm else "take a larger wall")]


def _moved(rig: Rig, x_cm: int, z_cm: int) -> Rig | None:
    """The rig with its occluder moved; None where that is past the lidar or out of the paper's gaps."""
    if rig.occluder is None:
        return None
    x_m, gap_m = rig.occluder.x_m + x_cm / 100.0, rig.occluder.z_min_m + z_cm / 100.0
    if x_m <= 0.0 or not GAP_RANGE_M[0] <= gap_m <= GAP_RANGE_M[1]:
        return None
    return rig.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=gap_m)})


def _sees_when_turned(rig: Rig, box: ObjectBox, degrees: int) -> bool:
    yaw_deg = rig.lidar.yaw_deg + degrees
    if yaw_deg > FACING_RANGE_DEG[1]:
        return False
    turned = _posed(rig, yaw_deg, rig.lidar.pitch_deg)
    return wall_sees(turned, box, _seen(turned)) >= MIN_SEEN


def _turned_to_wall(rig: Rig, degrees: int) -> Rig:
    """The rig with its lidar turned towards the wall's normal, as far as that at most."""
    left = max(1.0 - degrees / max(rig.facing_deg, 1e-9), 0.0)
    return _posed(rig, left * rig.lidar.yaw_deg, left * rig.lidar.pitch_deg)


def _posed(rig: Rig, yaw_deg: float, pitch_deg: float) -> Rig:
    lidar = LidarPose(distance_m=rig.lidar.distance_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    return rig.model_copy(update={"lidar": lidar})


def _seen(rig: Rig) -> Footprint:
    return footprint(rig.wall_from_lidar, rig.pinhole, rig.wall)


def _first(most: int, cures: Callable[[int], bool]) -> int:
    """The least whole amount that cures; 0 where none does."""
    return next((amount for amount in range(1, most + 1) if cures(amount)), 0)


def _degrees(amount: int) -> str:
    return f"{amount} degree{'s' * (amount != 1)}"
