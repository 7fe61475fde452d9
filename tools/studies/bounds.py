"""Bounds by what the maps of one, two and four stations hold, and of a wider gap:
docs/figures/bounds.json.

    python tools/studies/bounds.py [--objects N] [--out DIR]

A linear estimate of every pixel's albedo from the light of the cells that an object wins, with tilt
and self-occlusion in the data and in the model, and the mean and covariance of outlines as the
prior: the posterior mean is cut as the program cuts its images. The data are rendered of the object
alone; the model is linear in the albedo about an assumed depth, which goes on beyond the outline:
the true one, one that is 3 mm too far, or the one that the shipped direct network finds from one
frame at home. Each cell's bin is the strongest of the true outline at the assumed depth. How far the
model is trusted, an error relative to the light, is chosen on other objects, by depth and frames.
"""

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path

import harness
import numpy as np
from nlos_calibration import ObjectBox, Rig, load_rig
from nlos_calibration.arrays import Float32, Float64
from stations import rig_at

from nlos_cam.cli.common import tracked
from nlos_cam.evaluate import (
    SeededObject,
    echoes_of,
    over_objects,
    plain,
    seeded_objects,
    sense,
)
from nlos_cam.forecast import (
    ACCURACY,
    BLACK,
    EFFECTS,
    ChosenBeams,
    Shape,
    cut,
    shipped_basis,
)
from nlos_cam.objects import BenchmarkObject, benchmark_objects, object_box, unseen_objects
from nlos_cam.reconstruct import load_networks, reconstruct
from nlos_cam.render import Gradients, Scene, SensorModel, Surface, intensity_noise, render

SETS = (
    ("home",),
    ("near",),
    ("home", "near"),
    ("home", "near", "back", "fore"),
    ("wide",),
    ("wide", "wide-fore"),
)
FRAMES = 1, 30, 100
TOO_FAR_M = 0.003
DEPTHS = "exact", "3 mm too far", "the network's"
TRUSTS = 0.005, 0.01, 0.02, 0.05, 0.1, 0.2
"""Errors of the model relative to the light to choose from."""
TUNING_SEED = 95_000_000
TUNING = 24


@dataclass(frozen=True)
class Light:
    """Light of the cells (k) that an object wins at one station, and how it depends on albedo."""

    measured: Float64
    """(k,); expected, free of noise."""
    usual: Float64
    """(k,); of the prior's mean outline, at the assumed depth."""
    rates: Float64
    """(k, OUTLINES); by the prior's largest components of the outline."""
    noise: Float64
    """(k,); in one frame."""


def light_at(rig: Rig, truth: Shape, assumed: Shape) -> Light:
    """Return what a station's cells hold of an object, for a model at an assumed depth."""
    box = object_box(rig)
    alone_m = np.where(truth.outline, truth.depth_m(box), np.nan).astype(np.float32)
    data = Gradients(Scene(rig, alone_m), ACCURACY, EFFECTS)
    wall = render(Scene(rig), ACCURACY, ("direct", "occluder")).intensity
    albedo = np.where(truth.outline, 1.0, BLACK)
    model = Gradients(Scene(rig, assumed.depth_m(box), Surface(albedo)), ACCURACY, EFFECTS)
    won = data.three_bounce & (data.intensity > wall) & model.three_bounce
    noise = intensity_noise(data, SensorModel())
    won &= np.isfinite(noise)
    basis = shipped_basis()
    by_outline = ChosenBeams(model, won).jacobian("albedo")[0]
    return Light(
        data.intensity[won].astype(np.float64),
        by_outline @ basis.mean_outline,
        by_outline @ basis.outline,
        noise[won],
    )


def estimate(
    lights: Sequence[Light], frames: int, trust: float, seed: int
) -> tuple[Float64, float]:
    """Return the outline (GRID^2,) by the posterior mean, and how many of its numbers the maps
    determine.
    """
    basis = shipped_basis()
    generator = np.random.default_rng(seed)
    count = basis.outline.shape[1]
    prior = basis.covariance[:count, :count]
    information = np.linalg.inv(prior)
    told = np.zeros(count)
    for light in lights:
        drawn = light.noise / np.sqrt(frames)
        sensed = light.measured + drawn * generator.standard_normal(len(drawn))
        spread = np.hypot(drawn, trust * light.measured)
        rates = light.rates / spread[:, None]
        off = (sensed - light.usual) / spread
        information += rates.T @ rates
        told += rates.T @ off
    posterior = np.linalg.inv(information)
    outline = basis.mean_outline + basis.outline @ (posterior @ told)
    numbers = count - np.trace(np.linalg.solve(prior, posterior))
    return outline, float(numbers)


def overlap(outline: Float64, truth: Shape) -> float:
    """Return the silhouette IoU of an estimated outline."""
    inside = cut(outline)
    seen = truth.outline.ravel()
    return float((inside & seen).sum() / max((inside | seen).sum(), 1))


@dataclass(frozen=True)
class Subject:
    """An object, in the cells of the estimate, and the depths that a model may assume."""

    truth: Shape
    assumed: Mapping[str, Shape]


def subjects_of(
    objects: Sequence[BenchmarkObject] | Sequence[SeededObject], box: ObjectBox
) -> list[Subject]:
    """Return objects with their true depth, one that is too far, and the network's."""
    found: list[Subject] = []
    for each, seen_m in zip(objects, network_depths_m(objects), strict=True):
        truth = Shape.of(each.depth_m, box)
        farther = truth.depth + TOO_FAR_M / (box.z_far_m - box.z_near_m)
        seen = Shape.of(seen_m, box) if np.isfinite(seen_m).any() else average_shape()
        assumed = dict(zip(DEPTHS, (truth, Shape(truth.outline, farther), seen), strict=True))
        found.append(Subject(truth, assumed))
    return found


def average_shape() -> Shape:
    """Return the prior's mean depth, where the network finds no surface at all."""
    basis = shipped_basis()
    side = int(np.sqrt(len(basis.mean_depth)))
    return Shape(np.ones((side, side), bool), basis.mean_depth.reshape(side, side))


def network_depths_m(objects: Sequence[BenchmarkObject] | Sequence[SeededObject]) -> list[Float32]:
    """Return the depth maps (64, 64) that the shipped network finds from one frame at home."""
    rig = load_rig("paper-rig")
    maps = sense(echoes_of(objects, rig, lambda _done, _of: None), rig)
    network = load_networks()
    return [reconstruct(each, rig, network).depth_m for each in maps]


def lights_of(subject: Subject, depth: str) -> dict[str, Light]:
    """Return what every station holds of an object, for a model at one of its assumed depths."""
    stations = sorted({station for chosen in SETS for station in chosen})
    return {
        station: light_at(rig_at(station), subject.truth, subject.assumed[depth])
        for station in stations
    }


@dataclass(frozen=True)
class Setting:
    """Data and model of an estimate."""

    depth: str
    stations: tuple[str, ...]
    frames: int


SETTINGS = [Setting(*each) for each in product(DEPTHS, SETS, FRAMES)]
Found = dict[tuple[Setting, float], list[tuple[float, float]]]
"""IoU and numbers determined of every object, by setting and trusted error."""


def estimated(
    subjects: Sequence[Subject], what: str, trusts: Mapping[Setting, Sequence[float]]
) -> Found:
    """Return the estimates of every object."""
    found: Found = {}
    with tracked(what) as on_progress:
        for number, (subject, depth) in enumerate(product(subjects, DEPTHS)):
            lights = lights_of(subject, depth)
            for setting in (each for each in SETTINGS if each.depth == depth):
                chosen = [lights[station] for station in setting.stations]
                for trust in trusts[setting]:
                    outline, numbers = estimate(chosen, setting.frames, trust, number)
                    figures = overlap(outline, subject.truth), numbers
                    found.setdefault((setting, trust), []).append(figures)
            on_progress(number + 1, len(subjects) * len(DEPTHS))
    return found


def trusted(box: ObjectBox) -> dict[Setting, list[float]]:
    """Return the error of the model that is best for each setting, on objects of their own."""
    subjects = subjects_of(seeded_objects(TUNING_SEED, TUNING, box), box)
    found = estimated(subjects, "choosing how far to trust", dict.fromkeys(SETTINGS, TRUSTS))

    def mean_iou(setting: Setting, trust: float) -> float:
        return float(np.mean([iou for iou, _ in found[setting, trust]]))

    return {each: [max(TRUSTS, key=partial(mean_iou, each))] for each in SETTINGS}


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("--objects", type=int, default=54, help="of each set, at most 54")
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked = parser.parse_args()

    box = object_box(load_rig("paper-rig"))
    trusts = trusted(box)
    groups = {"kinds of training": benchmark_objects, "kinds never seen": unseen_objects}
    rows = [asdict(setting) | {"trusted_error": trusts[setting][0]} for setting in SETTINGS]
    for which, objects_in in groups.items():
        subjects = subjects_of(objects_in(box)[: asked.objects], box)
        found = estimated(subjects, which, trusts)
        for row, setting in zip(rows, SETTINGS, strict=True):
            figures = np.array(found[setting, trusts[setting][0]])
            row[which] = {
                "silhouette_iou": plain(over_objects({"silhouette_iou": figures[:, 0]})),
                "numbers": float(figures[:, 1].mean()),
            }
    for row in rows:
        iou = [row[which]["silhouette_iou"]["silhouette_iou"]["value"] for which in groups]
        print(row["depth"], "+".join(row["stations"]), row["frames"], iou, row["trusted_error"])
    facts = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "objects": min(asked.objects, len(benchmark_objects(box))),
        "rows": rows,
    }
    harness.write("bounds", facts, asked.out)


if __name__ == "__main__":
    main()
