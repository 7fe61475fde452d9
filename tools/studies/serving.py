"""Shipped weights on rigs that are not theirs: which of them serves a bench best.

    python tools/studies/serving.py [--weights [NAME=]DIR ...]
        docs/figures/serving.json

Rigs are drawn over all that the paper allows, and nearer to the rigs of the weights `direct` and
`wide`. The 54 test objects stand on each, one frame with noise; maps are aligned as in `live`. The
figures decide the order in which `weights_for` looks at the weights.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import harness
import numpy as np
from nlos_calibration import Rig, load_rig
from nlos_models import RIG_WEIGHTS, Reconstructor, load_reconstructor, weights_folder

from nlos_cam.dataset import RigRange
from nlos_cam.evaluate import (
    as_map_set,
    echoes_of,
    judge,
    network_input,
    plain,
    reconstruct_all,
    sense,
    truth_of,
)
from nlos_cam.files import cache_folder
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import weights_for, weights_serve

FIRST_SEED = 71_000_000
"""Of the rigs: no training set draws its rigs from it."""
FAMILIES = {"paper-rig": 12, "wide-rig": 12, "any": 24}
"""Rigs that are drawn near a packaged one, and over all that the paper allows."""
NEAR = {
    "distance_m": 0.03,
    "yaw_deg": 20.0,
    "gap_m": 0.03,
    "along_m": 0.03,
    "occluder_m": 0.01,
}
"""Largest difference of a rig that is drawn near another one."""


@dataclass(frozen=True)
class Draw:
    """One rig of a family."""

    family: str
    number: int

    def rig(self) -> Rig:
        """Return the rig."""
        seed = FIRST_SEED + list(FAMILIES).index(self.family) * 1000 + self.number
        if self.family == "any":
            return RigRange().draw(load_rig("paper-rig"), seed)
        rig = load_rig(self.family)
        return range_near(rig).draw(rig, seed)


def range_near(rig: Rig) -> RigRange:
    """Return the range of rigs near another one."""
    if rig.occluder is None:
        raise ValueError(f"{rig.name} has no occluder")
    middle = {
        "distance_m": rig.lidar.distance_m,
        "yaw_deg": rig.lidar.yaw_deg,
        "gap_m": rig.occluder.z_min_m,
        "along_m": 0.0,
        "occluder_m": 0.0,
    }
    ends = {name: (middle[name] - off, middle[name] + off) for name, off in NEAR.items()}
    return RigRange(**ends)


def measure(rig: Rig, networks: Mapping[str, Reconstructor]) -> dict[str, Any]:
    """Return the figures of all weights on one rig, with the verdict that `live` would give."""
    box = object_box(rig)
    subjects = benchmark_objects(box)
    truth = truth_of(subjects, box)
    maps = as_map_set(sense(echoes_of(subjects, rig, lambda *_: None), rig), truth)

    found = dict[str, Any]()
    for name, network in networks.items():
        taken = network_input(maps, None, repeat(rig), network.record)
        figures = plain(judge(reconstruct_all(network, taken), truth, box))
        found[name] = {
            "silhouette_iou": round(figures["silhouette_iou"]["value"], 4),
            "foreground_rmse_mm": round(figures["foreground_rmse_mm"]["value"], 2),
            "service": weights_serve(rig, network.record).service,
        }
    return {
        "rig": rig.model_dump(mode="json", include={"lidar", "occluder", "object_box"}),
        "chosen": weights_for(rig).name,
        "weights": found,
    }


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("--weights", type=harness.named, action="append", default=[])
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked: argparse.Namespace = parser.parse_args()

    folders: dict[str, Path] = {
        **{name: weights_folder(Path(name)) for name in RIG_WEIGHTS},
        **harness.by_name(asked.weights),
    }
    graphs = cache_folder() / "onnx"
    networks = {name: load_reconstructor(folder, graphs) for name, folder in folders.items()}
    draws = [Draw(family, n) for family, count in FAMILIES.items() for n in range(count)]
    with harness.one_line_errors():
        rows = harness.collect(
            "serving",
            draws,
            lambda draw, _: measure(draw.rig(), networks),
            key=repr(sorted((name, network.record.figures) for name, network in networks.items())),
        )
    harness.write("serving", {"rigs": rows}, asked.out)
    for name in networks:
        ious = [row["weights"][name]["silhouette_iou"] for row in rows]
        print(f"{name}: mean IoU {np.mean(ious):.3f}, worst {np.min(ious):.3f}")


if __name__ == "__main__":
    main()
