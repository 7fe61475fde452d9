import itertools

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_image import image_from_depth, object_box
from nlos_cam.reconstruct import pose_of, reconstruct

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


def test_a_rig_without_a_box_is_refused_by_name() -> None:
    with pytest.raises(SceneError, match="bare-wall"):
        reconstruct(some_maps(), load_rig("bare-wall"), lambda *_: np.zeros((1, 64, 64), np.float32))
