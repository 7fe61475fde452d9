"""From distance, angle and flatness to a verdict, with what to move and by how much; or a refusal."""

from math import ceil
from typing import Literal

from nlos_calibration.errors import WallRefusedError
from nlos_calibration.flatness import SURE_SIGMAS, Flatness

Verdict = Literal["good", "out of range", "doubtful"]
"""Doubtful: the plane itself may be off by more than `TOLERANCE_M` or `TOLERANCE_DEG`, and the depth cannot tell."""

DISTANCE_RANGE_M, FACING_RANGE_DEG = (0.15, 0.30), (15.0, 75.0)
"""The paper's ranges (SI 1)."""
TOLERANCE_M, TOLERANCE_DEG = 0.001, 0.2
"""What the measurement may err by: a wall on the edge of a range is in it, a bend that shifts it by less is none."""
DOUBTED_TOLERANCES, REFUSED_TOLERANCES = 0.7, 5.0
"""A wall is refused whose halves differ from the whole by this much: 5 mm or 1 degree (a bend of 2 degrees). Less could
also be ripples of the lidar, 1 or 2 mm high and as wide as half the view: those are told, not refused. It is doubted
from somewhat less than a tolerance on, since a half that bends itself says too little."""
DOUBTED_RIPPLE_M, MAX_RIPPLE_M = 0.0009, 0.002
"""RMS normal to the wall. The L515's ripples are a millimetre or two high; two panes 2 mm apart are 1 mm off a plane
between them."""
TOLD_RIPPLE_M, TOLD_NOISE_SCALE = 0.0003, 2.0


def check_flat(flat: Flatness, ripple_m: float) -> None:
    """Refuse a wall that surely bends, curves or steps, unless an offset of the lidar's range explains it."""
    sure_m, sure_deg = flat.bend_m - SURE_SIGMAS * flat.bend_std_m, flat.bend_deg - SURE_SIGMAS * flat.bend_std_deg
    if _tolerances(sure_m, sure_deg) > REFUSED_TOLERANCES and not _explained_by_offset(flat):
        raise WallRefusedError(
            f"the wall is not one flat wall: half of the view differs from the whole by {_amounts(flat)}, as of a "
            "bend, a curve or a step; take a flat wall, or move so that only one is in view",
        )
    if ripple_m > MAX_RIPPLE_M:
        raise WallRefusedError(
            f"the wall is not flat: parts are {ripple_m * 1e3:.1f} mm RMS off the plane, {MAX_RIPPLE_M * 1e3:.1f} "
            "mm allowed; take a flat, matt wall and let the lidar warm up",
        )


def judge(distance_m: float, facing_deg: float, flat: Flatness, ripple_m: float) -> tuple[Verdict, str]:
    """The verdict, and one sentence: what it rests on, or what to do."""
    doubts, problems = _doubts(flat, ripple_m), out_of_range(distance_m, facing_deg)
    verdict: Verdict = "doubtful" if doubts else "out of range" if problems else "good"
    return verdict, "; ".join(doubts + problems) or "distance and angle are inside the paper's ranges"


def warnings(ripple_m: float, noise_scale: float) -> tuple[str, ...]:
    """What does not change the verdict but should be known."""
    told: list[str] = []
    if ripple_m > TOLD_RIPPLE_M:
        told.append(f"the depth has ripples of {ripple_m * 1e3:.1f} mm RMS: the uncertainties allow for them")
    if noise_scale > TOLD_NOISE_SCALE:
        told.append(f"depth is {noise_scale:.1f} times as noisy as the lidar's should be: warm it up, dim the light")
    return tuple(told)


def _tolerances(bend_m: float, bend_deg: float) -> float:
    return max(bend_m / TOLERANCE_M, bend_deg / TOLERANCE_DEG)


def _explained_by_offset(flat: Flatness) -> bool:
    return flat.offset_m != 0.0 and _tolerances(flat.offset_bend_m, flat.offset_bend_deg) <= 1.0


def _amounts(flat: Flatness) -> str:
    return f"{flat.bend_m * 1e3:.1f} mm and {flat.bend_deg:.2f} degrees"


def _doubts(flat: Flatness, ripple_m: float) -> list[str]:
    """Why the plane may be another than the wall's."""
    bent = _tolerances(flat.bend_m, flat.bend_deg) > DOUBTED_TOLERANCES
    if bent and _explained_by_offset(flat):
        why = f"the depths look as if {flat.offset_m * 1e3:+.1f} mm were missing from each (or the wall is curved): "
        return [why + "measure the distance with a tape and give it with --tape-m"]
    if ripple_m > DOUBTED_RIPPLE_M:
        why = f"parts of the wall are {ripple_m * 1e3:.1f} mm RMS off the plane: ripples of the lidar, or a wall "
        return [why + "that is not flat; take a flat, matt wall and let the lidar warm up"]
    if not bent:
        return []
    if flat.bend_m <= SURE_SIGMAS * flat.bend_std_m and flat.bend_deg <= SURE_SIGMAS * flat.bend_std_deg:
        return [f"noise leaves {_amounts(flat)} between half of the view and the whole: average more frames"]
    why = f"half of the view differs from the whole by {_amounts(flat)}: a bent wall, or ripples of the lidar; "
    return [why + "take a flat wall and let the lidar warm up"]


def out_of_range(distance_m: float, facing_deg: float) -> list[str]:
    """What is out of the paper's ranges, each with what to do."""
    problems: list[str] = []
    low, high = DISTANCE_RANGE_M
    if not low - TOLERANCE_M <= distance_m <= high + TOLERANCE_M:
        away = at_least(100.0 * (low - distance_m)), "back"
        move = away if distance_m < low else (at_least(100.0 * (distance_m - high)), "closer")
        problems.append(
            f"{distance_m:.3f} m is outside {low:.2f} to {high:.2f} m: move the lidar {move[0]} cm {move[1]}"
        )
    low, high = FACING_RANGE_DEG
    if not low - TOLERANCE_DEG <= facing_deg <= high + TOLERANCE_DEG:
        aside = at_least(low - facing_deg), "aside"
        turn = aside if facing_deg < low else (at_least(facing_deg - high), "towards the wall")
        plural = "" if turn[0] == 1 else "s"
        problems.append(
            f"{facing_deg:.1f} degrees is outside {low:.0f} to {high:.0f}: turn the lidar {turn[0]} degree{plural} "
            f"{turn[1]}",
        )
    return problems


def at_least(amount: float) -> int:
    """The whole number that suffices; what lies a thousandth above one does not ask for the next."""
    return max(ceil(amount - 1e-3), 1)
