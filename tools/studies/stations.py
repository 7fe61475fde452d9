"""Is it a second place of the lidar, a closer one, or a wider gap? docs/figures/stations.json and
docs/images/stations.png.

    python tools/studies/stations.py WORK [--objects N] [--samples M] [--seeds S] [--sets NAMES ...]
        [--compile] [--name NAME]

The same objects are rendered on the paper's bench for a lidar at "home" (0.20 m from the wall),
"near" (0.15 m) and "back" (0.10 m farther from the object), and for an occluder whose gap is "wide"
(0.14 m for 0.10 m). A network for each set of stations is trained on as many samples, seed by seed:
one station's is the direct network itself; of several, each station has its own layers up to the
trunk, which reads their sum. They are judged on the 54 test objects, the 54 of kinds never seen and
held-out ones, each station with noise of its own. WORK keeps data and networks: a second call goes
on, also after a kill.
"""

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import harness
import numpy as np
import torch
from matplotlib.figure import Figure
from nlos_calibration import Rig, load_rig
from nlos_calibration.arrays import Float32
from nlos_models import DirectNetwork, image_from_logits
from nlos_models.training import (
    DirectRecipe,
    MapSet,
    NormalBatch,
    Running,
    figures_of,
    fit,
    load_recipe,
    parts_of,
    two_heads_error,
    varied,
)
from torch import Tensor, nn

from nlos_cam.camera import World
from nlos_cam.cli.common import tracked
from nlos_cam.dataset import (
    DatasetPlan,
    Objects,
    PackedMaps,
    build_dataset,
    map_noise,
    open_dataset,
    open_packed_maps,
)
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    advantage,
    as_map_set,
    echoes_of,
    over_objects,
    per_object,
    plain,
    truth_of,
)
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects import benchmark_objects, object_box, unseen_objects
from nlos_cam.render import SceneFile, SensorModel

RECIPE = harness.ROOT / "models" / "recipes" / "paper-rig-direct.toml"


class Place(NamedTuple):
    """Place of the lidar on the paper's bench, or of its occluder."""

    along_m: float = 0.0
    """Of the lidar's foot, from home's."""
    distance_m: float = 0.20
    yaw_deg: float = 45.0
    gap_m: float = 0.10
    """Between the wall and the occluder's edge."""


PLACES = {
    "home": Place(),
    "near": Place(distance_m=0.15),
    "back": Place(along_m=-0.10),
    "fore": Place(along_m=0.10, distance_m=0.15, yaw_deg=60.0),
    "wide": Place(gap_m=0.14),
    "wide-fore": Place(along_m=0.10, distance_m=0.15, yaw_deg=60.0, gap_m=0.14),
}
SETS = ("home", "near", "back", "home+near", "wide")
FIRST_SEED = 80_000_000
HELD_OUT_SEED = 90_000_000
HELD_OUT = 400
EPOCHS = 20
TESTS = "kinds of training", "kinds never seen", "held out"
SHARE_GENERIC = 0.5
Maps = Mapping[str, MapSet]
"""Maps of the same objects by the name of the station."""


class StationsNetwork(nn.Module):
    """Direct networks of some stations up to their trunk; the first one's trunk reads their sum."""

    def __init__(self, recipe: DirectRecipe, normals: Sequence[nn.Module]) -> None:
        super().__init__()
        self.stations = nn.ModuleList()
        for number, normal in enumerate(normals):
            network = DirectNetwork(recipe.direct, recipe.dropout)
            network.normal.load_state_dict(normal.state_dict())
            if number:  # only the first one's is used
                for name in ("trunk", "out", "place", "mixers", "norm", "heads"):
                    delattr(network, name)
            self.stations.append(network)

    def logits(self, normals: Sequence[Tensor]) -> Tensor:
        """Map normalised maps (n, 2, 64, 80) of each station to two logits (n, 2, 64, 64)."""
        features = sum(
            station.encode(normal) for station, normal in zip(self.stations, normals, strict=True)
        )
        # of several independent features, so that the trunk starts at the same variance
        return self.stations[0].decode(features / len(self.stations) ** 0.5, 2)

    @torch.no_grad()
    def images(self, maps: Sequence[MapSet]) -> Float32:
        """Return the images v (n, 64, 64) of maps of each station."""
        pairs = [
            list(zip(parts_of(one.depth_m), parts_of(one.intensity), strict=True)) for one in maps
        ]
        found: list[Float32] = []
        for part in zip(*pairs, strict=True):
            normals = [
                station.normal(torch.from_numpy(depth_m), torch.from_numpy(intensity))
                for station, (depth_m, intensity) in zip(self.stations, part, strict=True)
            ]
            found.append(image_from_logits(self.logits(normals)).float().numpy())
        return np.concatenate(found)


def rig_at(place: str) -> Rig:
    """Return the paper's bench, seen from a place, in the wall frame of that place's lidar."""
    home = load_rig("paper-rig")
    along_m, distance_m, yaw_deg, gap_m = PLACES[place]
    box = object_box(home)
    shifted = {"x_min_m": box.x_min_m - along_m, "x_max_m": box.x_max_m - along_m}
    occluder = home.occluder
    if occluder is None:
        raise SceneError(f"{home.name} has no occluder")
    return home.model_copy(
        update={
            "name": place,
            "lidar": home.lidar.model_copy(update={"distance_m": distance_m, "yaw_deg": yaw_deg}),
            "occluder": occluder.model_copy(
                update={"x_m": occluder.x_m - along_m, "z_min_m": gap_m}
            ),
            "object_box": box.model_copy(update=shifted),
        }
    )


def rendered(place: str, work: Path, seed: int, count: int) -> Path:
    """Render objects without noise as a place's lidar sees them, unless they are there."""
    folder = work / f"{place}-{seed}"
    plan = DatasetPlan(
        rig_at(place),
        seed,
        accuracy="draft",
        objects=Objects(share_generic=SHARE_GENERIC),
        expected=True,
    )
    with tracked(f"rendering {count} objects from {place}") as on_progress:
        build_dataset(plan, count, folder, workers=os.cpu_count() or 1, on_progress=on_progress)
    return folder


def held_out(place: str, work: Path) -> MapSet:
    """Return held-out maps with a station's own noise."""
    opened = open_dataset(rendered(place, work, HELD_OUT_SEED, HELD_OUT), expected=True)
    maps = opened.first(HELD_OUT)
    return map_noise(opened.plan).expose(maps, HELD_OUT_SEED + [*PLACES].index(place))


def test_maps(place: str, which: str) -> MapSet:
    """Return the maps of a set of test objects with a station's own noise."""
    rig = rig_at(place)
    box = object_box(rig)
    subjects = (benchmark_objects if which == "kinds of training" else unseen_objects)(box)
    with tracked(f"rendering {which} from {place}") as on_progress:
        echoes = echoes_of(subjects, rig, on_progress)
    scene = SceneFile(name=place, rig=rig, sensor=SensorModel())
    world = World(scene, echoes, [None])
    first = len(subjects) * [*PLACES].index(place)
    maps = [
        maps_from_frame(world.images(first + number).frame(world.rig.pinhole))
        for number in range(len(subjects))
    ]
    return as_map_set(maps, truth_of(subjects, box))


def matched(
    sources: Sequence[PackedMaps], batch: int, steps: int, seed: int
) -> Iterator[list[NormalBatch]]:
    """Yield batches of the same objects from every station."""
    while steps:
        generators = [torch.Generator().manual_seed(seed) for _ in sources]
        several = [
            source.batches(batch, generator)
            for source, generator in zip(sources, generators, strict=True)
        ]
        for batches in zip(*several, strict=True):
            yield list(batches)
            steps -= 1
            if not steps:
                return
        seed += 1


def trained(
    stations: Sequence[str],
    sources: Sequence[PackedMaps],
    recipe: DirectRecipe,
    maps: Maps,
    folder: Path,
    *,
    compiled: bool = False,
) -> StationsNetwork:
    """Train the network of some stations, or go on with it."""
    torch.manual_seed(recipe.seed)
    network = StationsNetwork(recipe, [source.normal for source in sources])
    steps = recipe.objects // recipe.batch
    running = Running(compiled=compiled)
    logits = running.maybe_compile(network.logits)

    def batches(generator: torch.Generator) -> Iterator[list[NormalBatch]]:
        return matched(sources, recipe.batch, steps, generator.initial_seed())

    def loss(batch: list[NormalBatch], _: float) -> Tensor:
        normals = [
            varied(recipe, station.normal, one, source.noise)
            for station, one, source in zip(network.stations, batch, sources, strict=True)
        ]
        noisy = [normal + recipe.noise * torch.randn_like(normal) for normal in normals]
        return two_heads_error(logits(noisy), batch[0].image)

    chosen = [maps[station] for station in stations]
    with tracked(f"training {'+'.join(stations)}, seed {recipe.seed}") as on_progress:
        fit(
            network,
            recipe=recipe,
            steps_per_epoch=steps,
            batches=batches,
            loss=loss,
            score=lambda: figures_of(network.images(chosen), chosen[0].image),
            folder=folder,
            running=replace(running, on_step=on_progress),
        )
    return network.cpu().eval()


def judged(
    network: StationsNetwork, sets: Mapping[str, Maps], stations: Sequence[str]
) -> dict[str, Any]:
    """Return every metric of every object of each set."""
    found: dict[str, Any] = {}
    for name, maps in sets.items():
        chosen = [maps[station] for station in stations]
        truth = chosen[0].image.astype(np.float32)
        values = per_object(network.images(chosen), truth, object_box(rig_at(stations[0])))
        found[name] = {metric: each.tolist() for metric, each in values.items()}
    return found


def summary(runs: Sequence[dict[str, Any]], base: str) -> dict[str, Any]:
    """Return figures of each set of stations, over objects and seeds, and their advantage over the
    base's runs of the same seeds.
    """
    by_stations: dict[str, dict[int, Any]] = {}
    for each in runs:
        by_stations.setdefault(each["stations"], {})[each["seed"]] = each["values"]
    found: dict[str, Any] = {}
    for stations, seeds in by_stations.items():
        found[stations] = {"seeds": sorted(seeds)}
        for name in next(iter(seeds.values())):
            own = over_seeds([values[name] for values in seeds.values()])
            found[stations][name] = plain(over_objects(own))
            means = [float(np.mean(values[name]["silhouette_iou"])) for values in seeds.values()]
            found[stations][name]["iou_by_seed"] = means
            both = sorted(set(seeds) & set(by_stations.get(base, {})))
            if stations != base and both:
                ours = over_seeds([seeds[seed][name] for seed in both])
                theirs = over_seeds([by_stations[base][seed][name] for seed in both])
                found[stations][name]["advantage"] = plain(advantage(ours, theirs))
    return found


def over_seeds(values: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, Any]:
    """Return the mean over seeds of every object's metrics: intervals are over objects."""
    return {
        metric: np.mean([np.asarray(each[metric], float) for each in values], axis=0)
        for metric in values[0]
    }


def draw(found: Mapping[str, Any]) -> Figure:
    """Draw the silhouette IoU of each set of stations, with its interval."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axis = figure.subplots()
    for number, which in enumerate(TESTS):
        places = np.arange(len(found)) + 0.2 * (number - 1)
        figures = [each[which]["silhouette_iou"] for each in found.values()]
        values = np.array([each["value"] for each in figures])
        low = values - [each["low"] for each in figures]
        high = [each["high"] for each in figures] - values
        axis.errorbar(places, values, (low, high), fmt="o", capsize=3, label=which)
    axis.set_xticks(range(len(found)), [*found])
    axis.set_ylabel("silhouette IoU")
    axis.legend(frameon=False)
    return figure


@dataclass(frozen=True)
class Material:
    """What networks are trained on and judged by."""

    sources: Mapping[str, PackedMaps]
    """Of each station."""
    sets: Mapping[str, Maps]
    recipe: DirectRecipe
    folder: Path
    compiled: bool

    def values(self, name: str, seed: int) -> dict[str, Any]:
        """Return the metrics of a network (stations joined by +), which is trained if the folder does
        not have them.
        """
        folder = self.folder / f"{name}-{seed}"
        done = folder / "judged.json"
        if not done.exists():
            stations = name.split("+")
            network = trained(
                stations,
                [self.sources[each] for each in stations],
                self.recipe.model_copy(update={"seed": seed}),
                self.sets[TESTS[2]],
                folder,
                compiled=self.compiled,
            )
            done.write_text(json.dumps(judged(network, self.sets, stations)), encoding="utf-8")
        return json.loads(done.read_text(encoding="utf-8"))


def recipe_of(samples: int) -> DirectRecipe:
    """Return the recipe of the study's networks. Raises SceneError where RECIPE is of another kind."""
    recipe = load_recipe(RECIPE)
    if not isinstance(recipe, DirectRecipe):
        raise SceneError(f"{RECIPE} is no recipe of a direct network")
    return recipe.model_copy(update={"epochs": EPOCHS, "objects": samples // EPOCHS})


def packed(opened: ExitStack, folder: Path, store: Path, objects: int) -> PackedMaps:
    """Return the maps of a station. Raises SceneError where they are of more or fewer objects."""
    source = opened.enter_context(open_packed_maps([folder], store))
    if len(source) != objects:  # an earlier call's, which the figures would be of
        raise SceneError(
            f"{folder} holds {len(source)} objects, not {objects}: ask for as many, or name an empty"
            " WORK"
        )
    return source


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--objects", type=int, default=100_000)
    parser.add_argument("--samples", type=int, default=1_500_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sets", nargs="+", default=SETS, help="stations joined by +")
    parser.add_argument("--compile", action="store_true", help="needs a C++ compiler (g++)")
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    parser.add_argument("--name", default="stations", help="of the results' files")
    asked = parser.parse_args()
    harness.claim(asked.work)
    threads = torch.get_num_threads()

    places = [place for place in PLACES if any(place in each.split("+") for each in asked.sets)]
    folders = {place: rendered(place, asked.work, FIRST_SEED, asked.objects) for place in places}
    sets: dict[str, Maps] = {
        which: {place: test_maps(place, which) for place in places} for which in TESTS[:2]
    }
    sets[TESTS[2]] = {place: held_out(place, asked.work) for place in places}
    torch.set_num_threads(threads)  # rendering set the number anew
    runs: list[dict[str, Any]] = []
    facts: dict[str, Any] = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "objects": asked.objects,
        "samples": asked.samples,
    }
    with ExitStack() as opened:
        sources = {
            place: packed(opened, folder, asked.work / f"packed-{place}", asked.objects)
            for place, folder in folders.items()
        }
        runs_folder = asked.work / f"{asked.objects}-{asked.samples}"
        material = Material(sources, sets, recipe_of(asked.samples), runs_folder, asked.compile)
        for seed, name in product(range(asked.seeds), asked.sets):
            values = material.values(name, seed)
            runs.append({"stations": name, "seed": seed, "values": values})
            iou = {
                which: round(float(np.mean(each["silhouette_iou"])), 4)
                for which, each in values.items()
            }
            print(name, "seed", seed, iou, flush=True)
            facts["stations"] = summary(runs, asked.sets[0])
            harness.write(asked.name, facts, asked.out)
    harness.save(asked.name, draw(facts["stations"]), asked.out, dpi=110)


if __name__ == "__main__":
    main()
