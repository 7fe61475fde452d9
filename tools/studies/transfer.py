"""Error on the simulated bench against the number of recordings that were adapted to: docs/transfer_curve.json, .png.

`python tools/transfer_curve.py DIR RUNS --recipe models/recipes/paper-rig-transfer.toml [--weights W]
[--scratch models/recipes/paper-rig-compressor-scratch.toml]`; DIR is that of `transfer_bench.py`, RUNS keeps the runs
and goes on where it was stopped. Judged by one frame of each of 18 objects that no run has seen; `train` itself looks
at 6 others. With --scratch the same recordings also train a compressor from nothing, onto the latent of the weights'
VAE.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from nlos_models.data import MapSet
from nlos_models.inference import load_reconstructor
from transfer_bench import ADAPTATION, FRAMES, HELD_OUT, VALIDATION
from transfer_figures import DOCS, judge, paper_box

from nlos_cam.cache import cache_folder
from nlos_cam.cli.main import main as nlos_cam
from nlos_cam.errors import NlosCamError
from nlos_cam.labelled import read_labelled, recordings_in
from nlos_cam.labelled_shards import write_shards

COUNTS = 2, 5, 10, 20, 30
FINISHED = "figures.json"


@dataclass(frozen=True)
class Lesson:
    """What a trainer is given."""

    dataset: Path
    validation: Path
    samples: int
    """In the dataset: frames, not recordings."""
    out: Path
    """The run's folder; a second call resumes there."""


Trainer = Callable[[Lesson], Path]
"""Trains on a lesson and returns the folder of the weights."""


@dataclass(frozen=True)
class Point:
    """One point of a curve."""

    trainer: str
    recordings: int
    figures: Mapping[str, Any]
    """Of `transfer_figures.judge`, on the held-out objects."""


def commanded(task: str, recipe: Path, *others: object) -> Trainer:
    """`nlos-cam train TASK` as a trainer. It raises NlosCamError where the command fails, and has said why."""

    def train(lesson: Lesson) -> Path:
        given = {
            "--recipe": recipe,
            "--dataset": lesson.dataset,
            "--held-out": lesson.validation,
            "--objects": lesson.samples,
            "--out": lesson.out,
        }
        arguments = ["train", task, *(str(part) for pair in given.items() for part in pair), *map(str, others)]
        if code := nlos_cam(arguments):
            raise NlosCamError(f"nlos-cam {' '.join(arguments)} ended with {code}: see above; run this again to go on")
        return lesson.out

    return train


def nested(recordings: Sequence[Path], counts: Sequence[int], seed: int = 0) -> dict[int, list[Path]]:
    """For each count, at most all, so many of the recordings in a random order: each set is within the next."""
    order = np.random.default_rng(seed).permutation(len(recordings))
    sizes = sorted({min(count, len(recordings)) for count in counts})
    return {size: [recordings[k] for k in order[:size]] for size in sizes}


def curve(
    folder: Path,
    runs: Path,
    trainers: Mapping[str, Trainer],
    before: Path | None,
    counts: Sequence[int] = COUNTS,
    frames: int = FRAMES,
) -> Iterator[Point]:
    """The points, as they are reached: the weights as they were, then every trainer at each number of recordings.

    Those that an earlier call reached are read from `runs`.
    """
    held_out = read_labelled(recordings_in(folder / HELD_OUT), frames=1).maps
    validation = runs / "validation"
    write_shards(read_labelled(recordings_in(folder / VALIDATION), frames=frames), validation)
    yield Point("before", 0, _judged(before, held_out))
    for count, chosen in nested(recordings_in(folder / ADAPTATION), counts).items():
        data = runs / f"{count:02d}-recordings"
        labelled = read_labelled(chosen, frames=frames)
        write_shards(labelled, data)
        for name, trainer in trainers.items():
            lesson = Lesson(data, validation, len(labelled.label), runs / f"{count:02d}-{name}")
            yield Point(name, count, _reached(lesson, trainer, held_out))


def _reached(lesson: Lesson, trainer: Trainer, held_out: MapSet) -> dict[str, Any]:
    done = lesson.out / FINISHED
    if not done.is_file():
        figures = _judged(trainer(lesson), held_out)
        done.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return json.loads(done.read_text(encoding="utf-8"))


def _judged(weights: Path | None, maps: MapSet) -> dict[str, Any]:
    return judge(load_reconstructor(weights, cache_folder() / "onnx"), maps, paper_box())


def draw(points: Sequence[Point], path: Path) -> None:
    """Foreground RMSE and silhouette IoU against the number of recordings, with their intervals."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    named = {"foreground_rmse_mm": "foreground RMSE, mm", "silhouette_iou": "silhouette IoU"}
    for axis, (metric, title) in zip(figure.subplots(1, 2), named.items(), strict=True):
        start = points[0].figures[metric]["value"]
        axis.axhline(start, color="grey", linestyle=":", label="before")
        for trainer in dict.fromkeys(point.trainer for point in points[1:]):
            own = [point for point in points if point.trainer == trainer]
            value, low, high = np.array(
                [[point.figures[metric][part] for part in ("value", "low", "high")] for point in own], float
            ).T
            at = [point.recordings for point in own]
            axis.plot(at, value, marker="o", label=trainer)
            axis.fill_between(at, low, high, alpha=0.2)
        axis.set(xlabel="recordings adapted to", ylabel=title, ylim=(0, None))
        axis.legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--recipe", type=Path, required=True)
    parser.add_argument("--weights", type=Path, help="where to start; the shipped weights unless given")
    parser.add_argument("--scratch", type=Path, help="a recipe for `train compressor`, on the same recordings")
    parser.add_argument("--out", type=Path, default=DOCS, help="where the figures and their picture go")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    asked = parser.parse_args()
    trainers = {
        "transfer": commanded("transfer", asked.recipe, *(["--weights", asked.weights] if asked.weights else []))
    }
    if asked.scratch:
        trainers["from scratch"] = commanded(
            "compressor", asked.scratch, *(["--vae", asked.weights] if asked.weights else [])
        )
    points: list[Point] = []
    for point in curve(asked.folder, asked.runs, trainers, asked.weights, asked.counts):
        points.append(point)
        rmse_mm, far_mm, iou = (
            point.figures[name]["value"] for name in ("foreground_rmse_mm", "foreground_too_far_mm", "silhouette_iou")
        )
        told = f"RMSE {rmse_mm} mm, {far_mm} mm too far, silhouette IoU {iou}"
        print(f"{point.trainer}, {point.recordings} recordings: {told}", flush=True)
    reached = {"frames_each": FRAMES, "points": [asdict(point) for point in points]}
    pictures = asked.out / "images"
    pictures.mkdir(parents=True, exist_ok=True)
    (asked.out / "transfer_curve.json").write_text(json.dumps(reached, indent=2) + "\n", encoding="utf-8")
    draw(points, pictures / "transfer_curve.png")


if __name__ == "__main__":
    main()
