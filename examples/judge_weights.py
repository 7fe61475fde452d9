"""Measure weights on each category of objects: `python examples/judge_weights.py [OBJECTS
[WEIGHTS]]`
"""

import sys
from itertools import repeat
from pathlib import Path

import numpy as np
from nlos_models import silhouette_iou

from nlos_cam.evaluate import (
    as_map_set,
    echoes_of,
    network_input,
    rig_of,
    seeded_objects,
    sense,
    truth_of,
)
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import load_networks

FIRST_SEED = 20_000_000
"""First seed of objects that training never draws."""


def main(count: int = 36, weights: Path | None = None) -> None:
    """Print the mean silhouette IoU of each category, over random objects that training never
    draws.
    """
    network = load_networks(weights)
    rig = rig_of(network.record)
    objects = seeded_objects(FIRST_SEED, count, object_box(rig))
    truth = truth_of(objects, object_box(rig))
    maps = as_map_set(sense(echoes_of(objects, rig, lambda *_: None), rig), truth)
    taken = network_input(maps, None, repeat(rig), network.record)
    iou = silhouette_iou(network(taken.depth_m, taken.intensity), truth)
    kinds = np.array([one.category for one in objects])
    for kind in sorted(set(kinds)):
        print(f"{kind:12s} {iou[kinds == kind].mean():.2f} over {np.sum(kinds == kind)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), *map(Path, sys.argv[2:3]))
