"""How well a wall is measured, and whether a wrong one is ever called good: docs/wall_study.json and its picture.

Simulated recordings over the paper's distances and angles, to either side and pitched: noise, outliers, flicker, walls
of which part is missing, ripples of the lidar, the simulated camera's own sensor, and walls that are not one flat wall.
Prints the tables of docs/calibration-measured.md. `--runs` is how many of each setting (60).
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from nlos_calibration.wall import fit_wall
from wall_trials import BARE, DISTANCES_M, FACING_DEG, HARD, Outcome, Setting, trial

from nlos_cam.calibrate.synthetic import looked_at, view
from nlos_cam.cli.common import progress

DOCS = Path(__file__).parents[1] / "docs"
RUNS = 60
NOISES, OUTLIERS, FRAMES = (0.5, 1.0, 2.0, 4.0), (0.0, 0.2, 0.4, 0.5, 0.6), (1, 8, 30)
MOST_OUTLIERS = 0.4
"""Up to here the wall must be measured."""
QUANTITIES = "distance", "facing", "yaw", "pitch"

Found = dict[Setting, list[Outcome]]
Chosen = Callable[[Setting], bool]


def settings() -> list[Setting]:
    """All that is tried."""
    bare = [Setting("bare", noise, share, 0.0, n) for noise, share, n in product(NOISES, OUTLIERS, FRAMES)]
    partial = [Setting("no return", noise, share, 0.0, 8) for noise, share in product((1.0, 4.0), (0.0, 0.2, 0.4))]
    flicker = [Setting("bare", 1.0, 0.0, share, 30) for share in (0.02, 0.1, 0.4)]
    uneven = product(("rippled", "patchy"), (1.0, 4.0), (1, 8, 30))
    ripples = [Setting(scene, noise, 0.0, 0.0, n) for scene, noise, n in uneven]
    sensor = [Setting("sensor", 1.0, 0.0, share, n) for share, n in ((0.0, 1), (0.0, 8), (0.02, 8))]
    tried = list(product((1.0, 4.0), (0.0, 0.2), (1, 8)))
    hard = [Setting(scene, noise, share, 0.0, n) for scene in HARD for noise, share, n in tried]
    return bare + partial + flicker + ripples + sensor + hard


def study(chosen: list[Setting], runs: int) -> Found:
    """`runs` trials of each setting; the same numbers give the same outcomes."""
    with progress() as bar:
        tried = [(i, n) for i in range(len(chosen)) for n in range(runs)]
        found: Found = {setting: [] for setting in chosen}
        for i, n in bar.track(tried, description="walls"):
            found[chosen[i]].append(trial(chosen[i], np.random.default_rng([i, n])))
    return found


def pooled(found: Found, chosen: Chosen) -> list[Outcome]:
    """The outcomes of some settings."""
    return [outcome for setting, outcomes in found.items() if chosen(setting) for outcome in outcomes]


def unbiased(setting: Setting) -> bool:
    """Noise is all that is wrong: what stated uncertainties are held against."""
    return setting.scene in {"bare", "no return"} and not setting.flicker and setting.outliers <= MOST_OUTLIERS


def row(name: str, outcomes: list[Outcome]) -> dict[str, Any]:
    """What a table tells of some outcomes; errors and coverage are of those that were measured."""
    measured = [outcome for outcome in outcomes if not outcome.refused]
    verdicts = Counter(outcome.verdict for outcome in measured)
    distance_mm = [1e3 * abs(outcome.distance_error_m) for outcome in measured]
    facing_deg = [abs(outcome.facing_error_deg) for outcome in measured]
    inside = np.array([outcome.inside for outcome in measured]).reshape(-1, len(QUANTITIES))
    return {
        "name": name,
        "runs": len(outcomes),
        "refused": 1.0 - len(measured) / max(len(outcomes), 1),
        "doubtful": verdicts["doubtful"] / max(len(outcomes), 1),
        "wrong": sum(outcome.wrong for outcome in measured),
        "wrong_and_good": sum(outcome.wrong_and_good for outcome in measured),
        "distance_mm": _percentiles(distance_mm),
        "facing_deg": _percentiles(facing_deg),
        "inside_95": dict(zip(QUANTITIES, inside.mean(axis=0).tolist(), strict=True)) if measured else None,
    }


def _percentiles(errors: list[float]) -> dict[str, float] | None:
    if not errors:
        return None
    return {name: float(np.percentile(errors, at)) for name, at in (("p50", 50), ("p95", 95), ("max", 100))}


def tables(found: Found) -> dict[str, list[dict[str, Any]]]:
    """Every way in which the outcomes are told."""

    def plain(setting: Setting) -> bool:
        return setting.scene == "bare" and not setting.flicker

    within = pooled(found, unbiased)
    return {
        "all": [row("noise only, up to 40 % outliers", within)],
        "outliers": [
            row(f"{share:.0%} outliers", pooled(found, lambda s, a=share: plain(s) and s.outliers == a))
            for share in OUTLIERS
        ],
        "noise": [
            row(f"noise x {noise:g}", pooled(found, lambda s, a=noise: unbiased(s) and s.noise == a))
            for noise in NOISES
        ],
        "frames": [
            row(f"{n} frame{'s' * (n > 1)}", pooled(found, lambda s, a=n: unbiased(s) and s.frames == a))
            for n in FRAMES
        ],
        "distance": [row(f"{at:.2f} m", [o for o in within if abs(o.where[0] - at) < 1e-6]) for at in DISTANCES_M],
        "facing": [row(f"{at:.0f} degrees", [o for o in within if abs(o.where[1] - at) < 1e-3]) for at in FACING_DEG],
        "others": list(_others(found)),
        "hard": [row(scene, pooled(found, lambda s, a=scene: s.scene == a)) for scene in HARD],
    }


def _others(found: Found) -> Iterator[dict[str, Any]]:
    yield row("20 to 70 % without return", pooled(found, lambda s: s.scene == "no return"))
    for share in sorted({s.flicker for s in found if s.flicker and s.scene == "bare"}):
        yield row(
            f"{share:.0%} of samples flicker", pooled(found, lambda s, a=share: s.scene == "bare" and s.flicker == a)
        )
    yield row("ripples up to 2 mm", pooled(found, lambda s: s.scene == "rippled"))
    yield row("drift up to 1 mm, in patches", pooled(found, lambda s: s.scene == "patchy"))
    yield row("the simulated camera's sensor", pooled(found, lambda s: s.scene == "sensor"))


def as_markdown(table: dict[str, list[dict[str, Any]]]) -> str:
    """The tables for docs/calibration-measured.md."""
    head = (
        "| {} | runs | refused | doubtful | distance p50 / p95 / max, mm | facing p50 / p95 / max, degrees "
        "| inside 95 %: distance, facing, yaw, pitch | wrong | wrong and good |\n" + "|---" * 9 + "|"
    )
    lines: list[str] = []
    for name, rows in table.items():
        lines += ["", head.format(name), *(_line(one) for one in rows)]
    return "\n".join(lines)


def _line(one: dict[str, Any]) -> str:
    distance, facing = (
        " / ".join(f"{value:.3f}" for value in one[name].values()) if one[name] else ""
        for name in ("distance_mm", "facing_deg")
    )
    inside = ", ".join(f"{share:.1%}" for share in one["inside_95"].values()) if one["inside_95"] else ""
    shares = f"{one['refused']:.0%} | {one['doubtful']:.0%}"
    wrong = f"{one['wrong']} | {one['wrong_and_good']}"
    return f"| {one['name']} | {one['runs']} | {shares} | {distance} | {facing} | {inside} | {wrong} |"


def fit_milliseconds() -> float:
    """The least time of one fit of a 640 x 480 mean map on this machine."""
    pinhole, generator = BARE.pinhole, np.random.default_rng(0)
    mean = looked_at(view(0.2, 45.0, 0.0, pinhole).depth_m, generator, frames=8)
    depth_m, noise, times = mean.mean_m(), mean.noise(), []
    for _ in range(10):
        start = time.perf_counter()
        fit_wall(depth_m, pinhole, generator, noise)
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


def draw(found: Found, table: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Errors against outliers, coverage, and what became of walls that are none."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes: list[Axes] = list(figure.subplots(2, 2).ravel())
    for axis, name, limit, unit in ((axes[0], "distance_mm", 1.0, "mm"), (axes[1], "facing_deg", 0.2, "degrees")):
        for noise in NOISES:
            rows = [
                row("", pooled(found, lambda s, a=noise, b=share: s == Setting("bare", a, b, 0.0, s.frames)))
                for share in OUTLIERS
            ]
            points = [(100 * share, one[name]["p95"]) for share, one in zip(OUTLIERS, rows, strict=True) if one[name]]
            axis.plot(*zip(*points, strict=True), "o-", label=f"noise x {noise:g}")
        axis.axhline(limit, color="0.4", ls="--", label="asked for")
        axis.set(yscale="log", xlabel="outliers, %", ylabel=f"95th percentile, {unit}", title=name.split("_")[0])
        axis.legend(fontsize=8)
    _draw_coverage(axes[2], table)
    _draw_hard(axes[3], table["hard"] + table["others"])
    figure.savefig(path, dpi=110)


def _draw_coverage(axis: Axes, table: dict[str, list[dict[str, Any]]]) -> None:
    rows = [one for name in ("all", "noise", "frames", "facing") for one in table[name] if one["inside_95"]]
    for quantity, marker in zip(QUANTITIES, "osv^", strict=True):
        axis.plot([100 * one["inside_95"][quantity] for one in rows], range(len(rows)), marker, label=quantity)
    axis.axvspan(93, 97, color="0.9")
    axis.axvline(95, color="0.6", lw=1)
    axis.set_yticks(range(len(rows)), [one["name"] for one in rows], fontsize=8)
    axis.set(xlabel="truth inside the stated 95 % interval, %", xlim=(85, 100))
    axis.invert_yaxis()
    axis.legend(fontsize=8)


def _draw_hard(axis: Axes, rows: list[dict[str, Any]]) -> None:
    left = np.zeros(len(rows))
    called = {
        "refused": [one["refused"] for one in rows],
        "doubtful": [one["doubtful"] for one in rows],
        "good, and right": [
            1 - one["refused"] - one["doubtful"] - one["wrong_and_good"] / max(one["runs"], 1) for one in rows
        ],
        "good, and wrong": [one["wrong_and_good"] / max(one["runs"], 1) for one in rows],
    }
    for (name, shares), colour in zip(called.items(), ("0.7", "tab:orange", "tab:green", "tab:red"), strict=True):
        axis.barh(range(len(rows)), 100 * np.array(shares), left=100 * left, label=name, color=colour)
        left += np.array(shares)
    axis.set_yticks(range(len(rows)), [one["name"] for one in rows], fontsize=8)
    axis.set(xlabel="share of walls, %", xlim=(0, 100))
    axis.invert_yaxis()
    axis.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def main() -> None:
    """Try, write, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=RUNS, help="of each setting")
    runs = parser.parse_args().runs
    start = time.perf_counter()
    found = study(settings(), runs)
    table = tables(found)
    facts = {
        "runs_of_each_setting": runs,
        "minutes": (time.perf_counter() - start) / 60,
        "fit_640x480_ms": fit_milliseconds(),
    }
    (DOCS / "wall_study.json").write_text(json.dumps(facts | table, indent=2) + "\n", encoding="utf-8")
    draw(found, table, DOCS / "images" / "wall_study.png")
    print(as_markdown(table), facts, sep="\n\n")


if __name__ == "__main__":
    main()
