"""Laws of the 54 objects that judge: always the same, out of training's reach, spread evenly."""

from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.benchmark import FixedObject, benchmark_objects
from nlos_cam.objects.depth_map import object_box
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import Pose

BOX = object_box(load_rig("paper-rig"))
OBJECTS = benchmark_objects(BOX)


def test_there_are_three_of_each_category_each_with_its_name() -> None:
    assert len(OBJECTS) == len({thing.name for thing in OBJECTS}) == 54
    assert [(thing.category, thing.number) for thing in OBJECTS] == [(c, k) for c in CATEGORIES for k in (1, 2, 3)]
    assert OBJECTS[0].name == "airplane-1"


def test_they_are_the_same_bits_each_time() -> None:
    again = benchmark_objects(BOX)
    assert again == OBJECTS
    for thing, same in zip(OBJECTS, again, strict=True):
        assert thing.depth_m.tobytes() == same.depth_m.tobytes()
        assert thing.triangles.tobytes() == same.triangles.tobytes()


@pytest.mark.parametrize("thing", OBJECTS, ids=lambda thing: thing.name)
def test_its_held_out_settings_are_where_no_seed_reaches(thing: FixedObject) -> None:
    """`test_settings` shows that no number a seed may give lands in there."""
    kind = CATEGORIES[thing.category]
    assert list(thing.settings) == list(kind.settings)
    for name, setting in kind.settings.items():
        if setting.held_out:
            assert setting.held_out[0] < thing.settings[name] < setting.held_out[1]
        else:
            assert setting.low < thing.settings[name] < setting.high


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_three_of_a_category_share_no_setting(category: str) -> None:
    three = [thing.settings for thing in OBJECTS if thing.category == category]
    for name in three[0]:
        low, middle, high = sorted(settings[name] for settings in three)
        assert high - middle == pytest.approx(middle - low)
        assert high > low


def test_it_is_whole_inside_the_box_and_shows() -> None:
    for thing in OBJECTS:
        low, high = thing.triangles.reshape(-1, 3).min(0), thing.triangles.reshape(-1, 3).max(0)
        assert (low >= np.array([BOX.x_min_m, BOX.y_min_m, BOX.z_near_m]) - 1e-9).all()
        assert (high <= np.array([BOX.x_max_m, BOX.y_max_m, BOX.z_far_m]) + 1e-9).all()
        assert thing.depth_m.shape == (64, 64)
        assert thing.depth_m.dtype == np.float32
        assert 0.03 < np.isfinite(thing.depth_m).mean() < 0.6


def test_each_quantity_of_the_poses_is_spread_evenly_over_trainings_range() -> None:
    spare = {thing.name: (0.25 - thing.pose.size_m) / 2 for thing in OBJECTS}
    spans = {
        "size_m": (0.25 * 0.55, 0.25 * 0.9, [o.pose.size_m for o in OBJECTS]),
        "tilt_x_rad": (*np.radians([-15, 15]), [o.pose.tilt_x_rad for o in OBJECTS]),
        "tilt_y_rad": (*np.radians([-20, 20]), [o.pose.tilt_y_rad for o in OBJECTS]),
        "turn_z_rad": (*np.radians([-35, 35]), [o.pose.turn_z_rad for o in OBJECTS]),
        "x_m": (-1, 1, [o.pose.x_m / spare[o.name] for o in OBJECTS]),
        "y_m": (-1, 1, [o.pose.y_m / spare[o.name] for o in OBJECTS]),
        "front_m": (0, 0.35 * 0.28, [o.pose.front_m for o in OBJECTS]),
    }
    assert set(spans) == set(Pose.__dataclass_fields__)
    for low, high, values in spans.values():
        even = low + (high - low) * (np.arange(54) + 0.5) / 54
        np.testing.assert_allclose(np.sort(values), even, atol=1e-9)


def test_no_two_quantities_of_the_poses_go_together() -> None:
    names = tuple(Pose.__dataclass_fields__)
    table = np.array([[getattr(thing.pose, name) for name in names] for thing in OBJECTS])
    table = np.column_stack([np.arange(54), table])
    assert np.abs(np.corrcoef(table.T) - np.eye(8)).max() < 0.25


def test_neighbours_of_a_category_are_not_the_same_picture() -> None:
    for thing, following in pairwise(OBJECTS):
        assert not np.array_equal(thing.depth_m, following.depth_m, equal_nan=True)
