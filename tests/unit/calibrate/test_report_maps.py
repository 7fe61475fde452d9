import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import MeasuredWall, depth_noise_m, wall_depth
from page_reader import decoded

from nlos_cam.calibrate.report_maps import (
    block_majority,
    block_side,
    expected_std_m,
    in_blocks,
    residual_m,
    wall_maps,
)
from nlos_cam.report import Picture, figure_of, png

FLOAT32_M = 1e-6


@pytest.fixture(scope="module")
def wall(measured: Callable[..., MeasuredWall]) -> MeasuredWall:
    return measured()


def maps(wall: MeasuredWall, **changes: np.ndarray) -> list[Picture]:
    """Return residual, spread, noise and infrared of a wall some of whose maps are others."""
    typed = {
        name: values if values.dtype == bool else values.astype(np.float32)
        for name, values in changes.items()
    }
    return wall_maps(wall.record, replace(wall.reference, **typed))


def red_and_blue(picture: Picture) -> tuple[float, float]:
    """Return the shares of the picture, without its colour bar, that are clearly red and clearly
    blue.
    """
    image = decoded(picture.png)
    image = image[:, : int(0.82 * image.shape[1])]
    redness = image[..., 0] - image[..., 2]
    return float((redness > 90).mean()), float((redness < -90).mean())


def test_maps_of_an_exact_plane_are_pale(wall: MeasuredWall) -> None:
    residual, spread, noise, _ = maps(wall)

    assert red_and_blue(residual) == (0.0, 0.0)
    assert not re.search("%|board", residual.caption)
    assert "0.000 mm" in spread.caption
    assert "1.00 " in noise.caption


def test_maps_have_pictures(wall: MeasuredWall) -> None:
    _, *pictures = maps(wall)
    assert all(decoded(picture.png).std() > 1.0 for picture in pictures)


def test_residual_map_names_a_plane_of_the_board(wall: MeasuredWall) -> None:
    refused = MeasuredWall(wall.record.model_copy(update={"residual_m": None}), wall.reference)
    assert "board" in maps(refused)[0].caption


def test_png_has_a_hundred_pixels_per_inch() -> None:
    assert decoded(png(figure_of(3.0, 2.0))).shape == (200, 300, 3)


@pytest.mark.slow
@pytest.mark.parametrize("bump_m", [0.01, -0.01])
def test_residual_map_is_red_behind_the_plane_else_blue(wall: MeasuredWall, bump_m: float) -> None:
    depth_m = wall.reference.depth_m.copy()
    depth_m[:, 16:32] += bump_m
    drawn, other = red_and_blue(maps(wall, depth_m=depth_m)[0])[:: 1 if bump_m > 0.0 else -1]

    assert 0.1 < drawn < 0.3
    assert other == 0.0


@pytest.mark.slow
def test_residual_map_stripes_what_was_left_out(wall: MeasuredWall) -> None:
    depth_m = wall.reference.depth_m.copy()
    inliers = wall.reference.inliers.copy()
    depth_m[:, 16:32] += 0.01
    inliers[:, 16:32] = False
    depth_m[:12] = np.nan
    residual = maps(wall, depth_m=depth_m, inliers=inliers)[0]

    assert red_and_blue(residual) == (0.0, 0.0)
    assert "18.8 %" in residual.caption
    assert "25.0 %" in residual.caption


@pytest.mark.slow
def test_residual_map_without_a_plane_is_striped_all_over(wall: MeasuredWall) -> None:
    residual, spread, *_ = maps(wall, inliers=np.zeros_like(wall.reference.inliers))

    assert residual.png is not None
    assert "100.0 %" in residual.caption
    assert spread.png is None


@pytest.mark.slow
def test_spread_map_separates_ripples_from_noise(wall: MeasuredWall) -> None:
    rippled_m = wall.reference.depth_m + 0.002 * np.sin(np.arange(64) / 4.0)
    spread = maps(wall, depth_m=rippled_m)[1]

    assert 0.8 < float(spread.caption.split(" mm RMS")[0].rsplit(" ", 1)[1]) < 1.45
    assert "60 frames" in spread.caption


def test_wall_maps_without_data_have_no_picture(wall: MeasuredWall) -> None:
    nothing = np.full_like(wall.reference.depth_m, np.nan)
    shown = maps(
        wall,
        depth_m=nothing,
        depth_std_m=nothing,
        ir=nothing,
        inliers=np.zeros(nothing.shape, bool),
    )

    assert [picture.png for picture in shown] == [None] * 4
    assert all(picture.caption.endswith(".") for picture in shown)


def test_noise_map_needs_two_samples_of_a_pixel(wall: MeasuredWall) -> None:
    nothing = np.full_like(wall.reference.depth_m, np.nan)
    residual, _, noise, _ = maps(wall, depth_std_m=nothing)

    assert residual.png is not None
    assert noise.png is None


@pytest.mark.slow
def test_infrared_map_draws_saturation_if_any(wall: MeasuredWall) -> None:
    bare = maps(wall)[3]
    share = np.zeros_like(wall.reference.saturated)
    share[:, :16] = 0.1
    share[:, :8] = 0.9
    blinded = maps(wall, saturated=share)[3]

    assert "48 of 255" in bare.caption
    assert "25.0 %" in blinded.caption
    assert "12.5 %" in blinded.caption
    assert decoded(blinded.png).shape[1] > decoded(bare.png).shape[1]


@pytest.mark.slow
def test_infrared_map_does_not_round_one_pixel_to_none(wall: MeasuredWall) -> None:
    share = np.zeros_like(wall.reference.saturated)
    share[5, 5] = 1.0

    assert "0.1 %" in maps(wall, saturated=share)[3].caption


def seen(wall: MeasuredWall, depth_m: np.ndarray, **others: object) -> np.ndarray:
    reference = replace(wall.reference, depth_m=depth_m.astype(np.float32))
    return residual_m(wall.record.model_copy(update=others), reference)


@pytest.mark.parametrize(
    ("distance_m", "yaw_deg", "pitch_deg"), [(0.15, 15.0, 0.0), (0.2, -45.0, 10.0), (0.3, 75, -5)]
)
def test_residual_is_the_height_above_the_plane(
    measured: Callable[..., MeasuredWall], distance_m: float, yaw_deg: float, pitch_deg: float
) -> None:
    wall = measured(distance_m, yaw_deg, pitch_deg)
    reference = wall.reference
    part = np.s_[10:20, 10:20]
    moved = np.array(wall.record.wall_from_lidar)
    depth_m = reference.depth_m.astype(np.float64)
    near = reference.depth_m < 2.0
    for bump_m in (0.0, 0.004, -0.004):
        moved[2, 3] = wall.record.distance_m + bump_m
        depth_m[part] = wall_depth(moved, reference.intrinsics)[part]
        off_m = seen(wall, depth_m)
        assert (np.isnan(off_m) == np.isnan(reference.depth_m)).all()
        off_m[part] -= bump_m
        assert np.abs(off_m[near]).max() < FLOAT32_M


@pytest.mark.parametrize("cause", ["depth", "origin"])
@pytest.mark.parametrize("offset_m", [0.0045, -0.0045])
def test_residual_allows_for_the_range_offset(
    wall: MeasuredWall, offset_m: float, cause: str
) -> None:
    reference = wall.reference
    depth_m = reference.depth_m.astype(np.float64) - offset_m
    if cause == "origin":
        meeting = np.array(wall.record.wall_from_lidar)
        meeting[:3, 3] += offset_m * meeting[:3, 2]
        depth_m = wall_depth(meeting, reference.intrinsics)
    offset = {"range_offset_m": offset_m, "range_offset_cause": cause}
    near = reference.depth_m < 2.0

    assert np.abs(seen(wall, depth_m, **offset)[near]).max() < FLOAT32_M
    assert np.abs(seen(wall, depth_m)[near]).max() > 0.003


def test_residual_of_noise_has_the_expected_spread(measured: Callable[..., MeasuredWall]) -> None:
    wall = measured(width=160)
    depth_m = wall.reference.depth_m.astype(np.float64)
    noise_m = depth_noise_m(depth_m) / np.sqrt(wall.reference.frames)
    off_m = seen(wall, depth_m + noise_m * np.random.default_rng(0).standard_normal(depth_m.shape))
    sigmas = off_m / expected_std_m(wall.record, wall.reference)

    assert sigmas.std() == pytest.approx(1.0, abs=0.02)
    assert [sigmas[:, :40].std(), sigmas[:, -40:].std()] == pytest.approx([1.0, 1.0], abs=0.04)


def test_blocks_are_means_of_known_pixels_and_majorities() -> None:
    values = np.array([[1.0, 3.0, np.nan], [np.nan, 5.0, np.nan], [7.0, 9.0, 11.0]])

    np.testing.assert_allclose(in_blocks(values, 2), [[3.0, np.nan], [8.0, 11.0]])
    np.testing.assert_array_equal(in_blocks(values, 1), values)
    assert [block_side(columns) for columns in (16, 320, 321, 640, 1024)] == [1, 1, 2, 2, 4]

    mask = np.array([[True, True, False, True], [False, False, False, False]])

    assert block_majority(mask, 2).tolist() == [[True, False]]
