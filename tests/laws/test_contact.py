"""Near contact: no more light goes out than came in, and far away it is S2 to the letter."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.rig import LidarPose, load_rig

from nlos_cam.render.geometry import NEAR_DIAGONALS, cast, contact_m2, softened
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
CELLS = np.arange(-60, 61)


@settings(deadline=None, derandomize=True)
@given(
    height=st.floats(1e-6, 8.0),
    x=st.floats(-0.5, 0.5),
    y=st.floats(-0.5, 0.5),
    longer=st.floats(1.0, 2.0),
    lambertian=st.booleans(),
)
def test_a_plane_of_cells_takes_no_more_than_was_sent(
    height: float, x: float, y: float, longer: float, lambertian: bool
) -> None:
    """Light from a point at any height over a plane of cells, each `longer` times as long as its width of 1."""
    solid_angle = np.pi if lambertian else 2 * np.pi
    squared = (CELLS[:, None] - x) ** 2 + ((CELLS - y) * longer) ** 2 + height**2
    cosine = height / np.sqrt(squared)
    near = NEAR_DIAGONALS * np.hypot(1, longer)
    soft = softened(squared, contact_m2(longer, solid_angle), near)
    assert (longer * cosine * (cosine if lambertian else 1) / (solid_angle * soft)).sum() <= 1


def test_it_fades_out_and_leaves_the_distance_alone_beyond() -> None:
    squared = np.linspace(0, 4, 400) ** 2
    soft = softened(squared, 0.3, 2.0)
    assert soft[0] == pytest.approx(0.3)
    assert (np.diff(soft) > -1e-3).all()
    np.testing.assert_array_equal(soft[squared >= 4], squared[squared >= 4])


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("z_m", [0.0, 1e-30, 1e-9, 1e-4, 0.01])
def test_an_object_touching_the_wall_is_finite_and_counted(implementation: Any, radiometry: Any, z_m: float) -> None:
    scene = Scene(RIG, np.full((8, 8), z_m, np.float32), radiometry=radiometry)
    rendering = implementation.render(scene, ["direct", "three-bounce", "occluder", "tilt", "self-occlusion"])
    assert np.isfinite(rendering.intensity).all()
    assert rendering.intensity.min() >= 0
    assert rendering.near_legs > 0


def test_a_far_object_has_no_near_legs() -> None:
    from nlos_cam.render.renderer import render

    depth = np.full((64, 64), np.nan, np.float32)
    depth[20:40, 20:40] = 0.3
    assert render(Scene(RIG, depth), "draft").near_legs == 0


@settings(deadline=None, derandomize=True)
@given(distance_m=st.floats(1e-6, 1.0))
def test_a_lidar_on_the_wall_gets_no_more_than_it_sent(distance_m: float) -> None:
    rig = RIG.model_copy(update={"lidar": LidarPose(distance_m=distance_m, yaw_deg=45), "occluder": None})
    for lambertian in (False, True):
        direct = cast(rig, Scene(rig).cell_intrinsics, lambertian=lambertian).direct
        assert np.isfinite(direct).all()
        assert 0 <= direct.min() <= direct.max() <= 1
