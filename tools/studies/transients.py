"""Transients: y-tal's own loader and back-projection of all four captures of three objects, and the
time to render one beside mitransient.

    python tools/studies/transients.py [tal] [mitransient] --tal-python VENV/bin/python
        docs/figures/transients.json, docs/images/transients.png

Each part that is named (default: all) replaces its own part of the JSON; the picture belongs to
`tal`. The Python named has y-tal and mitransient (`pip install y-tal mitransient`); they need numpy below
2, so usually a virtual environment of their own.
"""

import json
import os
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import rig_named
from nlos_calibration.arrays import Float32
from PIL import Image

from nlos_cam import render as renderer
from nlos_cam.evaluate import machine
from nlos_cam.objects import load_object, mesh_from_depth, object_box
from nlos_cam.transients import CAPTURES, Capture, Transient, render_transient, save_transient

OBJECTS = "cup", "airplane", "table"
RIG = rig_named("paper-rig")
BOX = object_box(RIG)
TOOLS = Path(__file__).parent
SAMPLES = [64, 256, 1024]
COLORS = 32
PARTS = ["tal", "mitransient"]


def run(python: str, program: str, *arguments: str) -> Any:
    """Return the JSON that a program prints, run by another Python."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    line = [python, str(TOOLS / program), *arguments]
    ended = subprocess.run(line, capture_output=True, text=True, check=False, env=environment)
    if ended.returncode:
        raise SystemExit(f"{program} failed: {ended.stderr.strip().splitlines()[-1]}")
    return json.loads(ended.stdout.splitlines()[-1])


def off_the_object_m(depth_m: Float32, point_m: list[float]) -> float:
    """Return the distance from a point to the hidden surface."""
    points = mesh_from_depth(depth_m, BOX).vertices_m
    return float(np.linalg.norm(points - np.array(point_m), axis=1).min())


def rendered(name: str, depth_m: Float32, folder: Path) -> dict[str, float]:
    """Write the four captures of an object; return the seconds to render each."""
    scene = renderer.Scene(RIG, depth_m)
    seconds: dict[str, float] = {}
    for kind in CAPTURES:
        render_transient(scene, Capture(kind))  # compiles
        start = time.perf_counter()
        found = render_transient(scene, Capture(kind))
        seconds[kind] = time.perf_counter() - start
        save_transient(folder / f"{name}-{kind}.hdf5", found)
    return seconds


def captures(python: str, folder: Path) -> tuple[dict[str, Any], Figure]:
    """Return seconds and tal's peaks for each object and capture, and the pictures."""
    figure = Figure(figsize=(7.2, 8.0), layout="constrained")
    axes = figure.subplots(len(OBJECTS), 1 + len(CAPTURES))
    rows: dict[str, Any] = {}
    extent = BOX.x_min_m, BOX.x_max_m, BOX.y_min_m, BOX.y_max_m
    depths = {name: load_object(name, BOX).depth_m for name in OBJECTS}
    seconds = {name: rendered(name, depth_m, folder) for name, depth_m in depths.items()}
    answers = run(python, "tal_reader.py", *map(str, sorted(folder.glob("*.hdf5"))))
    for line, name in zip(axes, OBJECTS, strict=True):
        depth_m = depths[name]
        line[0].imshow(depth_m, cmap="viridis_r", extent=extent)
        line[0].set_title(name, fontsize=8)
        rows[name] = {}
        for axis, kind in zip(line[1:], CAPTURES, strict=True):
            answer = answers[f"{name}-{kind}.hdf5"]
            light = np.load(folder / f"{name}-{kind}.tal.npy")
            axis.imshow(light.max(2).T, cmap="magma", origin="lower", extent=extent)
            axis.plot(*answer["peak_m"][:2], "+", color="cyan")
            axis.set_title(kind, fontsize=8)
            rows[name][kind] = {
                "render_s": seconds[name][kind],
                "shape": answer["shape"],
                "peak_m": answer["peak_m"],
                "peak_off_the_object_m": off_the_object_m(depth_m, answer["peak_m"]),
            }
    for axis in axes.ravel():
        axis.axis("off")
    return rows, figure


def normalized(histograms: Float32) -> Float32:
    """Return histograms (T, ...) that each sum to 1: only their shapes are left."""
    total = histograms.sum(0)
    return histograms / np.where(total > 0, total, 1)


def apart(one: Float32, other: Float32) -> float:
    """Return the mean L1 distance of the shapes of histograms (T, x, y)."""
    return float(np.abs(normalized(one) - normalized(other)).sum(0).mean())


def beside_mitransient(python: str, folder: Path) -> dict[str, Any]:
    """Time one capture of 32 x 32 points of the cup without an occluder in both programs, at equal
    error.
    """
    rig = RIG.model_copy(update={"occluder": None})
    depth_m = load_object("cup", BOX).depth_m
    scene = renderer.Scene(rig, depth_m, radiometry="lambertian")
    capture = Capture("single")
    found = render_transient(scene, capture)
    start = time.perf_counter()
    found = render_transient(scene, capture)
    ours_s = time.perf_counter() - start
    exact = render_transient(scene, capture, "reference")
    write_ply(folder / "cup.ply", depth_m)
    wall = rig.relay
    facts = {
        "wall": [wall.x_min_m, wall.x_max_m, wall.y_min_m, wall.y_max_m],
        "cells": 32,
        "lidar_m": rig.wall_from_lidar[:3, 3].tolist(),
        "laser_m": found.laser_grid_m[0, 0].tolist(),
        "bin_m": found.bin_m,
        "start_m": 0.0,
        "bins": found.bins,
        "samples": SAMPLES,
    }
    out = folder / "mitransient.npy"
    try:
        told = run(
            python, "mitransient_capture.py", str(folder / "cup.ply"), json.dumps(facts), str(out)
        )
    except SystemExit as error:
        return {"mitransient": str(error)}
    every = np.load(out)
    best = oriented(every[-1].mean(0), exact)
    rows = [
        {
            "samples": samples,
            "seconds": seconds,
            # Two runs differ by sqrt(2) of the noise of one.
            "noise": apart(runs[0], runs[1]) / np.sqrt(2),
        }
        for samples, seconds, runs in zip(SAMPLES, told["seconds"], every, strict=True)
    ]
    return {
        "ours_s": ours_s,
        "ours_from_exact": apart(found.histograms, exact.histograms),
        "mitransient": rows,
        "shapes_apart": apart(best, exact.histograms),
        "mean_arrival_apart_m": mean_arrival_apart_m(best, exact),
    }


def oriented(image: Float32, exact: Transient) -> Float32:
    """Return a film (T, ...) in our axes (T, x, y): of its eight turns the one that agrees best."""
    turns = [np.rot90(image, k, (1, 2)) for k in range(4)]
    turns += [turn.swapaxes(1, 2) for turn in turns]
    return min(turns, key=lambda turn: apart(turn, exact.histograms))


def mean_arrival_apart_m(image: Float32, exact: Transient) -> float:
    """Return the root mean square difference of the mean path lengths of all points."""
    path_m = exact.start_m + exact.bin_m * (np.arange(exact.bins) + 0.5)
    means = [np.tensordot(path_m, normalized(one), 1) for one in (image, exact.histograms)]
    return float(np.sqrt(np.mean((means[0] - means[1]) ** 2)))


def write_ply(path: Path, depth_m: Float32) -> None:
    """Write the hidden surface as a mesh."""
    import trimesh

    surface = mesh_from_depth(depth_m, BOX)
    trimesh.Trimesh(surface.vertices_m, surface.faces, process=False).export(path)


def save(figure: Figure) -> None:
    """Write the picture with a palette, as the docs keep theirs small."""
    harness.save("transients", figure, dpi=70)
    path = harness.DOCS / "images/transients.png"
    Image.open(path).convert("RGB").quantize(COLORS).save(path, optimize=True)


def main() -> None:
    """Run the parts that are named, and write their figures and the picture."""
    parser = harness.options(__doc__)
    parser.add_argument("parts", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--tal-python", required=True, help="a Python with y-tal and mitransient")
    options = parser.parse_args()
    path = harness.DOCS / "figures/transients.json"
    facts = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for part in options.parts:
        with TemporaryDirectory() as folder:
            if part == "tal":
                found, figure = captures(options.tal_python, Path(folder))
                save(figure)
            else:
                found = beside_mitransient(options.tal_python, Path(folder))
        load = os.getloadavg()[0]
        facts[part] = {"machine": machine(), "load_average_1_min": load, **found}
        harness.write("transients", facts)
        print(json.dumps(facts[part], indent=1))


if __name__ == "__main__":
    main()
