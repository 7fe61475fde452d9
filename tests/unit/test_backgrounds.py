"""What stands below or behind an object leaves the object as it is, and stays in the box."""

import numpy as np
import pytest
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.placement import object_depth, panel, post, with_background

BOX = object_box(load_rig("paper-rig"))
OBJECTS = [object_depth(seed, BOX)[1] for seed in range(20)]


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("seed", range(20))
def test_the_object_stays_and_what_is_added_is_in_the_box(seed: int) -> None:
    thing = OBJECTS[seed]
    depth = with_background(thing, BOX, _generator(seed))
    surface = ~np.isnan(thing)
    np.testing.assert_array_equal(depth[surface], thing[surface])
    added = depth[~surface & ~np.isnan(depth)]
    assert added.size
    assert (added >= np.nanmin(thing) - 1e-6).all()
    assert (added <= BOX.z_far_m + 1e-6).all()
    assert depth.dtype == np.float32


def test_both_kinds_come_up() -> None:
    shares = [np.isfinite(with_background(OBJECTS[0], BOX, _generator(seed))).mean() for seed in range(20)]
    assert min(shares) < np.isfinite(OBJECTS[0]).mean() + 0.1
    assert max(shares) > 0.4


@pytest.mark.parametrize("thing", OBJECTS)
def test_a_post_is_level_and_runs_from_the_underside_to_the_bottom(thing: Float32) -> None:
    below = ~np.isnan(post(thing, _generator(1)))
    surface = ~np.isnan(thing)
    for column in np.flatnonzero(below.any(axis=0)):
        lowest = np.flatnonzero(surface[:, column]).max()
        np.testing.assert_array_equal(np.flatnonzero(below[:, column]), np.arange(lowest + 1, 64))
    assert np.ptp(post(thing, _generator(1))[below]) == 0 if below.any() else surface[-1].any()


@pytest.mark.parametrize("thing", OBJECTS)
def test_a_panel_is_a_rectangle_behind_the_object(thing: Float32) -> None:
    board = panel(thing, BOX, _generator(2))
    there = ~np.isnan(board)
    rows, columns = there.any(axis=1), there.any(axis=0)
    np.testing.assert_array_equal(there, rows[:, None] & columns)
    assert 36 <= rows.sum() <= 64
    assert 36 <= columns.sum() <= 64
    assert np.ptp(board[there]) == 0
    assert board[there][0] >= np.nanmax(thing) - 1e-6
