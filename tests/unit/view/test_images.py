import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_map import object_box
from nlos_cam.view import images

BOX = object_box(load_rig("paper-rig"))
NOTHING = np.full((64, 64), np.nan, np.float32)


def flat(z_m: float) -> np.ndarray:
    return np.full((64, 64), z_m, np.float32)


@pytest.mark.parametrize(
    "rgb",
    [
        np.concatenate([images.hidden_rgb(flat(z_m), BOX)[:1, :1] for z_m in (np.nan, 0.4, 0.25, 0.13)], axis=1),
        images.noise_rgb(np.array([[np.nan, 0.0, 1.0, 2.0]]), 2.0),
    ],
    ids=["hidden depth, nearer", "noise, larger"],
)
def test_picture_is_brighter_the_larger_its_value(rgb: np.ndarray) -> None:
    assert (np.diff(rgb[0].sum(axis=-1).astype(int)) > 0).all()


def test_depth_pictures_show_missing_depth_as_background() -> None:
    assert (images.hidden_rgb(NOTHING, BOX) == images.BACKGROUND_RGB).all()
    assert (images.lidar_rgb(NOTHING, 0.1, 1.0) == images.BACKGROUND_RGB).all()
    depth_m = flat(0.3)
    depth_m[5, 6] = np.nan
    is_background = (images.lidar_rgb(depth_m, 0.1, 1.0) == images.BACKGROUND_RGB).all(axis=-1)
    assert np.argwhere(is_background).tolist() == [[5, 6]]


def test_lidar_rgb_is_red_near_and_blue_far() -> None:
    near, far = images.lidar_rgb(flat(0.1), 0.1, 1.0)[0, 0], images.lidar_rgb(flat(1.0), 0.1, 1.0)[0, 0]
    assert near[0] > near[2]
    assert far[2] > far[0]


def test_infrared_grey_keeps_order_and_ends_of_counts() -> None:
    grey = images.infrared_grey(np.arange(256, dtype=np.uint8)[None])[0].astype(int)
    assert (grey[0], grey[255]) == (0, 255)
    assert (np.diff(grey) >= 0).all()


def test_difference_rgb_is_red_nearer_grey_same_and_blue_farther() -> None:
    near, same, far, nothing = images.difference_rgb(np.array([-0.01, 0.0, 0.01, np.nan]), 0.01).astype(int)
    assert near[0] > 2 * near[2]
    assert far[2] > 2 * far[0]
    assert np.ptp(same) < 30
    assert tuple(nothing) == images.BACKGROUND_RGB
    redness = np.diff(images.difference_rgb(np.linspace(-1, 1, 21), 1.0)[:, [2, 0]].astype(int), axis=1)[:, 0]
    assert (np.diff(redness) < 0).all()


def test_saturated_rgb_colors_saturated_pixels_only() -> None:
    rgb = images.saturated_rgb(np.array([[0.0, 40.0, 255.0, np.nan]]), np.array([[0.0, 0.0, 0.01, 0.0]]))[0]
    assert tuple(rgb[2]) == images.SATURATED_RGB
    assert (np.ptp(rgb[[0, 1, 3]], axis=-1) == 0).all()


@given(st.floats(1e-6, 1e6))
def test_round_span_is_round_and_little_larger_than_the_values(value: float) -> None:
    span = images.round_span(np.array([value, -value, np.nan]))
    assert value <= span * (1 + 1e-5)
    assert span <= value * 2 * (1 + 1e-5)
    assert f"{span:e}"[0] in "1235"
    assert float(f"{span:.0e}") == span


def test_spans_ignore_what_is_missing_or_has_not_changed() -> None:
    depth_m = np.linspace(0.2, 1.2, 64 * 64, dtype=np.float32).reshape(64, 64)
    near_m, far_m = images.depth_span_m(depth_m)
    assert 0.2 <= near_m < 0.25
    assert 1.15 < far_m <= 1.2
    assert images.depth_span_m(NOTHING) == (0.0, 1.0)
    off_m = np.full((64, 80), 0.0003, np.float32)
    off_m[3] = np.nan
    assert images.change_span_m(off_m) == images.QUIET_SPAN_M
    off_m[:, 40:60] = 0.28
    off_m[:, 78:] = -1.5
    assert images.change_span_m(off_m) == pytest.approx(0.3)
    assert images.round_span(np.array([np.nan, np.nan])) == 1.0
    assert images.round_span(np.zeros(3), otherwise=0.5) == 0.5


def test_uncertainty_rgb_is_brighter_the_larger_on_the_surface() -> None:
    depth_m = flat(0.2)
    depth_m[0] = np.nan
    spread_m = np.linspace(0.0, 2 * images.MAX_UNCERTAINTY_M, 64, dtype=np.float32) * np.ones((64, 1), np.float32)
    rgb = images.uncertainty_rgb(spread_m, depth_m)
    assert (rgb[0] == images.BACKGROUND_RGB).all()
    brightness = rgb[1].sum(axis=-1).astype(int)
    assert (np.diff(brightness) >= -3).all()
    assert brightness[0] > sum(images.BACKGROUND_RGB)
    assert (rgb[1, 40:] == rgb[1, 63]).all()
    assert (images.uncertainty_rgb(NOTHING, depth_m) == images.uncertainty_rgb(flat(1.0), depth_m)).all(), (
        "unknown is the largest"
    )


def test_pictures_clip_values_beyond_their_span() -> None:
    np.testing.assert_array_equal(images.noise_rgb(flat(3.0), 2.0), images.noise_rgb(flat(2.0), 2.0))
    np.testing.assert_array_equal(images.lidar_rgb(flat(9.0), 0.1, 1.0), images.lidar_rgb(flat(1.0), 0.1, 1.0))
    np.testing.assert_array_equal(images.difference_rgb(flat(9.0), 0.01), images.difference_rgb(flat(0.01), 0.01))


def test_faded_keeps_brightness_and_loses_color() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (9, 9, 3)).astype(np.uint8)
    pale = images.faded(rgb).astype(float)
    np.testing.assert_allclose(pale.mean(axis=-1), rgb.mean(axis=-1), atol=1.0)
    np.testing.assert_allclose(np.ptp(pale, axis=-1), images.FADED * np.ptp(rgb.astype(float), axis=-1), atol=1.5)


def test_relief_rgb_is_lit_from_the_top_left() -> None:
    y, x = np.mgrid[:64, :64]
    hill_m = (0.3 - 0.1 * np.exp(-((x - 32) ** 2 + (y - 32) ** 2) / 200)).astype(np.float32)
    brightness = images.relief_rgb(hill_m, BOX).sum(axis=-1).astype(int)
    assert brightness[24, 24] > brightness[40, 40]
    assert (images.relief_rgb(NOTHING, BOX) == images.BACKGROUND_RGB).all()
