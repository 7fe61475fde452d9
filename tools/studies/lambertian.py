"""What a network reads from locked differences in Lambertian radiometry, by averaging time:
docs/figures/lambertian.json and docs/images/lambertian.png.

`lambertian.py RUNS [--minutes M] [--workers N] [--seconds S ...] [--out DIR]`. For matt and
retroreflective objects on the paper's rig, with a pulse of 1 ns, `nlos-cam adapt --frames` trains a
network for each averaging time at 30 frames a second; objects are rendered once for each material.
RUNS holds the runs: a second call goes on, also after a kill.
"""

import json
import os
import platform
import shutil
from pathlib import Path
from typing import Any

import harness
from matplotlib.figure import Figure

from nlos_cam.adapt import OBJECTS
from nlos_cam.camera import FRAMES_PER_S

SECONDS = 30, 300, 3600
MATERIALS = "matt", "retroreflective"
RIG = "paper-rig"
PULSE_NS = 1.0
SHARED = OBJECTS, "held-out"
"""Folders that do not depend on the averaging time."""


def run(folder: Path, material: str, seconds: int, minutes: float, workers: int) -> dict[str, Any]:
    """Adapt to one averaging time, or go on with it, and return the figures."""
    words = ["adapt", RIG, "--minutes", minutes, "--out", folder, "--workers", workers]
    words += ["--frames", FRAMES_PER_S * seconds, "--radiometry", "lambertian"]
    words += ["--pulse-ns", PULSE_NS, "--material", material]
    harness.run_command(*words)
    last = f"stage-{len(plan_of(folder)['stages'])}"
    figures = folder / "locked" / last / "report" / "figures.json"
    return json.loads(figures.read_text(encoding="utf-8"))


def plan_of(folder: Path) -> dict[str, Any]:
    """Return the plan of an adaptation to locked differences."""
    return json.loads((folder / "locked" / "plan.json").read_text(encoding="utf-8"))


def share(first: Path, folder: Path, seconds: int) -> None:
    """Begin a folder with the objects and the plan of another averaging time."""
    target = folder / "locked"
    if target.exists():
        return
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name in SHARED:
        shutil.copytree(
            first / "locked" / name,
            part / "locked" / name,
            copy_function=os.link,
            ignore=shutil.ignore_patterns(".*"),
        )
    plan = plan_of(first)
    plan["locked"]["frames"] = FRAMES_PER_S * seconds
    (part / "locked" / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
    part.rename(folder)


def draw(rows: list[dict[str, Any]]) -> Figure:
    """Draw the silhouette IoU over the averaging time, with the guess."""
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axis = figure.subplots()
    for material in MATERIALS:
        own = [row for row in rows if row["material"] == material]
        iou = [row["silhouette_iou"] for row in own]
        low = [one["value"] - one["low"] for one in iou]
        high = [one["high"] - one["value"] for one in iou]
        seconds = [row["seconds"] for row in own]
        values = [one["value"] for one in iou]
        axis.errorbar(seconds, values, (low, high), marker="o", capsize=3, label=material)
    axis.axhline(rows[0]["guess"]["value"], color="grey", linestyle=":", label="a guess")
    axis.set(xscale="log", xlabel="seconds averaged, object in and out", ylabel="silhouette IoU")
    axis.legend(frameon=False)
    return figure


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--minutes", type=float, default=120.0, help="Of each adaptation.")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=int, nargs="+", default=SECONDS)
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked = parser.parse_args()
    harness.claim(asked.runs, minutes=asked.minutes)

    rows: list[dict[str, Any]] = []
    for material in MATERIALS:
        first = asked.runs / f"{material}-{asked.seconds[0]}"
        for seconds in asked.seconds:
            folder = asked.runs / f"{material}-{seconds}"
            if folder != first:
                share(first, folder, seconds)
            figures = run(folder, material, seconds, asked.minutes, asked.workers)
            row = {
                "material": material,
                "seconds": seconds,
                "objects": plan_of(folder)["stages"][-1]["objects"],
                "silhouette_iou": figures["silhouette_iou"],
                "foreground_rmse_mm": figures["foreground_rmse_mm"],
                "guess": figures["baselines"]["mean_object"]["silhouette_iou"],
            }
            rows.append(row)
            print(json.dumps(row), flush=True)
    machine = f"{os.cpu_count()} cores, {platform.machine()}"
    found = {"machine": machine, "minutes": asked.minutes, "rig": RIG, "rows": rows}
    harness.write("lambertian", found, asked.out)
    harness.save("lambertian", draw(rows), asked.out, dpi=110)


if __name__ == "__main__":
    main()
