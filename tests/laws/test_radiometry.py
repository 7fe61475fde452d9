"""What the paper reports of real depth maps (SI 1), and what either radiometry says of it."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.renderer import render, three_bounce, transient
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
SEEDS = (3, 20_000_001, 20_000_009)


@pytest.fixture(scope="module")
def objects() -> list[np.ndarray]:
    assert RIG.object_box is not None
    return [object_depth(seed, RIG.object_box)[1] for seed in SEEDS]


def test_with_direct_returns_alone_the_depth_maps_of_all_objects_are_the_same(objects: list[np.ndarray]) -> None:
    empty = render(Scene(RIG), "draft").depth_m
    for depth in objects:
        alone = render(Scene(RIG, depth), "draft", effects=["direct", "occluder", "line-of-sight"])
        np.testing.assert_array_equal(alone.depth_m, empty)


def test_with_three_bounces_they_differ(objects: list[np.ndarray]) -> None:
    maps = [render(Scene(RIG, depth), "draft").depth_m for depth in objects]
    for one in range(len(maps)):
        for other in range(one):
            apart = np.abs(maps[one] - maps[other]) > RIG.device.bin_m
            assert apart.mean() > 0.05


def test_in_lambertian_radiometry_the_third_bounce_is_a_thousandth_and_wins_no_beam(objects: list[np.ndarray]) -> None:
    empty = render(Scene(RIG, radiometry="lambertian"), "draft")
    for depth in objects:
        scene = Scene(RIG, depth, radiometry="lambertian")
        rendering = render(scene, "draft")
        np.testing.assert_array_equal(rendering.depth_m, empty.depth_m)
        share = rendering.multi.peak.max() / empty.intensity.max()
        assert 1e-6 < share < 3e-3


def test_the_receiver_is_a_device_constant_that_scales_the_direct_return_alone_in_the_papers_radiometry() -> None:
    wide = RIG.model_copy(update={"device": RIG.device.model_copy(update={"receiver_cell_m2": 2e-4})})
    depth = np.full((8, 8), 0.25, np.float32)
    one, other = (three_bounce(Scene(rig, depth), "draft") for rig in (RIG, wide))
    np.testing.assert_array_equal(one, other)
    direct, wider = (transient(Scene(rig), "draft").sum() for rig in (RIG, wide))
    assert wider == pytest.approx(2 * direct, rel=1e-5)
