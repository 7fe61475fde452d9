"""Which training holds where a bench is off its record? docs/figures/edge_training.json.

    python tools/studies/edge_training.py WORK [--objects N] [--samples M] [--seeds S] [--out DIR]

The same objects, on the paper's bench, train direct networks with as many samples each: "exact", all
on the record; "jittered", each 25 objects on a bench up to 2 mm and 0.5 degrees off it; "blind", on
the record but without the cells that the occluder's edge can pass on such a bench, in training and
after. They are judged on the 54 test objects, on
benches that are off the record by a little, with either sign. WORK keeps data and networks, and may
be that of stations.py: a second call goes on, also after a kill.
"""

import os
import platform
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import harness
import numpy as np
from nlos_calibration import Rig
from nlos_models.training import DirectRecipe, MapSet, load_recipe
from stations import (
    FIRST_SEED,
    RECIPE,
    StationsNetwork,
    held_out,
    over_seeds,
    rendered,
    rig_at,
    shortened,
    trained,
    untrained,
)
from weights import OFFSETS_DEG, OFFSETS_MM, Place

from nlos_cam.cli.common import tracked
from nlos_cam.dataset import RigSpread, open_packed_maps
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    as_map_set,
    echoes_of,
    over_objects,
    per_object,
    plain,
    sense,
    truth_of,
)
from nlos_cam.objects import benchmark_objects, object_box

HOME = "home"
SPREAD = RigSpread(place_m=0.002, angle_deg=0.5)
TRAININGS = "exact", "jittered", "blind"


def places_of(rig: Rig) -> dict[str, Place]:
    """Return the places of a lidar that is a little off its record, by name."""
    here = Place(rig.lidar.distance_m, rig.lidar.yaw_deg)
    places = {"on the record": here}
    for off_mm, sign in product(OFFSETS_MM, (1, -1)):
        moved_m = here.distance_m + sign * off_mm / 1e3
        places[f"{sign * off_mm:+g} mm"] = replace(here, distance_m=moved_m)
    for off_deg, sign in product(OFFSETS_DEG, (1, -1)):
        places[f"{sign * off_deg:+g} degrees"] = replace(
            here, yaw_deg=here.yaw_deg + sign * off_deg
        )
    return places


def test_maps() -> dict[str, MapSet]:
    """Return the maps of the test objects at every place."""
    rig = rig_at(HOME)
    subjects = benchmark_objects(object_box(rig))
    truth = truth_of(subjects, object_box(rig))
    found: dict[str, MapSet] = {}
    places = places_of(rig)
    with tracked("rendering the test objects at every place") as on_progress:
        for number, (name, place) in enumerate(places.items()):
            bench = place.rig(rig)
            found[name] = as_map_set(
                sense(echoes_of(subjects, bench, lambda *_: None), bench), truth
            )
            on_progress(number + 1, len(places))
    return found


def judged(networks: Sequence[StationsNetwork], maps: MapSet) -> dict[str, Any]:
    """Return every metric, with intervals over objects, as the mean over networks."""
    box = object_box(rig_at(HOME))
    values = [
        per_object(network.images([maps]), maps.image.astype(np.float32), box)
        for network in networks
    ]
    return plain(over_objects(over_seeds(values)))


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--objects", type=int, default=20_000)
    parser.add_argument("--samples", type=int, default=204_800)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked = parser.parse_args()

    recipe = load_recipe(RECIPE)
    if not isinstance(recipe, DirectRecipe):
        raise SceneError(f"{RECIPE} is no recipe of a direct network")
    exact = rendered(HOME, asked.work, FIRST_SEED, asked.objects)
    jittered = rendered(HOME, asked.work, FIRST_SEED, asked.objects, SPREAD)
    held = [held_out(HOME, asked.work)]
    networks: dict[str, list[StationsNetwork]] = {}
    folder = asked.work / f"{asked.objects}-{asked.samples}"
    with ExitStack() as opened:
        sources = {
            training: opened.enter_context(
                open_packed_maps([data], asked.work / f"packed-{name}", align=False, edge=edge)
            )
            for training, data, name, edge in (
                ("exact", exact, HOME, None),
                ("jittered", jittered, f"{HOME}-spread", None),
                ("blind", exact, f"{HOME}-blind", SPREAD),
            )
        }
        for seed, (training, source) in product(range(asked.seeds), sources.items()):
            own = shortened(recipe, asked.samples, seed)
            # the exact one is the control of stations.py
            name = HOME if training == "exact" else f"{HOME}-{training}"
            network = untrained(own, [source])
            done = trained(network, name, [source], own, held, folder / f"{name}-{seed}")
            networks.setdefault(training, []).append(done)

    rows: dict[str, Any] = {}
    for place, maps in test_maps().items():
        rows[place] = {training: judged(networks[training], maps) for training in TRAININGS}
        iou = {
            name: round(each["silhouette_iou"]["value"], 4) for name, each in rows[place].items()
        }
        print(place, iou, flush=True)
    facts = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "objects": asked.objects,
        "samples": asked.samples,
        "seeds": asked.seeds,
        "hidden_cells": int(networks["blind"][0].stations[0].normal.hidden.sum()),
        "places": rows,
    }
    harness.write("edge_training", facts, asked.out)


if __name__ == "__main__":
    main()
