"""Every category fits its box at many seeds; a seed is one object, another seed another."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.categories import CATEGORIES
from nlos_cam.objects.hidden import category_triangles, place, random_pose
from nlos_cam.objects.raster import orthographic_depth

BOX = load_rig("paper-rig").object_box
SEEDS = (0, 1, 2, 3, 10_000_000, 20_000_000, 2**31 - 1)


@pytest.mark.parametrize("category", CATEGORIES)
def test_it_fits_the_box_and_shows(category: str) -> None:
    for seed in SEEDS:
        placed = place(category_triangles(category, seed), random_pose(np.random.default_rng(seed), BOX), BOX)
        low, high = placed.reshape(-1, 3).min(0), placed.reshape(-1, 3).max(0)
        assert (low >= np.array([BOX.x_min_m, BOX.y_min_m, BOX.z_near_m]) - 1e-9).all()
        assert (high <= np.array([BOX.x_max_m, BOX.y_max_m, BOX.z_far_m]) + 1e-9).all()
        depth = orthographic_depth(placed, BOX)
        assert 100 < np.isfinite(depth).sum() < 3500


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_seed_is_one_object_and_another_seed_another(category: str) -> None:
    first = category_triangles(category, 5)
    np.testing.assert_array_equal(category_triangles(category, 5), first)
    other = category_triangles(category, 6)
    assert other.shape != first.shape or not np.allclose(other, first)


@pytest.mark.parametrize("category", CATEGORIES)
def test_its_own_units_are_about_its_own_size(category: str) -> None:
    points = category_triangles(category, 0).reshape(-1, 3)
    assert np.isfinite(points).all()
    assert 0.5 < np.ptp(points, axis=0).max() < 1.5


def test_the_order_of_categories_is_fixed() -> None:
    """A seed picks by position: sorting or inserting would change every dataset."""
    assert list(CATEGORIES) == sorted(CATEGORIES)
    assert all(make.__name__ == name for name, make in CATEGORIES.items())
