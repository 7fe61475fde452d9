"""Shipped weights on rigs that are not theirs: which of them serves a bench best.

    python tools/studies/serving.py [--weights [NAME=]DIR ...]
        docs/figures/serving.json

Rigs are drawn over all that the paper allows, and nearer to the rigs of the weights `direct` and
`wide`; the twenty of the map (`weights.py rigs`) are added. The 54 test objects stand on each, one
frame with noise; maps are aligned as in `live`. By these figures `weights_for` chooses: put the
losses and gains that are printed into nlos_cam/reconstruct/serving.py.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import harness
import numpy as np
from nlos_calibration import Rig, load_rig
from nlos_models import (
    ANY,
    BENCH_WEIGHTS,
    DIRECT,
    WIDE,
    Reconstructor,
    load_reconstructor,
    weights_folder,
)
from weights import ANGLES_DEG, DISTANCES_M, Place, shown

from nlos_cam.dataset import RigRange
from nlos_cam.evaluate import (
    as_map_set,
    judge,
    network_input,
    plain,
    reconstruct_all,
)
from nlos_cam.files import cache_folder
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import (
    HOME_IOU,
    AlignedTerms,
    AnyTerms,
    aligned_terms,
    any_terms,
    weights_serve,
)

FIRST_SEED = 71_000_000
"""Of the rigs: no training set draws its rigs from it."""
MAP = [(distance_m, yaw_deg) for distance_m in DISTANCES_M for yaw_deg in ANGLES_DEG]
FAMILIES = {"paper-rig": 20, "wide-rig": 20, "any": 32, "map": len(MAP)}
"""Rigs that are drawn near a packaged one, and over all that the paper allows; those of the map."""
NEAR = {
    "distance_m": 0.05,
    "yaw_deg": 25.0,
    "gap_m": 0.03,
    "along_m": 0.03,
    "occluder_m": 0.01,
}
"""Largest difference of a rig that is drawn near another one."""
HOMES = {DIRECT: "paper-rig", WIDE: "wide-rig"}
"""Rigs of the shipped weights for one."""


@dataclass(frozen=True)
class Draw:
    """One rig of a family."""

    family: str
    number: int

    def rig(self) -> Rig:
        """Return the rig."""
        if self.family == "map":
            return Place(*MAP[self.number]).rig(load_rig("paper-rig"))
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
    """Return the figures of all weights on one rig, with their service."""
    box = object_box(rig)
    subjects = benchmark_objects(box)
    truth, seen = shown(subjects, rig)
    maps = as_map_set(seen, truth)

    found = dict[str, Any]()
    for name, network in networks.items():
        taken = network_input(maps, None, repeat(rig), network.record)
        figures = plain(judge(reconstruct_all(network, taken), truth, box))
        rmse_mm = figures["foreground_rmse_mm"]["value"]  # None where no pixel is shared
        found[name] = {
            "silhouette_iou": round(figures["silhouette_iou"]["value"], 4),
            "foreground_rmse_mm": None if rmse_mm is None else round(rmse_mm, 2),
            "service": weights_serve(rig, network.record).service,
        }
    return {
        "rig": rig.model_dump(mode="json", include={"lidar", "occluder", "object_box"}),
        "weights": found,
    }


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("--weights", type=harness.named, action="append", default=[])
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked: argparse.Namespace = parser.parse_args()

    folders: dict[str, Path] = {
        **{name: weights_folder(Path(name)) for name in BENCH_WEIGHTS},
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
            key=harness.weights_key(folders),
        )
    found = summary(rows)
    harness.write("serving", {"summary": found, "rigs": rows}, asked.out)
    for name, value in found.items():
        print(name, harness.rounded(value))


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what each difference of a rig costs weights that its maps are aligned with, what each of
    its numbers brings those for any rig; and the mean IoU of all weights over each family of rigs, of
    those that these numbers choose, and of the best ones.
    """
    losses = fitted(
        (HOME_IOU[name] - iou_of(row, name), aligned_terms(rig_of(row), load_rig(home)))
        for row in rows
        for name, home in HOMES.items()
        if row["weights"][name]["service"] != "not"
    )
    gains = fitted((iou_of(row, ANY), any_terms(rig_of(row))) for row in rows)
    found: dict[str, Any] = {
        "losses": dict(zip(AlignedTerms._fields, losses.factors, strict=True)),
        "losses_scatter": losses.scatter,
        "gains_of_any": dict(zip(AnyTerms._fields, gains.factors, strict=True)),
        "gains_scatter": gains.scatter,
    }
    for family in FAMILIES:
        own = [row for row in rows if row["family"] == family]
        means = {name: float(np.mean([iou_of(row, name) for row in own])) for name in BENCH_WEIGHTS}
        chosen = [iou_of(row, choice(row, losses.factors, gains.factors)) for row in own]
        best = [max(iou_of(row, name) for name in BENCH_WEIGHTS) for row in own]
        found[family] = means | {"chosen": float(np.mean(chosen)), "best": float(np.mean(best))}
    return found


@dataclass(frozen=True)
class Fit:
    """Linear fit."""

    factors: list[float]
    scatter: float
    """Root of the mean squared error."""


def fitted(points: Iterable[tuple[float, Sequence[float]]]) -> Fit:
    """Return the fit of values to their terms."""
    values, terms = (np.array(each) for each in zip(*points, strict=True))
    factors, *_ = np.linalg.lstsq(terms, values, rcond=None)
    return Fit(factors.tolist(), float(np.sqrt(np.mean((values - terms @ factors) ** 2))))


def choice(row: Mapping[str, Any], losses: Sequence[float], gains: Sequence[float]) -> str:
    """Return the name of the weights that are expected to be best."""
    rig = rig_of(row)
    expected = {
        name: HOME_IOU[name] - float(np.dot(losses, aligned_terms(rig, load_rig(home))))
        for name, home in HOMES.items()
        if row["weights"][name]["service"] != "not"
    }
    expected[ANY] = float(np.dot(gains, any_terms(rig)))
    return max(expected, key=lambda name: expected[name])


def iou_of(row: Mapping[str, Any], name: str) -> float:
    """Return the silhouette IoU of weights on a rig."""
    return row["weights"][name]["silhouette_iou"]


def rig_of(row: Mapping[str, Any]) -> Rig:
    """Return the rig of a row."""
    return Draw(row["family"], row["number"]).rig()


if __name__ == "__main__":
    main()
