import itertools

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.reconstruct.network import pose_of, reconstruct

RIG = load_rig("paper-rig")
BOX = object_box(RIG)


def a_hidden_depth(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    depth_m = generator.uniform(BOX.z_near_m, BOX.z_far_m, (64, 64)).astype(np.float32)
    depth_m[generator.random((64, 64)) < 0.5] = np.nan
    return depth_m


def some_maps() -> LidarMaps:
    depth_m = np.full((64, 80), 0.3, np.float32)
    depth_m[0, 0] = np.nan
    return LidarMaps(depth_m, np.full((64, 80), 40.0, np.float32), ~np.isnan(depth_m))


@pytest.mark.parametrize("seed", range(3))
def test_a_network_that_knows_the_truth_yields_the_truth(seed: int) -> None:
    truth_m = a_hidden_depth(seed)
    found = reconstruct(some_maps(), RIG, lambda *_: image_from_depth(truth_m, BOX)[None])
    np.testing.assert_allclose(found.depth_m, truth_m, atol=1e-6)  # NaN where NaN


def test_the_network_eats_the_maps_as_a_batch_of_one() -> None:
    eaten = []

    def network(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        eaten.append((depth_m, intensity))
        return np.zeros((1, 64, 64), np.float32)

    maps = some_maps()
    reconstruct(maps, RIG, network)
    np.testing.assert_array_equal(eaten[0][0], maps.depth_m[None])
    np.testing.assert_array_equal(eaten[0][1], maps.intensity[None])


def test_the_object_frame_stands_on_the_wall_before_the_middle_of_the_box() -> None:
    pose = pose_of(BOX)
    np.testing.assert_allclose(pose @ [0, 0, 0, 1], [0.45, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(pose[:3, :3], np.eye(3))


def test_the_time_is_taken_from_the_clock_it_is_given() -> None:
    ticks = itertools.count()
    found = reconstruct(some_maps(), RIG, lambda *_: np.zeros((1, 64, 64), np.float32), lambda: float(next(ticks)))
    assert found.timings_s == {"network": 1.0}
    assert found.uncertainty_m is None


def test_with_a_doubt_network_there_is_an_uncertainty_and_its_time_is_a_stage_of_its_own() -> None:
    ticks, doubter = itertools.count(), FakeDoubter(lambda *_: (0.25, 0.5), error_v=0.1)
    image = np.full((1, 64, 64), 0.5, np.float32)
    found = reconstruct(some_maps(), RIG, lambda *_: image, lambda: float(next(ticks)), doubter)
    assert found.timings_s == {"network": 1.0, "doubt": 1.0}
    assert found.doubt is not None
    assert (found.doubt.nothing, found.doubt.outside) == (0.25, 0.5)
    assert found.uncertainty_m is found.doubt.error_m
    np.testing.assert_array_equal(doubter.asked[0][2], image)


def test_of_maps_without_any_return_there_is_doubt_too() -> None:
    doubter, blank = FakeDoubter(), np.full((64, 80), np.nan, np.float32)
    maps = LidarMaps(blank, np.zeros((64, 80), np.float32), ~np.isnan(blank))
    found = reconstruct(maps, RIG, lambda *_: np.ones((1, 64, 64), np.float32), doubter=doubter)
    assert not found.shows
    assert found.uncertainty_m is not None
    assert not doubter.asked[0][2].any()


def test_what_is_hidden_shows_nothing_and_is_the_same_otherwise() -> None:
    found = reconstruct(some_maps(), RIG, lambda *_: np.full((1, 64, 64), 0.5, np.float32), doubter=FakeDoubter())
    assert found.shows
    assert not found.hidden.shows
    assert found.hidden.uncertainty_m is found.uncertainty_m
    assert found.hidden.doubt is found.doubt


def test_a_rig_without_a_box_is_refused_by_name() -> None:
    with pytest.raises(SceneError, match="bare-wall"):
        reconstruct(some_maps(), load_rig("bare-wall"), lambda *_: np.zeros((1, 64, 64), np.float32))
