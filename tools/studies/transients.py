"""Transients: y-tal's own loader and back-projection of all four captures of three objects, the
time to render each, and the capture `single` beside mitransient's.

    python tools/studies/transients.py --tal-python VENV/bin/python --mitransient-python VENV/bin/python
        docs/figures/transients.json, docs/images/transients.png

The first Python has y-tal (`pip install y-tal`; it needs numpy below 2), the second mitransient,
whose kernels need LLVM 16 or later: name it in DRJIT_LIBLLVM_PATH. Without the second, its figures
of an earlier run are kept.
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
import trimesh
from matplotlib.figure import Figure
from nlos_calibration import rig_named
from nlos_calibration.arrays import Float32

from nlos_cam import render as renderer
from nlos_cam.evaluate import machine
from nlos_cam.objects import load_object, mesh_from_depth, object_box
from nlos_cam.transients import CAPTURES, Capture, Transient, render_transient, save_transient

OBJECTS = "cup", "airplane", "table"
RIG = rig_named("paper-rig")
BOX = object_box(RIG)
TOOLS = Path(__file__).parent
SAMPLES = 128, 256, 512, 1024, 2048
"""Of each point by mitransient."""
CONVERGED = 16384


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
    """Write the four captures of an object; return the processor seconds to render each."""
    scene = renderer.Scene(RIG, depth_m)
    seconds: dict[str, float] = {}
    for kind in CAPTURES:
        render_transient(scene, Capture(kind))  # compiles
        start_s = time.process_time()
        found = render_transient(scene, Capture(kind))
        seconds[kind] = time.process_time() - start_s
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
                "processor_s": seconds[name][kind],
                "shape": answer["shape"],
                "peak_m": answer["peak_m"],
                "peak_off_the_object_m": off_the_object_m(depth_m, answer["peak_m"]),
            }
    for axis in axes.ravel():
        axis.axis("off")
    return rows, figure


def beside_mitransient(python: str, folder: Path) -> dict[str, Any]:
    """Return processor seconds and error of the capture `single`, ours and mitransient's, for each
    object.

    The error is the distance (L1) of the points' histograms, each of sum 1, from mitransient's with
    CONVERGED samples. Same mesh, grid, bins and lidar; no occluder, as its laser knows none.
    """
    rig = RIG.model_copy(update={"occluder": None})
    capture = Capture("single")
    rows: dict[str, Any] = {"machine": machine()}
    for name in OBJECTS:
        depth_m = load_object(name, BOX).depth_m
        scene = renderer.Scene(rig, depth_m, radiometry="lambertian")
        render_transient(scene, capture)  # compiles
        start_s = time.process_time()
        found = render_transient(scene, capture)
        ours_s = time.process_time() - start_s

        mesh = mesh_from_depth(depth_m, BOX)
        path = folder / f"{name}.ply"
        trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).export(path)
        facts = scene_facts(found, path)
        (folder / f"{name}.json").write_text(json.dumps(facts), encoding="utf-8")
        numbers = map(str, (*SAMPLES, CONVERGED))
        answer = run(python, "mitransient_render.py", str(folder / f"{name}.json"), *numbers)

        truth = of_sum_one(np.load(folder / f"{name}-{CONVERGED}.npy").transpose(0, 2, 1))
        theirs = {
            samples: np.load(folder / f"{name}-{samples}.npy").transpose(0, 2, 1)
            for samples in SAMPLES
        }
        rows["versions"] = answer["versions"]
        rows[name] = {
            "ours": {"processor_s": ours_s, "error": distance(found.histograms, truth)},
            "mitransient": [
                {
                    "samples": samples,
                    "processor_s": answer["seconds"][str(samples)],
                    "error": distance(light, truth),
                }
                for samples, light in theirs.items()
            ],
        }
    return rows


def scene_facts(found: Transient, mesh: Path) -> dict[str, Any]:
    """Return what mitransient_render.py asks for."""
    relay = RIG.relay
    return {
        "mesh": str(mesh),
        "wall": [relay.x_min_m, relay.x_max_m, relay.y_min_m, relay.y_max_m],
        "cells": found.histograms.shape[1],
        "bins": found.bins,
        "bin_m": found.bin_m,
        "start_m": found.start_m,
        "laser_m": found.laser_grid_m.reshape(3)[:2].tolist(),
        "lidar_m": np.array(found.laser_m).tolist(),
    }


def of_sum_one(histograms: Float32) -> Float32:
    """Return histograms (bins, x, y), each divided by its sum."""
    return histograms / np.maximum(histograms.sum(0, keepdims=True), 1e-30)


def distance(histograms: Float32, truth: Float32) -> float:
    """Return the mean L1 distance of histograms of sum 1."""
    return float(np.abs(of_sum_one(histograms) - truth).sum(0).mean())


def main() -> None:
    """Render, let tal look, and write figures and picture."""
    parser = harness.options(__doc__)
    parser.add_argument("--tal-python", required=True, help="a Python with y-tal")
    parser.add_argument("--mitransient-python", help="a Python with mitransient")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        found, figure = captures(options.tal_python, Path(folder))
    harness.save("transients", figure, dpi=70)
    facts = {"machine": machine(), "load_average_1_min": os.getloadavg()[0], "objects": found}
    path = harness.DOCS / "figures" / "transients.json"
    old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    facts["beside_mitransient"] = old.get("beside_mitransient")
    if options.mitransient_python:
        with TemporaryDirectory() as folder:
            facts["beside_mitransient"] = beside_mitransient(
                options.mitransient_python, Path(folder)
            )
    harness.write("transients", facts)
    print(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
