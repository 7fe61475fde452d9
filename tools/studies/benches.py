"""Benches drawn at random, from bare wall to their own weights: docs/figures/benches.json and
docs/images/benches.png.

    python tools/studies/benches.py WORK [--benches N] [--minutes M ...] [--out DIR]

Each bench has a rig out of all that the paper allows, and a device and a wall of its own: range
offset, ripples, gain, texture. Its owner's commands are run, `calibrate --wall`, `calibrate
--occluder` and `adapt`, on its simulated camera, with the lidar's distance by tape to a millimetre,
the occluder by ruler where no beam meets it, and the object box marked on the bench. The 54 test
objects stand on the bench itself, not on its record, and go through the pipeline of `live`, as do
frames of the empty bench, before and after each number of minutes. WORK holds the benches: a second
call goes on, also after a kill; more minutes go on from fewer.
"""

import argparse
import json
import os
import platform
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import ObjectBox, Rig, dump_toml, load_rig
from nlos_calibration.arrays import Float32

from nlos_cam.bench import MAIN, edit_bench, load_bench
from nlos_cam.camera import World, open_world
from nlos_cam.cli.benches import store_forecast
from nlos_cam.cli.common import tracked
from nlos_cam.dataset import RigRange
from nlos_cam.errors import NlosCamError
from nlos_cam.evaluate import echoes_of, format_interval, over_objects, per_object, plain, truth_of
from nlos_cam.objects import benchmark_objects, image_from_depth, object_box
from nlos_cam.reconstruct import (
    Arrival,
    FrameResult,
    Pipeline,
    build_pipeline,
    frame_issues,
    load_networks,
    load_uncertainty,
    weights_for,
)
from nlos_cam.render import SceneFile, SensorModel

FIRST_SEED = 70_000_000
"""Of the benches: no training set draws its rigs from it."""
MINUTES = 10.0, 30.0, 60.0
FRAMES = 60
STEADY_FRAMES = 5
"""Frames of one object after which its verdict holds nothing of the object before."""
EMPTY_FRAMES = 100


@dataclass(frozen=True)
class Bench:
    """A bench as it stands, and the folder of its owner."""

    scene: SceneFile
    folder: Path

    @property
    def box(self) -> ObjectBox:
        """Object box, as marked on the bench."""
        return object_box(self.scene.rig)

    @property
    def empty_scene(self) -> Path:
        """Scene file of the bench with its occluder, and nothing hidden."""
        return self.folder.with_name(f"{self.folder.name}-empty.toml")


def draw_bench(number: int, work: Path) -> Bench:
    """Return a bench out of all that the paper allows, before a device and a wall of its own."""
    seed = FIRST_SEED + number
    rig = RigRange().draw(load_rig("paper-rig"), seed)
    rig = rig.model_copy(update={"name": f"bench {number + 1}"})
    generator = np.random.default_rng([seed, 1])
    sensor = SensorModel(
        range_offset_m=round(generator.uniform(-0.005, 0.005), 4),
        ripple_m=round(generator.uniform(0.0, 0.0015), 4),
        bare_wall_counts=round(generator.uniform(36.0, 60.0), 1),
        wall_texture=round(generator.uniform(0.02, 0.12), 3),
    )
    scene = SceneFile(name=rig.name, rig=rig, sensor=sensor)
    return Bench(scene, work / f"bench-{number + 1}")


def calibrate(bench: Bench) -> None:
    """Measure the bench as its owner would, unless it was."""
    done = bench.folder / "box-is-marked"
    if done.exists():
        return
    bench.folder.parent.mkdir(parents=True, exist_ok=True)
    bare = bench.folder.with_name(f"{bench.folder.name}-bare.toml")
    rig = bench.scene.rig
    bench.empty_scene.write_text(dump_toml(bench.scene), encoding="utf-8")
    without = bench.scene.model_copy(update={"rig": rig.model_copy(update={"occluder": None})})
    bare.write_text(dump_toml(without), encoding="utf-8")

    measured = "--frames", FRAMES, "--overwrite"
    by_tape = "--tape-m", round(rig.lidar.distance_m, 3), "--bench", bench.folder
    wall = "calibrate", "--wall", "--camera", f"sim:{bare}", *by_tape, *measured
    harness.run_command(*wall)
    try:
        harness.run_command(
            "calibrate",
            "--occluder",
            bench.folder,
            "--camera",
            f"sim:{bench.empty_scene}",
            *measured,
        )
    except NlosCamError:  # not in view of every pose: its owner then gives it by ruler
        edge_m = round(numbers_of(rig)["edge_m"], 3)
        gap_m = round(numbers_of(rig)["gap_m"], 3)
        harness.run_command(*wall, "--occluder-x-m", edge_m, "--occluder-gap-m", gap_m)
    with edit_bench(bench.folder) as edit:
        station = edit.stations[MAIN].model_copy(update={"object_box": bench.box})
        edit.set_station(MAIN, station, load_bench(bench.folder).measured.record)
    store_forecast(bench.folder)  # the one before was of the box as it was assumed
    done.touch()


def shown(
    pipeline: Pipeline, world: World, count: int, box: ObjectBox
) -> tuple[Float32, dict[str, int]]:
    """Return the images v (count, 64, 64) that `live` would show of a frame of each object, and how
    many objects have each verdict, which is a mean over frames.
    """
    images: list[Float32] = []
    verdicts: Counter[str] = Counter()
    for number in range(count):
        numbers = range(number, number + count * STEADY_FRAMES, count)
        results = _results(pipeline, world, numbers)
        images.append(image_from_depth(results[0].depth_m, box))
        verdicts[results[-1].verdict or "none"] += 1
    return np.stack(images), dict(verdicts.most_common())


def empty_verdicts(pipeline: Pipeline, bench: Bench) -> dict[str, int]:
    """Return how many frames of the empty bench have each verdict."""
    world = open_world(str(bench.empty_scene))
    results = _results(pipeline, world, range(STEADY_FRAMES + EMPTY_FRAMES))
    return dict(Counter(one.verdict or "none" for one in results[STEADY_FRAMES:]).most_common())


def _results(pipeline: Pipeline, world: World, numbers: Iterable[int]) -> list[FrameResult]:
    """Return what the pipeline makes of frames of a world."""
    frames = (world.images(number).frame(world.rig.pinhole) for number in numbers)
    return [
        pipeline.process(Arrival(frame, 0.0, frame_issues(frame)), lambda: 0.0, 0.0)
        for frame in frames
    ]


def judge(bench: Bench, weights: Path | None) -> dict[str, Any]:
    """Return every metric over the 54 test objects on the bench itself."""
    subjects = benchmark_objects(bench.box)
    with tracked("rendering the test objects on the bench") as on_progress:
        echoes = echoes_of(subjects, bench.scene.rig, on_progress)
    world = World(bench.scene, echoes, [None])
    calibrated = load_bench(bench.folder).calibrated
    weights = weights or weights_for(calibrated.rig)
    pipeline = build_pipeline(
        calibrated,
        load_networks(weights),
        uncertainty_model=load_uncertainty(weights),
    )
    images, verdicts = shown(pipeline, world, len(subjects), bench.box)
    found = over_objects(per_object(images, truth_of(subjects, bench.box), bench.box))
    empty = empty_verdicts(pipeline, bench)
    return plain(found) | {"verdicts": verdicts, "empty_frames": empty}


def judged(bench: Bench, minutes: float) -> dict[str, Any]:
    """Return the figures after some minutes, 0 for the shipped weights; they are made once."""
    path = bench.folder.with_name(f"{bench.folder.name}-{minutes:g}.json")
    if not path.exists():
        _refuse_after_more(bench, minutes)
        weights = None
        if minutes:
            harness.run_command("adapt", bench.folder, "--minutes", minutes)
            weights = load_bench(bench.folder).weights  # None where the shipped ones are better
        path.write_text(json.dumps(judge(bench, weights)), encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def _refuse_after_more(bench: Bench, minutes: float) -> None:
    """Raise NlosCamError for fewer minutes than a bench's weights have had: they would be judged as
    weights of the fewer.
    """
    done = bench.folder.parent.glob(f"{bench.folder.name}-*.json")
    spent = [float(each.stem.removeprefix(f"{bench.folder.name}-")) for each in done]
    if more := [each for each in spent if each > minutes]:
        raise NlosCamError(
            f"{bench.folder} was adapted for {max(more):g} minutes: {minutes:g} come before, in an"
            " empty WORK"
        )


def described(bench: Bench) -> dict[str, Any]:
    """Return the numbers of a bench, true and as calibrated, and what was forecast."""
    rig = bench.scene.rig
    loaded = load_bench(bench.folder)
    return {
        "true": numbers_of(rig),
        "calibrated": numbers_of(loaded.rig),
        "verdict": loaded.measured.record.verdict,
        "sensor": bench.scene.sensor.model_dump(exclude_defaults=True),
        "expected_iou": loaded.expected_iou,
        "hidden_share": loaded.hidden_share,
    }


def numbers_of(rig: Rig) -> dict[str, float]:
    """Return the numbers of a rig that differ between benches."""
    gap_m = rig.occluder.z_min_m if rig.occluder else float("nan")
    edge_m = rig.occluder.x_m if rig.occluder else float("nan")
    lidar = rig.lidar
    return {
        "distance_m": lidar.distance_m,
        "yaw_deg": lidar.yaw_deg,
        "pitch_deg": lidar.pitch_deg,
        "gap_m": gap_m,
        "edge_m": edge_m,
        "box_from_m": object_box(rig).x_min_m,
    }


def as_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of docs/adapt.md: silhouette IoU, RMSE and share within 2 percent of the
    depth after each number of minutes, beside the forecast.
    """
    minutes = list(dict.fromkeys(each for row in rows for each in row["minutes"]))
    lines: list[list[str]] = []
    for row in rows:
        true = row["true"]
        line = [
            f"{true['distance_m']:.3f} m, {true['yaw_deg']:.0f}°, gap {true['gap_m']:.3f} m",
            f"{row['expected_iou']:.2f}",
        ]
        for each in minutes:
            figures = row["minutes"].get(each)
            line.append(_in_words(figures) if figures else "")
        lines.append(line)
    head = [
        "bench",
        "forecast",
        *(f"{each} minutes" if each != "0" else "at once" for each in minutes),
    ]
    return harness.table(head, lines)


def _in_words(figures: dict[str, Any]) -> str:
    iou = format_interval(figures["silhouette_iou"], 3)
    rmse_mm = figures["foreground_rmse_mm"]["value"]
    within = figures["accuracy_within_2_percent"]["value"]
    return f"{iou}, {rmse_mm:.0f} mm, {within:.2f}"


def draw(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw each bench's silhouette IoU over its minutes, with its forecast."""
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axis = figure.subplots()
    for row in rows:
        minutes = [float(each) for each in row["minutes"]]
        iou = [each["silhouette_iou"]["value"] for each in row["minutes"].values()]
        (line,) = axis.plot(minutes, iou, marker="o", label=row["name"])
        axis.plot(
            max(MINUTES) + 4, row["expected_iou"], marker="<", color=line.get_color(), alpha=0.6
        )
    axis.set(xlabel="minutes of `adapt` (at the right: forecast)", ylabel="silhouette IoU")
    axis.legend(frameon=False, ncols=2)
    return figure


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--benches", type=int, default=5)
    parser.add_argument("--minutes", type=float, nargs="+", default=MINUTES)
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked: argparse.Namespace = parser.parse_args()

    harness.claim(asked.work)
    benches = [draw_bench(number, asked.work) for number in range(asked.benches)]
    rows: list[dict[str, Any]] = [{} for _ in benches]
    for minutes in sorted({0.0, *asked.minutes}):
        for bench, row in zip(benches, rows, strict=True):
            calibrate(bench)
            figures = judged(bench, minutes)
            row.update(
                {"name": bench.scene.rig.name, **described(bench)},
                minutes={**row.get("minutes", {}), f"{minutes:g}": figures},
            )
            iou = figures["silhouette_iou"]["value"]
            print(f"{row['name']}, {minutes:g} minutes: silhouette IoU {iou:.3f}", flush=True)
            done = [each for each in rows if each]
            machine = f"{os.cpu_count()} cores, {platform.machine()}"
            harness.write("benches", {"machine": machine, "benches": done}, asked.out)
    print(as_table(rows))
    harness.save("benches", draw(rows), asked.out, dpi=110)


if __name__ == "__main__":
    main()
