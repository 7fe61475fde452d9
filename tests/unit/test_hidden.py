"""Placing objects in the box, and which objects a seed means."""

import numpy as np
import pytest
from nlos_calibration.rig import ObjectBox, load_rig

from nlos_cam.dataset.build import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED
from nlos_cam.errors import SceneError
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import (
    POSE_UNITS,
    Pose,
    category_triangles,
    fit,
    object_depth,
    object_depths,
    place,
    pose_from,
    random_pose,
)

BOX = load_rig("paper-rig").object_box
CUP = category_triangles("cup", 0)


def _points(pose: Pose, box: ObjectBox = BOX) -> np.ndarray:
    return place(CUP, pose, box).reshape(-1, 3)


def test_size_offset_and_front_are_what_the_pose_says() -> None:
    points = _points(Pose(turn_z_rad=0.4, tilt_x_rad=0.2, size_m=0.15, x_m=0.02, y_m=-0.03, front_m=0.04))
    assert np.ptp(points[:, :2], axis=0).max() == pytest.approx(0.15)
    middle = (points.min(0) + points.max(0)) / 2
    np.testing.assert_allclose(middle[:2], [0.45 + 0.02, -0.03], atol=1e-12)
    assert points[:, 2].min() == pytest.approx(BOX.z_near_m + 0.04)


def test_a_turn_about_z_turns_the_silhouette_counter_clockwise_seen_with_x_right_and_y_up() -> None:
    straight, turned = _points(Pose()), _points(Pose(turn_z_rad=np.pi / 2))
    straight, turned = straight - straight.mean(0), turned - turned.mean(0)
    scale = np.ptp(turned[:, :2], axis=0).max() / np.ptp(straight[:, :2], axis=0).max()
    np.testing.assert_allclose(turned[:, 0], -scale * straight[:, 1], atol=1e-9)
    np.testing.assert_allclose(turned[:, 1], scale * straight[:, 0], atol=1e-9)


def test_a_thing_deeper_than_the_box_is_flattened_and_keeps_its_silhouette() -> None:
    shallow = BOX.model_copy(update={"z_far_m": BOX.z_near_m + 0.06})
    deep, flat = _points(Pose()), _points(Pose(), shallow)
    assert flat[:, 2].max() == pytest.approx(shallow.z_far_m)
    np.testing.assert_allclose(flat[:, :2], deep[:, :2])


def test_a_fit_tells_what_placing_does() -> None:
    inside, beside = fit(CUP, Pose(size_m=0.2), BOX), fit(CUP, Pose(size_m=0.2, x_m=0.25), BOX)
    assert inside.outside == 0
    assert beside.outside == 1
    assert inside.depth_m == pytest.approx(np.ptp(_points(Pose(size_m=0.2))[:, 2]))
    assert inside.room_m == pytest.approx(BOX.z_far_m - BOX.z_near_m - Pose().front_m)
    shallow = BOX.model_copy(update={"z_far_m": BOX.z_near_m + 0.06})
    flattened = fit(CUP, Pose(size_m=0.2), shallow)
    assert flattened.depth_m == inside.depth_m > flattened.room_m == pytest.approx(0.03)


@pytest.mark.parametrize("front_m", [0.3, 1.0])
def test_no_room_behind_the_front_is_refused_not_turned_inside_out(front_m: float) -> None:
    with pytest.raises(SceneError, match="front_m"):
        place(CUP, Pose(front_m=front_m), BOX)


def test_a_random_pose_is_decided_by_its_generator() -> None:
    first, again, other = (random_pose(np.random.default_rng(s), BOX) for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_an_unknown_category_is_named_beside_the_known() -> None:
    with pytest.raises(SceneError, match=r"'teapot'.*airplane.*tower"):
        category_triangles("teapot", 0)


def test_the_seed_decides_all() -> None:
    category, depth = object_depth(17, BOX)
    again, same = object_depth(17, BOX)
    assert again == category
    np.testing.assert_array_equal(same, depth)


def test_many_objects_come_in_the_order_of_their_seeds() -> None:
    for seed, depth in zip((9, 3, 7), object_depths((9, 3, 7), BOX), strict=True):
        np.testing.assert_array_equal(depth, object_depth(seed, BOX)[1])


def test_training_held_out_and_test_objects_are_different_objects() -> None:
    groups = [
        {object_depth(first + k, BOX)[1].tobytes() for k in range(25)}
        for first in (TRAINING_SEED, HELD_OUT_SEED, TEST_SEED)
    ]
    assert [len(group) for group in groups] == [25, 25, 25]
    assert len(set.union(*groups)) == 75


def test_every_category_comes_up() -> None:
    assert {object_depth(seed, BOX)[0] for seed in range(250)} == set(CATEGORIES)


def test_a_choice_of_categories_is_kept_to() -> None:
    assert {object_depth(seed, BOX, ("cup", "hat"))[0] for seed in range(12)} == {"cup", "hat"}
    for seed, depth in zip((5, 6), object_depths((5, 6), BOX, ["boat"]), strict=True):
        np.testing.assert_array_equal(depth, object_depth(seed, BOX, ["boat"])[1])


def test_all_categories_and_no_choice_are_the_same() -> None:
    for seed in range(5):
        np.testing.assert_array_equal(object_depth(seed, BOX, tuple(CATEGORIES))[1], object_depth(seed, BOX)[1])


def test_no_category_and_an_unknown_one_are_refused() -> None:
    with pytest.raises(SceneError, match="no object category is left"):
        object_depth(0, BOX, ())
    with pytest.raises(SceneError, match="'teapot'"):
        object_depth(0, BOX, ("cup", "teapot"))


def test_a_share_of_backgrounds_is_a_share_and_leaves_the_objects_as_they_are() -> None:
    """The more, the more: each has its own from some share on, and keeps it."""
    seeds = range(40)
    alone, some, each = (list(object_depths(seeds, BOX, backgrounds=share)) for share in (0.0, 0.3, 1.0))
    has = [not np.array_equal(a, s, equal_nan=True) for a, s in zip(alone, some, strict=True)]
    assert 4 <= sum(has) <= 20
    for thing, with_some, with_each, seed_has in zip(alone, some, each, has, strict=True):
        surface = ~np.isnan(thing)
        np.testing.assert_array_equal(with_each[surface], thing[surface])
        np.testing.assert_array_equal(with_some, with_each if seed_has else thing)


def test_a_pose_of_seven_numbers_reaches_the_ends_of_training_and_keeps_in_the_box() -> None:
    least, most = pose_from([0.0] * POSE_UNITS, BOX), pose_from([1.0] * POSE_UNITS, BOX)
    assert (least.size_m, most.size_m) == (pytest.approx(0.55 * 0.25), pytest.approx(0.9 * 0.25))
    assert (least.turn_z_rad, most.turn_z_rad) == (pytest.approx(-np.radians(35)), pytest.approx(np.radians(35)))
    assert (least.front_m, most.front_m) == (0, pytest.approx(0.35 * 0.28))
    for pose in (least, most):
        assert abs(pose.x_m) + pose.size_m / 2 == pytest.approx(0.125)
        assert abs(pose.y_m) + pose.size_m / 2 == pytest.approx(0.125)


@pytest.mark.parametrize("seed", range(5))
def test_a_random_pose_is_seven_random_numbers(seed: int) -> None:
    units = np.random.default_rng(seed).random(POSE_UNITS).tolist()
    assert random_pose(np.random.default_rng(seed), BOX) == pose_from(units, BOX)


def test_depths_are_within_the_box() -> None:
    for seed in range(20):
        depth = object_depth(seed, BOX)[1]
        assert depth.shape == (64, 64)
        assert depth.dtype == np.float32
        assert np.nanmin(depth) >= BOX.z_near_m - 1e-6
        assert np.nanmax(depth) <= BOX.z_far_m + 1e-6
