import numpy as np
import pytest
from depth_maps import inside
from nlos_calibration import ObjectBox, load_rig
from nlos_calibration.arrays import Float32

from nlos_cam.dataset import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED
from nlos_cam.errors import SceneError
from nlos_cam.objects import CATEGORIES, object_box, object_depth, panel, place, post, random_pose
from nlos_cam.objects.benchmark import BenchmarkObject, benchmark_objects
from nlos_cam.objects.placement import (
    POSE_UNITS,
    Pose,
    add_background,
    category_triangles,
    fit_in_box,
    pose_from_units,
)

BOX = object_box(load_rig("paper-rig"))
CUP = category_triangles("cup", 0)


def _points(pose: Pose, box: ObjectBox = BOX) -> np.ndarray:
    return place(CUP, pose, box).reshape(-1, 3)


def test_place_gives_size_offset_and_a_front_within_the_box() -> None:
    points = _points(
        Pose(
            turn_z_rad=0.4,
            tilt_x_rad=0.2,
            size_m=0.15,
            x_m=0.02,
            y_m=-0.03,
            front_m=0.04,
        )
    )

    assert np.ptp(points[:, :2], axis=0).max() == pytest.approx(0.15)

    middle = (points.min(0) + points.max(0)) / 2

    np.testing.assert_allclose(
        middle[:2],
        [0.45 + 0.02, -0.03],
        atol=1e-12,
    )
    assert points[:, 2].min() == pytest.approx(BOX.z_near_m + 0.04)

    for front_m in (0.3, 1.0):
        with pytest.raises(SceneError, match="front_m"):
            place(CUP, Pose(front_m=front_m), BOX)


def test_deep_mesh_is_flattened_and_fit_reports_it() -> None:
    inside = fit_in_box(CUP, Pose(size_m=0.2), BOX)
    beside = fit_in_box(CUP, Pose(size_m=0.2, x_m=0.25), BOX)

    assert inside.outside == 0
    assert beside.outside == 1
    assert inside.depth_m == pytest.approx(np.ptp(_points(Pose(size_m=0.2))[:, 2]))
    assert inside.room_m == pytest.approx(BOX.z_far_m - BOX.z_near_m - Pose().front_m)

    shallow = BOX.model_copy(update={"z_far_m": BOX.z_near_m + 0.06})
    flattened = fit_in_box(CUP, Pose(size_m=0.2), shallow)

    assert flattened.depth_m == inside.depth_m > flattened.room_m == pytest.approx(0.03)

    deep = _points(Pose())
    flat = _points(Pose(), shallow)

    assert flat[:, 2].max() == pytest.approx(shallow.z_far_m)
    np.testing.assert_allclose(flat[:, :2], deep[:, :2])


def test_training_held_out_and_test_objects_all_differ() -> None:
    seeds = [
        first + k
        for first in (
            TRAINING_SEED,
            HELD_OUT_SEED,
            TEST_SEED,
        )
        for k in range(25)
    ]
    assert len({object_depth(seed, BOX)[1].tobytes() for seed in seeds}) == 75


def test_object_depth_draws_known_categories_only() -> None:
    assert {
        object_depth(
            seed,
            BOX,
            ("cup", "hat"),
        )[0]
        for seed in range(12)
    } == {"cup", "hat"}
    assert {object_depth(seed, BOX)[0] for seed in range(250)} == set(CATEGORIES)

    for categories, word in (
        ((), "category"),
        (("cup", "teapot"), "teapot"),
    ):
        with pytest.raises(SceneError, match=word):
            object_depth(0, BOX, categories)


def test_backgrounds_come_at_their_share_behind_the_same_objects() -> None:
    """Each object has its own background from some share on, and keeps it at any larger share."""
    seeds = range(40)
    alone, some, each = (
        [object_depth(seed, BOX, backgrounds=share)[1] for seed in seeds]
        for share in (0.0, 0.3, 1.0)
    )
    has = [
        not np.array_equal(a, s, equal_nan=True)
        for a, s in zip(
            alone,
            some,
            strict=True,
        )
    ]

    assert 4 <= sum(has) <= 20

    for thing, with_some, with_each, seed_has in zip(
        alone,
        some,
        each,
        has,
        strict=True,
    ):
        surface = ~np.isnan(thing)
        np.testing.assert_array_equal(with_each[surface], thing[surface])
        np.testing.assert_array_equal(with_some, with_each if seed_has else thing)


def test_random_pose_spans_the_training_range_in_the_box() -> None:
    least = pose_from_units([0.0] * POSE_UNITS, BOX)
    most = pose_from_units([1.0] * POSE_UNITS, BOX)

    assert least.size_m == pytest.approx(0.55 * 0.25)
    assert most.size_m == pytest.approx(0.9 * 0.25)
    assert least.turn_z_rad == pytest.approx(-np.radians(35))
    assert most.turn_z_rad == pytest.approx(np.radians(35))
    assert (least.front_m, most.front_m) == (
        0,
        pytest.approx(0.35 * 0.28),
    )

    for pose in (least, most):
        assert abs(pose.x_m) + pose.size_m / 2 == pytest.approx(0.125)
        assert abs(pose.y_m) + pose.size_m / 2 == pytest.approx(0.125)
    for seed in range(5):
        units = np.random.default_rng(seed).random(POSE_UNITS).tolist()
        assert random_pose(np.random.default_rng(seed), BOX) == pose_from_units(units, BOX)


OBJECTS = [object_depth(seed, BOX)[1] for seed in range(20)]


@pytest.mark.parametrize("seed", range(20))
def test_background_leaves_the_object_and_stays_in_the_box(seed: int) -> None:
    thing = OBJECTS[seed]
    depth = add_background(thing, BOX, np.random.default_rng(seed))
    surface = ~np.isnan(thing)

    np.testing.assert_array_equal(depth[surface], thing[surface])

    added = depth[~surface & ~np.isnan(depth)]

    assert added.size
    assert (added >= np.nanmin(thing) - 1e-6).all()
    assert (added <= BOX.z_far_m + 1e-6).all()
    assert depth.dtype == np.float32


def test_background_is_a_post_or_a_panel() -> None:
    shares = [
        np.isfinite(
            add_background(
                OBJECTS[0],
                BOX,
                np.random.default_rng(seed),
            )
        ).mean()
        for seed in range(20)
    ]

    assert min(shares) < np.isfinite(OBJECTS[0]).mean() + 0.1
    assert max(shares) > 0.4


@pytest.mark.parametrize("thing", OBJECTS)
def test_post_is_level_from_the_underside_to_the_bottom(thing: Float32) -> None:
    below = ~np.isnan(post(thing, np.random.default_rng(1)))
    surface = ~np.isnan(thing)
    for column in np.flatnonzero(below.any(axis=0)):
        lowest = np.flatnonzero(surface[:, column]).max()
        np.testing.assert_array_equal(
            np.flatnonzero(below[:, column]),
            np.arange(lowest + 1, 64),
        )

    assert (
        np.ptp(
            post(
                thing,
                np.random.default_rng(1),
            )[below]
        )
        == 0
        if below.any()
        else surface[-1].any()
    )


def test_panel_fits_behind_an_object_at_the_back() -> None:
    at_the_back = np.full((64, 64), np.nan, np.float32)
    at_the_back[20:40, 20:40] = BOX.z_far_m  # as float32, 6 nm behind the box

    found = panel(at_the_back, BOX, np.random.default_rng(0))

    assert np.nanmin(found) == np.float32(BOX.z_far_m)


@pytest.mark.parametrize("thing", OBJECTS)
def test_panel_is_a_rectangle_behind_the_object(thing: Float32) -> None:
    board = panel(thing, BOX, np.random.default_rng(2))
    there = ~np.isnan(board)
    rows = there.any(axis=1)
    columns = there.any(axis=0)

    np.testing.assert_array_equal(there, rows[:, None] & columns)
    assert 36 <= rows.sum() <= 64
    assert 36 <= columns.sum() <= 64
    assert np.ptp(board[there]) == 0
    assert board[there][0] >= np.nanmax(thing) - 1e-6


BENCHMARK = benchmark_objects(BOX)


def test_benchmark_has_three_named_objects_per_category() -> None:
    assert len(BENCHMARK) == len({thing.name for thing in BENCHMARK}) == 54

    numbered = [(thing.category, thing.number) for thing in BENCHMARK]

    assert numbered == [(c, k) for c in CATEGORIES for k in (1, 2, 3)]
    assert BENCHMARK[0].name == "airplane-1"


def test_benchmark_is_the_same_each_time() -> None:
    again = benchmark_objects(BOX)

    assert again == BENCHMARK

    for thing, same in zip(BENCHMARK, again, strict=True):
        assert thing.depth_m.tobytes() == same.depth_m.tobytes()
        assert thing.triangles.tobytes() == same.triangles.tobytes()


@pytest.mark.parametrize("thing", BENCHMARK, ids=lambda thing: thing.name)
def test_benchmark_object_shows_in_the_box(thing: BenchmarkObject) -> None:
    assert inside(thing.triangles, BOX)
    assert thing.depth_m.shape == (64, 64)
    assert thing.depth_m.dtype == np.float32
    assert 0.03 < np.isfinite(thing.depth_m).mean() < 0.6


@pytest.mark.parametrize("thing", BENCHMARK, ids=lambda thing: thing.name)
def test_benchmark_object_takes_held_out_settings(thing: BenchmarkObject) -> None:
    """No seed reaches these intervals (test_generators.py)."""
    kind = CATEGORIES[thing.category]

    assert list(thing.settings) == list(kind.settings)

    for name, setting in kind.settings.items():
        if setting.held_out:
            assert setting.held_out[0] < thing.settings[name] < setting.held_out[1]
        else:
            assert setting.low < thing.settings[name] < setting.high


@pytest.mark.parametrize("category", CATEGORIES)
def test_benchmark_spreads_settings_evenly_within_category(category: str) -> None:
    three = [thing.settings for thing in BENCHMARK if thing.category == category]
    for name in three[0]:
        low, middle, high = sorted(settings[name] for settings in three)
        assert high - middle == pytest.approx(middle - low)
        assert high > low


def test_benchmark_poses_cover_the_training_range_evenly() -> None:
    spans = {
        "size_m": (0.25 * 0.55, 0.25 * 0.9),
        "front_m": (0, 0.35 * 0.28),
        "x_m": (-1, 1),
        "y_m": (-1, 1),
    }
    spans |= {
        f"{name}_rad": (-np.radians(deg), np.radians(deg))
        for name, deg in (
            ("tilt_x", 15),
            ("tilt_y", 20),
            ("turn_z", 35),
        )
    }

    assert set(spans) == set(Pose.__dataclass_fields__)

    for name, (low, high) in spans.items():
        spare = [
            (0.25 - thing.pose.size_m) / 2 if name in {"x_m", "y_m"} else 1 for thing in BENCHMARK
        ]
        values = [
            getattr(thing.pose, name) / room
            for thing, room in zip(
                BENCHMARK,
                spare,
                strict=True,
            )
        ]
        np.testing.assert_allclose(
            np.sort(values), low + (high - low) * (np.arange(54) + 0.5) / 54, atol=1e-9
        )
    table = np.array(
        [
            [
                k,
                *vars(thing.pose).values(),
            ]
            for k, thing in enumerate(BENCHMARK)
        ]
    )

    assert np.abs(np.corrcoef(table.T) - np.eye(8)).max() < 0.25
