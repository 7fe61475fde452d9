"""Calibration of the uncertainty network: docs/figures/doubt.json and docs/images/reliability.png.

Expected against observed error on the 54 test objects and on held-out ones; objects shown on empty
benches; detection of outliers, of kinds in the training set and of others. `--weights DIR` names
other weights than the shipped ones, `--count N` and `--empty N` set the samples of each kind,
`--samples DIR` is the folder of the rendered samples.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import Rig
from nlos_calibration.arrays import Float64
from nlos_models import (
    Reconstructor,
    UncertaintyModel,
    load_reconstructor,
    load_uncertainty_model,
    weights_folder,
)
from numpy.typing import NDArray

from nlos_cam.cli.common import tracked
from nlos_cam.dataset import (
    EMPTY,
    GENERIC,
    HELD_OUT_OUTLIERS,
    ORDINARY,
    SEEDS_PER_BENCH,
    SHAPE_OUTLIERS,
    TEST_SEED,
    TRAINING_OUTLIERS,
    Benches,
    open_dataset,
    samples_on_disk,
)
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import echoes_of, rig_of, sense, spearman, truth_of
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, depth_from_image, object_box
from nlos_cam.reconstruct import (
    FrameConditions,
    Reconstruction,
    Verdict,
    VerdictFilter,
    reconstruct,
    verdict_limits,
)
from nlos_cam.render import SensorModel

BINS = 10
LEVELS = 0.5, 0.68, 0.8, 0.9, 0.95
FEWER = {"glossy": 0.25}
"""Share of samples for kinds that take longest to render; they are rendered at draft."""
VISIBLE_CELLS = 8
"""Smallest number of map cells in which an object can be detected."""


@dataclass(frozen=True)
class Answer:
    """Reconstruction and verdict of a single frame."""

    found: Reconstruction
    verdict: Verdict | None
    shows: bool


class Pipeline:
    """Pipeline of `live` for single frames, without a memory."""

    def __init__(
        self, rig: Rig, network: Reconstructor, uncertainty_model: UncertaintyModel
    ) -> None:
        self.rig = rig
        self.limits = verdict_limits(uncertainty_model)
        self.learnt = uncertainty_model.record.learnt
        self._network = network
        self._uncertainty_model = uncertainty_model

    def answer(self, depth_m: NDArray[np.float32], intensity: NDArray[np.float32]) -> Answer:
        """Return the answer to maps (64, 80)."""
        maps = LidarMaps(depth_m, intensity, ~np.isnan(depth_m))
        found = reconstruct(
            maps, self.rig, self._network, uncertainty_model=self._uncertainty_model
        )
        shown, verdict = VerdictFilter(self.limits).decide(found, FrameConditions())
        return Answer(found, verdict, shown.has_surface)


def verdicts_of(answers: Sequence[Answer]) -> dict[str, int]:
    """Count frames by verdict."""
    counted = Counter(one.verdict for one in answers)
    return {verdict.value: counted[verdict] for verdict in Verdict if counted[verdict]}


def errors_of(answers: Sequence[Answer], truth_m: NDArray[np.float32]) -> tuple[Float64, Float64]:
    """Return expected and observed absolute error in metres (pixels,), where image and truth have
    surface.
    """
    expected = list[Float64]()
    observed = list[Float64]()
    for one, true_m in zip(answers, truth_m, strict=True):
        off_m = np.abs(one.found.depth_m - true_m)
        there = ~np.isnan(off_m)
        expected.append(np.asarray(one.found.uncertainty_m, np.float64)[there])
        observed.append(off_m[there].astype(np.float64))
    return np.concatenate(expected), np.concatenate(observed)


def reliability(expected: Float64, observed: Float64, bins: int = BINS) -> list[dict[str, float]]:
    """Return the means of both in bins of equal size, by expected error."""
    order = np.array_split(np.argsort(expected), bins)
    return [
        {
            "expected_mm": 1e3 * expected[some].mean(),
            "observed_mm": 1e3 * observed[some].mean(),
            "pixels": len(some),
        }
        for some in order
    ]


def coverage(expected: Float64, observed: Float64) -> list[dict[str, float]]:
    """Return the coverage of stated intervals; a Laplace interval has the half width -ln(1 - level)
    times the error.
    """
    return [
        {"level": level, "observed": float((observed <= -np.log(1 - level) * expected).mean())}
        for level in LEVELS
    ]


def of_objects(answers: Sequence[Answer], truth: NDArray[np.floating], rig: Rig) -> dict[str, Any]:
    """Summarize ordinary objects: false alarms, and quality of the uncertainty."""
    truth_m = depth_from_image(np.asarray(truth, np.float32), object_box(rig))
    expected, observed = errors_of(answers, truth_m)
    per_object = [
        errors_of([one], true_m[None]) for one, true_m in zip(answers, truth_m, strict=True)
    ]
    both = [(e.mean(), o.mean()) for e, o in per_object if e.size]
    surface = np.concatenate(
        [one.found.uncertainty.p_surface.ravel() for one in answers if one.found.uncertainty]
    ).astype(np.float64)
    there = (np.asarray(truth) > 0).ravel().astype(np.float64)
    return {
        "verdicts": verdicts_of(answers),
        "told_outside": harness.wilson(
            sum(one.verdict == Verdict.OUTSIDE for one in answers), len(answers)
        ),
        "told_nothing": harness.wilson(
            sum(one.verdict == Verdict.NOTHING for one in answers), len(answers)
        ),
        "expected_mm": 1e3 * expected.mean(),
        "observed_mm": 1e3 * observed.mean(),
        "rank_correlation_of_pixels": spearman(expected, observed),
        "rank_correlation_of_objects": spearman(*np.array(both).T),
        "reliability": reliability(expected, observed),
        "coverage": coverage(expected, observed),
        "surface": [
            {
                "expected": float(surface[some].mean()),
                "observed": float(there[some].mean()),
                "pixels": len(some),
            }
            for some in (
                np.flatnonzero((surface >= k / BINS) & (surface <= (k + 1) / BINS))
                for k in range(BINS)
            )
            if len(some)
        ],
    }


def of_outliers(answers: Sequence[Answer], cells: NDArray[np.int32]) -> dict[str, Any]:
    """Count the outliers of a kind that are flagged, of those that can be detected and of all."""
    seen = [one for one, shows_in in zip(answers, cells, strict=True) if shows_in >= VISIBLE_CELLS]
    flagged = sum(one.verdict == Verdict.OUTSIDE for one in seen)
    return {
        "flagged": harness.wilson(flagged, len(seen)) if seen else None,
        "believed": sum(one.verdict == Verdict.SEEN for one in answers),
        "cannot_be_seen": len(answers) - len(seen),
        "verdicts": verdicts_of(answers),
    }


def study(
    pipeline: Pipeline, held_out: Path, samples: Path, count: int, empty: int, start: int
) -> dict[str, Any]:
    """Run the study; rows of the held-out maps before `start` were used in calibration and are
    skipped.
    """
    rig = pipeline.rig
    sensor = SensorModel()
    with tracked("rendering the test objects") as on_progress:
        subjects = benchmark_objects(object_box(rig))
        maps = sense(echoes_of(subjects, rig, on_progress), rig)
    answers = [pipeline.answer(one.depth_m, one.intensity) for one in maps]
    result: dict[str, Any] = {
        "test_objects": of_objects(answers, truth_of(subjects, object_box(rig)), rig)
    }
    usual = open_dataset(held_out).arrays()
    answers = [
        pipeline.answer(*pair)
        for pair in zip(usual.depth_m[start:], usual.intensity[start:], strict=True)
    ]
    result["held_out_objects"] = of_objects(answers, usual.image[start:], rig)
    for kind in (EMPTY, ORDINARY, GENERIC, *TRAINING_OUTLIERS, *HELD_OUT_OUTLIERS):
        wanted = {kind: empty if kind == EMPTY else math.ceil(count * FEWER.get(kind, 1.0))}
        with tracked(f"rendering {kind}") as on_progress:
            made = samples_on_disk(
                samples,
                wanted,
                TEST_SEED,
                Benches(rig, sensor, accuracy="draft" if kind in FEWER else "standard"),
                on_progress=on_progress,
            )
        answers = [
            pipeline.answer(*pair) for pair in zip(made.depth_m, made.intensity, strict=True)
        ]
        if kind == EMPTY:
            shown = [one.shows for one in answers]
            # frames of one bench differ by their noise alone: an interval is one of benches
            starts = range(0, len(shown), SEEDS_PER_BENCH)
            benches = [any(shown[start : start + SEEDS_PER_BENCH]) for start in starts]
            result["empty"] = {
                "false_objects": harness.wilson(sum(shown), len(shown)),
                "benches_with_false_objects": harness.wilson(sum(benches), len(benches)),
                "verdicts": verdicts_of(answers),
            }
        elif kind in {ORDINARY, GENERIC}:
            result[f"{kind}_on_slightly_other_benches"] = of_objects(answers, made.image, rig)
        else:
            sort = "learnt" if kind in pipeline.learnt else "never_learnt"
            result.setdefault(sort, {})[kind] = of_outliers(answers, made.cells)
    return result | flagged_by_sort(result["learnt"], result["never_learnt"])


def flagged_by_sort(learnt: Mapping[str, Any], never_learnt: Mapping[str, Any]) -> dict[str, Any]:
    """Count flagged outliers by sort of kind, and by whether shape or range is unusual."""
    both = {**learnt, **never_learnt}
    sorts = {
        "learnt": learnt,
        "never_learnt": never_learnt,
        "learnt_out_of_range": {
            name: kind for name, kind in learnt.items() if name not in SHAPE_OUTLIERS
        },
        "out_of_range": {name: kind for name, kind in both.items() if name not in SHAPE_OUTLIERS},
        "unlike_in_shape": {name: kind for name, kind in both.items() if name in SHAPE_OUTLIERS},
    }
    found = dict[str, Any]()
    for sort, kinds in sorts.items():
        flagged = [kind["flagged"] for kind in kinds.values() if kind["flagged"]]
        found[f"{sort}_flagged"] = harness.wilson(
            sum(one["count"] for one in flagged), sum(one["of"] for one in flagged)
        )
    return found


SETS = {"test_objects": "54 test objects", "held_out_objects": "held-out objects"}


def draw(result: dict[str, Any]) -> Figure:
    """Draw expected against observed error, coverage, and share of surface."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    errors, covers, surfaces = figure.subplots(1, 3)
    for name, label in SETS.items():
        rows = result[name]
        errors.plot(*_columns(rows["reliability"], "expected_mm", "observed_mm"), "o-", label=label)
        covers.plot(*_columns(rows["coverage"], "level", "observed"), "o-", label=label)
        surfaces.plot(*_columns(rows["surface"], "expected", "observed"), "o-", label=label)
    titles = (
        (errors, "expected error (mm)", "observed error (mm)"),
        (covers, "stated coverage of an interval", "observed coverage"),
        (surfaces, "stated probability of a surface", "observed share"),
    )
    for axes, x, y in titles:
        most = max(axes.get_xlim()[1], axes.get_ylim()[1]) if axes is errors else 1.0
        axes.plot([0, most], [0, most], "k:", label="perfect")
        axes.set(xlabel=x, ylabel=y, xlim=(0, most), ylim=(0, most))
        axes.legend()
    return figure


def _columns(rows: list[dict[str, float]], *names: str) -> list[list[float]]:
    return [[row[name] for row in rows] for name in names]


def main() -> None:
    """Judge, write, draw, print."""
    parser = harness.options(__doc__)
    parser.add_argument("--weights", type=Path, default=None)
    parser.add_argument("--held-out", type=Path, default=Path("data/held-out"))
    parser.add_argument("--samples", type=Path, default=cache_folder() / "doubt")
    parser.add_argument("--count", type=int, default=100, help="of each kind of outlier")
    parser.add_argument("--empty", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=harness.DOCS)
    asked = parser.parse_args()
    with harness.one_line_errors():
        network = load_reconstructor(asked.weights, cache_folder() / "onnx")
        uncertainty_model = load_uncertainty_model(asked.weights, cache_folder() / "onnx")
        if uncertainty_model is None:
            raise SceneError(
                f"{weights_folder(asked.weights)} has no uncertainty network: train one with `train"
                " doubt`"
            )
        pipeline = Pipeline(rig_of(network.record), network, uncertainty_model)
        start = uncertainty_model.record.recipe.held_out
        result = study(pipeline, asked.held_out, asked.samples, asked.count, asked.empty, start)
    result["limits"] = {"nothing": pipeline.limits.nothing, "outside": pipeline.limits.outside}
    harness.write("doubt", result, asked.out)
    harness.save("reliability", draw(result), asked.out, dpi=110)
    print(
        json.dumps(
            {name: found for name, found in result.items() if name == "empty" or "flagged" in name},
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
