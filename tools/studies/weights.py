"""Where weights work: `evaluate`'s figures over the rigs of SI 1: docs/rig_map.json and docs/images/rig_map.png.

`--weights [NAME=]DIR`, once or more: other weights than the shipped ones, side by side. The lidar moves (0.15 to
0.30 m from the wall, 15 to 75 degrees to its normal); occluder and object box stay. A second run keeps the cells that
are done.
"""

import hashlib
import json
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from named_weights import by_name, errors_told, named
from nlos_calibration.object_sight import lidar_sees
from nlos_calibration.rig import Rig, load_rig
from nlos_models.checkpoint import load_record, shipped_folder
from nlos_models.inference import Reconstructor, load_reconstructor

from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import tracked
from nlos_cam.cli.evaluate_maps import as_eaten, bare_wall_for
from nlos_cam.dataset import TEST_SEED, DatasetPlan
from nlos_cam.evaluate import BARS, SMALLER_IS_BETTER, judge, plain
from nlos_cam.evaluate_objects import Subject, as_map_set, echoes_of, reconstruct_all, sense, truth_of
from nlos_cam.folders import file_when_whole
from nlos_cam.objects.depth_image import object_box
from nlos_cam.objects.test_set import test_set
from nlos_cam.render.scene_file import RENDERING_VERSION

DOCS = Path(__file__).parents[2] / "docs"
DISTANCES_M = 0.15, 0.2, 0.25, 0.3
ANGLES_DEG = 15.0, 30.0, 45.0, 60.0, 75.0
SHIPPED = "shipped"

Cell = dict[str, Any]


def rig_at(rig: Rig, distance_m: float, yaw_deg: float) -> Rig:
    """The rig with its lidar elsewhere."""
    lidar = rig.lidar.model_copy(update={"distance_m": distance_m, "yaw_deg": yaw_deg})
    return rig.model_copy(update={"name": f"{rig.name} at {distance_m:g} m, {yaw_deg:g} degrees", "lidar": lidar})


def cell_at(rig: Rig, subjects: Sequence[Subject], networks: Mapping[str, Reconstructor]) -> Cell:
    """The figures of all networks on one rig; those that eat difference maps know the bare wall as it is there."""
    box, plan = object_box(rig), DatasetPlan(rig, TEST_SEED)
    truth = truth_of(subjects, box)
    maps = as_map_set(sense(echoes_of(subjects, rig, _untold), rig), truth)
    eaten = {name: as_eaten(maps, bare_wall_for(network.record, plan)) for name, network in networks.items()}
    found = {name: judge(reconstruct_all(network, eaten[name]), truth, box) for name, network in networks.items()}
    return {
        "distance_m": rig.lidar.distance_m,
        "yaw_deg": rig.lidar.yaw_deg,
        "rig_checksum": rig.checksum,
        "share_of_box_in_direct_sight": lidar_sees(rig, box),
        "share_of_cells_with_a_return": float(np.mean(~np.isnan(maps.depth_m))),
        "weights": {name: plain(figures) for name, figures in found.items()},
    }


def _untold(done: int, total: int) -> None:
    del done, total


def measured(
    rig: Rig,
    grid: Sequence[tuple[float, float]],
    subjects: Sequence[Subject],
    networks: Mapping[str, Reconstructor],
    path: Path,
    made_of: str,
) -> list[Cell]:
    """All cells of a grid, each written down when it is done; those that are there are kept if `made_of` is alike."""
    cells = _kept(path, made_of)
    with tracked("rigs") as on_progress:
        for distance_m, yaw_deg in grid:
            there = rig_at(rig, distance_m, yaw_deg)
            if not any(cell["rig_checksum"] == there.checksum for cell in cells):
                cells.append(cell_at(there, subjects, networks))
                table = {"objects": len(subjects), "made_of": made_of, "cells": cells}
                with file_when_whole(path) as part:
                    part.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
            on_progress(len(cells), len(grid))
    return cells


def _kept(path: Path, made_of: str) -> list[Cell]:
    table = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return table["cells"] if table.get("made_of") == made_of else []


def checksum(folders: Mapping[str, Path | None], subjects: Sequence[Subject]) -> str:
    """Of weights, renderer and objects: cells of others are no use."""
    digest = hashlib.sha256(f"{RENDERING_VERSION} {' '.join(folders)}".encode())
    for folder in folders.values():
        for file in sorted((folder or shipped_folder()).glob("*.safetensors")):
            digest.update(file.read_bytes())
        digest.update(load_record(folder or shipped_folder()).input.encode())
    for subject in subjects:
        digest.update(subject.depth_m.tobytes())
    return digest.hexdigest()[:16]


def draw(path: Path, cells: Sequence[Cell], rig: Rig) -> None:
    """A heat map of each metric for each of the weights, with its numbers; the rig of the weights is framed."""
    from matplotlib.figure import Figure

    names = list(cells[0]["weights"])
    distances, angles = (sorted({cell[of] for cell in cells}) for of in ("distance_m", "yaw_deg"))
    figure = Figure(figsize=(3.4 * len(BARS), 2.9 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), len(BARS), squeeze=False)
    for row, name in zip(rows, names, strict=True):
        for axis, metric in zip(row, BARS, strict=True):
            values = np.full((len(distances), len(angles)), np.nan)
            for cell in cells:
                value = cell["weights"][name][metric]["value"]
                values[distances.index(cell["distance_m"]), angles.index(cell["yaw_deg"])] = (
                    np.nan if value is None else value
                )
            _heat(axis, values, metric)
            axis.set(xticks=range(len(angles)), xticklabels=[f"{angle:g}" for angle in angles], xlabel="angle, degrees")
            axis.set(yticks=range(len(distances)), yticklabels=[f"{distance:g}" for distance in distances])
            if rig.lidar.distance_m in distances and rig.lidar.yaw_deg in angles:
                _frame(axis, angles.index(rig.lidar.yaw_deg), distances.index(rig.lidar.distance_m))
        row[0].set_ylabel(f"{name}\ndistance, m")
    figure.savefig(path, dpi=80)


def _heat(axis: Any, values: Any, metric: str) -> None:
    smaller = metric in SMALLER_IS_BETTER
    known = values[~np.isnan(values)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 0.0)
    axis.imshow(values, cmap="viridis_r" if smaller else "viridis", aspect="auto", origin="lower")
    for (i, j), value in np.ndenumerate(values):
        bright = (value - low) / max(high - low, 1e-9)
        ink = "white" if (1 - bright if smaller else bright) <= 0.55 else "black"  # what has no value is white
        words = "none" if np.isnan(value) else f"{value:.0f}" if smaller else f"{value:.2f}"
        axis.text(j, i, words, ha="center", va="center", fontsize=8, color=ink)
    axis.set_title(metric.replace("_", " "), fontsize=9)


def _frame(axis: Any, column: int, row: int) -> None:
    from matplotlib.patches import Rectangle

    axis.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor="red", linewidth=2))


def main() -> None:
    """Measure, write, draw."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=named, action="append", default=[])
    parser.add_argument("--rig", default="paper-rig")
    parser.add_argument("--out", type=Path, default=DOCS)
    asked = parser.parse_args()
    folders: dict[str, Path | None] = by_name(asked.weights) or {SHIPPED: None}
    (asked.out / "images").mkdir(parents=True, exist_ok=True)
    with errors_told():
        networks = {name: load_reconstructor(folder, cache_folder() / "onnx") for name, folder in folders.items()}
        rig = load_rig(asked.rig)
        grid = [(distance_m, yaw_deg) for distance_m in DISTANCES_M for yaw_deg in ANGLES_DEG]
        subjects = test_set(object_box(rig))
        made_of = checksum(folders, subjects)
        cells = measured(rig, grid, subjects, networks, asked.out / "rig_map.json", made_of)
    draw(asked.out / "images" / "rig_map.png", cells, rig)
    for cell in cells:
        ious = {name: figures["silhouette_iou"]["value"] for name, figures in cell["weights"].items()}
        print(f"{cell['distance_m']:g} m, {cell['yaw_deg']:g} degrees: IoU {ious}")


if __name__ == "__main__":
    main()
