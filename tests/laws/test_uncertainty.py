"""Verdicts and expected errors of the shipped weights, through the whole processing of a frame."""

from collections.abc import Sequence

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import load_reconstructor, load_uncertainty_model

from nlos_cam.dataset.outliers import (
    TRAINING_OUTLIERS,
    Stimulus,
    draw_outlier,
    ordinary,
    vary_empty_bench,
)
from nlos_cam.evaluate import echoes_of, sense
from nlos_cam.files import cache_folder
from nlos_cam.frames import Frame
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import (
    Arrival,
    CalibratedRig,
    FrameResult,
    Pipeline,
    Verdict,
    frame_issues,
)
from nlos_cam.render import Sensor, SensorModel, render

pytestmark = pytest.mark.slow

RIG = load_rig("paper-rig")


@pytest.fixture(scope="module")
def processing() -> Pipeline:
    cache = cache_folder() / "onnx"
    uncertainty_model = load_uncertainty_model(None, cache)
    assert uncertainty_model is not None
    return Pipeline(
        CalibratedRig(RIG), load_reconstructor(None, cache), uncertainty_model=uncertainty_model
    )


def frames_of(stimulus: Stimulus, count: int, seed: int) -> list[Frame]:
    """Return frames of one scene with different noise."""
    sensor = Sensor(stimulus.rig, stimulus.sensor)
    echoes = render(stimulus.scene, "draft").multi
    noises = (np.random.default_rng([seed, number]) for number in range(count))
    return [sensor.expose(echoes, noise).frame(stimulus.rig.pinhole) for noise in noises]


def steps_of(processing: Pipeline, frames: Sequence[Frame]) -> list[FrameResult]:
    return [
        processing.process(Arrival(frame, 0.0, frame_issues(frame)), lambda: 0.0, 0.0)
        for frame in frames
    ]


@pytest.mark.parametrize("seed", range(10))
def test_empty_bench_never_shows_an_object(processing: Pipeline, seed: int) -> None:
    bench = vary_empty_bench(RIG, SensorModel(), np.random.default_rng([seed, 77]))
    for step in steps_of(processing, frames_of(Stimulus(*bench), 3, seed)):
        assert step.verdict == Verdict.NOTHING
        assert not step.reconstruction.has_surface


def test_known_objects_are_seen_with_honest_expected_errors(processing: Pipeline) -> None:
    subjects = benchmark_objects(object_box(RIG))[::3]
    expected = list[float]()
    observed = list[float]()
    verdicts = list[Verdict | None]()
    for subject, maps in zip(
        subjects, sense(echoes_of(subjects, RIG, lambda *_: None), RIG), strict=True
    ):
        ir = np.clip(np.round(maps.intensity), 0, 255).astype(np.uint8)
        frame = Frame(
            maps.depth_m, ir, ir, 0.0, 0, RIG.pinhole.scaled(80, 64)
        )  # of one pixel per cell
        # A fifth repeat of the same noise would be a frozen camera's.
        step = steps_of(processing, [frame] * 4)[-1]
        verdicts.append(step.verdict)
        uncertainty_m = step.reconstruction.uncertainty_m
        off_m = step.reconstruction.depth_m - subject.depth_m
        assert np.isfinite(uncertainty_m).all()
        assert uncertainty_m.min() > 0
        there = ~np.isnan(off_m)
        expected.append(float(uncertainty_m[there].mean()))
        observed.append(float(np.abs(off_m[there]).mean()))
    ranks = [np.argsort(np.argsort(values)) for values in (expected, observed)]

    assert np.corrcoef(*ranks)[0, 1] > 0.2
    assert np.mean(expected) == pytest.approx(np.mean(observed), rel=0.4)
    assert Verdict.NOTHING not in verdicts
    assert verdicts.count(Verdict.SEEN) >= 15


@pytest.mark.parametrize("name", ["plates", "other rig", "other sensor", "large"])
def test_plain_outliers_are_reported_as_unusual(processing: Pipeline, name: str) -> None:
    verdicts = list[Verdict | None]()
    for seed in range(8):
        shown = draw_outlier(
            TRAINING_OUTLIERS[name], np.random.default_rng([seed, 78]), Stimulus(RIG, SensorModel())
        )
        verdicts.append(steps_of(processing, frames_of(shown, 5, seed))[-1].verdict)

    assert verdicts.count(Verdict.OUTSIDE) + verdicts.count(Verdict.SATURATED) >= 6


def test_object_shows_in_its_first_frame_and_not_after(processing: Pipeline) -> None:
    stimulus = ordinary(np.random.default_rng(5), Stimulus(RIG, SensorModel()))
    with_it = frames_of(stimulus, 1, 0)
    without = frames_of(Stimulus(RIG, SensorModel()), 1, 0)
    shown = [
        step.reconstruction.has_surface
        for step in steps_of(processing, [*without, *with_it, *without])
    ]

    assert shown == [False, True, False]
