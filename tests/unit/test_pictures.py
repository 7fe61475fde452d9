import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig
from PIL import Image

from nlos_cam.objects.depth_map import object_box
from nlos_cam.view.images import (
    BACKGROUND_RGB,
    FADED,
    JUMP_M,
    MAX_UNCERTAINTY_M,
    QUIET_SPAN_M,
    SATURATED_RGB,
    change_span_m,
    confidence_rgb,
    depth_span_m,
    difference_rgb,
    encoded,
    faded,
    hidden_rgb,
    infrared_grey,
    lidar_rgb,
    noise_rgb,
    relief_rgb,
    round_span,
    saturated_rgb,
    surface,
    uncertainty_rgb,
)

BOX = object_box(load_rig("paper-rig"))
NOTHING = np.full((64, 64), np.nan, np.float32)


def flat(z_m: float) -> np.ndarray:
    return np.full((64, 64), z_m, np.float32)


def test_near_is_brighter_than_far_and_far_brighter_than_nothing() -> None:
    brightness = [
        hidden_rgb(depth_m, BOX).sum(axis=-1).mean() for depth_m in (flat(0.13), flat(0.25), flat(0.4), NOTHING)
    ]
    assert brightness == sorted(brightness, reverse=True)
    assert len(set(brightness)) == 4


def test_what_has_no_depth_is_background_in_both_pictures() -> None:
    assert (hidden_rgb(NOTHING, BOX) == BACKGROUND_RGB).all()
    assert (lidar_rgb(NOTHING, 0.1, 1.0) == BACKGROUND_RGB).all()
    depth_m = flat(0.3)
    depth_m[5, 6] = np.nan
    is_background = (lidar_rgb(depth_m, 0.1, 1.0) == BACKGROUND_RGB).all(axis=-1)
    assert np.argwhere(is_background).tolist() == [[5, 6]]


def test_lidar_depth_is_red_near_and_blue_far_and_clips_beyond() -> None:
    near, far = lidar_rgb(flat(0.1), 0.1, 1.0)[0, 0], lidar_rgb(flat(1.0), 0.1, 1.0)[0, 0]
    assert near[0] > near[2]
    assert far[2] > far[0]
    np.testing.assert_array_equal(lidar_rgb(flat(9.0), 0.1, 1.0)[0, 0], far)


def test_infrared_keeps_the_order_of_counts_and_its_ends() -> None:
    grey = infrared_grey(np.arange(256, dtype=np.uint8)[None])[0].astype(int)
    assert (grey[0], grey[255]) == (0, 255)
    assert (np.diff(grey) >= 0).all()


def test_the_span_of_a_map_holds_most_of_it_and_exists_without_returns() -> None:
    depth_m = np.linspace(0.2, 1.2, 64 * 64, dtype=np.float32).reshape(64, 64)
    near_m, far_m = depth_span_m(depth_m)
    assert 0.2 <= near_m < 0.25
    assert 1.15 < far_m <= 1.2
    assert depth_span_m(NOTHING) == (0.0, 1.0)


def test_a_full_map_is_one_sheet_inside_the_box() -> None:
    mesh = surface(flat(0.2), BOX)
    assert len(mesh.points_m) == len(mesh.rgb) == 64 * 64
    assert len(mesh.triangles) == 2 * 63 * 63
    assert mesh.triangles.max() == 64 * 64 - 1
    assert (mesh.points_m[:, 0] > BOX.x_min_m).all()
    assert (mesh.points_m[:, 0] < BOX.x_max_m).all()
    np.testing.assert_allclose(mesh.points_m[:, 2], 0.2)


def test_the_sheet_covers_what_its_cells_cover() -> None:
    mesh = surface(flat(0.2), BOX)
    a, b, c = np.moveaxis(mesh.points_m[mesh.triangles].astype(float), 1, 0)
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area_m2 == pytest.approx((0.25 * 63 / 64) ** 2, rel=1e-4)


def test_no_triangle_crosses_a_jump_or_touches_the_background() -> None:
    depth_m = flat(0.2)
    depth_m[:, 32:] += 2 * JUMP_M
    depth_m[:8] = np.nan
    mesh = surface(depth_m, BOX)
    corners_m = mesh.points_m[mesh.triangles][..., 2]
    assert np.isfinite(mesh.points_m).all()
    assert np.ptp(corners_m, axis=1).max() < JUMP_M


def test_nothing_has_no_surface() -> None:
    mesh = surface(NOTHING, BOX)
    assert len(mesh.points_m) == len(mesh.triangles) == len(mesh.rgb) == 0


def test_nearer_is_red_farther_blue_as_expected_grey_and_nothing_dark() -> None:
    near, same, far, beyond, nothing = difference_rgb(np.array([-0.01, 0.0, 0.01, 9.0, np.nan]), 0.01).astype(int)
    assert near[0] > 2 * near[2]
    assert far[2] > 2 * far[0]
    assert np.ptp(same) < 30
    np.testing.assert_array_equal(beyond, far)
    assert tuple(nothing) == BACKGROUND_RGB


def test_a_difference_turns_redder_the_nearer_it_is() -> None:
    redness = np.diff(difference_rgb(np.linspace(-1, 1, 21), 1.0)[:, [2, 0]].astype(int), axis=1)[:, 0]
    assert (np.diff(redness) < 0).all()


def test_noise_is_brighter_the_larger_and_nothing_is_darker_than_none() -> None:
    brightness = noise_rgb(np.array([[np.nan, 0.0, 1.0, 2.0, 3.0]]), 2.0)[0].sum(axis=-1).astype(int)
    assert (np.diff(brightness[:4]) > 0).all()
    assert brightness[4] == brightness[3]


def test_only_the_saturated_has_a_colour() -> None:
    rgb = saturated_rgb(np.array([[0.0, 40.0, 255.0, np.nan]]), np.array([[0.0, 0.0, 0.01, 0.0]]))[0]
    assert tuple(rgb[2]) == SATURATED_RGB
    assert (np.ptp(rgb[[0, 1, 3]], axis=-1) == 0).all()


@given(st.floats(1e-6, 1e6))
def test_a_span_is_round_and_little_more_than_what_it_spans(value: float) -> None:
    span = round_span(np.array([value, -value, np.nan]))
    assert value <= span * (1 + 1e-5)
    assert span <= value * 2 * (1 + 1e-5)
    assert f"{span:e}"[0] in "1235"
    assert float(f"{span:.0e}") == span


def test_a_span_of_nothing_is_what_was_asked_for() -> None:
    assert round_span(np.array([np.nan, np.nan])) == 1.0
    assert round_span(np.zeros(3), otherwise=0.5) == 0.5


def test_the_span_of_a_change_is_of_what_has_changed() -> None:
    off_m = np.full((64, 80), 0.0003, np.float32)
    off_m[3] = np.nan
    assert change_span_m(off_m) == QUIET_SPAN_M
    off_m[:, 40:60] = 0.28
    off_m[:, 78:] = -1.5
    assert change_span_m(off_m) == pytest.approx(0.3)


def test_uncertainty_is_brighter_the_larger_and_shown_only_where_there_is_a_surface() -> None:
    depth_m = flat(0.2)
    depth_m[0] = np.nan
    spread_m = np.linspace(0.0, 2 * MAX_UNCERTAINTY_M, 64, dtype=np.float32) * np.ones((64, 1), np.float32)
    rgb = uncertainty_rgb(spread_m, depth_m)
    assert (rgb[0] == BACKGROUND_RGB).all()
    brightness = rgb[1].sum(axis=-1).astype(int)
    assert (np.diff(brightness) >= -3).all()
    assert brightness[0] > sum(BACKGROUND_RGB)
    assert (rgb[1, 40:] == rgb[1, 63]).all()


def test_an_uncertainty_that_is_not_known_is_the_largest() -> None:
    depth_m, unknown_m = flat(0.2), NOTHING
    assert (uncertainty_rgb(unknown_m, depth_m) == uncertainty_rgb(flat(1.0), depth_m)).all()


def test_confidence_is_brighter_the_higher() -> None:
    rgb = confidence_rgb(np.arange(16, dtype=np.uint8)[None])[0].astype(int)
    assert (np.diff(rgb.sum(axis=-1)) > 0).all()
    np.testing.assert_array_equal(confidence_rgb(np.full((1, 1), 200, np.uint8))[0, 0], rgb[15])


def test_what_is_faded_keeps_its_brightness_and_loses_its_colour() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (9, 9, 3)).astype(np.uint8)
    pale = faded(rgb).astype(float)
    np.testing.assert_allclose(pale.mean(axis=-1), rgb.mean(axis=-1), atol=1.0)
    np.testing.assert_allclose(np.ptp(pale, axis=-1), FADED * np.ptp(rgb.astype(float), axis=-1), atol=1.5)


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3)])
def test_a_picture_is_a_file_of_its_own_that_says_the_same(shape: tuple[int, ...]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encoded(picture, ".png")))), picture)
    smooth = np.full(shape, 90, np.uint8)
    near = np.asarray(Image.open(io.BytesIO(encoded(smooth, ".jpg")))).astype(int)
    assert np.abs(near - smooth).max() <= 2


def test_a_sheets_normals_lead_away_from_the_wall_and_are_the_planes() -> None:
    x = np.linspace(0.0, 1.0, 64, dtype=np.float32)
    slope_m = 0.2 + 0.05 * x * np.ones((64, 1), np.float32)
    mesh = surface(slope_m, BOX)
    across = 0.05 / (0.25 * 63 / 64)
    expected = np.array([-across, 0.0, 1.0]) / np.hypot(across, 1.0)
    np.testing.assert_allclose(mesh.normals, np.broadcast_to(expected, mesh.normals.shape), atol=1e-4)


@given(st.integers(0, 2**32 - 1))
def test_normals_are_of_length_one(seed: int) -> None:
    depth_m = (0.2 + np.random.default_rng(seed).uniform(0, 0.01, (64, 64))).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(surface(depth_m, BOX).normals, axis=1), 1.0, atol=1e-5)


def test_a_relief_is_lit_from_the_top_left_and_dark_where_there_is_nothing() -> None:
    y, x = np.mgrid[:64, :64]
    hill_m = (0.3 - 0.1 * np.exp(-((x - 32) ** 2 + (y - 32) ** 2) / 200)).astype(np.float32)
    brightness = relief_rgb(hill_m, BOX).sum(axis=-1).astype(int)
    assert brightness[24, 24] > brightness[40, 40]
    assert (relief_rgb(NOTHING, BOX) == BACKGROUND_RGB).all()
