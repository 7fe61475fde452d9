import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig
from PIL import Image

from nlos_cam.objects.depth_map import object_box
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.images import (
    BACKGROUND_RGB,
    BANNER_HEIGHT,
    BANNER_WIDTH,
    FADED,
    JUMP_M,
    MAX_UNCERTAINTY_M,
    QUIET_SPAN_M,
    SATURATED_RGB,
    STYLES,
    banner_rgb,
    change_span_m,
    confidence_rgb,
    depth_span_m,
    difference_rgb,
    dim_untrusted,
    encoded,
    faded,
    hidden_rgb,
    infrared_grey,
    is_trusted,
    lidar_rgb,
    noise_rgb,
    note_rgba,
    relief_rgb,
    round_span,
    saturated_rgb,
    style_of,
    surface,
    uncertainty_rgb,
)

BOX = object_box(load_rig("paper-rig"))
NOTHING = np.full((64, 64), np.nan, np.float32)


def flat(z_m: float) -> np.ndarray:
    return np.full((64, 64), z_m, np.float32)


@pytest.mark.parametrize(
    "rgb",
    [
        np.concatenate([hidden_rgb(flat(z_m), BOX)[:1, :1] for z_m in (np.nan, 0.4, 0.25, 0.13)], axis=1),
        noise_rgb(np.array([[np.nan, 0.0, 1.0, 2.0]]), 2.0),
        confidence_rgb(np.arange(16, dtype=np.uint8)[None]),
    ],
    ids=["hidden depth, nearer", "noise, larger", "confidence, higher"],
)
def test_picture_is_brighter_the_larger_its_value(rgb: np.ndarray) -> None:
    assert (np.diff(rgb[0].sum(axis=-1).astype(int)) > 0).all()


def test_depth_pictures_show_missing_depth_as_background() -> None:
    assert (hidden_rgb(NOTHING, BOX) == BACKGROUND_RGB).all()
    assert (lidar_rgb(NOTHING, 0.1, 1.0) == BACKGROUND_RGB).all()
    depth_m = flat(0.3)
    depth_m[5, 6] = np.nan
    is_background = (lidar_rgb(depth_m, 0.1, 1.0) == BACKGROUND_RGB).all(axis=-1)
    assert np.argwhere(is_background).tolist() == [[5, 6]]


def test_lidar_rgb_is_red_near_and_blue_far() -> None:
    near, far = lidar_rgb(flat(0.1), 0.1, 1.0)[0, 0], lidar_rgb(flat(1.0), 0.1, 1.0)[0, 0]
    assert near[0] > near[2]
    assert far[2] > far[0]


def test_infrared_grey_keeps_order_and_ends_of_counts() -> None:
    grey = infrared_grey(np.arange(256, dtype=np.uint8)[None])[0].astype(int)
    assert (grey[0], grey[255]) == (0, 255)
    assert (np.diff(grey) >= 0).all()


def test_surface_of_a_full_map_is_one_sheet_inside_the_box() -> None:
    mesh = surface(flat(0.2), BOX)
    assert len(mesh.points_m) == len(mesh.rgb) == 64 * 64
    assert len(mesh.triangles) == 2 * 63 * 63
    assert mesh.triangles.max() == 64 * 64 - 1
    assert (mesh.points_m[:, 0] > BOX.x_min_m).all()
    assert (mesh.points_m[:, 0] < BOX.x_max_m).all()
    np.testing.assert_allclose(mesh.points_m[:, 2], 0.2)
    a, b, c = np.moveaxis(mesh.points_m[mesh.triangles].astype(float), 1, 0)
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area_m2 == pytest.approx((0.25 * 63 / 64) ** 2, rel=1e-4)
    empty = surface(NOTHING, BOX)
    assert len(empty.points_m) == len(empty.triangles) == len(empty.rgb) == 0


def test_surface_has_no_triangle_across_a_jump_or_a_gap() -> None:
    depth_m = flat(0.2)
    depth_m[:, 32:] += 2 * JUMP_M
    depth_m[:8] = np.nan
    mesh = surface(depth_m, BOX)
    assert np.isfinite(mesh.points_m).all()
    assert np.ptp(mesh.points_m[mesh.triangles][..., 2], axis=1).max() < JUMP_M


def test_difference_rgb_is_red_nearer_grey_same_and_blue_farther() -> None:
    near, same, far, nothing = difference_rgb(np.array([-0.01, 0.0, 0.01, np.nan]), 0.01).astype(int)
    assert near[0] > 2 * near[2]
    assert far[2] > 2 * far[0]
    assert np.ptp(same) < 30
    assert tuple(nothing) == BACKGROUND_RGB
    redness = np.diff(difference_rgb(np.linspace(-1, 1, 21), 1.0)[:, [2, 0]].astype(int), axis=1)[:, 0]
    assert (np.diff(redness) < 0).all()


def test_saturated_rgb_colors_saturated_pixels_only() -> None:
    rgb = saturated_rgb(np.array([[0.0, 40.0, 255.0, np.nan]]), np.array([[0.0, 0.0, 0.01, 0.0]]))[0]
    assert tuple(rgb[2]) == SATURATED_RGB
    assert (np.ptp(rgb[[0, 1, 3]], axis=-1) == 0).all()


@given(st.floats(1e-6, 1e6))
def test_round_span_is_round_and_little_larger_than_the_values(value: float) -> None:
    span = round_span(np.array([value, -value, np.nan]))
    assert value <= span * (1 + 1e-5)
    assert span <= value * 2 * (1 + 1e-5)
    assert f"{span:e}"[0] in "1235"
    assert float(f"{span:.0e}") == span


def test_spans_ignore_what_is_missing_or_has_not_changed() -> None:
    depth_m = np.linspace(0.2, 1.2, 64 * 64, dtype=np.float32).reshape(64, 64)
    near_m, far_m = depth_span_m(depth_m)
    assert 0.2 <= near_m < 0.25
    assert 1.15 < far_m <= 1.2
    assert depth_span_m(NOTHING) == (0.0, 1.0)
    off_m = np.full((64, 80), 0.0003, np.float32)
    off_m[3] = np.nan
    assert change_span_m(off_m) == QUIET_SPAN_M
    off_m[:, 40:60] = 0.28
    off_m[:, 78:] = -1.5
    assert change_span_m(off_m) == pytest.approx(0.3)
    assert round_span(np.array([np.nan, np.nan])) == 1.0
    assert round_span(np.zeros(3), otherwise=0.5) == 0.5


def test_uncertainty_rgb_is_brighter_the_larger_on_the_surface() -> None:
    depth_m = flat(0.2)
    depth_m[0] = np.nan
    spread_m = np.linspace(0.0, 2 * MAX_UNCERTAINTY_M, 64, dtype=np.float32) * np.ones((64, 1), np.float32)
    rgb = uncertainty_rgb(spread_m, depth_m)
    assert (rgb[0] == BACKGROUND_RGB).all()
    brightness = rgb[1].sum(axis=-1).astype(int)
    assert (np.diff(brightness) >= -3).all()
    assert brightness[0] > sum(BACKGROUND_RGB)
    assert (rgb[1, 40:] == rgb[1, 63]).all()
    assert (uncertainty_rgb(NOTHING, depth_m) == uncertainty_rgb(flat(1.0), depth_m)).all(), "unknown is the largest"


def test_pictures_clip_values_beyond_their_span() -> None:
    np.testing.assert_array_equal(noise_rgb(flat(3.0), 2.0), noise_rgb(flat(2.0), 2.0))
    np.testing.assert_array_equal(lidar_rgb(flat(9.0), 0.1, 1.0), lidar_rgb(flat(1.0), 0.1, 1.0))
    np.testing.assert_array_equal(difference_rgb(flat(9.0), 0.01), difference_rgb(flat(0.01), 0.01))
    clipped, highest = (confidence_rgb(np.full((1, 1), value, np.uint8)) for value in (200, 15))
    np.testing.assert_array_equal(clipped, highest)


def test_faded_keeps_brightness_and_loses_color() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (9, 9, 3)).astype(np.uint8)
    pale = faded(rgb).astype(float)
    np.testing.assert_allclose(pale.mean(axis=-1), rgb.mean(axis=-1), atol=1.0)
    np.testing.assert_allclose(np.ptp(pale, axis=-1), FADED * np.ptp(rgb.astype(float), axis=-1), atol=1.5)


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3)])
def test_encoded_picture_decodes_to_itself(shape: tuple[int, ...]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encoded(picture, ".png")))), picture)
    smooth = np.full(shape, 90, np.uint8)
    near = np.asarray(Image.open(io.BytesIO(encoded(smooth, ".jpg")))).astype(int)
    assert np.abs(near - smooth).max() <= 2


def test_surface_normals_are_those_of_the_plane() -> None:
    x = np.linspace(0.0, 1.0, 64, dtype=np.float32)
    slope_m = 0.2 + 0.05 * x * np.ones((64, 1), np.float32)
    mesh = surface(slope_m, BOX)
    across = 0.05 / (0.25 * 63 / 64)
    expected = np.array([-across, 0.0, 1.0]) / np.hypot(across, 1.0)
    np.testing.assert_allclose(mesh.normals, np.broadcast_to(expected, mesh.normals.shape), atol=1e-4)


@given(st.integers(0, 2**32 - 1))
def test_surface_normals_have_length_one(seed: int) -> None:
    depth_m = (0.2 + np.random.default_rng(seed).uniform(0, 0.01, (64, 64))).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(surface(depth_m, BOX).normals, axis=1), 1.0, atol=1e-5)


def test_relief_rgb_is_lit_from_the_top_left() -> None:
    y, x = np.mgrid[:64, :64]
    hill_m = (0.3 - 0.1 * np.exp(-((x - 32) ** 2 + (y - 32) ** 2) / 200)).astype(np.float32)
    brightness = relief_rgb(hill_m, BOX).sum(axis=-1).astype(int)
    assert brightness[24, 24] > brightness[40, 40]
    assert (relief_rgb(NOTHING, BOX) == BACKGROUND_RGB).all()


DOUBTED = [verdict for verdict in Verdict if verdict is not Verdict.SEEN]


def test_only_the_verdict_seen_looks_trusted() -> None:
    assert set(STYLES) == set(Verdict)
    assert [verdict for verdict in Verdict if is_trusted(verdict)] == [Verdict.SEEN]
    assert is_trusted(None), "without an uncertainty network nothing is dimmed"
    assert all(
        style.rgb != STYLES[Verdict.SEEN].rgb for verdict, style in STYLES.items() if verdict is not Verdict.SEEN
    )


@pytest.mark.parametrize("verdict", [*Verdict, None])
def test_banner_has_its_verdicts_color_and_fitting_words(verdict: Verdict | None) -> None:
    banner = banner_rgb(verdict)
    assert banner.shape == (BANNER_HEIGHT, BANNER_WIDTH, 3)
    assert tuple(banner[40, 5]) == style_of(verdict).rgb
    ground = banner[0, -1]
    assert (banner[:, -20:] == ground).all(), "nothing is written up to the edge"
    assert (banner[:, 30:600] != ground).any()
    others = [other for other in (*Verdict, None) if other is not verdict]
    assert not any((banner_rgb(other) == banner).all() for other in others)


@pytest.mark.parametrize("verdict", DOUBTED)
def test_note_frames_the_picture_and_hatches_doubted_ones(verdict: Verdict) -> None:
    note = note_rgba(verdict)
    frame = np.concatenate([note[0], note[-1], note[:, 0], note[:, -1]])
    assert (frame == (*style_of(verdict).rgb, 255)).all()
    assert (note[..., 3] > 200).mean() < 0.25
    assert (note[20:200, 20:200, 3] > 0).any() == (verdict is not Verdict.NOTHING)


def test_picture_under_a_note_keeps_its_place_and_loses_color() -> None:
    rgb = np.full((64, 64, 3), BACKGROUND_RGB, np.uint8)
    rgb[10:20, 30:40] = 255, 160, 0
    assert dim_untrusted(rgb, None) is dim_untrusted(rgb, Verdict.SEEN) is rgb
    noted = dim_untrusted(rgb, Verdict.NOTHING).astype(int)
    assert noted.shape == (512, 512, 3)
    inside, outside = noted[100, 300], noted[40, 40]
    assert inside.sum() > outside.sum() + 200
    assert np.ptp(inside) < 100
