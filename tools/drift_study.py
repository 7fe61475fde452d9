"""How soon a lidar that moved is told, and what is told though it stands: docs/drift_study.json.

Simulated streams at 320 x 240 (`drift_streams`) over the paper's distances and angles, pitched, with up to 90 % of the
wall hidden. Prints the tables of docs/calibration-measured.md. `--every` takes one in so many streams (1).
"""

import argparse
import json
import time
from collections import defaultdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from drift_trials import AT_REST, AT_REST_FRAMES, HALF_HIDDEN, KNOCKED, SHIFTS, Knock, Rest, at_rest, knock, poses
from nlos_calibration.wall import wall_depth

from nlos_cam.calibrate.synthetic import PINHOLE, Pose, WallStream, sensed, wall_from_lidar
from nlos_cam.cli.common import progress

DOCS = Path(__file__).parents[1] / "docs"
TIMED_POSE: Pose = (0.2, 45.0, 0.0)
TIMED_FRAMES, DRAWN_FRAMES = 300, 10


def rest_row(name: str, found: list[Rest]) -> dict[str, Any]:
    """What the first table tells of some streams."""
    frames, warned = len(found) * AT_REST_FRAMES, sum(one.warned_frames for one in found)
    return {
        "name": name,
        "streams": len(found),
        "frames": frames,
        "warned_per_10000": 1e4 * warned / frames,
        "of_which_too_little_is_seen": 1e4 * sum(one.blind_frames for one in found) / frames,
        "streams_with_a_warning": sum(one.warned_frames > 0 for one in found),
        "seen_median": float(np.median([one.seen_share for one in found])),
        "seen_least": min(one.seen_share for one in found),
    }


def knock_row(name: str, look: str, found: list[Knock]) -> dict[str, Any]:
    """What the second table tells of some streams."""
    told = [one for one in found if one.told_after is not None]
    after = [one.told_after for one in told if one.told_after is not None]
    return {
        "name": name,
        "look": look,
        "tried": len(found),
        "warned_before": sum(one.warned_before for one in found),
        "told": len(told),
        "frames_median": float(np.median(after)) if after else None,
        "frames_max": max(after, default=None),
        "right_kind": sum(one.right_kind for one in told),
        "inside_95": float(np.mean([one.inside for one in told])) if told else None,
        "inside_95_later": float(np.mean([one.inside_later for one in told])) if told else None,
    }


def study(every: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Both tables from one in `every` streams; the same number gives the same tables."""
    resting, knocked = defaultdict[str, list[Rest]](list), defaultdict[tuple[str, str], list[Knock]](list)
    rest_of = list(product(AT_REST, poses()))[::every]
    knocks_of = list(product(SHIFTS, KNOCKED, poses()))[::every]
    with progress() as bar:
        for look, (seed, pose) in bar.track(rest_of, description="at rest"):
            resting[look].append(at_rest(pose, AT_REST[look], seed))
        for name, look, (seed, pose) in bar.track(knocks_of, description="knocks"):
            knocked[name, look].append(knock(pose, KNOCKED[look], SHIFTS[name], seed + 100 * list(SHIFTS).index(name)))
    rests = [rest_row(name, found) for name, found in resting.items()]
    return rests, [knock_row(name, look, found) for (name, look), found in knocked.items()]


def look_ms() -> float:
    """The median time of one look at a frame of 640 x 480 in which every pixel has depth."""
    stream, generator = WallStream(TIMED_POSE, PINHOLE), np.random.default_rng(0)
    depth_m = wall_depth(wall_from_lidar(TIMED_POSE), PINHOLE)
    depth_m[~np.isfinite(depth_m)] = np.nan
    frames = [sensed(depth_m, generator).astype(np.float32) for _ in range(DRAWN_FRAMES)]
    took_s: list[float] = []
    for number in range(TIMED_FRAMES):
        start = time.perf_counter()
        stream.check.look(frames[number % DRAWN_FRAMES], {})
        took_s.append(time.perf_counter() - start)
    return 1e3 * float(np.median(took_s))


def as_markdown(rests: list[dict[str, Any]], knocks: list[dict[str, Any]]) -> str:
    """The tables for the docs."""
    told = "with a warning, per 10,000 | of these, that too little of the wall is seen"
    lines = [
        f"| the lidar stands | wall not hidden: median, least | frames | {told} | streams with one |",
        "|---" * 6 + "|",
        *(_rest_line(one) for one in rests),
        "",
        f"| it moved: told / tried, after frames | {' | '.join(KNOCKED)} | right at first, a second later |",
        "|---" * (len(KNOCKED) + 2) + "|",
    ]
    for name in SHIFTS:
        of = {one["look"]: one for one in knocks if one["name"] == name}
        cells = [_cell(of[look]) if look in of else "" for look in KNOCKED]
        lines.append(f"| {name} | {' | '.join(cells)} | {_right([of[look] for look in HALF_HIDDEN if look in of])} |")
    return "\n".join(lines)


def _rest_line(one: dict[str, Any]) -> str:
    seen = f"{one['seen_median']:.0%}, {one['seen_least']:.0%}"
    warned = f"{one['warned_per_10000']:.1f} | {one['of_which_too_little_is_seen']:.1f}"
    streams = f"{one['streams_with_a_warning']} of {one['streams']}"
    return f"| {one['name']} | {seen} | {one['frames']} | {warned} | {streams} |"


def _cell(one: dict[str, Any]) -> str:
    after = f", {one['frames_median']:.0f} / {one['frames_max']}" if one["told"] else ""
    return f"{one['told']} / {one['tried']}{after}"


def _right(ones: list[dict[str, Any]]) -> str:
    """Of the numbers told, how many were right."""
    told = sum(one["told"] for one in ones)
    return ", ".join(
        f"{sum(one[key] * one['told'] for one in ones if one['told']) / told:.0%}"
        for key in ("inside_95", "inside_95_later")
        if told
    )


def main() -> None:
    """Try, write, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--every", type=int, default=1, help="take one in so many streams")
    every = parser.parse_args().every
    start = time.process_time()
    rests, knocks = study(every)
    facts = {"look_ms": look_ms(), "processor_minutes": (time.process_time() - start) / 60, "every": every}
    table = {"at_rest": rests, "knocks": knocks}
    (DOCS / "drift_study.json").write_text(json.dumps(facts | table, indent=2) + "\n", encoding="utf-8")
    print(as_markdown(rests, knocks), facts, sep="\n\n")


if __name__ == "__main__":
    main()
