"""Hidden depth to image and back."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_map import cell_centres_m, depth_from_image, image_from_depth

BOX = load_rig("paper-rig").object_box


def test_near_is_bright_far_is_a_tenth_and_nothing_is_0() -> None:
    depth = np.array([BOX.z_near_m, BOX.z_far_m, (BOX.z_near_m + BOX.z_far_m) / 2, np.nan])
    np.testing.assert_allclose(image_from_depth(depth, BOX), [1.0, 0.1, 0.55, 0.0], rtol=1e-6)


def test_what_leaves_the_box_is_clipped_and_stays_a_surface() -> None:
    depth = np.array([BOX.z_near_m - 0.05, BOX.z_far_m + 1, np.inf])
    np.testing.assert_allclose(image_from_depth(depth, BOX), [1.0, 0.1, 0.1], rtol=1e-6)


@settings(max_examples=20, derandomize=True, deadline=None)
@given(near=st.floats(0.05, 0.5), deep=st.floats(0.01, 2), seed=st.integers(0, 1000))
def test_depth_survives_the_round_trip(near: float, deep: float, seed: int) -> None:
    box = BOX.model_copy(update={"z_near_m": near, "z_far_m": near + deep})
    generator = np.random.default_rng(seed)
    depth = generator.uniform(near, near + deep, (64, 64)).astype(np.float32)
    depth[generator.random(depth.shape) < 0.5] = np.nan
    back = depth_from_image(image_from_depth(depth, box), box)
    np.testing.assert_allclose(back, depth, atol=1e-6 * (1 + deep))


def test_an_image_survives_the_round_trip_even_through_float16() -> None:
    image = np.linspace(0.1, 1, 4096, dtype=np.float32).reshape(64, 64)
    image[:10] = 0
    np.testing.assert_allclose(image_from_depth(depth_from_image(image, BOX), BOX), image, atol=1e-6)
    half = image.astype(np.float16)
    np.testing.assert_allclose(image_from_depth(depth_from_image(half, BOX), BOX), half, atol=2e-3)


def test_background_is_below_5_percent() -> None:
    depth = depth_from_image(np.array([0.0, 0.049, 0.051, 0.1]), BOX)
    assert np.isnan(depth).tolist() == [True, True, False, False]
    np.testing.assert_allclose(depth[2:], BOX.z_far_m, rtol=1e-6)


def test_columns_grow_with_wall_x_and_rows_against_wall_y() -> None:
    x_m, y_m = cell_centres_m(BOX)
    pitch = (BOX.x_max_m - BOX.x_min_m) / 64
    np.testing.assert_allclose(np.diff(x_m), pitch)
    np.testing.assert_allclose(np.diff(y_m), -pitch)
    np.testing.assert_allclose([x_m[0], x_m[-1]], [BOX.x_min_m + pitch / 2, BOX.x_max_m - pitch / 2])
    np.testing.assert_allclose([y_m[0], y_m[-1]], [BOX.y_max_m - pitch / 2, BOX.y_min_m + pitch / 2])
