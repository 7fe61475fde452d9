"""How well an occluder is found, and when it is refused: docs/occluder_study.json and its picture.

Simulated recordings at 160 x 120 (the sensor's: 320 x 240) over the paper's distances and angles, pitched, with sheets
about where the paper's stands: noise, pixels that mix sheet and wall, outliers, and the simulated camera's own sensor.
Prints the tables of docs/calibration-measured.md. `--runs` is how many of each setting (1).
"""

import argparse
import json
import re
import time
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from occluder_trials import BARELY, EDGE_HIDDEN, IN_VIEW, NOT_IN_VIEW, PAPER, Outcome, Setting, sensed, trial

from nlos_cam.cli.common import progress

DOCS = Path(__file__).parents[1] / "docs"
DISTANCES_M, FACING_DEG = (0.15, 0.20, 0.25, 0.30), (15.0, 30.0, 45.0, 60.0, 75.0)
X_M, GAPS_M = (0.12, 0.16, 0.20, 0.25, 0.30), (0.05, 0.10, 0.15, 0.20)
LOOKS = {
    "noise x 1": Setting(),
    "noise x 4": Setting(noise=4.0),
    "mixed pixels": Setting(beams=4),
    "5 % outliers": Setting(outliers=0.05),
}
SENSOR_POSES = tuple(product((45.0, 60.0), (0.16, 0.20, 0.25), (0.07, 0.10, 0.13)))
SENSOR_SIZE = 320, 240
SHOWN = IN_VIEW, BARELY, EDGE_HIDDEN, NOT_IN_VIEW
QUANTITIES = "x", "gap", "tilt"

Found = list[tuple[str, Setting, Outcome]]


def settings() -> list[tuple[str, Setting]]:
    """All that is tried, by the name of how it is looked at."""
    grid = product(LOOKS.items(), DISTANCES_M, FACING_DEG, X_M, GAPS_M)
    looked = [
        (name, Setting(at_m, facing_deg, x_m, gap_m, how.noise, how.frames, how.beams, how.outliers))
        for (name, how), at_m, facing_deg, x_m, gap_m in grid
    ]
    sensor = [("sensor", Setting(0.2, facing_deg, x_m, gap_m)) for facing_deg, x_m, gap_m in SENSOR_POSES]
    return looked + sensor


def study(chosen: list[tuple[str, Setting]], runs: int) -> Found:
    """`runs` trials of each setting; the same numbers give the same outcomes."""
    pinhole = PAPER.pinhole.scaled(*SENSOR_SIZE)
    found: Found = []
    with progress() as bar:
        tried = [(i, n) for i in range(len(chosen)) for n in range(runs)]
        for i, n in bar.track(tried, description="occluders"):
            (name, setting), generator = chosen[i], np.random.default_rng([i, n])
            got = sensed(setting, generator, pinhole) if name == "sensor" else trial(setting, generator)
            found.append((name, setting, got))
    return found


def row(name: str, outcomes: list[Outcome]) -> dict[str, Any]:
    """What a table tells of some outcomes; errors and coverage are of those that were found."""
    found = [one for one in outcomes if not one.refused]
    inside = np.array([one.inside for one in found]).reshape(-1, len(QUANTITIES))
    return {
        "name": name,
        "runs": len(outcomes),
        "found": len(found) / max(len(outcomes), 1),
        "x_mm": _percentiles([1e3 * abs(one.x_error_m) for one in found]),
        "gap_mm": _percentiles([1e3 * abs(one.gap_error_m) for one in found]),
        "tilt_deg": _percentiles([abs(one.tilt_error_deg) for one in found]),
        "inside_95": dict(zip(QUANTITIES, inside.mean(axis=0).tolist(), strict=True)) if found else None,
        "refused": dict(Counter(re.sub(r"\d+", "n", one.refused.split(":")[0]) for one in outcomes if one.refused)),
    }


def _percentiles(errors: list[float]) -> dict[str, float] | None:
    if not errors:
        return None
    return {name: float(np.percentile(errors, at)) for name, at in (("p50", 50), ("p95", 95), ("max", 100))}


def tables(found: Found) -> dict[str, list[dict[str, Any]]]:
    """Every way in which the outcomes are told; all but the first of sheets that are in view."""
    shown = [one for one in found if one[2].shown == IN_VIEW]
    return {
        "what there is to see": [row(kind, [o for _, _, o in found if o.shown == kind]) for kind in SHOWN],
        "look": [row(name, [o for look, _, o in shown if look == name]) for name in [*LOOKS, "sensor"]],
        "distance": [row(f"{at:.2f} m", [o for _, s, o in shown if s.distance_m == at]) for at in DISTANCES_M],
        "facing": [row(f"{at:.0f} degrees", [o for _, s, o in shown if s.facing_deg == at]) for at in FACING_DEG],
        "x": [row(f"{at:.2f} m", [o for _, s, o in shown if s.x_m == at]) for at in X_M],
        "gap": [row(f"{at:.2f} m", [o for _, s, o in shown if s.gap_m == at]) for at in GAPS_M],
    }


def as_markdown(table: dict[str, list[dict[str, Any]]]) -> str:
    """The tables for the docs."""
    head = (
        "| {} | runs | found | x p50 / p95 / max, mm | gap p50 / p95 / max, mm | inside 95 %: x, gap, tilt |\n"
        + "|---" * 6
        + "|"
    )
    lines: list[str] = []
    for name, rows in table.items():
        lines += ["", head.format(name), *(_line(one) for one in rows)]
    return "\n".join(lines)


def _line(one: dict[str, Any]) -> str:
    x, gap = (" / ".join(f"{v:.3f}" for v in one[name].values()) if one[name] else "" for name in ("x_mm", "gap_mm"))
    inside = ", ".join(f"{share:.1%}" for share in one["inside_95"].values()) if one["inside_95"] else ""
    return f"| {one['name']} | {one['runs']} | {one['found']:.1%} | {x} | {gap} | {inside} |"


def draw(found: Found, table: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Where it is found, and how far off."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    axes: list[Axes] = list(figure.subplots(1, 3).ravel())
    _draw_found(axes[0], found)
    for name, marker in (("x_mm", "o"), ("gap_mm", "s")):
        rows = [one for one in table["look"] if one[name]]
        for at, style in (("p50", "-"), ("p95", "--")):
            axes[1].plot(range(len(rows)), [one[name][at] for one in rows], marker + style, label=f"{name[:-3]} {at}")
        axes[1].set_xticks(range(len(rows)), [one["name"] for one in rows], rotation=20, fontsize=8)
    axes[1].set(yscale="log", ylabel="error, mm", title="sheets in view")
    axes[1].legend(fontsize=8)
    rows = [
        one | {"name": one["name"] if group == "look" else f"{group} {one['name']}"}
        for group in ("look", "facing", "gap")
        for one in table[group]
        if one["inside_95"]
    ]
    for quantity, marker in zip(QUANTITIES, "osv", strict=True):
        axes[2].plot([100 * one["inside_95"][quantity] for one in rows], range(len(rows)), marker, label=quantity)
    axes[2].axvline(95, color="0.6", lw=1)
    axes[2].set_yticks(range(len(rows)), [one["name"] for one in rows], fontsize=8)
    axes[2].set(xlabel="truth inside the stated 95 % interval, %", xlim=(85, 101))
    axes[2].legend(fontsize=8)
    figure.savefig(path, dpi=90)


def _draw_found(axis: Axes, found: Found) -> None:
    shares = np.array(
        [
            [
                np.mean([not o.refused for _, s, o in found if (s.facing_deg, s.distance_m) == (facing, at)] or [0.0])
                for at in DISTANCES_M
            ]
            for facing in FACING_DEG
        ]
    )
    axis.imshow(100 * shares, vmin=0, vmax=100, cmap="viridis", aspect="auto")
    for (i, j), share in np.ndenumerate(shares):
        axis.text(j, i, f"{share:.0%}", ha="center", va="center", color="w" if share < 0.6 else "k")
    axis.set_xticks(range(len(DISTANCES_M)), [f"{at:.2f}" for at in DISTANCES_M])
    axis.set_yticks(range(len(FACING_DEG)), [f"{at:.0f}" for at in FACING_DEG])
    axis.set(xlabel="distance, m", ylabel="facing, degrees", title="found, of all sheets (in view or not)")


def main() -> None:
    """Try, write, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=1, help="of each setting")
    runs = parser.parse_args().runs
    start = time.perf_counter()
    found = study(settings(), runs)
    table = tables(found)
    facts = {"runs_of_each_setting": runs, "minutes": (time.perf_counter() - start) / 60}
    (DOCS / "occluder_study.json").write_text(json.dumps(facts | table, indent=2) + "\n", encoding="utf-8")
    draw(found, table, DOCS / "images" / "occluder_study.png")
    print(as_markdown(table), facts, sep="\n\n")


if __name__ == "__main__":
    main()
