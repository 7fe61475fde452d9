"""What weights make of the simulated bench, and of the same objects on the paper's rig: docs/transfer.json.

`python tools/transfer_figures.py DIR [--weights W] [--out docs/transfer.json]`; DIR is that of `transfer_bench.py`. Of
each recording one frame is judged, as `live` shows it.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox, load_rig
from nlos_models import metrics
from nlos_models.data import MapSet
from nlos_models.inference import Reconstructor, load_reconstructor
from numpy.typing import NDArray
from transfer_bench import ADAPTATION, HELD_OUT, VALIDATION, part_of

from nlos_cam.cli.common import tracked
from nlos_cam.dataset.labelled import read_labelled, recordings_in
from nlos_cam.evaluate import metrics as evaluate
from nlos_cam.evaluate.subjects import reconstruct_all
from nlos_cam.files import cache_folder
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

DOCS = Path(__file__).parents[1] / "docs"
PARTS = ADAPTATION, VALIDATION, HELD_OUT
OnProgress = Callable[[int, int], None]


def judge(reconstructor: Reconstructor, maps: MapSet, box: ObjectBox) -> dict[str, Any]:
    """The metrics by name over samples, each {value, low, high}, and how many samples there were."""
    image, truth = reconstruct_all(reconstructor, maps), maps.image.astype(np.float32)
    too_far_mm = evaluate.mm_per_v(box) * too_far(image, truth)
    values = {**evaluate.per_object(image, truth, box), "foreground_too_far_mm": too_far_mm}
    return {"objects": len(truth), **evaluate.plain(evaluate.over_objects(values))}


def too_far(image: Float32, truth: Float32) -> NDArray[np.float64]:
    """By how much v is too small on average where both show surface, (n,); NaN where they share none.

    Doubt that training by squared error turns into distance shows here; what is left of the RMSE is not of that kind.
    """
    both = metrics.surface(image) & metrics.surface(truth)
    count = both.sum((-2, -1))
    sums = np.where(both, truth.astype(np.float64) - image, 0.0).sum((-2, -1))
    return np.where(count > 0, sums / np.maximum(count, 1), np.nan)


def paper_box() -> ObjectBox:
    """The paper's object box; the bench's is as deep."""
    return object_box(load_rig("paper-rig"))


def on_paper_rig(on_progress: OnProgress) -> dict[str, MapSet]:
    """The same objects as the training renderer has them, with the sensor's noise: each part of the test set."""
    rig = load_rig("paper-rig")
    box, sensor = object_box(rig), Sensor(rig, SensorModel())
    parts: dict[str, list[tuple[Float32, Float32, Float32]]] = {part: [] for part in PARTS}
    for number, thing in enumerate(things := test_set(box)):
        images = sensor.expose(render(Scene(rig, thing.depth_m)).multi, np.random.default_rng([number, 1]))
        maps = maps_from_frame(images.frame(rig.pinhole))
        parts[part_of(thing)].append((maps.depth_m, maps.intensity, image_from_depth(thing.depth_m, box)))
        on_progress(number + 1, len(things))
    return {part: MapSet(*map(np.stack, zip(*samples, strict=True))) for part, samples in parts.items()}


def on_bench(folder: Path, on_progress: OnProgress) -> dict[str, MapSet]:
    """One frame of each recording of each folder."""
    return {part: read_labelled(recordings_in(folder / part), frames=1, on_progress=on_progress).maps for part in PARTS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--out", type=Path, default=DOCS / "transfer.json")
    asked = parser.parse_args()
    reconstructor = load_reconstructor(asked.weights, cache_folder() / "onnx")
    with tracked("rendering the paper's rig") as on_progress:
        rigs = {"paper-rig": on_paper_rig(on_progress)}
    with tracked("reading recordings") as on_progress:
        rigs["bench"] = on_bench(asked.folder, on_progress)
    box = paper_box()
    figures = {
        rig: {part: judge(reconstructor, maps, box) for part, maps in parts.items()} for rig, parts in rigs.items()
    }
    told = {"weights": str(asked.weights or "shipped"), **figures}
    asked.out.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    for rig, parts in figures.items():
        for part, found in parts.items():
            iou, rmse_mm = found["silhouette_iou"]["value"], found["foreground_rmse_mm"]["value"]
            print(
                f"{rig} {part}: {found['objects']} objects, silhouette IoU {iou:.3f}, foreground RMSE {rmse_mm:.1f} mm"
            )


if __name__ == "__main__":
    main()
