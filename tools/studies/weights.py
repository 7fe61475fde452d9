"""Weights: the limits of their figures, and their range of rigs.

    python tools/studies/weights.py limits [--weights DIR] [--frames 10 100]
        docs/figures/limits.json

    python tools/studies/weights.py rigs [--weights [NAME=]DIR ...]
        docs/figures/rig_map.json and docs/images/rig_map.png

    python tools/studies/weights.py edge [--rig RIG] [--weights [NAME=]DIR ...]
        docs/figures/edge.json

    python tools/studies/weights.py poses [--rig RIG] [--weights [NAME=]DIR ...]
        docs/figures/poses.json; both are edge-RIG.json, poses-RIG.json for another rig than the paper's

`limits` evaluates with one thing removed or added at a time. `rigs` moves the lidar over the
distances and angles of SI 1 and by what a bench built with a ruler is off, while occluder and
object box stay, and resumes. `edge` measures what a record costs that is off by fractions of a
millimetre, with either sign: one column of cells at the occluder's edge then sees the other thing,
which `EdgeRepair` mends. `poses` looks at single scans: each test object on ten benches whose lidar
is 1 mm and 0.2 degrees from its record, in a random direction.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from nlos_calibration import Rig, lidar_visible_share, load_rig
from nlos_calibration.arrays import Float32
from nlos_models import (
    Reconstructor,
    UncertaintyModel,
    cut_silhouette,
    lift_edges,
    load_pipeline,
    load_reconstructor,
    load_record,
    load_uncertainty_model,
    shipped_folder,
    weights_folder,
)
from nlos_models.training import MapSet, latent_error, load_encoder, run

from nlos_cam.cli.common import tracked
from nlos_cam.dataset import TEST_SEED, TRAINING_SEED, DatasetPlan
from nlos_cam.evaluate import (
    SMALLER_IS_BETTER,
    TARGETS,
    Figures,
    Subject,
    as_map_set,
    bare_wall_for,
    echoes_of,
    format_interval,
    judge,
    network_input,
    per_object,
    plain,
    reconstruct_all,
    rig_of,
    seeded_objects,
    sense,
    truth_of,
)
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import CalibratedRig, EdgeRepair, estimate_uncertainty
from nlos_cam.render import QUIET

FRAMES = 10, 100
DISTANCES_M = (0.15, 0.2, 0.25, 0.3)
ANGLES_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)


@dataclass(frozen=True)
class Row:
    """Figures of one experiment; the latent error is in units of the encoder's spread, None without
    an encoder.
    """

    name: str
    tells: str
    """Change from the evaluation."""
    figures: Figures
    latent_error: float | None = None


class Network:
    """The two steps of a pipeline, apart and together."""

    def __init__(self, folder: Path) -> None:
        self.pipeline, self.record = load_pipeline(folder)
        recipe = self.record.compressor_recipe
        joint = (
            recipe and recipe.steps == "two-then-joint"
        )  # its decoder has left the encoder's latent
        self.encoder = None if joint else load_encoder(folder)
        self.rig = rig_of(self.record)
        self.plan = DatasetPlan(self.rig, TEST_SEED)
        self.bare = bare_wall_for(self.record, self.plan)

    @torch.inference_mode()
    def raw_image(self, maps: MapSet) -> Float32:
        """Return the decoder's image, without the silhouette step."""
        return self.pipeline.decoder(self._latent(maps))[:, 0].numpy()

    @torch.inference_mode()
    def rebuilt(self, truth: Float32) -> Float32 | None:
        """Return the image of the true latent, cut and lifted as the pipeline does; None without an
        encoder.
        """
        if self.encoder is None:
            return None
        image = self.pipeline.decoder(self.encoder(torch.from_numpy(truth)[:, None])[0])
        return torch.where(cut_silhouette(image) > 0, lift_edges(image), 0.0)[:, 0].numpy()

    @torch.inference_mode()
    def latent_error(self, maps: MapSet) -> float | None:
        """Return the error of the compressor's latent; None without an encoder."""
        truth = torch.from_numpy(maps.image)[:, None]
        return (
            None
            if self.encoder is None
            else float(latent_error(self._latent(maps), *self.encoder(truth)))
        )

    def _latent(self, maps: MapSet) -> torch.Tensor:
        return self.pipeline.latent(
            torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)
        )


def experiments(
    folder: Path,
    subjects: Sequence[Subject],
    trained: Sequence[Subject],
    frames: Sequence[int] = FRAMES,
) -> Iterator[Row]:
    """Yield one row per experiment; `trained` are objects of the training set.

    Weights trained in one step, or jointly at last, have no latent of the VAE: its experiments are
    left out.
    """
    network = Network(folder)
    rig, box = network.rig, object_box(network.rig)
    truth = truth_of(subjects, box)
    count = len(subjects)
    with tracked("rendering") as on_progress:
        echoes = echoes_of([*subjects, *trained], rig, on_progress)

    def row(name: str, change: str, sensed: Any, images: Float32 = truth) -> Row:
        maps = network_input(as_map_set(sensed, images), network.bare, repeat(rig), network.record)
        return Row(
            name,
            change,
            judge(run(network.pipeline, maps), maps.image, box),
            network.latent_error(maps),
        )

    first = sense(echoes[:count], rig)
    maps = network_input(as_map_set(first, truth), network.bare, repeat(rig), network.record)
    yield row("as evaluated", "both steps, noise on, one frame", first)
    if (rebuilt := network.rebuilt(truth)) is not None:
        yield Row(
            "VAE alone", "no compressor: the decoder on the true latent", judge(rebuilt, truth, box)
        )
        against = judge(run(network.pipeline, maps), rebuilt, box)
        yield Row(
            "compressor alone",
            "no VAE error: against the decoder's image of the true latent",
            against,
        )
    raw = judge(network.raw_image(maps), truth, box)
    yield Row("no silhouette step", "the decoder's image, neither cut nor lifted", raw)
    yield row("noise off", "no noise, no dead pixels", sense(echoes[:count], rig, QUIET))
    for number in frames:
        yield row(f"{number} frames", "averaged", sense(echoes[:count], rig, frames=number))
    yield row(
        "training's objects",
        "by their seeds, with other noise",
        sense(echoes[count:], rig),
        truth_of(trained, box),
    )


def limits(asked: argparse.Namespace) -> None:
    """Measure the limits of the figures of `evaluate`."""
    box = object_box(rig_of(load_record(asked.weights)))
    subjects = benchmark_objects(box)
    trained = seeded_objects(TRAINING_SEED, len(subjects), box)
    rows = [*experiments(asked.weights, subjects, trained, asked.frames)]
    harness.write(
        "limits", {"objects": len(subjects), "rows": [asdict(row) for row in rows]}, asked.out
    )
    print(limits_table(rows))


def limits_table(rows: Sequence[Row]) -> str:
    """Return the experiments as Markdown."""
    latent = ["" if row.latent_error is None else f"{row.latent_error:.0f}" for row in rows]
    cells = [
        [row.name, row.tells, *(format_interval(row.figures[name]) for name in TARGETS), e]
        for row, e in zip(rows, latent, strict=True)
    ]
    return harness.table(["experiment", "change", *TARGETS, "latent error"], cells)


@dataclass(frozen=True)
class Place:
    """Place of the lidar before the relay wall."""

    distance_m: float = 0.2
    yaw_deg: float = 45.0
    pitch_deg: float = 0.0
    aside_m: float = 0.0  # along the wall, towards the object
    up_m: float = 0.0

    def rig(self, rig: Rig) -> Rig:
        """Return the rig with its lidar here; positions on the wall are relative to the lidar's
        foot.
        """
        lidar = rig.lidar.model_copy(
            update={
                "distance_m": self.distance_m,
                "yaw_deg": self.yaw_deg,
                "pitch_deg": self.pitch_deg,
            }
        )
        update: dict[str, Any] = {"name": f"{rig.name} with another lidar's place", "lidar": lidar}
        for part in ("wall", "relay", "object_box"):
            extent = getattr(rig, part)
            ends = {
                f"x_{end}_m": getattr(extent, f"x_{end}_m") - self.aside_m for end in ("min", "max")
            }
            ends |= {
                f"y_{end}_m": getattr(extent, f"y_{end}_m") - self.up_m for end in ("min", "max")
            }
            update[part] = extent.model_copy(update=ends)
        if rig.occluder:
            update["occluder"] = rig.occluder.model_copy(
                update={"x_m": rig.occluder.x_m - self.aside_m}
            )
        return rig.model_copy(update=update)


BENCHES = [
    Place(distance_m=0.202),
    Place(distance_m=0.21),
    Place(yaw_deg=45.5),
    Place(yaw_deg=47.0),
    Place(pitch_deg=1.0),
    Place(aside_m=0.005, up_m=0.005),
    Place(0.206, 46.8, 1.1, 0.004, -0.003),
]
"""What a bench built with a ruler is off by; the last is that of examples/bench.toml."""


OFFSETS_MM = 0.2, 0.5, 1.0, 2.0, 5.0
OFFSETS_DEG = 0.1, 0.2, 0.5, 1.0
OFF_M = 0.001
OFF_DEG = 0.2
DRAWS = 10
"""Benches of `poses`, off their record by OFF_M and OFF_DEG."""
OFF = Place(0.001, 0.2, 0.2, 0.001, 0.001)
"""Error of a bench's record."""

Judged = tuple[Reconstructor, UncertaintyModel | None]


def cell(
    place: Place, rig: Rig, subjects: Sequence[Subject], weights: Mapping[str, Judged]
) -> dict[str, Any]:
    """Return the figures of all weights with a rig's lidar elsewhere, with maps aligned with their
    own rig and without.

    They are also aligned by a record that is off. Difference maps are relative to the rig's own
    bare wall. `outside` is the share of objects that are flagged.
    """
    apart = zip(astuple(place), astuple(OFF), strict=True)
    rig, believed = place.rig(rig), Place(*(value + off for value, off in apart)).rig(rig)
    box = object_box(rig)
    plan = DatasetPlan(rig, TEST_SEED)
    truth = truth_of(subjects, box)
    maps = as_map_set(sense(echoes_of(subjects, rig, lambda *_: None), rig), truth)

    def figures(
        network: Reconstructor, doubter: UncertaintyModel | None, taken: MapSet
    ) -> dict[str, Any]:
        images = reconstruct_all(network, taken)
        found = plain(judge(images, truth, box))
        found = {
            of: {end: value and round(value, 4) for end, value in one.items()}
            for of, one in found.items()
        }
        if doubter:
            seen = (
                LidarMaps(*pair, ~np.isnan(pair[0]))
                for pair in zip(taken.depth_m, taken.intensity, strict=True)
            )
            doubts = [
                estimate_uncertainty(doubter, one, image, box)
                for one, image in zip(seen, images, strict=True)
            ]
            found["outside"] = float(
                np.mean(
                    [doubt.p_out_of_distribution > doubter.record.outside_above for doubt in doubts]
                )
            )
        return found

    found = dict[str, Any]()
    for name, judged in weights.items():
        record = judged[0].record
        found[name] = figures(
            *judged, network_input(maps, bare_wall_for(record, plan), repeat(plan.rig), record)
        )
        if record.input == "raw maps":
            found[f"{name}, record off"] = figures(
                *judged, network_input(maps, None, repeat(believed), record)
            )
            found[f"{name}, not aligned"] = figures(*judged, maps)
    return {
        "rig_checksum": rig.checksum,
        "share_of_box_in_direct_sight": lidar_visible_share(rig, box),
        "share_of_cells_with_a_return": float(np.mean(~np.isnan(maps.depth_m))),
        "weights": found,
    }


def loaded(asked: argparse.Namespace) -> dict[str, Judged]:
    """Return the asked weights by name, by default the shipped ones."""
    graphs = cache_folder() / "onnx"
    return {
        name: (
            load_reconstructor(folder, graphs),
            load_uncertainty_model(folder, graphs, quality=False),
        )
        for name, folder in folders_of(asked).items()
    }


def folders_of(asked: argparse.Namespace) -> dict[str, Path | None]:
    """Return the folders of the asked weights by name; None for the shipped ones."""
    return harness.by_name(asked.weights) or {"shipped": None}


def key_of(asked: argparse.Namespace) -> str:
    """Return a checksum of the asked weights, by which finished parts are known again."""
    named = {name: weights_folder(folder) for name, folder in folders_of(asked).items()}
    return harness.weights_key(named)


def rigs(asked: argparse.Namespace) -> None:
    """Map the figures of weights over the rigs of SI 1."""
    weights = loaded(asked)
    rig = load_rig(asked.rig)
    subjects = benchmark_objects(object_box(rig))
    places = [
        *(Place(distance_m, yaw_deg) for distance_m in DISTANCES_M for yaw_deg in ANGLES_DEG),
        *BENCHES,
    ]
    measured = harness.collect(
        "rigs",
        places,
        lambda place, _: cell(place, rig, subjects, weights),
        key=key_of(asked) + rig.checksum,
    )
    cells = measured[: -len(BENCHES)]
    benches = measured[-len(BENCHES) :]
    found = {"objects": len(subjects), "cells": cells, "benches": benches}
    harness.write(named_after("rig_map", rig), found, asked.out)
    harness.save(named_after("rig_map", rig), draw_rigs(cells, rig), asked.out, dpi=80)
    for one in measured:
        print({key: one[key] for key in asdict(Place())})
        for name, figures in one["weights"].items():
            iou = figures["silhouette_iou"]["value"]
            rmse_mm = figures["foreground_rmse_mm"]["value"]
            rmse = "none" if rmse_mm is None else f"{rmse_mm:.0f} mm"
            print(f"    {name}: IoU {iou:.3f}, RMSE {rmse}, flagged {figures.get('outside')}")


def shown(subjects: Sequence[Subject], bench: Rig) -> tuple[Float32, list[LidarMaps]]:
    """Return the true images of objects on a bench, and their maps, one frame each."""
    maps = sense(echoes_of(subjects, bench, lambda *_: None), bench)
    return truth_of(subjects, object_box(bench)), maps


def edge(asked: argparse.Namespace) -> None:
    """Measure weights on benches that are a little off the record that their maps are aligned by."""
    weights = loaded(asked)
    rig = load_rig(asked.rig)
    subjects = benchmark_objects(object_box(rig))
    here = Place(rig.lidar.distance_m, rig.lidar.yaw_deg, rig.lidar.pitch_deg)
    repair = EdgeRepair(CalibratedRig(rig))
    moves = [0.0, *(sign * off for off in OFFSETS_MM for sign in (1, -1))]
    turns = [sign * off for off in OFFSETS_DEG for sign in (1, -1)]
    places = [
        *(replace(here, distance_m=here.distance_m + off / 1e3) for off in moves),
        *(replace(here, yaw_deg=here.yaw_deg + off) for off in turns),
    ]

    def measured(place: Place, _: Any) -> dict[str, Any]:
        bench = place.rig(rig)
        truth, seen = shown(subjects, bench)
        repaired = [repair.repair(each) for each in seen]
        found = dict[str, dict[str, float]]()
        for label, (network, _) in weights.items():
            for way, each in (("repaired", repaired), ("as they are", seen)):
                maps = as_map_set(each, truth)
                taken = network_input(maps, None, repeat(rig), network.record)
                figures = plain(judge(reconstruct_all(network, taken), truth, object_box(bench)))
                iou = round(figures["silhouette_iou"]["value"], 4)
                found.setdefault(label, {})[way] = iou
        return {"silhouette_iou": found}

    rows = harness.collect("edge", places, measured, key=key_of(asked) + rig.checksum)
    harness.write(named_after("edge", rig), {"objects": len(subjects), "rows": rows}, asked.out)
    for row in rows:
        off_mm = 1e3 * (row["distance_m"] - here.distance_m)
        print(
            f"{off_mm:+.1f} mm, {row['yaw_deg'] - here.yaw_deg:+.1f} degrees", row["silhouette_iou"]
        )


def poses(asked: argparse.Namespace) -> None:
    """Measure what single scans lose on benches whose lidar is not quite where its record has it."""
    weights = loaded(asked)
    rig = load_rig(asked.rig)
    subjects = benchmark_objects(object_box(rig))
    here = Place(rig.lidar.distance_m, rig.lidar.yaw_deg, rig.lidar.pitch_deg)
    repair = EdgeRepair(CalibratedRig(rig))
    places = [here, *(off_record(here, seed) for seed in range(DRAWS))]

    def measured(place: Place, _: Any) -> dict[str, Any]:
        bench = place.rig(rig)
        truth, seen = shown(subjects, bench)
        maps = as_map_set([repair.repair(each) for each in seen], truth)
        found = dict[str, list[float]]()
        for label, (network, _) in weights.items():
            taken = network_input(maps, None, repeat(rig), network.record)
            values = per_object(reconstruct_all(network, taken), truth, object_box(bench))
            found[label] = values["silhouette_iou"].tolist()
        return {"silhouette_iou": found}

    rows = harness.collect("poses", places, measured, key=key_of(asked) + rig.checksum)
    found = dict[str, Any]()
    for label in weights:
        iou = np.array([row["silhouette_iou"][label] for row in rows])
        lost = iou[0] - iou[1:]
        worst = np.sort(lost, axis=None)[-(lost.size // 10) :]
        found[label] = {
            "on_record": float(iou[0].mean()),
            "mean_lost": float(lost.mean()),
            "lost_at_most_in_nine_of_ten": float(np.quantile(lost, 0.9)),
            "mean_lost_of_worst_tenth": float(worst.mean()),
            "mean_lost_by_draw": lost.mean(1).tolist(),
        }
        print(label, harness.rounded(found[label]))
    harness.write(
        named_after("poses", rig), {"scans": DRAWS * len(subjects), "weights": found}, asked.out
    )


def named_after(study: str, rig: Rig) -> str:
    """Return the name of a study's figures: its own for the paper's rig."""
    return study if rig.name == "paper-rig" else f"{study}-{rig.name}"


def off_record(here: Place, seed: int) -> Place:
    """Return a place OFF_M and OFF_DEG from another one, in a random direction and about a random
    axis.
    """
    generator = np.random.default_rng(seed)
    moved = generator.normal(size=3)
    moved *= OFF_M / np.linalg.norm(moved)
    turned = generator.normal(size=2)
    turned *= OFF_DEG / np.linalg.norm(turned)
    off = Place(moved[0], turned[0], turned[1], moved[1], moved[2])
    return Place(*(value + each for value, each in zip(astuple(here), astuple(off), strict=True)))


def draw_rigs(cells: Sequence[Mapping[str, Any]], rig: Rig) -> Figure:
    """Draw a heat map of each metric for each of the weights; the weights' own rig is framed."""
    names = [name for name in cells[0]["weights"] if "record off" not in name]
    distances, angles = (sorted({one[of] for one in cells}) for of in ("distance_m", "yaw_deg"))
    figure = Figure(figsize=(3.4 * len(TARGETS), 2.9 * len(names)), layout="constrained")
    for row, name in zip(
        figure.subplots(len(names), len(TARGETS), squeeze=False), names, strict=True
    ):
        for axis, metric in zip(row, TARGETS, strict=True):
            values = np.full((len(distances), len(angles)), np.nan)
            for one in cells:
                at = distances.index(one["distance_m"]), angles.index(one["yaw_deg"])
                value = one["weights"][name][metric]["value"]
                values[at] = np.nan if value is None else value
            draw_heat(axis, values, metric)
            axis.set(
                xticks=range(len(angles)),
                xticklabels=[f"{angle:g}" for angle in angles],
                xlabel="angle, degrees",
            )
            axis.set(
                yticks=range(len(distances)),
                yticklabels=[f"{distance:g}" for distance in distances],
            )
            if rig.lidar.distance_m in distances and rig.lidar.yaw_deg in angles:
                corner = (
                    angles.index(rig.lidar.yaw_deg) - 0.5,
                    distances.index(rig.lidar.distance_m) - 0.5,
                )
                axis.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="red", linewidth=2))
        row[0].set_ylabel(f"{name}\ndistance, m")
    return figure


def draw_heat(axis: Any, values: Any, metric: str) -> None:
    """Draw one metric over distances and angles, with its numbers."""
    smaller = metric in SMALLER_IS_BETTER
    known = values[~np.isnan(values)]
    low, high = (known.min(), known.max()) if known.size else (0.0, 0.0)
    axis.imshow(values, cmap="viridis_r" if smaller else "viridis", aspect="auto", origin="lower")
    for (i, j), value in np.ndenumerate(values):
        bright = (value - low) / max(high - low, 1e-9)
        ink = (
            "white" if (1 - bright if smaller else bright) <= 0.55 else "black"
        )  # cells without a value are white
        words = "none" if np.isnan(value) else f"{value:.0f}" if smaller else f"{value:.2f}"
        axis.text(j, i, words, ha="center", va="center", fontsize=8, color=ink)
    axis.set_title(metric.replace("_", " "), fontsize=9)


def main() -> None:
    """Run the named study."""
    parser = harness.options(__doc__)
    commands = parser.add_subparsers(required=True)
    parts = {
        work.__name__: commands.add_parser(work.__name__, help=work.__doc__)
        for work in (limits, rigs, edge, poses)
    }
    for work in (limits, rigs, edge, poses):
        parts[work.__name__].set_defaults(run=work)
        parts[work.__name__].add_argument(
            "--out", type=Path, help="folder of the results (default: docs)"
        )
    parts["limits"].add_argument("--weights", type=Path, default=shipped_folder("paper"))
    parts["limits"].add_argument("--frames", type=int, nargs="*", default=list(FRAMES))
    for name in ("rigs", "edge", "poses"):
        parts[name].add_argument("--weights", type=harness.named, action="append", default=[])
        parts[name].add_argument("--rig", default="paper-rig")
    asked = parser.parse_args()
    with harness.one_line_errors():
        asked.run(asked)


if __name__ == "__main__":
    main()
