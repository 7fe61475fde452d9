"""Trade-off of accuracy against time in reconstruction: networks, each on the bench it was trained
for, and averaged frames; kinds of training and kinds never seen.

Number formats, runtimes and threads were measured too, and are not worth a choice: a decision
record says what they gave. All settings here run as in `live`: ONNX Runtime, on one thread.
"""

import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import nlos_models as models
import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32
from nlos_models.training import MapSet

from nlos_cam.camera import FRAMES_PER_S
from nlos_cam.dataset import TEST_SEED
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import subjects
from nlos_cam.evaluate.figures import LABELS
from nlos_cam.evaluate.metrics import SMALLER_IS_BETTER, TARGETS, Figures, Interval, judge, plain
from nlos_cam.evaluate.render_tradeoff import INCOMPLETE, undominated, write_table
from nlos_cam.files import atomic_directory
from nlos_cam.objects import benchmark_objects, object_box, unseen_objects
from nlos_cam.render import MultiBounce, SensorModel, paper_scene
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NETWORKS: Mapping[str, Path | None] = {"direct": Path("direct"), "paper": Path("paper")}
"""Weights that are compared if none are named."""
FRAMES = 1, 4, 16, 64
MIN_CALLS = 50
"""Minimum number of calls for a median; a small set of objects is repeated until then."""
AS_GOOD = {
    "silhouette_iou": 0.005,
    "accuracy_mean_abs": 0.001,
    "accuracy_within_2_percent": 0.005,
    "foreground_rmse_mm": 0.5,
}
"""Losses against the most accurate setting up to which a setting is as good."""

Clock = Callable[[], float]


@dataclass(frozen=True)
class ReconstructSetting:
    """Weights and averaged frames of one measurement."""

    name: str
    weights: str
    runtime: str
    frames: int
    """Frames averaged, as by `live --average`."""
    rig: str
    """Name of the one on which it is measured: that of the weights' training, or the paper's for
    weights of any rig.
    """


@dataclass(frozen=True)
class ReconstructRow:
    """Time and accuracy of one setting."""

    setting: ReconstructSetting
    milliseconds: float
    """Median time of one call on one object's maps."""
    milliseconds_p90: float
    figures: Figures
    """On the kinds of training."""
    unseen: Figures
    """On kinds never seen."""

    @property
    def wait_ms(self) -> float:
        """Return the time in which the averaged frames arrive, at the camera's rate."""
        return 1000 * self.setting.frames / FRAMES_PER_S


@dataclass(frozen=True)
class ObjectSet:
    """Objects on a rig, with their echoes."""

    rig: Rig
    truth: Float32
    """(n, 64, 64) in v."""
    echoes: list[MultiBounce]
    sensor: SensorModel = field(default_factory=SensorModel)

    @classmethod
    def of(
        cls, objects: Sequence[subjects.Subject], rig: Rig, tracked: subjects.Tracked
    ) -> "ObjectSet":
        """Render objects on a rig."""
        with tracked(f"rendering on {rig.name}") as on_progress:
            echoes = subjects.echoes_of(objects, rig, on_progress)
        return cls(rig, subjects.truth_of(objects, object_box(rig)), echoes)

    def maps(self, frames: int) -> MapSet:
        """Return maps averaged over frames, as `live` forms them."""
        sensed = subjects.sense(self.echoes, self.rig, self.sensor, frames=frames)
        return subjects.as_map_set(sensed, self.truth)


class BothSets(NamedTuple):
    """Both sets of objects on one rig."""

    kinds: ObjectSet
    unseen: ObjectSet

    def seen_by(self, sensor: SensorModel) -> "BothSets":
        """Return the sets as another sensor sees them."""
        return BothSets(*(replace(each, sensor=sensor) for each in self))


@dataclass(frozen=True)
class ReconstructBench:
    """Networks, and objects with their echoes, on which every setting is measured."""

    networks: Mapping[str, models.Reconstructor]
    sets: Mapping[str, BothSets]
    """By the name of the weights, on the rig that they were trained for."""

    @property
    def objects(self) -> int:
        """Return the number of objects of the kinds of training."""
        return max(len(sets.kinds.truth) for sets in self.sets.values())


def open_reconstruct_bench(
    weights: Mapping[str, Path | None],
    cache: Path,
    count: int | None = None,
    tracked: subjects.Tracked = subjects.untracked,
) -> ReconstructBench:
    """Load networks, and render the 54 test objects, or `count` random ones, and as many of kinds
    never seen on the rig of each.

    Raises SceneError if weights expect difference maps, CheckpointError for color.
    """
    networks = {name: models.load_reconstructor(folder, cache) for name, folder in weights.items()}
    inputs = {network.record.input for network in networks.values()} - {"raw maps"}
    if inputs:
        raise SceneError(
            f"the weights expect {inputs.pop()} but the test maps are raw: use weights for raw maps"
        )

    rigs = {name: subjects.rig_of(network.record) for name, network in networks.items()}
    rendered = {
        checksum: _both_sets(rig, count, tracked)
        for checksum, rig in {rig.checksum: rig for rig in rigs.values()}.items()
    }
    sets = {
        name: rendered[rig.checksum].seen_by(subjects.sensor_of(networks[name].record, rig))
        for name, rig in rigs.items()
    }
    return ReconstructBench(networks, sets)


def _both_sets(rig: Rig, count: int | None, tracked: subjects.Tracked) -> BothSets:
    box = object_box(rig)
    kinds = subjects.seeded_objects(TEST_SEED, count, box) if count else benchmark_objects(box)
    unseen = unseen_objects(box)[:count]
    return BothSets(ObjectSet.of(kinds, rig, tracked), ObjectSet.of(unseen, rig, tracked))


def reconstruct_settings(bench: ReconstructBench) -> list[ReconstructSetting]:
    """Return all settings to measure, the quickest to wait for first."""
    return [
        ReconstructSetting(
            f"{name}, {frames} frame{'s' * (frames > 1)}",
            name,
            network.runtime,
            frames,
            bench.sets[name].kinds.rig.name,
        )
        for frames in FRAMES
        for name, network in bench.networks.items()
    ]


def measure_reconstructions(
    asked: Sequence[ReconstructSetting],
    bench: ReconstructBench,
    clock: Clock = time.perf_counter,
) -> Iterator[ReconstructRow]:
    """Measure each setting and yield its row."""
    # both networks of a rig see the same maps
    maps: dict[tuple[str, int], tuple[MapSet, MapSet]] = {}
    for setting in asked:
        sets = bench.sets[setting.weights]
        key = sets.kinds.rig.checksum, setting.frames
        if key not in maps:
            maps = {one: both for one, both in maps.items() if one[1] == setting.frames}
            maps[key] = sets.kinds.maps(setting.frames), sets.unseen.maps(setting.frames)
        network = bench.networks[setting.weights]
        kinds, unseen = (
            subjects.network_input(each, None, repeat(sets.kinds.rig), network.record)
            for each in maps[key]
        )
        images, seconds = _timed(network, kinds, clock)
        box = object_box(sets.kinds.rig)
        middle, late = 1000 * np.quantile(seconds, [0.5, 0.9])
        yield ReconstructRow(
            setting,
            float(middle),
            float(late),
            judge(images, sets.kinds.truth, box),
            judge(subjects.reconstruct_all(network, unseen), sets.unseen.truth, box),
        )


def _timed(
    network: models.Reconstructor, maps: MapSet, clock: Clock
) -> tuple[Float32, list[float]]:
    """Return images of all maps and the seconds of every call but the first, which allocates."""
    network(maps.depth_m[:1], maps.intensity[:1])
    images: list[Float32] = []
    seconds: list[float] = []
    for _ in range(-(-MIN_CALLS // len(maps.image))):
        images.clear()
        for depth_m, intensity in zip(maps.depth_m, maps.intensity, strict=True):
            start_s = clock()
            images.append(network(depth_m[None], intensity[None]))
            seconds.append(clock() - start_s)
    return np.concatenate(images), seconds


def losses(row: ReconstructRow, base: ReconstructRow) -> dict[str, float]:
    """Return by how much a row is worse than the base, by metric; infinite if only one of the two
    has a value.
    """
    worse: dict[str, float] = {}
    for name in TARGETS:
        own = row.figures[name].value
        best = base.figures[name].value
        sign = 1 if name in SMALLER_IS_BETTER else -1
        if own is not None and best is not None:
            worse[name] = sign * (own - best)
        else:
            worse[name] = 0.0 if own is best else float("inf")
    return worse


def most_accurate(rows: Sequence[ReconstructRow]) -> ReconstructRow:
    """Return the row of the largest silhouette IoU."""
    return max(rows, key=_overlap)


def loses_accuracy(row: ReconstructRow, base: ReconstructRow) -> bool:
    """Return True if a row is worse than the base by more than AS_GOOD in any metric."""
    return any(loss > AS_GOOD[name] for name, loss in losses(row, base).items())


def recommended(rows: Sequence[ReconstructRow]) -> ReconstructRow | None:
    """Return the first setting that is as good as the most accurate; None without rows."""
    if not rows:
        return None
    base = most_accurate(rows)
    as_good = [row for row in rows if not loses_accuracy(row, base)]
    return min(as_good, key=_ready_ms)


def pareto_front(rows: Sequence[ReconstructRow]) -> list[ReconstructRow]:
    """Return the rows that no other beats in both time and silhouette IoU, from fast to slow."""
    return undominated(rows, lambda row: (_ready_ms(row), -_overlap(row)))


def _ready_ms(row: ReconstructRow) -> float:
    """Return the time from the first of the frames to the picture."""
    return row.wait_ms + row.milliseconds


def _overlap(row: ReconstructRow) -> float:
    return row.figures["silhouette_iou"].value or 0.0


HEAD = (
    "setting",
    "time, ms: median",
    "p90",
    "wait for frames, ms",
    *LABELS.values(),
    f"{LABELS['silhouette_iou']}, kinds never seen",
    "loses accuracy",
)
NOTES = (
    "Each network is measured on the rig that it was trained for. Times are of one call on one"
    " object's maps: medians over all objects, after a first call that is not counted; they are"
    " from this machine and run. More frames cost no network time: their maps are averaged while"
    ' the next arrive, and the picture is as old as the wait. "Loses accuracy": worse than the most'
    " accurate row by more than any of"
    f" {', '.join(f'{least:g} of {LABELS[name]}' for name, least in AS_GOOD.items())}."
)
PLOT_CAPTION = "Upper left is better: a larger IoU, sooner. Lines: 95 % intervals over objects."


def reconstruct_facts(
    rows: Sequence[ReconstructRow], planned: int, objects: int, machine: str
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
                "unseen": plain(row.unseen),
                "loses_accuracy": loses_accuracy(row, most_accurate(rows)),
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


def reconstruct_document(table: Mapping[str, Any], folder: Path | None = None) -> Document:
    """Return the report on a table, with the plot in `folder`."""
    pick = table["recommended"]
    banner = Banner("doubtful", "Nothing was measured", "")
    commands = ["nlos-cam evaluate"]
    if pick:
        row = next(row for row in table["settings"] if pick.items() <= row.items())
        banner = Banner(
            "good",
            f"Recommended: {pick['name']}",
            "The first setting that is as good as the most accurate one.",
        )
        # The simulated camera is on the paper's rig: weights of another one are for a real bench.
        camera = "sim" if row["rig"] == paper_scene().rig.name else "l515"
        weights = shlex.quote(row["weights"])
        commands.insert(0, f"nlos-cam live {camera} --weights {weights} --average {row['frames']}")
    parts: list[Section | Picture] = [
        Section("", [banner, Bullets("Note", [] if table["complete"] else [INCOMPLETE])]),
        Section("Settings", [Table(HEAD, [_line(row) for row in table["settings"]]), NOTES]),
        Section("Next commands", [Commands(commands)]),
    ]
    if folder:
        picture = saved_picture("Accuracy against time", PLOT_CAPTION, folder / "tradeoff.png")
        parts.insert(2, picture)
    subtitle = f"{table['machine']}; {table['objects']} objects."
    return Document("Reconstruction: accuracy against time", subtitle, parts)


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    metrics = [_short(row[name]["value"]) for name in TARGETS]
    metrics.append(_short(row["unseen"]["silhouette_iou"]["value"]))
    times = f"{row['milliseconds']:.1f}", f"{row['milliseconds_p90']:.1f}", f"{row['wait_ms']:.0f}"
    return row["name"], *times, *metrics, "yes" if row["loses_accuracy"] else "no"


def _short(value: float | None) -> str:
    if value is None:
        return "none"
    return f"{value:.3f}" if value < 1 else f"{value:.1f}"


def write_reconstructions(
    folder: Path, table: Mapping[str, Any], rows: Sequence[ReconstructRow]
) -> None:
    """Write the measured trade-off as JSON, report and plot."""
    with atomic_directory(folder) as part:
        draw_reconstructions(part / "tradeoff.png", rows)
        write_table(part, table, reconstruct_document(table, part))


def draw_reconstructions(path: Path, rows: Sequence[ReconstructRow]) -> None:
    """Draw silhouette IoU against the time from the first frame to the picture, for both sets."""
    figure = figure_of(12, 5.5)
    kinds, unseen = figure.subplots(1, 2, sharey=True)
    for weights in dict.fromkeys(row.setting.weights for row in rows):
        own = [row for row in rows if row.setting.weights == weights]
        for axis, part in (
            (kinds, [row.figures for row in own]),
            (unseen, [row.unseen for row in own]),
        ):
            iou = [figures["silhouette_iou"] for figures in part]
            _draw_line(axis, weights, own, iou)
    kinds.set(title="kinds of training", ylabel="silhouette IoU, 95 % interval over objects")
    unseen.set(title="kinds never seen")
    for axis in (kinds, unseen):
        axis.set(xscale="log", xlabel="milliseconds from the first frame to the picture (log)")
        axis.grid(alpha=0.3)
    kinds.legend()
    figure.savefig(path, dpi=100)


def _draw_line(
    axis: "Axes", weights: str, rows: Sequence[ReconstructRow], iou: Sequence[Interval]
) -> None:
    """Draw one network's values over the time, with their intervals."""
    times_ms = [_ready_ms(row) for row in rows]
    values = [each.value or 0.0 for each in iou]
    (line,) = axis.plot(times_ms, values, "o-", label=weights)
    for time_ms, row, value, each in zip(times_ms, rows, values, iou, strict=True):
        if each.low is not None and each.high is not None:
            ends = [each.low, each.high]
            axis.plot([time_ms, time_ms], ends, color=line.get_color(), alpha=0.35)
        words = f"{row.setting.frames} frame{'s' * (row.setting.frames > 1)}"
        axis.annotate(words, (time_ms, value), (4, 4), textcoords="offset points", fontsize=8)
