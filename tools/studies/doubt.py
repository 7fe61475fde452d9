"""How far doubt may be believed: docs/doubt.json and docs/images/reliability.png.

On the 54 test objects and on held-out ones: what uncertainty promises against what errors are. On empty benches: how
often an object is shown. On outliers, of kinds that were learnt from and of kinds that were not: how often they are
told. `--weights DIR` names other weights than the shipped ones, `--count N` and `--empty N` change how many of each
are judged, `--samples DIR` keeps what is rendered.
"""

import json
import math
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from doubt_pictures import draw_reliability
from named_weights import errors_told
from nlos_calibration.rig import Rig
from nlos_models.checkpoint import shipped_folder
from nlos_models.doubt_inference import Doubter, load_doubter
from nlos_models.inference import Reconstructor, load_reconstructor
from numpy.typing import NDArray

from nlos_cam import dataset
from nlos_cam.cache import cache_folder
from nlos_cam.cli.common import tracked
from nlos_cam.cli.evaluate_maps import rig_of
from nlos_cam.doubt_samples import EMPTY, ORDINARY, samples_on_disk
from nlos_cam.errors import SceneError
from nlos_cam.evaluate_objects import echoes_of, sense, truth_of
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_image import depth_from_image, object_box
from nlos_cam.objects.test_set import test_set
from nlos_cam.outliers import IN_SHAPE, TO_JUDGE, TO_LEARN
from nlos_cam.processing import limits_of
from nlos_cam.reconstruct import Reconstruction, reconstruct
from nlos_cam.render.sensor_model import SensorModel
from nlos_cam.verdict import Judge, Signs, Verdict

DOCS = Path(__file__).parents[2] / "docs"
BINS = 10
LEVELS = 0.5, 0.68, 0.8, 0.9, 0.95
FEWER = {"glossy": 0.25}
"""A lobe takes a hundred times as long to render: of these so large a share, and at draft."""
VISIBLE_CELLS = 8
"""What shows in fewer cells of the maps cannot be told from nothing."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Told:
    """What was said of one frame by itself."""

    found: Reconstruction
    verdict: Verdict | None
    shows: bool
    """Whether a surface is shown."""


class Pipeline:
    """What `live` does with maps, one frame at a time, with nothing remembered."""

    def __init__(self, rig: Rig, network: Reconstructor, doubter: Doubter) -> None:
        self.rig, self.limits = rig, limits_of(doubter)
        self._network, self._doubter = network, doubter

    def tell(self, depth_m: NDArray[np.float32], intensity: NDArray[np.float32]) -> Told:
        """What is said of maps (64, 80)."""
        maps = LidarMaps(depth_m, intensity, ~np.isnan(depth_m))
        found = reconstruct(maps, self.rig, self._network, doubter=self._doubter)
        shown, verdict = Judge(self.limits).look(found, Signs())
        return Told(found, verdict, shown.shows)


def wilson(count: int, of: int) -> dict[str, Any]:
    """A share, and its 95 % interval by Wilson's score."""
    z, share = 1.96, count / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * np.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return {"count": count, "of": of, "share": share, "low": max(0.0, middle - half), "high": min(1.0, middle + half)}


def verdicts_of(told: Sequence[Told]) -> dict[str, int]:
    """Frames by verdict."""
    counted = Counter(one.verdict for one in told)
    return {verdict.value: counted[verdict] for verdict in Verdict if counted[verdict]}


def errors_of(told: Sequence[Told], truth_m: NDArray[np.float32]) -> tuple[Array, Array]:
    """Expected and observed absolute error in metres (pixels,), where both image and truth (n, 64, 64) have surface."""
    expected, observed = list[Array](), list[Array]()
    for one, true_m in zip(told, truth_m, strict=True):
        off_m = np.abs(one.found.depth_m - true_m)
        there = ~np.isnan(off_m)
        expected.append(np.asarray(one.found.uncertainty_m, np.float64)[there])
        observed.append(off_m[there].astype(np.float64))
    return np.concatenate(expected), np.concatenate(observed)


def reliability(expected: Array, observed: Array, bins: int = BINS) -> list[dict[str, float]]:
    """Pixels in bins of as many each, by what was expected: the means of both."""
    order = np.array_split(np.argsort(expected), bins)
    return [
        {"expected_mm": 1e3 * expected[some].mean(), "observed_mm": 1e3 * observed[some].mean(), "pixels": len(some)}
        for some in order
    ]


def coverage(expected: Array, observed: Array) -> list[dict[str, float]]:
    """Of stated intervals about a depth, which holds the truth: Laplace's, whose half width is -ln(1 - level) times."""
    return [{"level": level, "observed": float((observed <= -np.log(1 - level) * expected).mean())} for level in LEVELS]


def rank_correlation(one: Array, other: Array) -> float:
    """Spearman's."""
    ranks = [np.argsort(np.argsort(values)) for values in (one, other)]
    return float(np.corrcoef(*ranks)[0, 1])


def of_objects(told: Sequence[Told], truth: NDArray[np.floating], rig: Rig) -> dict[str, Any]:
    """How doubt fares on ordinary objects: false alarms, and what uncertainty is worth."""
    truth_m = depth_from_image(np.asarray(truth, np.float32), object_box(rig))
    expected, observed = errors_of(told, truth_m)
    per_object = [errors_of([one], true_m[None]) for one, true_m in zip(told, truth_m, strict=True)]
    both = [(e.mean(), o.mean()) for e, o in per_object if e.size]
    surface, there = (
        np.concatenate([one.found.doubt.surface.ravel() for one in told if one.found.doubt]).astype(np.float64),
        (np.asarray(truth) > 0).ravel().astype(np.float64),
    )
    return {
        "verdicts": verdicts_of(told),
        "told_outside": wilson(sum(one.verdict == Verdict.OUTSIDE for one in told), len(told)),
        "told_nothing": wilson(sum(one.verdict == Verdict.NOTHING for one in told), len(told)),
        "expected_mm": 1e3 * expected.mean(),
        "observed_mm": 1e3 * observed.mean(),
        "rank_correlation_of_pixels": rank_correlation(expected, observed),
        "rank_correlation_of_objects": rank_correlation(*np.array(both).T),
        "reliability": reliability(expected, observed),
        "coverage": coverage(expected, observed),
        "surface": [
            {"expected": float(surface[some].mean()), "observed": float(there[some].mean()), "pixels": len(some)}
            for some in (np.flatnonzero((surface >= k / BINS) & (surface <= (k + 1) / BINS)) for k in range(BINS))
            if len(some)
        ],
    }


def of_outliers(told: Sequence[Told], cells: NDArray[np.int32]) -> dict[str, Any]:
    """How often a kind is told to be outside; of what can be seen, and of all."""
    seen = [one for one, shows_in in zip(told, cells, strict=True) if shows_in >= VISIBLE_CELLS]
    flagged = sum(one.verdict == Verdict.OUTSIDE for one in seen)
    return {
        "flagged": wilson(flagged, len(seen)) if seen else None,
        "believed": sum(one.verdict == Verdict.SEEN for one in told),
        "cannot_be_seen": len(told) - len(seen),
        "verdicts": verdicts_of(told),
    }


def study(pipeline: Pipeline, held_out: Path, samples: Path, count: int, empty: int, start: int) -> dict[str, Any]:
    """All of it; ordinary objects from the row `start` of the held-out maps on, which no calibration saw."""
    rig, sensor = pipeline.rig, SensorModel()
    with tracked("rendering the test objects") as on_progress:
        subjects = test_set(object_box(rig))
        maps = sense(echoes_of(subjects, rig, on_progress), rig)
    told = [pipeline.tell(one.depth_m, one.intensity) for one in maps]
    result: dict[str, Any] = {"test_objects": of_objects(told, truth_of(subjects, object_box(rig)), rig)}
    usual = dataset.open_dataset(held_out).arrays()
    told = [pipeline.tell(*pair) for pair in zip(usual.depth_m[start:], usual.intensity[start:], strict=True)]
    result["held_out_objects"] = of_objects(told, usual.image[start:], rig)
    for kind in (EMPTY, ORDINARY, *TO_LEARN, *TO_JUDGE):
        wanted = {kind: empty if kind == EMPTY else math.ceil(count * FEWER.get(kind, 1.0))}
        with tracked(f"rendering {kind}") as on_progress:
            made = samples_on_disk(
                samples,
                wanted,
                dataset.TEST_SEED,
                rig,
                sensor,
                accuracy="draft" if kind in FEWER else "standard",
                on_progress=on_progress,
            )
        told = [pipeline.tell(*pair) for pair in zip(made.depth_m, made.intensity, strict=True)]
        if kind == EMPTY:
            false = wilson(sum(one.shows for one in told), len(told))
            result["empty"] = {"false_objects": false, "verdicts": verdicts_of(told)}
        elif kind == ORDINARY:
            result["ordinary_on_slightly_other_benches"] = of_objects(told, made.image, rig)
        else:
            sort = "learnt" if kind in TO_LEARN else "never_learnt"
            result.setdefault(sort, {})[kind] = of_outliers(told, made.cells)
    return result | flagged_by_sort(result["learnt"], result["never_learnt"])


def flagged_by_sort(learnt: Mapping[str, Any], never_learnt: Mapping[str, Any]) -> dict[str, Any]:
    """How often outliers are told to be outside: of all kinds of a sort, and of what is unlike in them."""
    both = {**learnt, **never_learnt}
    sorts = {
        "learnt": learnt,
        "never_learnt": never_learnt,
        "learnt_out_of_range": {name: kind for name, kind in learnt.items() if name not in IN_SHAPE},
        "out_of_range": {name: kind for name, kind in both.items() if name not in IN_SHAPE},
        "unlike_in_shape": {name: kind for name, kind in both.items() if name in IN_SHAPE},
    }
    found = dict[str, Any]()
    for sort, kinds in sorts.items():
        flagged = [kind["flagged"] for kind in kinds.values() if kind["flagged"]]
        found[f"{sort}_flagged"] = wilson(sum(one["count"] for one in flagged), sum(one["of"] for one in flagged))
    return found


def main() -> None:
    """Judge, write, draw, print."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=None)
    parser.add_argument("--held-out", type=Path, default=Path("data/held-out"))
    parser.add_argument("--samples", type=Path, default=cache_folder() / "doubt")
    parser.add_argument("--count", type=int, default=100, help="of each kind of outlier")
    parser.add_argument("--empty", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=DOCS)
    asked = parser.parse_args()
    with errors_told():
        network = load_reconstructor(asked.weights, cache_folder() / "onnx")
        doubter = load_doubter(asked.weights, cache_folder() / "onnx")
        if doubter is None:
            raise SceneError(f"{asked.weights or shipped_folder()} has no doubt network: train one with `train doubt`")
        pipeline = Pipeline(rig_of(network.record), network, doubter)
        start = doubter.record.recipe.held_out
        result = study(pipeline, asked.held_out, asked.samples, asked.count, asked.empty, start)
    result["limits"] = {"nothing": pipeline.limits.nothing, "outside": pipeline.limits.outside}
    (asked.out / "doubt.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    draw_reliability(asked.out / "images" / "reliability.png", result)
    print(json.dumps({name: found for name, found in result.items() if name == "empty" or "flagged" in name}, indent=2))


if __name__ == "__main__":
    main()
