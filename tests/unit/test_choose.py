"""Choosing a stop: bounds are kept, the cheapest that keeps them is taken, and no test looks at a clock."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.accuracy_search import Choice, Work, _seconds, choose, least_seconds, pick, predict, some_of
from nlos_cam.render.material import Surface
from nlos_cam.render.planning import Prepared
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
SMALL = tuple(
    replace(stop, relay_columns=columns, relay_rows=8)
    for stop, columns in zip(STOPS.values(), (5, 10, 10, 10), strict=True)
)
"""The dial on a relay wall that brute force is quick with."""


def _scene(**more: object) -> Scene:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[5:9, 4:12] = 0.2 + 0.002 * np.arange(8)
    return Scene(RIG, depth, **more)  # pyright: ignore[reportArgumentType]


def _lit(scene: Scene) -> int:
    return int(Prepared.of(scene, SMALL[-1], "auto").beams.on_wall.sum())


def by_rows(fixed_s: float, each_s: float) -> Callable[[Work, int], float]:
    """A stopwatch by which work takes what its beams take, and brute force (float64) 1000 times that."""

    def stopwatch(work: Work, repeats: int) -> float:
        assert repeats >= 1
        found = work()
        return (fixed_s + each_s * len(found)) * (1000 if found.dtype == np.float64 else 1)

    return stopwatch


def _choices(*figures: tuple[str, float, float]) -> list[Choice]:
    return [Choice(replace(STOPS["standard"], name=name), error, seconds) for name, error, seconds in figures]


DIAL = _choices(("rough", 0.03, 0.005), ("middling", 0.003, 0.02), ("good", 0.0005, 0.03), ("exact", 0.0, 20.0))


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "name"),
    [
        (0.05, None, "rough"),
        (0.01, None, "middling"),
        (0.001, None, "good"),
        (0.0, None, "exact"),
        (None, 0.025, "middling"),
        (None, 100.0, "exact"),
        (0.05, 100.0, "rough"),
        (0.001, 0.03, "good"),
    ],
)
def test_the_cheapest_that_keeps_the_error_else_the_best_that_keeps_the_time(
    max_error: float | None, max_seconds: float | None, name: str
) -> None:
    assert pick(DIAL, max_error, max_seconds).accuracy.name == name


@pytest.mark.parametrize(
    ("max_error", "max_seconds", "words"),
    [
        (None, 0.001, ["max_seconds 0.001", "nearest is rough", "0.005 s are 0.004 s too long"]),
        (0.0004, 0.02, ["max_error 0.0004 and max_seconds 0.02", "nearest is good", "0.0001 too large", "0.01 s too"]),
        (0.0, 1.0, ["nearest is exact", "19 s too long"]),
        (None, 0.0, ["max_seconds 0", "nearest is rough"]),
    ],
)
def test_where_none_keeps_them_the_nearest_is_told(
    max_error: float | None, max_seconds: float | None, words: list[str]
) -> None:
    with pytest.raises(SceneError) as refusal:
        pick(DIAL, max_error, max_seconds)
    assert all(word in str(refusal.value) for word in words)
    assert "nan" not in str(refusal.value)


def test_seconds_are_those_of_all_beams() -> None:
    scene = _scene()
    found = predict(scene, "auto", "cpu", SMALL, by_rows(2.0, 0.001))
    expected = 2 + 0.001 * _lit(scene)
    np.testing.assert_allclose([c.predicted_seconds for c in found], [*[expected] * 3, 1000 * expected])


@pytest.mark.parametrize("beams", [1, 50, 200, 1000])
def test_few_beams_are_timed_as_truly(beams: int) -> None:
    scene = _scene()
    lit = np.flatnonzero(Prepared.of(scene, SMALL[1], "auto").beams.on_wall)[:beams]
    found = _seconds(scene, SMALL[1], "auto", "cpu", lit, by_rows(2.0, 0.001))
    np.testing.assert_allclose(found, 2 + 0.001 * beams)


def test_noise_of_the_clock_never_makes_more_beams_cheaper() -> None:
    scene = _scene()
    lit = np.flatnonzero(Prepared.of(scene, SMALL[1], "auto").beams.on_wall)
    assert _seconds(scene, SMALL[1], "auto", "cpu", lit, lambda work, _: 1 / len(work())) > 0


def test_colour_costs_a_rendering_for_each_channel() -> None:
    grey, albedo = _scene(), np.ones((16, 16, 3), np.float32)
    albedo[..., 0] = 0.2
    coloured = _scene(surface=Surface(albedo))
    calls = [_renderings(scene) for scene in (grey, coloured)]
    assert calls == [1, 4]


def _renderings(scene: Scene) -> int:
    """How many times a timed piece of work sums histograms."""
    from unittest.mock import patch

    from nlos_cam.render import accuracy_search as module

    work: list[Work] = []

    def keep(one: Work, repeats: int) -> float:
        work.append(one)
        return float(repeats)

    predict(scene, "auto", "cpu", SMALL, keep)
    with patch.object(module, "histograms", wraps=module.histograms) as counted:
        work[0]()
    return counted.call_count


def test_a_pulse_is_part_of_the_work() -> None:
    lengths: list[int] = []

    def watch(work: Work, repeats: int) -> float:
        lengths.append(work().shape[1])
        return float(repeats)

    predict(_scene(), "auto", "cpu", SMALL, watch)
    sharp = lengths.copy()
    predict(_scene(pulse_ns=1.0), "auto", "cpu", SMALL, watch)
    assert all(wide > narrow for wide, narrow in zip(lengths[len(sharp) :], sharp, strict=True))


def test_the_predicted_error_is_seldom_below_that_of_all_beams() -> None:
    scene = _scene()
    truth = three_bounce(scene, SMALL[-1]).max(1)
    lit = truth > 0
    for choice in predict(scene, "auto", "cpu", SMALL[1:], by_rows(1, 1)):
        found = three_bounce(scene, choice.accuracy).max(1)
        p99 = np.quantile(np.abs(found - truth)[lit] / truth[lit], 0.99)
        assert choice.predicted_error >= 0.8 * p99
        assert choice.predicted_error <= 4 * p99


def test_the_choice_keeps_what_was_asked() -> None:
    scene, watch = _scene(), by_rows(1, 0.001)
    errors = {c.accuracy.name: c.predicted_error for c in predict(scene, "auto", "cpu", SMALL, watch)}
    assert errors["reference"] == 0
    assert errors["draft"] > errors["standard"] > errors["fine"] > 0
    within = choose(scene, max_error=errors["standard"], stops=SMALL, stopwatch=by_rows(1, 0.001))
    assert within.accuracy.name in {"standard", "fine"}  # equal seconds: the better of equals
    assert choose(scene, max_error=errors["fine"] / 2, stops=SMALL, stopwatch=watch).accuracy.name == "reference"
    assert choose(scene, max_seconds=10.0, stops=SMALL, stopwatch=watch).accuracy.name == "fine"


def test_the_effects_that_are_asked_for_are_timed_and_compared() -> None:
    seen: list[float] = []

    def watch(work: Work, repeats: int) -> float:
        seen.append(float(np.abs(work()).max()))
        return float(repeats)

    found = predict(_scene(), ["direct"], "cpu", SMALL, watch)
    assert max(seen) == 0  # no third bounce was asked for
    assert all(choice.predicted_error == 0 for choice in found)
    assert choose(_scene(), 0.0, effects=["direct"], stops=SMALL, stopwatch=by_rows(1, 0)).accuracy.name != "reference"


def test_where_nothing_is_hidden_every_stop_is_exact() -> None:
    watch = by_rows(1.0, 0.0)
    assert all(c.predicted_error == 0 for c in predict(Scene(RIG), "auto", "cpu", SMALL, watch))


@pytest.mark.parametrize(
    "bounds", [{"max_error": -0.1}, {"max_error": np.nan}, {"max_seconds": np.inf}, {"max_seconds": -1.0}]
)
def test_bounds_that_are_none_are_refused(bounds: dict[str, float]) -> None:
    with pytest.raises(SceneError, match=f"{next(iter(bounds))} is .*finite"):
        choose(_scene(), **bounds)


def test_a_choice_needs_a_bound() -> None:
    with pytest.raises(SceneError, match="neither"):
        choose(_scene())


def test_a_backend_that_is_none_is_refused() -> None:
    with pytest.raises(SceneError, match="no backend 'abacus'"):
        choose(_scene(), 0.1, backend="abacus", stops=SMALL, stopwatch=by_rows(1, 1))


def test_beams_are_taken_from_all_of_the_map_once_each() -> None:
    lit = np.arange(100, 5100)
    taken = some_of(lit, 32)
    assert len(np.unique(taken)) == len(taken) == 32
    assert np.diff(taken).max() < 2 * 5000 / 32
    np.testing.assert_array_equal(some_of(lit, 32), taken)
    np.testing.assert_array_equal(some_of(lit[:7], 32), lit[:7])


def test_the_clock_does_the_work_as_often_as_told() -> None:
    done: list[Accuracy] = []

    def work() -> np.ndarray:
        done.append(STOPS["draft"])
        return np.empty(0)

    assert least_seconds(work, 3) >= 0
    assert len(done) == 3
