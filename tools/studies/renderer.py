"""What the renderer's time and memory grow with: docs/scaling.json and docs/images/scaling.png (no arguments).

Time against active patches and against beams, each with a straight line fitted; what self-occlusion costs; and peak
memory at four times the default grids, of a process of its own (`--memory` is that process).
"""

import json
import resource
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.choose import Work, least_seconds, some_of
from nlos_cam.render.effects import Effects, included
from nlos_cam.render.prepare import Prepared
from nlos_cam.render.renderer import render, three_bounce
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import paper_scene
from nlos_cam.render.tradeoff_report import machine

DOCS = Path(__file__).parents[2] / "docs"
STANDARD = STOPS["standard"]
REPEATS = 15
DENSE = replace(STANDARD, beams_per_cell=2)
FOUR_TIMES = replace(DENSE, relay_columns=160, relay_rows=128)


@dataclass(frozen=True)
class Line:
    """Times and the straight line nearest to them."""

    count: list[int]
    seconds: list[float]
    seconds_each: float
    seconds_fixed: float
    r_squared: float
    largest_deviation: float
    """Of a time from the line, as a share of that time."""


def sheet(cells: int, rows: int) -> Scene:
    """A wavy sheet, which shades itself, over the first rows of an object grid (cells, cells)."""
    y, x = np.mgrid[0:cells, 0:cells] / cells
    depth = 0.2 + 0.03 * np.sin(12 * x) * np.cos(9 * y)
    depth[rows:] = np.nan
    return Scene(load_rig("paper-rig"), depth.astype(np.float32))


def histograms_of(scene: Scene, accuracy: Accuracy, beams: int | None = None) -> Work:
    """The three-bounce histograms of all beams on the wall, or of some, as a piece of work."""
    lit = np.flatnonzero(Prepared.of(scene, accuracy, "auto").beams.on_wall)
    chosen = some_of(lit, beams or len(lit))
    return lambda: three_bounce(scene, accuracy, chosen=chosen)


def in_turns(works: list[Work]) -> list[float]:
    """The least seconds of each piece of work, done in turns: what disturbs the machine disturbs them alike."""
    for work in works:
        work()  # compiles
    rounds = [[least_seconds(work, 1) for work in works] for _ in range(REPEATS)]
    return np.min(rounds, axis=0).tolist()


def fitted(count: list[int], seconds: list[float]) -> Line:
    """A straight line through times, by least squares."""
    each, fixed = np.polyfit(count, seconds, 1)
    off = np.array(seconds) - (fixed + each * np.array(count))
    r_squared = 1 - float((off**2).sum() / np.square(seconds - np.mean(seconds)).sum())
    return Line(count, seconds, float(each), float(fixed), r_squared, float((np.abs(off) / seconds).max()))


def against_patches() -> Line:
    """Time against the patches of a sheet of growing height."""
    rows = [4, 8, 16, 24, 32, 48, 64]
    return fitted([64 * n for n in rows], in_turns([histograms_of(sheet(64, n), STANDARD) for n in rows]))


def against_beams() -> Line:
    """Time against the beams that are rendered of the default scene, two to a cell's side."""
    scene = paper_scene().scene_at(0)
    lit = int(Prepared.of(scene, DENSE, "auto").beams.on_wall.sum())
    count = [lit * n // 12 for n in (1, 2, 4, 6, 8, 10, 12)]
    return fitted(count, in_turns([histograms_of(scene, DENSE, n) for n in count]))


def self_occlusion() -> dict[str, dict[str, float | bool]]:
    """Seconds of a whole rendering as planned, with self-occlusion forced in, and with it left out."""
    box = paper_scene().scene_at(0).box
    level = np.full((64, 64), (box.z_near_m + box.z_far_m) / 2, np.float32)
    scenes = {
        "airplane": paper_scene().scene_at(0),
        "wavy sheet": sheet(64, 64),
        "level plate": Scene(load_rig("paper-rig"), level),
    }
    return {name: _with_and_without(scene) for name, scene in scenes.items()}


def _with_and_without(scene: Scene) -> dict[str, float | bool]:
    plan = render(scene).plan
    others = {effect.name for effect in plan if effect.included} - {"self-occlusion"}
    asked: list[Effects] = ["auto", {*others, "self-occlusion"}, others]
    planned, forced, without = in_turns([partial(render, scene, effects=effects) for effects in asked])
    return {
        "called_for": included(plan, "self-occlusion"),
        "seconds_planned": planned,
        "seconds_with": forced,
        "seconds_without": without,
        "times_as_long": forced / without,
    }


def peak_mib() -> float:
    """The most memory this process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def memory() -> dict[str, float | str]:
    """Peak memory of a fresh process that renders four times the default grids, object grid full."""
    run = [sys.executable, str(Path(__file__).resolve()), "--memory"]
    peak, before = map(float, subprocess.run(run, check=True, capture_output=True, text=True).stdout.split())
    grids = "160 x 128 beams, 128 x 128 object cells, 160 x 128 relay cells"
    return {"grids": grids, "peak_mib": peak, "before_rendering_mib": before}


def draw(patches: Line, beams: Line) -> None:
    """Times and fitted lines, side by side."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes: list[Axes] = list(figure.subplots(1, 2))
    for axis, line, name in zip(axes, (patches, beams), ("active patches", "beams on the wall"), strict=True):
        ends = np.array([0, max(line.count)])
        axis.plot(ends, 1000 * (line.seconds_fixed + line.seconds_each * ends), color="0.6", label="straight line")
        axis.plot(line.count, 1000 * np.array(line.seconds), "o", label="measured")
        axis.set(xlabel=name, ylabel="milliseconds", title=f"R² = {line.r_squared:.4f}", ylim=(0, None))
        axis.legend()
    figure.savefig(DOCS / "images" / "scaling.png", dpi=110)


def main() -> None:
    """Measure, write, print."""
    if "--memory" in sys.argv:
        before = peak_mib()
        render(sheet(128, 128), FOUR_TIMES)
        print(peak_mib(), before)
        return
    peak = memory()  # first: a process starts with the peak of the one that started it
    patches, beams = against_patches(), against_beams()
    result = {
        "machine": machine(),
        "memory": peak,
        "patches": asdict(patches),
        "beams": asdict(beams),
        "self_occlusion": self_occlusion(),
    }
    (DOCS / "scaling.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    draw(patches, beams)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
