import numpy as np
import pytest
from fake_doubter import FakeDoubter
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import depth_from_image, object_box
from nlos_cam.reconstruct.network import doubt_of

BOX = object_box(load_rig("paper-rig"))


def maps() -> LidarMaps:
    return LidarMaps(np.full((64, 80), 0.3, np.float32), np.ones((64, 80), np.float32), np.ones((64, 80), np.bool_))


def test_an_error_in_v_is_as_many_metres_as_two_images_apart_by_it_are() -> None:
    image = np.full((64, 64), 0.5, np.float32)
    doubt = doubt_of(FakeDoubter(error_v=0.1), maps(), image, BOX)
    apart_m = depth_from_image(image, BOX) - depth_from_image(image + np.float32(0.1), BOX)
    np.testing.assert_allclose(doubt.error_m, apart_m, rtol=1e-5)


def test_the_network_is_asked_of_the_maps_and_the_image_as_a_batch_of_one() -> None:
    doubter, image = FakeDoubter(lambda *_: (0.25, 0.5)), np.full((64, 64), 0.5, np.float32)
    doubt = doubt_of(doubter, maps(), image, BOX)
    assert (doubt.nothing, doubt.outside) == pytest.approx((0.25, 0.5))
    asked = doubter.asked[0]
    assert [part.shape for part in asked] == [(1, 64, 80), (1, 64, 80), (1, 64, 64)]
    np.testing.assert_array_equal(asked[2][0], image)
