"""Transients: y-tal's own loader and back-projection of all four captures of three objects, and the
time to render each.

    python tools/studies/transients.py --tal-python VENV/bin/python
        docs/figures/transients.json, docs/images/transients.png

The Python named has y-tal (`pip install y-tal`); it needs numpy below 2, so usually a virtual
environment of its own.
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
from nlos_cam.transients import CAPTURES, Capture, render_transient, save_transient

OBJECTS = "cup", "airplane", "table"
RIG = rig_named("paper-rig")
BOX = object_box(RIG)
TOOLS = Path(__file__).parent
COLORS = 32


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


def save(figure: Figure) -> None:
    """Write the picture with a palette, as the docs keep theirs small."""
    harness.save("transients", figure, dpi=70)
    path = harness.DOCS / "images/transients.png"
    Image.open(path).convert("RGB").quantize(COLORS).save(path, optimize=True)


def main() -> None:
    """Render, let tal look, and write figures and picture."""
    parser = harness.options(__doc__)
    parser.add_argument("--tal-python", required=True, help="a Python with y-tal")
    python = parser.parse_args().tal_python
    with TemporaryDirectory() as folder:
        found, figure = captures(python, Path(folder))
    save(figure)
    load = os.getloadavg()[0]
    facts = {"machine": machine(), "load_average_1_min": load, "objects": found}
    harness.write("transients", facts)
    print(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()
