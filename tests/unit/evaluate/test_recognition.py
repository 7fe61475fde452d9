"""Recognition by silhouette: whatever its place and size, and nothing where there is no surface."""

import numpy as np
from nlos_calibration.rig import load_rig

from nlos_cam.evaluate.recognition import recognise, recognised
from nlos_cam.objects import CATEGORIES, category_triangles, image_from_depth, object_box, orthographic_depth
from nlos_cam.objects.placement import Pose, place

BOX = object_box(load_rig("paper-rig"))


def _images(pose: Pose, seed: int) -> np.ndarray:
    shapes = (place(category_triangles(name, seed), pose, BOX) for name in CATEGORIES)
    return np.stack([image_from_depth(orthographic_depth(shape, BOX), BOX) for shape in shapes])


def test_kinds_are_recognised_in_any_place_and_size() -> None:
    kinds = list(CATEGORIES)
    for pose in (Pose(size_m=0.2), Pose(size_m=0.12, x_m=0.05, y_m=-0.04), Pose(turn_z_rad=0.3, tilt_y_rad=0.2)):
        assert recognised(_images(pose, 1000), kinds, BOX).mean() > 0.8


def test_no_surface_and_another_kind_are_not_recognised() -> None:
    images = np.stack([np.zeros((64, 64), np.float32), _images(Pose(), 7)[list(CATEGORIES).index("cup")]])
    assert recognise(images, BOX) == ["", "cup"]
    np.testing.assert_array_equal(recognised(images, ["cup", "rocket"], BOX), [0, 0])
