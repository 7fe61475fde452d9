"""Delay and false alarms of the drift watch: docs/drift_study.json.

Simulated streams at 320 x 240 over the paper's distances and angles, pitched, with up to 90 % of the wall hidden: the
lidar stands, or is knocked. Prints the tables of docs/calibration-measured.md. `--every N` takes one stream in N.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import harness  # before the synthetic scenes: it puts their folder on the path
import numpy as np
from nlos_calibration import INTERVAL_STDS, WINDOW_FRAMES, Drift, wall_depth
from wall import DISTANCES_M, FACING_DEG

from nlos_cam.calibrate.synthetic import (
    PINHOLE,
    Float64,
    Hide,
    Pose,
    WallStream,
    both,
    detours,
    sensed,
    sheet,
    wall_from_lidar,
)

PITCHED_DEG, SEED = 8.0, 20_260
AT_REST_FRAMES, CHANGES_EVERY = 400, 100
BEFORE_FRAMES, AFTER_FRAMES = 40, 240
"""Fewer than BLIND_FRAMES together, so that a warning after a knock is about the move."""
BLIND = "of the wall is seen"


@dataclass(frozen=True)
class Cover:
    """Range of the share of pixels whose light takes a detour, and of the place in the view where a sheet begins."""

    hidden: tuple[float, float] = (0.0, 0.0)
    sheet: tuple[float, float] | None = None

    def hide(self, places: Float64, seed: int) -> Hide:
        """Draw the cover; detours of odd seeds are all on one side of a line that sways."""
        generator = np.random.default_rng(seed)
        share, hide = generator.uniform(*self.hidden), _unchanged
        if share:
            hide = detours(places, share, seed, beyond=seed % 2 == 1)
        return both(hide, sheet(places, generator.uniform(*self.sheet))) if self.sheet else hide


def _unchanged(depth_m: Float64, _: int) -> Float64:
    return depth_m


AT_REST = {
    "noise": Cover(),
    "30 % hidden": Cover((0.3, 0.3)),
    "50 % hidden": Cover((0.5, 0.5)),
    "70 % hidden": Cover((0.7, 0.7)),
    "90 % hidden": Cover((0.9, 0.9)),
    "occluder": Cover(sheet=(0.4, 0.8)),
    "occluder + 30 %": Cover((0.3, 0.3), (0.6, 0.8)),
    "occluder + 60 %": Cover((0.6, 0.6), (0.6, 0.8)),
}
KNOCKED = {
    "noise": Cover(),
    "30-50 % hidden": Cover((0.3, 0.5)),
    "60-70 % hidden": Cover((0.6, 0.7)),
    "occluder + 50-60 %": Cover((0.5, 0.6), (0.7, 0.8)),
    "80 % hidden": Cover((0.8, 0.8)),
}
HALF_HIDDEN = "noise", "30-50 % hidden"
"""Covers whose estimates count for the coverage."""


@dataclass(frozen=True)
class Shift:
    """Change of the lidar's pose, or of its range."""

    distance_m: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    range_m: float = 0.0

    def right_kind(self, drift: Drift) -> bool:
        """Return whether range drift and motion are not confused."""
        return drift.uniform == bool(self.range_m)

    def inside(self, drift: Drift) -> float:
        """Return the share of estimates within 1.96 standard uncertainties; 0 for the wrong kind."""
        if not self.right_kind(drift):
            return 0.0
        names = ("range",) if drift.uniform else ("distance", "yaw", "pitch")
        units = {"range": "m", "distance": "m", "yaw": "deg", "pitch": "deg"}
        pulls = [
            (getattr(drift, f"{name}_{units[name]}") - getattr(self, f"{name}_{units[name]}"))
            / getattr(drift, f"{name}_std_{units[name]}")
            for name in names
        ]
        return float(np.mean([abs(pull) <= INTERVAL_STDS for pull in pulls]))


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
class Setting:
    """A stream: cover by name, pose, seed, and the shift's name (empty for a lidar that stands)."""

    look: str
    pose: Pose
    stream: int
    shift: str = ""


def settings() -> tuple[list[Setting], list[Setting]]:
    """Return the streams of a lidar that stands, and those of one that is knocked."""
    rests = [Setting(look, pose, seed) for look, (seed, pose) in product(AT_REST, poses())]
    knocks = product(SHIFTS, KNOCKED, poses())
    return rests, [Setting(look, pose, seed, shift) for shift, look, (seed, pose) in knocks]


def poses() -> Iterator[tuple[int, Pose]]:
    """Yield every distance and angle to either side, each with its seed and pitch."""
    for number, (distance_m, facing_deg) in enumerate(product(DISTANCES_M, FACING_DEG)):
        seed = SEED + number
        side, pitched = np.random.default_rng(seed).uniform(-1.0, 1.0, 2).tolist()
        yield seed, (distance_m, math.copysign(facing_deg, side), PITCHED_DEG * pitched)


def trial(setting: Setting, _: np.random.Generator) -> harness.Record:
    """Run one stream."""
    return knock(setting) if setting.shift else at_rest(setting)


def at_rest(setting: Setting) -> harness.Record:
    """Count warnings while the lidar stands and the cover changes every few seconds."""
    stream = WallStream(setting.pose, seed=setting.stream)
    depth_m, hide, warned, blind, share = stream.depth_from(setting.pose), _unchanged, 0, 0, 1.0
    for number in range(AT_REST_FRAMES):
        if number % CHANGES_EVERY == 0:
            seed = setting.stream + 1001 * (1 + number // CHANGES_EVERY)
            hide = AT_REST[setting.look].hide(stream.places, seed)
        shown_m = hide(depth_m, number)
        share = min(share, float(np.mean(shown_m == depth_m)))
        stream.look(shown_m)
        lines = stream.check.warnings
        warned += bool(lines)
        blind += bool(lines) and all(BLIND in line for line in lines)
    return {"warned_frames": warned, "blind_frames": blind, "visible": share}


def knock(setting: Setting) -> harness.Record:
    """Measure after how many frames a moved lidar is reported, and whether the estimate is right."""
    shift, seed = SHIFTS[setting.shift], setting.stream + 100 * list(SHIFTS).index(setting.shift)
    stream = WallStream(setting.pose, seed=seed)
    hide = KNOCKED[setting.look].hide(stream.places, seed + 1000)
    before = {"warned_before": stream.show(setting.pose, BEFORE_FRAMES, hide) is not None, "after": None}
    moved = stream.moved(shift.distance_m, shift.yaw_deg, shift.pitch_deg)
    depth_m = stream.depth_from(moved) + shift.range_m
    for number in range(1, AFTER_FRAMES + 1):
        stream.look(hide(depth_m, stream.frames))
        if stream.check.warnings and (first := stream.check.drift) is not None:
            for _ in range(WINDOW_FRAMES):
                stream.look(hide(depth_m, stream.frames))
            later = stream.check.drift
            inside = {"inside": shift.inside(first), "inside_later": shift.inside(later) if later else 0.0}
            return before | {"after": number, "right_kind": bool(shift.right_kind(first))} | inside
    return before


def rest_row(name: str, found: list[harness.Record]) -> harness.Record:
    """Summarize streams of a lidar that stands."""
    frames, shares = len(found) * AT_REST_FRAMES, [one["visible"] for one in found]
    return {
        "name": name,
        "streams": len(found),
        "frames": frames,
        "warned_per_10000": 1e4 * sum(one["warned_frames"] for one in found) / frames,
        "of_which_too_little_is_seen": 1e4 * sum(one["blind_frames"] for one in found) / frames,
        "streams_with_a_warning": sum(one["warned_frames"] > 0 for one in found),
        "seen_median": float(np.median(shares)),
        "seen_least": min(shares),
    }


def knock_row(name: str, look: str, found: list[harness.Record]) -> harness.Record:
    """Summarize streams of a knocked lidar."""
    reported = [one for one in found if one["after"] is not None]
    after = [one["after"] for one in reported]
    inside = {key: [one[key] for one in reported] for key in ("inside", "inside_later")}
    return {
        "name": name,
        "look": look,
        "tried": len(found),
        "warned_before": sum(one["warned_before"] for one in found),
        "told": len(reported),
        "frames_median": float(np.median(after)) if after else None,
        "frames_max": max(after, default=None),
        "right_kind": sum(one["right_kind"] for one in reported),
        "inside_95": float(np.mean(inside["inside"])) if reported else None,
        "inside_95_later": float(np.mean(inside["inside_later"])) if reported else None,
    }


def as_markdown(rests: list[harness.Record], knocks: list[harness.Record]) -> str:
    """Return the tables of docs/calibration-measured.md."""
    head = (
        "lidar at rest",
        "wall not hidden: median, least",
        "frames",
        "warned, per 10,000",
        "too little wall",
        "streams",
    )

    def rest(one: harness.Record) -> list[str]:
        warned = f"{one['warned_per_10000']:.1f}", f"{one['of_which_too_little_is_seen']:.1f}"
        visible = f"{one['seen_median']:.0%}, {one['seen_least']:.0%}"
        return [
            one["name"],
            visible,
            str(one["frames"]),
            *warned,
            f"{one['streams_with_a_warning']} of {one['streams']}",
        ]

    def cell(one: harness.Record) -> str:
        after = f", {one['frames_median']:.0f} / {one['frames_max']}" if one["told"] else ""
        return f"{one['told']} / {one['tried']}{after}"

    def right(ones: list[harness.Record], key: str) -> str:
        reported = sum(one["told"] for one in ones)
        return f"{sum(one[key] * one['told'] for one in ones if one['told']) / reported:.0%}" if reported else ""

    rows = list[list[str]]()
    for name in SHIFTS:
        of = {one["look"]: one for one in knocks if one["name"] == name}
        half = [of[look] for look in HALF_HIDDEN if look in of]
        shares = [right(half, key) for key in ("inside_95", "inside_95_later")]
        rows.append(
            [name, *(cell(of[look]) if look in of else "" for look in KNOCKED), ", ".join(filter(None, shares))]
        )
    moved = "moved: reported / tried, after frames (median / most)", *KNOCKED, "right at first, a second later"
    return harness.table(head, map(rest, rests)) + "\n\n" + harness.table(moved, rows)


def look_ms(frames: int = 300) -> float:
    """Return the median time of one check of a 640 x 480 frame in which every pixel has depth."""
    pose: Pose = (0.2, 45.0, 0.0)
    stream, generator, times = WallStream(pose, PINHOLE), np.random.default_rng(0), list[float]()
    depth_m = wall_depth(wall_from_lidar(pose), PINHOLE)
    depth_m[~np.isfinite(depth_m)] = np.nan
    noisy = [sensed(depth_m, generator).astype(np.float32) for _ in range(10)]
    for number in range(frames):
        start = time.perf_counter()
        stream.check.look(noisy[number % len(noisy)], {})
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def main() -> None:
    """Measure, write, print."""
    parser = harness.options(__doc__)
    parser.add_argument("--every", type=int, default=1, help="take one stream in this many (default: 1)")
    every, start = parser.parse_args().every, time.process_time()
    rests, knocks = (harness.collect(f"drift {k}", some[::every], trial) for k, some in enumerate(settings()))
    looks = [rest_row(name, some) for name in AT_REST if (some := [one for one in rests if one["look"] == name])]
    moves = [
        knock_row(name, look, some)
        for name, look in product(SHIFTS, KNOCKED)
        if (some := [one for one in knocks if (one["shift"], one["look"]) == (name, look)])
    ]
    facts = {"look_ms": look_ms(), "processor_minutes": (time.process_time() - start) / 60, "every": every}
    harness.write("drift_study", facts | {"at_rest": looks, "knocks": moves})
    print(as_markdown(looks, moves), facts, sep="\n\n")


if __name__ == "__main__":
    main()
