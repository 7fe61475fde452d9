from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from depth_maps import depth_map
from nlos_calibration import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render import (
    STOPS,
    EchoMaps,
    Scene,
    Surface,
    Work,
    agreement,
    choose,
    costs,
    least_seconds,
    prepare,
)
from nlos_cam.render.accuracy_search import (
    AccuracyChoice,
    beam_histograms,
    pick,
    predict,
    relative_error,
)
from nlos_cam.render.renderer import render, three_bounce

RIG = load_rig("paper-rig")
SMALL = tuple(
    replace(stop, relay_columns=columns, relay_rows=8)
    for stop, columns in zip(STOPS.values(), (5, 10, 10, 10), strict=True)
)
"""The stops on a small relay wall."""


def _scene(**more: object) -> Scene:
    depth = depth_map(16, np.nan, (np.s_[5:9, 4:12], 0.2 + 0.002 * np.arange(8)))
    return Scene(RIG, depth, **more)  # pyright: ignore[reportArgumentType]


def by_rows(fixed_s: float, each_s: float) -> Callable[[Work, int], float]:
    """Stopwatch with a fixed cost and a cost per beam; brute force (float64) takes 1000 times as
    long.
    """

    def stopwatch(work: Work, repeats: int) -> float:
        assert repeats >= 1
        found = work()
        return (fixed_s + each_s * len(found)) * (1000 if found.dtype == np.float64 else 1)

    return stopwatch


FIGURES = (
    ("rough", 0.03, 0.005),
    ("middling", 0.003, 0.02),
    ("good", 0.0005, 0.03),
    ("exact", 0.0, 20.0),
)
DIAL = [
    AccuracyChoice(replace(STOPS["standard"], name=name), *figures) for name, *figures in FIGURES
]


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "name"),
    [
        *[
            (0.05, None, "rough"),
            (0.01, None, "middling"),
            (0.001, None, "good"),
            (0.0, None, "exact"),
        ],
        *[
            (None, 0.025, "middling"),
            (None, 100.0, "exact"),
            (0.05, 100.0, "rough"),
            (0.001, 0.03, "good"),
        ],
    ],
)
def test_pick_takes_cheapest_stop_within_bounds(
    max_error: float | None, max_seconds: float | None, name: str
) -> None:
    assert pick(DIAL, max_error, max_seconds).accuracy.name == name


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "words"),
    [
        (None, 0.001, ["0.001", "rough", "0.004 s"]),
        (0.0004, 0.02, ["0.0004", "0.02", "good", "0.0001", "0.01 s"]),
        (0.0, 1.0, ["exact", "19 s"]),
        (None, 0.0, ["rough"]),
    ],
)
def test_pick_out_of_bounds_names_nearest(
    max_error: float | None, max_seconds: float | None, words: list[str]
) -> None:
    with pytest.raises(SceneError) as refusal:
        pick(DIAL, max_error, max_seconds)
    assert all(word in str(refusal.value) for word in words)
    assert "nan" not in str(refusal.value)


def test_predict_scales_seconds_to_all_beams() -> None:
    scene = _scene()
    found = predict(scene, "auto", "cpu", SMALL, by_rows(2.0, 0.001))
    expected = 2 + 0.001 * prepare(scene, SMALL[-1], "auto").beams.on_wall.sum()
    np.testing.assert_allclose(
        [c.predicted_seconds for c in found], [*[expected] * 3, 1000 * expected]
    )
    assert all(
        c.predicted_error == 0 for c in predict(Scene(RIG), "auto", "cpu", SMALL, by_rows(1.0, 0.0))
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("albedo", "renderings"), [(np.ones(3), 1), (np.array([0.2, 1.0, 1.0]), 4)]
)
def test_predict_times_each_color_channel(
    albedo: np.ndarray, renderings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Mock(return_value=1.0)
    counted = Mock(wraps=beam_histograms)
    predict(_scene(surface=Surface(albedo)), "auto", "cpu", SMALL, watch)
    monkeypatch.setattr("nlos_cam.render.accuracy_search.beam_histograms", counted)
    watch.call_args_list[0].args[0]()
    assert counted.call_count == renderings


def test_predict_times_the_pulse_and_only_the_named_effects() -> None:
    found: list[np.ndarray] = []
    for scene, effects in (
        (_scene(), "auto"),
        (_scene(pulse_ns=1.0), "auto"),
        (_scene(), ["direct"]),
    ):
        choices = predict(scene, effects, "cpu", SMALL, lambda work, _: found.append(work()) or 1.0)
    sharp, wide, direct = (found[k * len(found) // 3 : (k + 1) * len(found) // 3] for k in range(3))
    assert all(one.shape[1] < other.shape[1] for one, other in zip(sharp, wide, strict=True))
    assert not any(histogram.any() for histogram in direct)  # no third bounce is rendered
    assert all(choice.predicted_error == 0 for choice in choices)
    assert (
        choose(
            _scene(), 0.0, effects=["direct"], stops=SMALL, stopwatch=by_rows(1, 0)
        ).accuracy.name
        != "reference"
    )


def test_predicted_error_is_near_that_of_all_beams() -> None:
    scene = _scene()
    truth = three_bounce(scene, SMALL[-1]).max(1)
    lit = truth > 0
    for choice in predict(scene, "auto", "cpu", SMALL[1:], by_rows(1, 1)):
        found = three_bounce(scene, choice.accuracy).max(1)
        p99 = np.quantile(np.abs(found - truth)[lit] / truth[lit], 0.99)
        assert choice.predicted_error >= 0.8 * p99
        assert choice.predicted_error <= 4 * p99


@pytest.mark.slow
def test_choose_keeps_the_bounds() -> None:
    scene = _scene()
    watch = by_rows(1, 0.001)
    errors = {
        c.accuracy.name: c.predicted_error for c in predict(scene, "auto", "cpu", SMALL, watch)
    }
    assert errors["reference"] == 0
    assert errors["draft"] > errors["standard"] > errors["fine"] > 0
    within = choose(scene, max_error=errors["standard"], stops=SMALL, stopwatch=by_rows(1, 0.001))
    assert within.accuracy.name in {"standard", "fine"}  # equal seconds: the better of equals
    assert (
        choose(scene, max_error=errors["fine"] / 2, stops=SMALL, stopwatch=watch).accuracy.name
        == "reference"
    )
    assert choose(scene, max_seconds=10.0, stops=SMALL, stopwatch=watch).accuracy.name == "fine"


@pytest.mark.parametrize(
    ("options", "word"),
    [
        *[({"max_error": value}, "max_error") for value in (-0.1, np.nan)],
        *[({"max_seconds": value}, "max_seconds") for value in (-1.0, np.inf)],
        ({}, "max_error"),
        ({"max_error": 0.1, "backend": "abacus"}, "abacus"),
    ],
)
def test_choose_refuses_bad_or_missing_bounds_and_backends(
    options: dict[str, Any], word: str
) -> None:
    with pytest.raises(SceneError, match=word):
        choose(_scene(), stops=SMALL, stopwatch=by_rows(1, 1), **options)


def test_least_seconds_repeats_the_work() -> None:
    assert least_seconds(work := Mock(), 3) >= 0
    assert work.call_count == 3


BIN_M = 0.01


def test_agreement_measures_intensity_bins_depth_and_lost_echoes() -> None:
    generator = np.random.default_rng(1)
    path = (generator.integers(40, 200, 100) + 0.5) * BIN_M
    truth = EchoMaps(generator.uniform(1, 2, 100), path, path / 2)
    same = agreement(truth, truth, BIN_M)
    nothing = replace(truth, depth_m=np.full(100, np.nan))
    assert (same.bin_exact, same.bin_within_1) == (1.0, 1.0)
    assert max(same.intensity_error_max, same.depth_error_mm, same.depth_error_mean_mm) == 0
    assert agreement(nothing, truth, BIN_M).depth_error_mm == 0
    off = np.linspace(0, 0.1, 100)
    step = np.zeros(100)
    found = agreement(replace(truth, intensity=truth.intensity * (1 + off)), truth, BIN_M)
    errors = (found.intensity_error_median, found.intensity_error_p99, found.intensity_error_max)
    np.testing.assert_allclose(errors, (np.median(off), np.quantile(off, 0.99), 0.1))
    step[:20] = 2 * BIN_M
    step[20:50] = -BIN_M
    found = agreement(
        replace(truth, path_m=truth.path_m + step, depth_m=truth.depth_m + step), truth, BIN_M
    )
    np.testing.assert_allclose((found.bin_exact, found.bin_within_1), (0.5, 0.8))
    np.testing.assert_allclose(found.depth_error_mean_mm, 0.2 * 20 + 0.3 * 10)
    lost = truth.path_m.copy()
    lost[:10] = np.nan
    assert agreement(replace(truth, path_m=lost), truth, BIN_M).bin_within_1 == pytest.approx(0.9)
    both = replace(truth, path_m=lost)
    assert agreement(both, both, BIN_M).bin_exact == 1
    np.testing.assert_array_equal(
        relative_error(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 2.0])), [0, 1, 1]
    )


def test_echoes_of_cells_are_those_of_beams_that_win() -> None:
    scene = _scene()
    rendering = render(scene, "draft")
    cells = EchoMaps.of_cells(rendering, scene)
    beams = EchoMaps.of_beams(rendering)
    wins = cells.intensity == beams.intensity
    assert wins.sum() > 500
    np.testing.assert_allclose(cells.path_m[wins], beams.path_m[wins], rtol=1e-5)


PRICES = {"direct": 0.5, "three-bounce": 8.0, "self-occlusion": 4.0, "tilt": 1.0, "occluder": 2.0}


def test_costs_are_the_seconds_that_each_effect_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = _scene()
    plan = render(scene).plan
    now = [0.0]

    def priced(_scene: Scene, _accuracy: str, effects: list[str], _backend: str) -> None:
        now[0] += sum(PRICES[name] for name in effects)

    monkeypatch.setattr("nlos_cam.render.accuracy_search.render", priced)
    found = costs(scene, "standard", plan, clock=lambda: now[0])
    assert list(found) == [effect.name for effect in plan]
    for effect in plan:
        assert found[effect.name] == pytest.approx(PRICES[effect.name] if effect.included else 0.0)
    assert sum(effect.included for effect in plan) >= 4
