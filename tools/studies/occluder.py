"""Accuracy of the occluder's detection, and refusals: docs/occluder_study.json and docs/images/occluder_study.png.

Simulated recordings over the paper's distances and angles with sheets near the paper's place: noise, pixels that mix
sheet and wall, outliers, and the simulated camera's own sensor. Prints the tables of docs/calibration-measured.md.
`--runs` sets the trials of each setting (default: 1).
"""

import re
import time
from collections import Counter
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import harness  # before the synthetic scenes: it puts their folder on the path
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import INTERVAL_STDS, MIN_COLUMNS, LidarPose, Occluder, PinholeRecord, find_occluder, load_rig
from nlos_calibration.errors import OccluderRefusedError
from wall import DISTANCES_M, FACING_DEG, SENSOR_SIZE, SIZE, sensor_mean

from nlos_cam.calibrate import Sheet, View, bench, looked_at, view, with_outliers

Generator = np.random.Generator

X_M, GAPS_M, PITCHES_DEG = (0.12, 0.16, 0.20, 0.25, 0.30), (0.05, 0.10, 0.15, 0.20), (-12.0, 0.0, 0.0, 8.0)
PAPER = load_rig("paper-rig")
IN_VIEW, BARELY, EDGE_HIDDEN, NOT_IN_VIEW = "in view", "barely in view", "edge out of view", "out of view"
QUANTITIES = "x", "gap", "tilt"


@dataclass(frozen=True)
class Setting:
    """Nominal place of lidar and sheet, and the conditions of the recording."""

    look: str = "noise x 1"
    distance_m: float = 0.2
    facing_deg: float = 45.0
    x_m: float = 0.2
    gap_m: float = 0.1
    noise: float = 1.0
    frames: int = 30
    beams: int = 1
    """Across a pixel: several mix on the edge."""
    outliers: float = 0.0
    lean_deg: float = 1.0
    """Largest lean, twist and turn of the edge."""


LOOKS = {
    "noise x 1": Setting(),
    "noise x 4": Setting(noise=4.0),
    "mixed pixels": Setting(beams=4),
    "5 % outliers": Setting(outliers=0.05),
}


def settings() -> list[Setting]:
    """Return every setting of the study."""
    grid = product(LOOKS.items(), DISTANCES_M, FACING_DEG, X_M, GAPS_M)
    places = product((45.0, 60.0), (0.16, 0.20, 0.25), (0.07, 0.10, 0.13))
    return [
        *(replace(s, look=name, distance_m=d, facing_deg=f, x_m=x, gap_m=g) for (name, s), d, f, x, g in grid),
        *(Setting("sensor", 0.2, facing, x, gap) for facing, x, gap in places),
    ]


def drawn(setting: Setting, generator: Generator) -> tuple[View, Sheet]:
    """Draw a bench near the setting."""
    distance_m = setting.distance_m + generator.uniform(-0.005, 0.005)
    yaw_deg = setting.facing_deg + generator.uniform(-1.0, 1.0)
    lean_deg, twist_deg, edge_deg = generator.uniform(-setting.lean_deg, setting.lean_deg, 3)
    x_m, gap_m = setting.x_m + generator.uniform(-0.01, 0.01), setting.gap_m + generator.uniform(-0.005, 0.005)
    seen = view(distance_m, yaw_deg, float(generator.choice(PITCHES_DEG)), PAPER.pinhole.scaled(*SIZE))
    return seen, Sheet(x_m, gap_m, lean_deg, twist_deg, edge_deg)


def visibility(seen: View, sheet: Sheet) -> str:
    """Classify how much of the sheet is in view."""
    hit = bench(seen, sheet) < bench(seen, None)
    if hit[:, 0].mean() > 0.5:
        return EDGE_HIDDEN
    return IN_VIEW if np.median(hit.sum(axis=1)) >= 2 * MIN_COLUMNS else BARELY if hit.any() else NOT_IN_VIEW


def trial(setting: Setting, generator: Generator) -> harness.Record:
    """Draw a bench, detect its occluder, and compare with the truth."""
    seen, sheet = drawn(setting, generator)
    if setting.look == "sensor":  # the renderer's beams; its sheet stands straight
        sheet, pinhole = Sheet(sheet.x_m, sheet.gap_m), PAPER.pinhole.scaled(*SENSOR_SIZE)
        changed = {
            "lidar": LidarPose(distance_m=float(seen.pose[2, 3]), yaw_deg=setting.facing_deg),
            "intrinsics": PinholeRecord.model_validate(vars(pinhole)),
            "occluder": Occluder(x_m=sheet.x_m, z_min_m=sheet.gap_m),
        }
        rig = PAPER.model_copy(update=changed)
        seen, mean = View(rig.wall_from_lidar, pinhole), sensor_mean(rig, setting, generator)
    else:
        depth_m = with_outliers(bench(seen, sheet, beams=setting.beams), setting.outliers, generator)
        mean = looked_at(depth_m, generator, frames=setting.frames, noise=setting.noise)
    shown = {"shown": visibility(seen, sheet)}
    try:
        found = find_occluder(mean.mean_m(), mean.noise(), seen.pinhole, seen.pose, generator)
    except OccluderRefusedError as error:
        return shown | {"refused": str(error)}
    errors = [found.x_m - sheet.x_m, found.gap_m - sheet.gap_m, found.tilt_deg - sheet.lean_deg]
    stds = found.x_std_m, found.gap_std_m, found.tilt_std_deg
    inside = [bool(abs(error) <= INTERVAL_STDS * std) for error, std in zip(errors, stds, strict=True)]
    return shown | {"refused": "", "errors": [float(error) for error in errors], "inside": inside}


def row(name: str, records: list[harness.Record]) -> harness.Record:
    """Summarize records; errors and coverage are of the occluders that were found."""
    found = [one for one in records if not one["refused"]]
    units = zip(("x_mm", "gap_mm", "tilt_deg"), (1e3, 1e3, 1.0), strict=True)
    reasons = Counter(re.sub(r"\d+", "n", one["refused"].split(":")[0]) for one in records if one["refused"])
    return {
        "name": name,
        "runs": len(records),
        "found": len(found) / max(len(records), 1),
        **{
            of: harness.percentiles(unit * abs(one["errors"][k]) for one in found) for k, (of, unit) in enumerate(units)
        },
        "inside_95": harness.coverage((one["inside"] for one in found), QUANTITIES),
        "refused": dict(reasons),
    }


def tables(records: list[harness.Record]) -> dict[str, list[harness.Record]]:
    """Return every table of the study; all but the first are of sheets in view."""
    shown = [one for one in records if one["shown"] == IN_VIEW]

    def rows(of: list[harness.Record], field: str, levels: Any, form: str) -> list[harness.Record]:
        return [row(form.format(at), [one for one in of if one[field] == at]) for at in levels]

    return {
        "what there is to see": rows(records, "shown", (IN_VIEW, BARELY, EDGE_HIDDEN, NOT_IN_VIEW), "{}"),
        "look": rows(shown, "look", [*LOOKS, "sensor"], "{}"),
        "distance": rows(shown, "distance_m", DISTANCES_M, "{:.2f} m"),
        "facing": rows(shown, "facing_deg", FACING_DEG, "{:.0f} degrees"),
        "x": rows(shown, "x_m", X_M, "{:.2f} m"),
        "gap": rows(shown, "gap_m", GAPS_M, "{:.2f} m"),
    }


def as_markdown(found: dict[str, list[harness.Record]]) -> str:
    """Return the tables of docs/calibration-measured.md."""
    head = ("runs", "found", "x p50 / p95 / max, mm", "gap p50 / p95 / max, mm", "inside 95 %: x, gap, tilt")

    def cells(one: harness.Record) -> list[str]:
        errors = harness.joined(one["x_mm"]), harness.joined(one["gap_mm"])
        inside = harness.joined(one["inside_95"], "{:.1%}", ", ")
        return [one["name"], str(one["runs"]), f"{one['found']:.1%}", *errors, inside]

    return "\n\n".join(harness.table([name, *head], map(cells, rows)) for name, rows in found.items())


def draw(records: list[harness.Record], found: dict[str, list[harness.Record]]) -> Figure:
    """Draw the share found over distance and angle, errors, and coverage."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    shares_axis, errors_axis, coverage_axis = figure.subplots(1, 3)

    def share(facing: float, at: float) -> float:
        return float(
            np.mean([not o["refused"] for o in records if (o["facing_deg"], o["distance_m"]) == (facing, at)] or [0.0])
        )

    shares = np.array([[share(facing, at) for at in DISTANCES_M] for facing in FACING_DEG])
    shares_axis.imshow(100 * shares, vmin=0, vmax=100, cmap="viridis", aspect="auto")
    for (i, j), value in np.ndenumerate(shares):
        shares_axis.text(j, i, f"{value:.0%}", ha="center", va="center", color="w" if value < 0.6 else "k")
    shares_axis.set_xticks(range(len(DISTANCES_M)), [f"{at:.2f}" for at in DISTANCES_M])
    shares_axis.set_yticks(range(len(FACING_DEG)), [f"{at:.0f}" for at in FACING_DEG])
    shares_axis.set(xlabel="distance, m", ylabel="facing, degrees", title="found, of all sheets (in view or not)")
    rows = [one for one in found["look"] if one["x_mm"]]
    for (name, marker), (at, style) in product((("x_mm", "o"), ("gap_mm", "s")), (("p50", "-"), ("p95", "--"))):
        values = [one[name][at] for one in rows]
        errors_axis.plot(range(len(rows)), values, marker + style, label=f"{name[:-3]} {at}")
    errors_axis.set_xticks(range(len(rows)), [one["name"] for one in rows], rotation=20, fontsize=8)
    errors_axis.set(yscale="log", ylabel="error, mm", title="sheets in view")
    errors_axis.legend(fontsize=8)
    groups = [one | {"name": f"{group} {one['name']}"} for group in ("look", "facing", "gap") for one in found[group]]
    harness.draw_coverage(coverage_axis, groups, QUANTITIES)
    return figure


def main() -> None:
    """Measure, write, draw, print."""
    parser = harness.options(__doc__)
    parser.add_argument("--runs", type=int, default=1, help="trials of each setting (default: 1)")
    runs, start = parser.parse_args().runs, time.perf_counter()
    records = harness.collect("occluder", settings(), trial, runs)
    found = tables(records)
    facts = {"runs_of_each_setting": runs, "minutes": (time.perf_counter() - start) / 60}
    harness.write("occluder_study", facts | found)
    harness.save("occluder_study", draw(records, found), dpi=90)
    print(as_markdown(found), facts, sep="\n\n")


if __name__ == "__main__":
    main()
