"""Outliers: each kind is outside what training's objects are, by its own measure."""

from collections.abc import Callable

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.outliers import IN_SHAPE, LEAST_PIXELS, TO_JUDGE, TO_LEARN, Sight, ordinary, outlier
from nlos_cam.objects.depth_map import object_box
from nlos_cam.render.sensor.model import SensorModel

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
PLAIN = Sight(RIG, SensorModel())
SEEDS = range(6)


def made(name: str, seed: int) -> Sight:
    return outlier({**TO_LEARN, **TO_JUDGE}[name], np.random.default_rng(seed), PLAIN)


def depth_of(sight: Sight) -> np.ndarray:
    assert sight.depth_m is not None
    return sight.depth_m


def width_m(depth_m: np.ndarray) -> float:
    rows, columns = np.nonzero(np.isfinite(depth_m))
    return float(max(np.ptp(rows), np.ptp(columns)) + 1) * 0.25 / 64


@pytest.mark.parametrize("name", [*TO_LEARN, *TO_JUDGE])
def test_every_kind_shows_some_surface_before_the_wall_and_the_same_for_the_same_seed(name: str) -> None:
    for seed in SEEDS:
        one, again = made(name, seed), made(name, seed)
        np.testing.assert_array_equal(depth_of(one), depth_of(again))
        surface_m = depth_of(one)[np.isfinite(depth_of(one))]
        assert surface_m.size >= LEAST_PIXELS
        assert surface_m.min() > 0.0
        assert one.scene.rig == one.rig


def test_no_kind_is_both_learnt_from_and_judged_by() -> None:
    assert not set(TO_LEARN) & set(TO_JUDGE)


def test_kinds_of_both_sorts_are_learnt_from_and_judged_by() -> None:
    for kinds in (TO_LEARN, TO_JUDGE):
        assert set(kinds) & IN_SHAPE
        assert set(kinds) - IN_SHAPE
    assert {*TO_LEARN, *TO_JUDGE} > IN_SHAPE


OUTSIDE: dict[str, Callable[[Sight], bool]] = {
    "small": lambda s: width_m(depth_of(s)) < 0.5 * 0.25,
    "large": lambda s: bool(np.isfinite(depth_of(s)[[0, -1]]).any() or np.isfinite(depth_of(s)[:, [0, -1]]).any()),
    "far": lambda s: float(np.nanmin(depth_of(s))) > BOX.z_near_m + 0.119,
    "near": lambda s: float(np.nanmin(depth_of(s))) < BOX.z_near_m,
    "dim": lambda s: float(np.max(s.surface.albedo)) <= 0.4,
    "two tone": lambda s: len(np.unique(s.surface.albedo)) == 2,
    "glossy": lambda s: s.surface.brdf is not None,
    "other rig": lambda s: abs(s.rig.lidar.distance_m - RIG.lidar.distance_m) >= 0.015,
    "other sensor": lambda s: not 0.65 < s.sensor.bare_wall_counts / 48.0 < 1.6,
    "half out": lambda s: bool(np.isfinite(depth_of(s)[[0, -1]]).any() or np.isfinite(depth_of(s)[:, [0, -1]]).any()),
    "noise sheet": lambda s: float(np.nanstd(depth_of(s))) > 0.07,
}


@pytest.mark.parametrize("name", list(OUTSIDE))
def test_a_kind_is_outside_by_its_own_measure(name: str) -> None:
    assert all(OUTSIDE[name](made(name, seed)) for seed in SEEDS)


def test_an_ordinary_thing_is_none_of_this() -> None:
    for seed in SEEDS:
        sight = ordinary(np.random.default_rng(seed), PLAIN)
        assert (sight.rig, sight.sensor) == (RIG, PLAIN.sensor)
        for name in ("far", "near", "dim", "glossy", "other rig", "other sensor"):
            assert not OUTSIDE[name](sight)


def test_an_outlier_that_shows_nothing_is_made_again() -> None:
    tries = list[int]()

    def shy(generator: np.random.Generator, sight: Sight) -> Sight:
        tries.append(1)
        seen = ordinary(generator, sight)
        return sight if len(tries) < 3 else seen

    assert np.isfinite(depth_of(outlier(shy, np.random.default_rng(0), PLAIN))).any()
    assert len(tries) == 3
