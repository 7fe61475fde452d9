from dataclasses import replace

import numpy as np
import pytest

from nlos_cam.frames import LidarMaps
from nlos_cam.reconstruct.physics_check import Expected, explanation, fitted_gain, mean_cost

SHAPE = 64, 80
GAIN = 1e5
RIGHT = np.broadcast_to(np.arange(80) >= 40, SHAPE)
WALL_M = np.broadcast_to(np.linspace(0.2, 0.6, 80), SHAPE)


def bench(echo_m: float = 0.5, strength: float = 4.0) -> Expected:
    """A wall; on the right half an object's echo, so many times as strong as the wall's own return."""
    direct = np.full(SHAPE, 3e-4)
    echo = np.where(RIGHT, strength * direct, 0.0)
    return Expected(WALL_M, direct, np.where(echo > 0, echo_m + np.zeros(SHAPE), np.nan), echo)


def seen_of(expected: Expected, *, noise_m: float = 0.0, albedo: float = 1.0, gain: float = GAIN) -> LidarMaps:
    depth_m, intensity = expected.seen(albedo, gain)
    noise = np.random.default_rng(0).normal(0, 1, SHAPE).astype(np.float32)
    return LidarMaps(depth_m + np.float32(noise_m) * noise, intensity, np.isfinite(depth_m))


def score(seen: LidarMaps, expected: Expected) -> float:
    return explanation(seen, expected, expected.bare).score


def test_what_was_expected_is_explained_and_noise_hardly_matters() -> None:
    assert score(seen_of(bench()), bench()) == pytest.approx(0.0, abs=1e-6)
    assert score(seen_of(bench(), noise_m=1e-4), bench()) < 0.1


def test_nothing_expected_explains_an_object_no_better_than_nothing() -> None:
    assert score(seen_of(bench()), bench().bare) == 1.0


def test_an_object_elsewhere_explains_less_the_farther_off_it_is() -> None:
    seen = seen_of(bench(0.5))
    scores = [score(seen, bench(0.5 + off_m)) for off_m in (0.0, 0.005, 0.01, 0.03, 0.1)]
    assert scores == sorted(scores)
    assert scores[1] < scores[2] < scores[3] < scores[4]
    assert scores[-1] > 0.9


def test_a_bare_bench_is_explained_by_nothing_and_not_by_an_object() -> None:
    seen = seen_of(bench().bare, noise_m=1e-4)
    assert score(seen, bench().bare) < 0.05
    assert score(seen, bench(strength=20.0)) > 1.0


def test_a_score_does_not_depend_on_the_gain() -> None:
    seen = seen_of(bench(0.51), noise_m=1e-4)
    dimmed = replace(seen, intensity=seen.intensity * np.float32(0.25))
    assert score(dimmed, bench()) == pytest.approx(score(seen, bench()), rel=1e-5)
    assert fitted_gain(dimmed, bench().bare) == pytest.approx(0.25 * GAIN, rel=1e-5)


def test_the_gain_is_told_by_the_wall_where_it_shows_and_else_by_all() -> None:
    seen = seen_of(bench(strength=40.0), gain=1e4)
    assert fitted_gain(seen, bench().bare) == pytest.approx(1e4, rel=1e-5)
    far = replace(seen, depth_m=seen.depth_m + np.float32(0.2))
    assert fitted_gain(far, bench().bare) > 1e4
    assert fitted_gain(replace(seen, valid=np.zeros(SHAPE, np.bool_)), bench().bare) == 1.0


@pytest.mark.parametrize("albedo", [0.75, 1.0, (4 / 3) ** 0.5])
def test_an_object_of_another_albedo_is_explained_and_its_albedo_told(albedo: float) -> None:
    best = explanation(seen_of(bench(), albedo=albedo), bench(), bench().bare)
    assert best.albedo == pytest.approx(albedo, rel=1e-6)
    assert best.score == pytest.approx(0.0, abs=1e-6)


def test_echoes_that_nearly_tie_may_swap() -> None:
    close, clear = (mean_cost(seen_of(bench().bare), bench(strength=by), GAIN, 1.0) for by in (1.1, 10.0))
    assert close < 0.05
    assert clear > 0.4


def test_a_cell_that_returns_where_it_should_not_or_the_other_way_round_is_not_explained() -> None:
    wall = bench().bare
    half = replace(wall, direct=np.where(RIGHT, 0.0, wall.direct), direct_m=np.where(RIGHT, np.nan, wall.direct_m))
    assert mean_cost(seen_of(wall), half, GAIN, 1.0) == pytest.approx(0.5, abs=1e-3)
    assert mean_cost(seen_of(half), wall, GAIN, 1.0) == pytest.approx(0.5, abs=1e-3)
    assert mean_cost(seen_of(half), half, GAIN, 1.0) == pytest.approx(0.0, abs=1e-6)


def test_maps_without_a_return_on_a_bench_without_one_are_explained() -> None:
    nothing = Expected(np.full(SHAPE, np.nan), np.zeros(SHAPE), np.full(SHAPE, np.nan), np.zeros(SHAPE))
    assert score(seen_of(nothing), nothing) == 0.0
    assert score(seen_of(nothing), bench()) == pytest.approx(1.0)


def test_full_scale_may_hide_more_light_but_not_less() -> None:
    bright = seen_of(bench(strength=1000.0))
    assert bright.intensity.max() == 255
    assert mean_cost(bright, bench(strength=1000.0), GAIN, 1.0) == pytest.approx(0.0, abs=1e-6)
    dim = mean_cost(bright, bench(strength=1.5), GAIN, 1.0)
    assert dim > 0.1
