"""Generic shapes: decided by the seed, of every family, within the box, and carved as solids are."""

from collections import Counter

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects import object_box
from nlos_cam.objects.generic import FAMILIES, MIN_PIXELS, generic_depth
from nlos_cam.objects.primitives import prism

BOX = object_box(load_rig("paper-rig"))


def test_shape_follows_from_the_seed_alone_and_stands_in_the_box() -> None:
    shapes = [generic_depth(seed, BOX) for seed in range(150)]
    for seed in (3, 90):
        np.testing.assert_array_equal(generic_depth(seed, BOX)[1], shapes[seed][1])
    for name, depth_m in shapes:
        surface = depth_m[np.isfinite(depth_m)]
        assert surface.size >= MIN_PIXELS, name
        assert surface.min() >= BOX.z_near_m - 1e-6, name
        assert surface.max() <= BOX.z_far_m + 1e-6, name
    assert len({depth_m.tobytes() for _, depth_m in shapes}) == len(shapes)


def test_families_carved_shapes_and_pairs_all_occur_in_their_shares() -> None:
    names = [generic_depth(seed, BOX)[0] for seed in range(400)]
    alone = Counter(name for name in names if " " not in name)
    assert alone.keys() == FAMILIES.keys()
    assert 0.1 < np.mean([name.startswith("carved") for name in names]) < 0.3
    assert 0.06 < np.mean([" and " in name for name in names]) < 0.2


@pytest.mark.parametrize("taper", [0.0, 0.5, 1.0])
def test_prism_has_the_volume_of_its_frustum(taper: float) -> None:
    """By the divergence theorem; side faces point one way, so the sign is that of the outline's turn."""
    angle = np.linspace(0, 2 * np.pi, 5)[:-1]
    a, b, c = np.moveaxis(prism(np.column_stack([np.cos(angle), np.sin(angle)]), 3.0, taper), 1, 0)
    area_z = 0.5 * np.abs(np.cross(b - a, c - a)[:, 2])
    assert area_z.sum() == pytest.approx(2 + 2 * taper**2 + 2 * (1 - taper**2))  # base, front, and sides seen along z
