"""Trade-off of accuracy against time in reconstruction: number formats, runtimes, threads and
averaged frames.
"""

import shlex
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import nlos_models as models
import numpy as np
import torch
from nlos_calibration import ObjectBox, Rig, rig_named
from nlos_calibration.arrays import Float32

from nlos_cam.camera import FRAMES_PER_S, OnProgress
from nlos_cam.dataset import TEST_SEED, TRAINING_SEED
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import subjects
from nlos_cam.evaluate.figures import LABELS
from nlos_cam.evaluate.metrics import SMALLER_IS_BETTER, TARGETS, Figures, judge, plain
from nlos_cam.evaluate.render_tradeoff import INCOMPLETE, undominated, write_table
from nlos_cam.files import atomic_directory
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import Mirrored
from nlos_cam.render import MultiBounce
from nlos_cam.report import (
    Banner,
    Bullets,
    Commands,
    Document,
    Picture,
    Section,
    Table,
    figure_of,
    saved_picture,
)

FRAMES = 1, 4, 16
THREADS = 1, 2
CALIBRATING = 32
"""Training objects that calibrate the ranges of 8-bit activations."""
MIN_CALLS = 50
"""Minimum number of calls for a median; a small set of objects is repeated until then."""
AS_GOOD = {
    "silhouette_iou": 0.005,
    "accuracy_mean_abs": 0.001,
    "accuracy_within_2_percent": 0.005,
    "foreground_rmse_mm": 0.5,
}
"""Losses that the recommended setting may have against float32 in torch."""

Make = Callable[[int], models.Reconstructor]
"""Makes a reconstructor for a number of threads."""
Clock = Callable[[], float]


@dataclass(frozen=True)
class RuntimeSetting:
    """Weights, runtime, threads and averaged frames of one measurement."""

    name: str
    weights: str
    runtime: str
    threads: int
    frames: int
    """Frames averaged, as by `live --average`."""


@dataclass(frozen=True)
class RuntimeRow:
    """Time and accuracy of one setting."""

    setting: RuntimeSetting
    milliseconds: float
    """Median time of one call on one object's maps."""
    milliseconds_p90: float
    figures: Figures

    @property
    def wait_ms(self) -> float:
        """Return the time in which the averaged frames arrive, at the camera's rate."""
        return 1000 * self.setting.frames / FRAMES_PER_S


@dataclass(frozen=True)
class RuntimeBench:
    """Objects and their echoes, on which every setting is measured."""

    rig: Rig
    box: ObjectBox
    truth: Float32
    echoes: list[MultiBounce]

    @classmethod
    def of(
        cls, objects: Sequence[subjects.Subject], rig: Rig, box: ObjectBox, on_progress: OnProgress
    ) -> "RuntimeBench":
        """Render the objects."""
        return cls(
            rig, box, subjects.truth_of(objects, box), subjects.echoes_of(objects, rig, on_progress)
        )


def open_runtime_bench(
    weights: Mapping[str, Path | None],
    count: int | None = None,
    tracked: subjects.Tracked = subjects.untracked,
) -> RuntimeBench:
    """Render the 54 test objects, or `count` random ones, on the rig of all these weights (None:
    the shipped ones).

    Raises SceneError if the weights are for different rigs or expect difference maps,
    CheckpointError for color.
    """
    records = {
        name: models.load_record(models.weights_folder(folder)) for name, folder in weights.items()
    }
    for name, record in records.items():
        models.refuse_color(record, weights[name])
    rigs = {record.rig_name for record in records.values()}
    if len(rigs) > 1:
        raise SceneError(
            f"the weights are for different rigs ({', '.join(sorted(rigs))}): compare weights of"
            " one rig"
        )
    if inputs := {record.input for record in records.values()} - {"raw maps"}:
        raise SceneError(
            f"the weights expect {inputs.pop()} but the test maps are raw: use weights for raw maps"
        )
    rig = rig_named(rigs.pop())
    box = object_box(rig)
    objects = subjects.seeded_objects(TEST_SEED, count, box) if count else benchmark_objects(box)
    with tracked("rendering") as on_progress:
        return RuntimeBench.of(objects, rig, box, on_progress)


def runtimes(weights: Path | None, rig: Rig, box: ObjectBox, cache: Path) -> dict[str, Make]:
    """Return a maker for every runtime and number format of weights, by name.

    8-bit networks are quantised when first made, with ranges calibrated on training objects.
    """
    folder = models.weights_folder(weights)
    record = models.load_record(folder)
    key, export = models.network_export(folder)

    def onnx(suffix: str, make_content: Callable[[bytes], bytes] = bytes) -> Make:
        def make(threads: int) -> models.Reconstructor:
            def content() -> bytes:
                return make_content(models.load_cached(cache / key, bytes, export))

            path = (cache / key).with_suffix(suffix)
            return models.load_cached(
                path, lambda model: models.OnnxReconstructor(model, record, threads), content
            )

        return make

    def in_torch(device: str, dtype: torch.dtype) -> Make:
        def make(threads: int) -> models.Reconstructor:
            del threads  # torch has one number for all networks, set by `measure_runtimes`
            return models.TorchReconstructor(models.load_network(weights)[0], record, device, dtype)

        return make

    def mirrored(threads: int) -> models.Reconstructor:
        return Mirrored(onnx(".onnx")(threads))

    formats = {"float32": torch.float32, "bfloat16": torch.bfloat16}
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return {
        **{
            f"torch {name}, {device}": in_torch(device, dtype)
            for device in devices
            for name, dtype in formats.items()
        },
        "ONNX Runtime float32": onnx(".onnx"),
        **(
            {} if record.direct_recipe else {"ONNX Runtime float32, mirrored": mirrored}
        ),  # a direct network is exact
        "ONNX Runtime int8 weights": onnx(".dynamic-7.onnx", models.quantize),
        "ONNX Runtime int8": onnx(
            f".static-7-{rig.checksum}.onnx",
            lambda model: models.quantize(model, calibration(rig, box)),
        ),
    }


def calibration(rig: Rig, box: ObjectBox) -> Iterator[models.Sample]:
    """Yield maps of training objects, one at a time."""
    objects = subjects.seeded_objects(TRAINING_SEED, CALIBRATING, box)
    for maps in subjects.sense(subjects.echoes_of(objects, rig, lambda _done, _total: None), rig):
        yield maps.depth_m[None], maps.intensity[None]


def runtime_settings(weights: Sequence[str], runtime_names: Sequence[str]) -> list[RuntimeSetting]:
    """Return all settings to measure: every runtime on one frame, and several frames on the runtime
    of `live`.
    """
    singles = [
        RuntimeSetting(
            f"{runtime}, {threads} thread{'s' * (threads > 1)}", name, runtime, threads, 1
        )
        for name in weights
        for runtime in runtime_names
        for threads in THREADS
        if "cuda" not in runtime or threads == THREADS[0]
    ]
    averaged = [
        RuntimeSetting(
            f"ONNX Runtime float32, {frames} frames", name, "ONNX Runtime float32", 1, frames
        )
        for name in weights
        for frames in FRAMES[1:]
    ]
    return singles + averaged


def measure_runtimes(
    asked: Sequence[RuntimeSetting],
    makes: Mapping[str, Mapping[str, Make]],
    bench: RuntimeBench,
    clock: Clock = time.perf_counter,
) -> Iterator[RuntimeRow]:
    """Measure each setting and yield its row; `makes` has the runtimes of each folder of weights by
    name.
    """
    maps: dict[int, list[LidarMaps]] = {}
    for setting in asked:
        if setting.frames not in maps:
            maps[setting.frames] = subjects.sense(bench.echoes, bench.rig, frames=setting.frames)
        with _torch_threads(setting.threads):
            reconstructor = makes[setting.weights][setting.runtime](setting.threads)
            image, seconds = _timed(reconstructor, maps[setting.frames], bench.truth, clock)
        middle, late = 1000 * np.quantile(seconds, [0.5, 0.9])
        yield RuntimeRow(setting, float(middle), float(late), judge(image, bench.truth, bench.box))


@contextmanager
def _torch_threads(count: int) -> Generator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _timed(
    reconstructor: models.Reconstructor, maps: Sequence[LidarMaps], truth: Float32, clock: Clock
) -> tuple[Float32, list[float]]:
    """Return images of all maps and the seconds of every call but the first, which allocates."""
    both = subjects.as_map_set(maps, truth)
    reconstructor(both.depth_m[:1], both.intensity[:1])
    images: list[Float32] = []
    seconds: list[float] = []
    for _ in range(-(-MIN_CALLS // len(truth))):
        images.clear()
        for depth_m, intensity in zip(both.depth_m, both.intensity, strict=True):
            start_s = clock()
            images.append(reconstructor(depth_m[None], intensity[None]))
            seconds.append(clock() - start_s)
    return np.concatenate(images), seconds


def losses(row: RuntimeRow, base: RuntimeRow) -> dict[str, float]:
    """Return by how much a row is worse than the base, by metric; infinite without a value."""
    worse: dict[str, float] = {}
    for name in TARGETS:
        mine = row.figures[name].value
        its = base.figures[name].value
        sign = 1 if name in SMALLER_IS_BETTER else -1
        worse[name] = float("inf") if mine is None or its is None else sign * (mine - its)
    return worse


def recommended(rows: Sequence[RuntimeRow]) -> RuntimeRow | None:
    """Return the fastest single-frame setting that loses at most AS_GOOD against the first row;
    None without rows.
    """
    if not rows:
        return None
    base = rows[0]
    candidates = [
        row
        for row in rows
        if row.setting.frames == 1
        and all(loss <= AS_GOOD[name] for name, loss in losses(row, base).items())
    ]
    return min(candidates, key=lambda row: row.milliseconds, default=base)


def pareto_front(rows: Sequence[RuntimeRow]) -> list[RuntimeRow]:
    """Return the single-frame rows that no other beats in both time and silhouette IoU, from fast
    to slow.
    """
    singles = (row for row in rows if row.setting.frames == 1)
    return undominated(
        singles, lambda row: (row.milliseconds, -(row.figures["silhouette_iou"].value or 0.0))
    )


HEAD = (
    "setting",
    "time, ms: median",
    "p90",
    "wait for frames, ms",
    *LABELS.values(),
    "loses accuracy",
)
NOTES = (
    "Times are of one call on one object's maps: medians over all objects, after a first call that"
    " is not counted; they are from this machine and run. More frames cost no network time: their"
    ' maps are averaged while the next arrive, and the picture is as old as the wait. "Loses'
    ' accuracy": worse than the first row by more than any of'
    f" {', '.join(f'{least:g} of {LABELS[name]}' for name, least in AS_GOOD.items())}."
)
PLOT_CAPTION = (
    "Left: one frame; numbers are threads. Right: averaged frames. Lines: 95 % intervals over"
    " objects."
)


def runtime_facts(
    rows: Sequence[RuntimeRow], planned: int, objects: int, machine: str
) -> dict[str, Any]:
    """Return all rows, ready for JSON; `complete` is False after an interruption."""
    pick = recommended(rows)
    return {
        "machine": machine,
        "objects": objects,
        "complete": len(rows) == planned,
        "settings": [
            {
                **asdict(row.setting),
                "milliseconds": row.milliseconds,
                "milliseconds_p90": row.milliseconds_p90,
                "wait_ms": row.wait_ms,
                **plain(row.figures),
                "loses_accuracy": any(
                    loss > AS_GOOD[name] for name, loss in losses(row, rows[0]).items()
                ),
            }
            for row in rows
        ],
        "recommended": (
            {"name": pick.setting.name, "weights": pick.setting.weights} if pick else None
        ),
        "pareto_front": [
            {"name": row.setting.name, "weights": row.setting.weights} for row in pareto_front(rows)
        ],
    }


def runtime_document(
    table: Mapping[str, Any], folder: Path | None = None, out: str = "tradeoff"
) -> Document:
    """Return the report on a table, with the plot in `folder`, which will be renamed to `out`."""
    pick = table["recommended"]
    banner = Banner("doubtful", "Nothing was measured", "")
    if pick:
        banner = Banner(
            "good",
            f"Recommended: {_called(pick)}",
            "The fastest single-frame setting that loses no accuracy.",
        )
    live = (
        "nlos-cam live --camera sim --budget-ms 30 --tradeoff"
        f" {shlex.quote(f'{out}/tradeoff.json')}"
    )
    parts: list[Section | Picture] = [
        Section("", [banner, Bullets("Note", [] if table["complete"] else [INCOMPLETE])]),
        Section("Settings", [Table(HEAD, [_line(row) for row in table["settings"]]), NOTES]),
        Section("Next commands", [Commands([live, "nlos-cam evaluate"])]),
    ]
    if folder:
        parts.insert(
            2, saved_picture("Accuracy against time", PLOT_CAPTION, folder / "tradeoff.png")
        )
    subtitle = f"{table['machine']}; {table['objects']} objects."
    return Document("Reconstruction: accuracy against time", subtitle, parts)


def _called(setting: Mapping[str, Any]) -> str:
    return (
        setting["name"]
        if setting["weights"] == "shipped"
        else f"{setting['weights']}: {setting['name']}"
    )


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    values = [row[name]["value"] for name in TARGETS]
    metrics = [
        "none" if value is None else f"{value:.3f}" if value < 1 else f"{value:.1f}"
        for value in values
    ]
    times = f"{row['milliseconds']:.1f}", f"{row['milliseconds_p90']:.1f}", f"{row['wait_ms']:.0f}"
    return _called(row), *times, *metrics, "yes" if row["loses_accuracy"] else "no"


def write_runtimes(folder: Path, table: Mapping[str, Any], rows: Sequence[RuntimeRow]) -> None:
    """Write the measured trade-off as JSON, report and plot."""
    with atomic_directory(folder) as part:
        draw_runtimes(part / "tradeoff.png", rows)
        write_table(part, table, runtime_document(table, part, str(folder)))


def draw_runtimes(path: Path, rows: Sequence[RuntimeRow]) -> None:
    """Draw silhouette IoU against milliseconds per call, and against averaged frames."""
    figure = figure_of(12, 5.5)
    times, frames = figure.subplots(1, 2, width_ratios=(2, 1))
    front = pareto_front(rows)
    places = (
        [row.milliseconds for row in front],
        [row.figures["silhouette_iou"].value for row in front],
    )
    times.plot(
        *places, color="0.8", linewidth=6, solid_capstyle="round", label="not beaten in both"
    )
    singles = [row for row in rows if row.setting.frames == 1]
    for runtime in dict.fromkeys((row.setting.weights, row.setting.runtime) for row in singles):
        _series(
            times, [row for row in singles if (row.setting.weights, row.setting.runtime) == runtime]
        )
    times.set(
        xscale="log",
        xlabel="milliseconds per call (log)",
        ylabel="silhouette IoU, 95 % interval over objects",
    )
    times.set_title("one frame: format, runtime, threads")
    times.legend(fontsize=8)
    for weights in dict.fromkeys(row.setting.weights for row in rows):
        _against_frames(frames, weights, [row for row in rows if row.setting.weights == weights])
    frames.set(
        xscale="log",
        xlabel="frames averaged",
        xticks=FRAMES,
        xticklabels=FRAMES,
        title="averaged frames",
    )
    for axis in (times, frames):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=100)


def _series(axis: Any, rows: Sequence[RuntimeRow]) -> None:
    """Draw one runtime with its numbers of threads."""
    setting = rows[0].setting
    label = (
        setting.runtime if setting.weights == "shipped" else f"{setting.weights}: {setting.runtime}"
    )
    (line,) = axis.plot(
        [row.milliseconds for row in rows],
        [row.figures["silhouette_iou"].value for row in rows],
        "o-",
        label=label,
    )
    for row in rows:
        iou = row.figures["silhouette_iou"]
        axis.plot([row.milliseconds] * 2, [iou.low, iou.high], color=line.get_color(), alpha=0.35)
        words = f"{row.setting.threads}"
        axis.annotate(
            words, (row.milliseconds, iou.value), (4, 4), textcoords="offset points", fontsize=8
        )


def _against_frames(axis: Any, weights: str, rows: Sequence[RuntimeRow]) -> None:
    """Draw the runtime that was measured with several frames."""
    tried = {row.setting.runtime for row in rows if row.setting.frames > 1}
    some = [row for row in rows if row.setting.runtime in tried and row.setting.threads == 1]
    ious = [row.figures["silhouette_iou"] for row in some]
    (line,) = axis.plot(
        [row.setting.frames for row in some], [iou.value for iou in ious], "o-", label=weights
    )
    for row, iou in zip(some, ious, strict=True):
        axis.plot([row.setting.frames] * 2, [iou.low, iou.high], color=line.get_color(), alpha=0.35)
