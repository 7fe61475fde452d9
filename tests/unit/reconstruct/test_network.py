import itertools

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import depth_from_image, image_from_depth, object_box
from nlos_cam.reconstruct.network import Mirrored, box_pose, estimate_doubt, reconstruct, reconstruct_all

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


def half(*_: np.ndarray) -> np.ndarray:
    return np.full((1, 64, 64), 0.5, np.float32)


def test_mirrored_answers_alike_to_mirrored_maps_and_takes_every_surface() -> None:
    class Shifting:
        record, runtime = None, "none"

        def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
            del intensity
            return np.roll(np.nan_to_num(depth_m[:, :, 8:72]), 1, axis=1)  # down, whatever the maps

    depth_m = np.full((1, 64, 80), np.nan, np.float32)
    depth_m[0, 20, 30], depth_m[0, 22, 30] = 0.4, 0.6
    network = Mirrored(Shifting())  # type: ignore[arg-type]
    image = network(depth_m, depth_m)
    np.testing.assert_array_equal(network(depth_m[:, ::-1], depth_m[:, ::-1]), image[:, ::-1])
    np.testing.assert_allclose(image[0, 18:25, 22], [0, 0.4, 0, 0.5, 0, 0.6, 0], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_reconstruct_inverts_the_image_of_a_depth_map(seed: int) -> None:
    truth_m = a_hidden_depth(seed)
    found = reconstruct(some_maps(), RIG, lambda *_: image_from_depth(truth_m, BOX)[None])
    np.testing.assert_allclose(found.depth_m, truth_m, atol=1e-6)  # NaN where NaN


def test_pose_of_box_stands_on_the_wall_before_its_middle() -> None:
    pose = box_pose(BOX)
    np.testing.assert_allclose(pose @ [0, 0, 0, 1], [0.45, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(pose[:3, :3], np.eye(3))


def test_reconstruct_all_shares_the_network_time() -> None:
    ticks = itertools.count()
    found = reconstruct_all([some_maps()] * 4, RIG, lambda *_: np.repeat(half(), 4, 0), lambda: float(next(ticks)))
    assert [(each.timings_s, each.uncertainty_m) for each in found] == [({"network": 0.25}, None)] * 4


def test_reconstruct_with_doubt_adds_uncertainty_and_a_stage() -> None:
    ticks, doubter = itertools.count(), FakeDoubter(lambda *_: (0.25, 0.5), error_v=0.1)
    found = reconstruct(some_maps(), RIG, half, lambda: float(next(ticks)), doubter)
    assert found.timings_s == {"network": 1.0, "doubt": 1.0}
    assert (found.doubt.nothing, found.doubt.outside) == (0.25, 0.5)
    assert found.uncertainty_m is found.doubt.error_m
    assert [part.shape for part in doubter.asked[0]] == [(1, 64, 80), (1, 64, 80), (1, 64, 64)]
    for asked, given in zip(doubter.asked[0], (some_maps().depth_m, some_maps().intensity, half()[0]), strict=True):
        np.testing.assert_array_equal(asked[0], given)
    hidden = found.without_surface
    assert found.has_surface
    assert (hidden.has_surface, hidden.uncertainty_m, hidden.doubt) == (False, found.uncertainty_m, found.doubt)


def test_reconstruct_without_returns_still_asks_for_doubt() -> None:
    doubter, blank = FakeDoubter(), np.full((64, 80), np.nan, np.float32)
    maps = LidarMaps(blank, np.zeros((64, 80), np.float32), ~np.isnan(blank))
    found = reconstruct(maps, RIG, lambda *_: np.ones((1, 64, 64), np.float32), uncertainty_model=doubter)
    assert not found.has_surface
    assert found.uncertainty_m is not None
    assert not doubter.asked[0][2].any()


def test_reconstruct_refuses_a_rig_without_object_box() -> None:
    with pytest.raises(SceneError, match="bare-wall"):
        reconstruct(some_maps(), load_rig("bare-wall"), half)


def test_doubt_converts_an_image_error_to_metres() -> None:
    doubt = estimate_doubt(FakeDoubter(error_v=0.1), some_maps(), half()[0], BOX)
    apart_m = depth_from_image(half()[0], BOX) - depth_from_image(half()[0] + np.float32(0.1), BOX)
    np.testing.assert_allclose(doubt.error_m, apart_m, rtol=1e-5)
