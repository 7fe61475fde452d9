"""Transfer to a bench: its recordings, figures on it and on the paper's rig, and the learning curve
over recordings.

    python tools/studies/transfer.py record DIR [--scene examples/bench.toml] [--frames 8]
    python tools/studies/transfer.py figures DIR [--weights W]
        docs/figures/transfer.json
    python tools/studies/transfer.py curve DIR RUNS --recipe direct-transfer [--weights W]
        docs/figures/transfer_curve.json, .png

DIR holds the 54 test objects as labelled recordings of a simulated bench, for adaptation,
validation and judging: of 8 frames of 640 x 480 they take 0.4 GB and two minutes, and a second call
resumes. Frames of a bench at rest differ by their noise alone, so that more of them would add
little; a person's recordings of a few seconds have more. One frame of each of 18 objects that no
run trains on is judged. RUNS holds the trainings, which resume.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import repeat
from pathlib import Path
from threading import Event
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import ObjectBox, load_rig
from nlos_calibration.arrays import Float32
from nlos_models import CheckpointRecord, Reconstructor, load_reconstructor, surface
from nlos_models.training import MapSet, load_recipe
from numpy.typing import NDArray

from nlos_cam.camera import FRAMES_PER_S, Recording, SimulatedCamera, World
from nlos_cam.cli.common import tracked
from nlos_cam.dataset import Labelled, list_recordings, read_labelled, write_shards
from nlos_cam.errors import RecordingError
from nlos_cam.evaluate import mm_per_v, over_objects, per_object, plain, reconstruct_all
from nlos_cam.files import cache_folder, checksums_of
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects import (
    CATEGORIES,
    BenchmarkObject,
    benchmark_objects,
    image_from_depth,
    object_box,
)
from nlos_cam.reconstruct import align_all
from nlos_cam.recording import (
    CaptureSession,
    CaptureTarget,
    finalize,
    load_sidecar,
    sidecar_path,
    verify,
)
from nlos_cam.render import Scene, SceneFile, SensedImages, Sensor, SensorModel, load_scene, render

SCENE = Path(__file__).parents[2] / "examples" / "bench.toml"
ADAPTATION = "adaptation"
VALIDATION = "validation"
HELD_OUT = "held-out"
"""30 objects, 6 for the training's schedule, and 18 for judging: no object is in two parts."""
HELD_OUT_NUMBER = 3
VALIDATION_NUMBER = 2
VALIDATION_EVERY = 3
"""Of each category's three objects, one is held out; of every third category, another is for
validation.
"""
FRAMES = 8
BETWEEN_S = 30.0
"""Time between starts of recordings, in which the object is changed and the lidar warms."""
PARTS = ADAPTATION, VALIDATION, HELD_OUT
COUNTS = 2, 5, 10, 20, 30
FINISHED = "figures.json"
OnProgress = Callable[[int, int], None]


class HurriedClock:
    """Clock that moves only by waiting, so that nothing has to wait."""

    def __init__(self, start_s: float = 1e9) -> None:
        self.time_s = start_s

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        self.time_s += max(seconds, 0.0)
        return stop.wait(0.0005)


class Later(World):
    """World at rest, seen by a camera that was switched on `since` frames ago."""

    def __init__(self, scene: SceneFile, shown: Scene, since: int) -> None:
        super().__init__(scene, [render(shown).multi], [shown.object_depth_m])
        self._since = since

    def images(self, number: int) -> SensedImages:
        return super().images(self._since + number)

    def celsius(self, number: int) -> Mapping[str, float]:
        return super().celsius(self._since + number)


@dataclass(frozen=True)
class Take:
    """Recording to be made: object, file, and frames since the device was switched on."""

    thing: BenchmarkObject
    path: Path
    since: int

    @property
    def truth(self) -> Path:
        """Path of the hidden depth: labels stay true when a generator of objects changes."""
        return self.path.with_suffix(".npy")

    @property
    def is_whole(self) -> bool:
        """True where the recording exists, of the object in its present shape."""
        if not (self.path.is_file() and self.truth.is_file()):
            return False
        same = np.array_equal(np.load(self.truth), self.thing.depth_m, equal_nan=True)
        try:
            return same and load_sidecar(sidecar_path(self.path)).state == "complete"
        except RecordingError:
            return False


def part_of(thing: BenchmarkObject) -> str:
    """Return the part of an object."""
    if thing.number == HELD_OUT_NUMBER:
        return HELD_OUT
    looked_at = sorted(CATEGORIES).index(thing.category) % VALIDATION_EVERY == 0
    return VALIDATION if looked_at and thing.number == VALIDATION_NUMBER else ADAPTATION


def takes(things: Sequence[BenchmarkObject], folder: Path) -> list[Take]:
    """Return one take of each object, in order: F/adaptation/cup-1.bag, F/held-out/cup-3.bag,
    ...
    """
    apart = round(BETWEEN_S * FRAMES_PER_S)
    return [
        Take(thing, folder / part_of(thing) / f"{thing.name}.bag", k * apart)
        for k, thing in enumerate(things)
    ]


def record(take: Take, scene: SceneFile, frames: int) -> None:
    """Make one recording and its sidecar, and read it back. Raises the error that ended it, if one
    did.
    """
    take.path.parent.mkdir(parents=True, exist_ok=True)
    sidecar_path(take.path).unlink(missing_ok=True)  # until it is there, nothing is whole
    np.save(take.truth, take.thing.depth_m)
    bare = scene.bare
    shown = Scene(
        scene.rig, take.thing.depth_m, bare.surface, scene.radiometry, scene.jump_m, bare.pulse_ns
    )
    recording = Recording(take.path, frames=frames)
    camera = SimulatedCamera(
        f"sim:{scene.rig.name}",
        Later(scene, shown, take.since),
        clock=HurriedClock(),
        recording=recording,
    )
    job = CaptureTarget(take.path, take.thing.name)
    for made in CaptureSession(camera, recording, [job]).record(Event(), lambda _: None):
        settled = finalize(made, verify)
        if settled.error:
            raise settled.error


def record_all(
    scene: SceneFile,
    things: Sequence[BenchmarkObject],
    folder: Path,
    frames: int,
    on_progress: OnProgress,
) -> Iterator[Path]:
    """Make the missing recordings in order; yield each when it exists."""
    for done, take in enumerate(every := takes(things, folder)):
        on_progress(done, len(every))
        if not take.is_whole:
            record(take, scene, frames)
        yield take.path


def record_bench(asked: argparse.Namespace) -> None:
    """Record the test objects on a simulated bench."""
    scene = load_scene(asked.scene)
    things = benchmark_objects(object_box(scene.rig))
    with tracked("recording the test objects") as on_progress:
        made = list(record_all(scene, things, asked.folder, asked.frames, on_progress))
    size_gb = sum(path.stat().st_size for path in made) / 1e9
    print(f"{len(made)} recordings of {asked.frames} frames, {size_gb:.2f} GB: {asked.folder}")


def judge(reconstructor: Reconstructor, maps: MapSet, box: ObjectBox) -> dict[str, Any]:
    """Return the metrics by name over samples, each {value, low, high}, and the number of
    samples.
    """
    image, truth = reconstruct_all(reconstructor, maps), maps.image.astype(np.float32)
    too_far_mm = mm_per_v(box) * too_far(image, truth)
    values = {**per_object(image, truth, box), "foreground_too_far_mm": too_far_mm}
    return {"objects": len(truth), **plain(over_objects(values))}


def too_far(image: Float32, truth: Float32) -> NDArray[np.float64]:
    """Return the mean shortfall of v where both show surface, (n,); NaN where they share none.

    Training by squared error turns uncertainty into distance, which is this part of the RMSE.
    """
    both = surface(image) & surface(truth)
    count = both.sum((-2, -1))
    sums = np.where(both, truth.astype(np.float64) - image, 0.0).sum((-2, -1))
    return np.where(count > 0, sums / np.maximum(count, 1), np.nan)


def paper_box() -> ObjectBox:
    """Return the paper's object box; the bench's has the same depth."""
    return object_box(load_rig("paper-rig"))


def on_paper_rig(on_progress: OnProgress) -> dict[str, MapSet]:
    """Render each part of the test set on the paper's rig, with the sensor's noise."""
    rig = load_rig("paper-rig")
    box = object_box(rig)
    sensor = Sensor(rig, SensorModel())
    parts: dict[str, list[tuple[Float32, Float32, Float32]]] = {part: [] for part in PARTS}
    for number, thing in enumerate(things := benchmark_objects(box)):
        images = sensor.expose(
            render(Scene(rig, thing.depth_m)).multi, np.random.default_rng([number, 1])
        )
        maps = maps_from_frame(images.frame(rig.pinhole))
        parts[part_of(thing)].append(
            (maps.depth_m, maps.intensity, image_from_depth(thing.depth_m, box))
        )
        on_progress(number + 1, len(things))
    return {
        part: MapSet(*map(np.stack, zip(*samples, strict=True))) for part, samples in parts.items()
    }


def on_bench(
    folder: Path, trained: CheckpointRecord, on_progress: OnProgress
) -> dict[str, dict[str, MapSet]]:
    """Read one frame of each recording of each folder: aligned with the rig of weights, and as
    measured.
    """
    found = {part: list_recordings(folder / part) for part in PARTS}
    read = {
        part: read_labelled(paths, frames=1, on_progress=on_progress)
        for part, paths in found.items()
    }
    aligned = {part: align_all(one.maps, repeat(one.rig), trained) for part, one in read.items()}
    measured = {part: one.recorded for part, one in read.items()}
    return {"bench": aligned, "bench, not aligned": measured}


def figures(asked: argparse.Namespace) -> None:
    """Judge weights on the simulated bench and on the paper's rig."""
    reconstructor = load_reconstructor(asked.weights, cache_folder() / "onnx")
    with tracked("rendering the paper's rig") as on_progress:
        rigs = {"paper-rig": on_paper_rig(on_progress)}
    with tracked("reading recordings") as on_progress:
        rigs |= on_bench(asked.folder, reconstructor.record, on_progress)
    box = paper_box()
    found = {
        rig: {part: judge(reconstructor, maps, box) for part, maps in parts.items()}
        for rig, parts in rigs.items()
    }
    harness.write("transfer", {"weights": str(asked.weights or "shipped"), **found}, asked.out)
    for rig, parts in found.items():
        for part, one in parts.items():
            iou = one["silhouette_iou"]["value"]
            rmse_mm = one["foreground_rmse_mm"]["value"]
            print(
                f"{rig} {part}: {one['objects']} objects, silhouette IoU {iou:.3f}, foreground RMSE"
                f" {rmse_mm:.1f} mm"
            )


@dataclass(frozen=True)
class Lesson:
    """Data, number of frames (not recordings) and run folder of one training; a second call resumes
    there.
    """

    dataset: Path
    validation: Path
    samples: int
    out: Path


Trainer = Callable[[Lesson], Path]
"""Trains on a lesson and returns the folder of the weights."""


@dataclass(frozen=True)
class Point:
    """One point of a curve."""

    trainer: str
    recordings: int
    figures: Mapping[str, Any]


def commanded(task: str, recipe: Path, *others: object) -> Trainer:
    """Return `nlos-cam train TASK` as a trainer, which raises NlosCamError where the command
    fails.
    """

    def train(lesson: Lesson) -> Path:
        given = {
            "--recipe": recipe,
            "--dataset": lesson.dataset,
            "--held-out": lesson.validation,
            "--objects": lesson.samples,
            "--out": lesson.out,
        }
        arguments = [
            "train",
            task,
            *(str(part) for pair in given.items() for part in pair),
            *map(str, others),
        ]
        harness.run_command(*arguments)
        return lesson.out

    return train


def nested(
    recordings: Sequence[Path], counts: Sequence[int], seed: int = 0
) -> dict[int, list[Path]]:
    """Return for each count that number of recordings, at most all, in a random order: each set is
    within the next.
    """
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
    """Yield the points: the initial weights, then every trainer at each number of recordings.

    Points of an earlier call are read from `runs`.
    """
    held_out = read_labelled(list_recordings(folder / HELD_OUT), frames=1)
    validation = runs / "validation"
    write_shards(read_labelled(list_recordings(folder / VALIDATION), frames=frames), validation)
    yield Point("before", 0, _judged(before, held_out))
    for count, chosen in nested(list_recordings(folder / ADAPTATION), counts).items():
        data = runs / f"{count:02d}-recordings"
        labelled = read_labelled(chosen, frames=frames)
        write_shards(labelled, data)
        for name, trainer in trainers.items():
            lesson = Lesson(data, validation, len(labelled.label), runs / f"{count:02d}-{name}")
            yield Point(name, count, _reached(lesson, trainer, held_out))


def _reached(lesson: Lesson, trainer: Trainer, held_out: Labelled) -> dict[str, Any]:
    done = lesson.out / FINISHED
    if not done.is_file():
        figures = _judged(trainer(lesson), held_out)
        done.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return json.loads(done.read_text(encoding="utf-8"))


def _judged(weights: Path | None, held_out: Labelled) -> dict[str, Any]:
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    return judge(
        reconstructor,
        align_all(held_out.maps, repeat(held_out.rig), reconstructor.record),
        paper_box(),
    )


def draw(points: Sequence[Point]) -> Figure:
    """Draw foreground RMSE and silhouette IoU against the number of recordings, with their
    intervals.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    named = {"foreground_rmse_mm": "foreground RMSE, mm", "silhouette_iou": "silhouette IoU"}
    for axis, (metric, title) in zip(figure.subplots(1, 2), named.items(), strict=True):
        start = points[0].figures[metric]["value"]
        axis.axhline(start, color="grey", linestyle=":", label="before")
        for trainer in dict.fromkeys(point.trainer for point in points[1:]):
            own = [point for point in points if point.trainer == trainer]
            ends = [
                [point.figures[metric][part] for part in ("value", "low", "high")] for point in own
            ]
            value, low, high = np.array(ends, float).T
            at = [point.recordings for point in own]
            axis.plot(at, value, marker="o", label=trainer)
            axis.fill_between(at, low, high, alpha=0.2)
        axis.set(xlabel="recordings adapted to", ylabel=title, ylim=(0, None))
        axis.legend(frameon=False)
    return figure


def run_curve(asked: argparse.Namespace) -> None:
    """Train on growing numbers of recordings, and judge."""
    harness.claim(
        asked.runs,
        recordings=asked.folder.resolve(),
        recipe=load_recipe(asked.recipe),
        weights=checksums_of(asked.weights) if asked.weights else "shipped",
    )
    given = ["--weights", asked.weights] if asked.weights else []
    trainers = {"transfer": commanded("transfer", asked.recipe, *given)}
    points = list[Point]()
    for point in curve(asked.folder, asked.runs, trainers, asked.weights, asked.counts):
        points.append(point)
        names = "foreground_rmse_mm", "foreground_too_far_mm", "silhouette_iou"
        values = ", ".join(f"{name} {point.figures[name]['value']}" for name in names)
        print(f"{point.trainer}, {point.recordings} recordings: {values}", flush=True)
    reached = {"frames_each": FRAMES, "points": [asdict(point) for point in points]}
    harness.write("transfer_curve", reached, asked.out)
    harness.save("transfer_curve", draw(points), asked.out, dpi=110)


def main() -> None:
    """Run the named study."""
    parser = harness.options(__doc__)
    commands = parser.add_subparsers(required=True)
    for name, work in {"record": record_bench, "figures": figures, "curve": run_curve}.items():
        part = commands.add_parser(name, help=work.__doc__)
        part.set_defaults(run=work)
        part.add_argument("folder", type=Path)
        if work is record_bench:
            part.add_argument("--scene", type=Path, default=SCENE)
            part.add_argument("--frames", type=int, default=FRAMES)
            continue
        if work is run_curve:
            part.add_argument("runs", type=Path)
            part.add_argument("--recipe", type=Path, required=True)
            part.add_argument("--counts", type=int, nargs="+", default=COUNTS)
        part.add_argument(
            "--weights", type=Path, help="initial weights (default: the shipped ones)"
        )
        part.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
