"""Streams of a lidar that stands or is knocked, and what the watch over drift tells of each."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from nlos_calibration.drift import WINDOW_FRAMES, Drift

from nlos_cam.calibrate.synthetic import Array, Hide, Pose, WallStream, both, detours, sheet

DISTANCES_M, FACING_DEG, PITCHED_DEG = (0.15, 0.20, 0.25, 0.30), (15.0, 30.0, 45.0, 60.0, 75.0), 8.0
SEED = 20_260
AT_REST_FRAMES, CHANGES_EVERY = 400, 100
BEFORE_FRAMES, AFTER_FRAMES = 40, 240
"""Less than BLIND_FRAMES together: what is told after a knock is told of the move."""
INSIDE_95 = 1.96
TOLD_OF_BLINDNESS = "of the wall is seen"


@dataclass(frozen=True)
class Look:
    """What is in the way: of how many pixels light takes a detour, and from where in the view on a sheet stands."""

    hidden: tuple[float, float] = (0.0, 0.0)
    """From, to."""
    sheet: tuple[float, float] | None = None

    def hide(self, places: Array, seed: int) -> Hide:
        """Drawn by `seed`; every other detour is all on one side of a line that sways."""
        generator = np.random.default_rng(seed)
        share, hide = generator.uniform(*self.hidden), _nothing
        if share:
            hide = detours(places, share, seed, beyond=seed % 2 == 1)
        return both(hide, sheet(places, generator.uniform(*self.sheet))) if self.sheet else hide


def _nothing(depth_m: Array, _: int) -> Array:
    return depth_m


AT_REST = {
    "noise": Look(),
    "30 % hidden": Look((0.3, 0.3)),
    "50 % hidden": Look((0.5, 0.5)),
    "70 % hidden": Look((0.7, 0.7)),
    "90 % hidden": Look((0.9, 0.9)),
    "occluder": Look(sheet=(0.4, 0.8)),
    "occluder + 30 %": Look((0.3, 0.3), (0.6, 0.8)),
    "occluder + 60 %": Look((0.6, 0.6), (0.6, 0.8)),
}
KNOCKED = {
    "noise": Look(),
    "30-50 % hidden": Look((0.3, 0.5)),
    "60-70 % hidden": Look((0.6, 0.7)),
    "occluder + 50-60 %": Look((0.5, 0.6), (0.7, 0.8)),
    "80 % hidden": Look((0.8, 0.8)),
}
HALF_HIDDEN = "noise", "30-50 % hidden"
"""Of which it is told whether the number is right."""


@dataclass(frozen=True)
class Shift:
    """By what the wall leaves the reference: a lidar that moves, or a range that drifts."""

    distance_m: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    range_m: float = 0.0

    def right_kind(self, drift: Drift) -> bool:
        """Whether what is told is a range that drifted, or a lidar that moved, as it was."""
        return drift.uniform == bool(self.range_m)

    def inside(self, drift: Drift) -> float:
        """Which share of the numbers told is right within 1.96 standard uncertainties; none where the kind is not."""
        if not self.right_kind(drift):
            return 0.0
        pulls = [
            (drift.distance_m - self.distance_m) / drift.distance_std_m,
            (drift.yaw_deg - self.yaw_deg) / drift.yaw_std_deg,
            (drift.pitch_deg - self.pitch_deg) / drift.pitch_std_deg,
        ]
        if drift.uniform:
            pulls = [(drift.range_m - self.range_m) / drift.range_std_m]
        return float(np.mean([abs(pull) <= INSIDE_95 for pull in pulls]))


SHIFTS = {
    "+1 mm": Shift(0.001),
    "-1 mm": Shift(-0.001),
    "+2 mm": Shift(0.002),
    "-2 mm": Shift(-0.002),
    "+1 cm": Shift(0.01),
    "yaw +0.5 degrees": Shift(yaw_deg=0.5),
    "yaw -0.5 degrees": Shift(yaw_deg=-0.5),
    "yaw +2 degrees": Shift(yaw_deg=2.0),
    "yaw -2 degrees": Shift(yaw_deg=-2.0),
    "pitch 0.5 degrees": Shift(pitch_deg=0.5),
    "range +1.5 mm": Shift(range_m=0.0015),
}


@dataclass(frozen=True)
class Rest:
    """A stream of a lidar that stands."""

    warned_frames: int
    blind_frames: int
    """Of these, those with no warning but that too little of the wall is seen."""
    seen_share: float
    """Of the watched pixels, those that nothing hid, where the most was hidden."""


@dataclass(frozen=True)
class Knock:
    """A stream of a lidar that moved."""

    warned_before: bool
    told_after: int | None
    """Frames; None where it was not told."""
    right_kind: bool = False
    inside: float = 0.0
    """Share of the numbers first told."""
    inside_later: float = 0.0
    """Of those a window of frames later."""


def poses() -> Iterator[tuple[int, Pose]]:
    """Every distance and angle, to either side, each with its seed and a pitch of its own."""
    for number, (distance_m, facing_deg) in enumerate(product(DISTANCES_M, FACING_DEG)):
        seed = SEED + number
        side, pitched = np.random.default_rng(seed).uniform(-1.0, 1.0, 2).tolist()
        yield seed, (distance_m, math.copysign(facing_deg, side), PITCHED_DEG * pitched)


def at_rest(pose: Pose, look: Look, seed: int) -> Rest:
    """What is told of a lidar that stands; what is in the way is another one every few seconds."""
    stream = WallStream(pose, seed=seed)
    depth_m, hide, warned, blind, seen = stream.depth_from(pose), _nothing, 0, 0, 1.0
    for number in range(AT_REST_FRAMES):
        if number % CHANGES_EVERY == 0:
            hide = look.hide(stream.places, seed + 1001 * (1 + number // CHANGES_EVERY))
        shown_m = hide(depth_m, number)
        seen = min(seen, float(np.mean(shown_m == depth_m)))
        stream.look(shown_m)
        lines = stream.check.warnings
        warned += bool(lines)
        blind += bool(lines) and all(TOLD_OF_BLINDNESS in line for line in lines)
    return Rest(warned, blind, seen)


def knock(pose: Pose, look: Look, shift: Shift, seed: int) -> Knock:
    """How a lidar that moves after a while is told."""
    stream = WallStream(pose, seed=seed)
    hide = look.hide(stream.places, seed + 1000)
    warned = stream.show(pose, BEFORE_FRAMES, hide) is not None
    moved = stream.moved(shift.distance_m, shift.yaw_deg, shift.pitch_deg)
    depth_m = stream.depth_from(moved) + shift.range_m
    for number in range(1, AFTER_FRAMES + 1):
        stream.look(hide(depth_m, stream.frames))
        if stream.check.warnings and (first := stream.check.drift) is not None:
            for _ in range(WINDOW_FRAMES):
                stream.look(hide(depth_m, stream.frames))
            later = stream.check.drift
            inside_later = shift.inside(later) if later else 0.0
            return Knock(warned, number, shift.right_kind(first), shift.inside(first), inside_later)
    return Knock(warned, None)
