"""Detection of wrong reconstructions by the physics check: docs/physics_check.json and docs/images/physics_check.png.

Scores of true objects, of reconstructions by the shipped weights and by those of another object, of empty benches, and
of objects unlike the training set. The threshold is the smallest that at most 1 % of new ordinary objects reach;
`nlos_cam.physics_check.UNEXPLAINED` holds it. `--new` and `--outside` set the numbers of objects.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float32, Float64
from nlos_models import Reconstructor, load_reconstructor

from nlos_cam.cli.common import say, tracked
from nlos_cam.dataset import TEST_SEED
from nlos_cam.evaluate import seeded_objects, sense
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, depth_from_image, object_box
from nlos_cam.reconstruct import UNEXPLAINED, check_reconstruction
from nlos_cam.render import Scene, Stop, render

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
NOTHING = np.full((64, 64), np.nan, np.float32)
MAX_FLAGGED = 0.01
OTHERS = 7, 19
"""Offsets in the list of the other objects whose reconstruction is scored with an object's maps."""
OUTSIDE_ACCURACY: Stop = "draft"
"""At `standard` a glossy object takes minutes, and its score is far above the threshold either way."""
ORDINARY, TEST, WRONG, OUTSIDE = "new objects", "test objects", "another object's", "outside: "


@dataclass(frozen=True)
class Seen:
    """Maps of one frame, and their reconstruction."""

    maps: LidarMaps
    found_m: Float32


class Study:
    """Sensor and networks of the study."""

    def __init__(self, network: Reconstructor) -> None:
        self._network = network

    def see(self, scene: Scene, sensor: Any = None, accuracy: Stop = "standard") -> Seen:
        """Sense and reconstruct one frame of a scene, with its own noise."""
        maps = sense([render(scene, accuracy).multi], scene.rig, sensor)[0]
        image = self._network(maps.depth_m[np.newaxis], maps.intensity[np.newaxis])[0]
        return Seen(maps, depth_from_image(image, BOX))

    def ordinary(self, depths_m: Iterable[Float32]) -> list[Seen]:
        """Sense and reconstruct one frame of each object on the paper's rig."""
        return [self.see(Scene(RIG, depth_m)) for depth_m in depths_m]


def scores(pairs: Iterable[tuple[LidarMaps, Float32]], accuracy: Any = "standard") -> Float64:
    """Return the score of each hidden depth with its maps."""
    return np.array([check_reconstruction(maps, depth_m, RIG, accuracy=accuracy).score for maps, depth_m in pairs])


def populations(
    study: Study, new: int, outside: Mapping[str, Sequence[Any]], told: Callable[[int, int], None]
) -> dict[str, Float64]:
    """Return scores by population; `outside` are stimuli by kind."""
    found, steps = dict[str, Float64](), 7 + len(outside)

    def add(name: str, values: Float64) -> None:
        found[name] = values
        told(len(found), steps)

    truth_m = [one.depth_m for one in benchmark_objects(BOX)]
    seen = study.ordinary(truth_m)
    for stop in ("draft", "standard"):
        pairs = ((one.maps, depth_m) for one, depth_m in zip(seen, truth_m, strict=True))
        add(f"the true object, {stop}", scores(pairs, stop))
    add(TEST, scores((one.maps, one.found_m) for one in seen))
    fresh = study.ordinary(one.depth_m for one in seeded_objects(TEST_SEED, new, BOX))
    add(ORDINARY, scores((one.maps, one.found_m) for one in fresh))
    add(WRONG, scores((one.maps, seen[(k + by) % len(seen)].found_m) for k, one in enumerate(seen) for by in OTHERS))
    empty = sense([render(Scene(RIG)).multi] * len(seen), RIG)
    add("empty bench, nothing shown", scores((maps, NOTHING) for maps in empty))
    add("empty bench, an object shown", scores((maps, one.found_m) for maps, one in zip(empty, seen, strict=True)))
    for kind, sights in outside.items():
        made = [study.see(sight.scene, sight.sensor, OUTSIDE_ACCURACY) for sight in sights]
        add(f"{OUTSIDE}{kind}", scores((one.maps, one.found_m) for one in made))
    return found


def outliers(each: int) -> dict[str, list[Any]]:
    """Return the same stimuli of every kind of outlier."""
    from nlos_cam.dataset import HELD_OUT_OUTLIERS, TRAINING_OUTLIERS, Stimulus, draw_outlier
    from nlos_cam.render import SensorModel

    plain = Stimulus(RIG, SensorModel())
    kinds = {**TRAINING_OUTLIERS, **HELD_OUT_OUTLIERS}
    return {
        name: [draw_outlier(kind, np.random.default_rng([which, number]), plain) for number in range(each)]
        for which, (name, kind) in enumerate(kinds.items())
    }


def least_threshold(ordinary: Float64) -> float:
    """Return the smallest threshold, in hundredths, that at most MAX_FLAGGED of ordinary scores reach."""
    steps = np.arange(0, np.ceil(100 * ordinary.max()) + 2) / 100
    return float(steps[[(ordinary >= step).mean() <= MAX_FLAGGED for step in steps]][0])


def flagged(values: Float64, threshold: float) -> float:
    """Return the share of scores that reach a threshold."""
    return float((values >= threshold).mean())


def told_apart(ordinary: Float64, other: Float64) -> float:
    """Return the probability that the other's score is the higher (the area under the ROC curve)."""
    return float(((other[:, None] > ordinary).mean() + (other[:, None] >= ordinary).mean()) / 2)


def figures(found: Mapping[str, Float64], threshold: float) -> dict[str, Any]:
    """Return the results for JSON."""
    rows = {
        name: {
            "count": len(values),
            "median": float(np.median(values)),
            "p90": float(np.quantile(values, 0.9)),
            "most": float(values.max()),
            "flagged": flagged(values, threshold),
            "told_apart": told_apart(found[ORDINARY], values),
        }
        for name, values in found.items()
    }
    every = np.concatenate([values for name, values in found.items() if name.startswith(OUTSIDE)] or [np.zeros(0)])
    outside = {"count": len(every), "flagged": flagged(every, threshold)} if every.size else None
    return {"threshold": threshold, "exported": UNEXPLAINED, "scores": rows, "outside": outside}


def draw(found: Mapping[str, Float64], threshold: float) -> Figure:
    """Draw the distribution of scores, and detections against false alarms."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    shown = {name: values for name, values in found.items() if not name.startswith(OUTSIDE)}
    if every := [values for name, values in found.items() if name.startswith(OUTSIDE)]:
        shown["outside the trained range"] = np.concatenate(every)
    _spread(left, shown, threshold)
    _traded(right, shown)
    return figure


def _spread(axis: Axes, shown: Mapping[str, Float64], threshold: float) -> None:
    for name, values in shown.items():
        axis.step(np.sort(values), (np.arange(len(values)) + 1) / len(values), where="post", label=name)
    axis.axvline(threshold, color="0.5", linestyle=":")
    axis.set(xlabel="score", ylabel="share of frames at most so high", xlim=(0, 1.6), ylim=(0, 1))
    axis.legend(fontsize=7)


def _traded(axis: Axes, shown: Mapping[str, Float64]) -> None:
    ordinary = shown[ORDINARY]
    steps = np.sort(np.concatenate([[-np.inf, np.inf], *shown.values()]))[::-1]
    for name in (WRONG, "empty bench, an object shown", "outside the trained range"):
        if name in shown:
            axis.plot([flagged(ordinary, s) for s in steps], [flagged(shown[name], s) for s in steps], label=name)
    axis.axvline(MAX_FLAGGED, color="0.5", linestyle=":")
    axis.set(xlabel="share of new ordinary objects flagged", ylabel="share flagged", xlim=(0, 0.5), ylim=(0, 1))
    axis.legend(fontsize=7)


def main() -> None:
    """Run it."""
    parser = harness.options(__doc__)
    parser.add_argument("--new", type=int, default=300, help="new ordinary objects")
    parser.add_argument("--outside", type=int, default=20, help="outliers of each kind")
    parser.add_argument("--weights", type=Path, help="other weights than the shipped ones")
    parser.add_argument("--out", type=Path, default=harness.DOCS)
    given = parser.parse_args()
    study = Study(load_reconstructor(given.weights, cache_folder() / "onnx"))
    with tracked("scoring") as on_progress:
        found = populations(study, given.new, outliers(given.outside) if given.outside else {}, on_progress)
    threshold = least_threshold(found[ORDINARY])
    harness.write("physics_check", figures(found, threshold), given.out)
    harness.save("physics_check", draw(found, threshold), given.out)
    for name, row in figures(found, threshold)["scores"].items():
        say(f"{name:34} median {row['median']:.2f}, p90 {row['p90']:.2f}, {row['flagged']:.1%} at {threshold:.2f}")


if __name__ == "__main__":
    main()
