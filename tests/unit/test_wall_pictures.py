from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from nlos_calibration.reference import BareWall
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.calibrate.report_maps import Picture, figure_of, png, wall_maps

Measured = Callable[..., MeasuredWall]


def decoded(picture: Picture) -> np.ndarray:
    """The picture's pixels (height, width, 3), red first."""
    assert picture.png is not None
    return cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def maps(wall: MeasuredWall, **changes: np.ndarray) -> list[Picture]:
    """Residual, spread, noise, infrared of a wall some of whose maps are others."""
    assert isinstance(wall.reference, BareWall)
    typed = {name: values if values.dtype == bool else values.astype(np.float32) for name, values in changes.items()}
    return wall_maps(wall.record, replace(wall.reference, **typed))


def red_and_blue(picture: Picture) -> tuple[float, float]:
    """Shares of the map's part of the picture, without its colour bar, that are clearly red and clearly blue."""
    image = decoded(picture)
    image = image[:, : int(0.82 * image.shape[1])]
    redness = image[..., 0] - image[..., 2]
    return float((redness > 90).mean()), float((redness < -90).mean())


def test_a_figure_becomes_a_png_of_its_size() -> None:
    figure = figure_of(3.0, 2.0)
    assert decoded(Picture("", "", png(figure))).shape == (200, 300, 3)


def test_an_exact_plane_is_drawn_pale(measured: Measured) -> None:
    residual, spread, noise, infrared = maps(measured())
    assert red_and_blue(residual) == (0.0, 0.0)
    assert "striped): none of the pixels; without return: none." in residual.caption
    assert "0.000 mm RMS" in spread.caption
    assert "1.00 times the nominal" in noise.caption
    assert all(decoded(picture).std() > 1.0 for picture in (spread, noise, infrared))


@pytest.mark.parametrize(("bump_m", "colour", "other"), [(0.01, 0, 1), (-0.01, 1, 0)])
def test_a_bump_is_red_behind_the_plane_and_blue_before_it(
    measured: Measured, bump_m: float, colour: int, other: int
) -> None:
    wall = measured()
    assert wall.reference is not None
    depth_m = wall.reference.depth_m.copy()
    depth_m[:, 16:32] += bump_m
    residual = maps(wall, depth_m=depth_m)[0]
    drawn = red_and_blue(residual)
    assert 0.1 < drawn[colour] < 0.3
    assert drawn[other] == 0.0


def test_what_was_left_out_is_striped_and_not_coloured(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    depth_m, inliers = wall.reference.depth_m.copy(), wall.reference.inliers.copy()
    depth_m[:, 16:32] += 0.01
    inliers[:, 16:32] = False
    depth_m[:12] = np.nan
    residual = maps(wall, depth_m=depth_m, inliers=inliers)[0]
    assert red_and_blue(residual) == (0.0, 0.0)
    assert "striped): 18.8 % of the pixels; without return: 25.0 %." in residual.caption


def test_the_spread_tells_ripples_from_noise(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    rippled_m = wall.reference.depth_m + 0.002 * np.sin(np.arange(64) / 4.0)
    spread = maps(wall, depth_m=rippled_m)[1]
    found = float(spread.caption.split(" mm RMS")[0].rsplit(" ", 1)[1])
    assert 0.8 < found < 1.45
    assert "60 frames" in spread.caption


def test_a_wall_without_returns_is_told_in_words(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    nothing = np.full_like(wall.reference.depth_m, np.nan)
    shown = maps(wall, depth_m=nothing, depth_std_m=nothing, ir=nothing, inliers=np.zeros(nothing.shape, bool))
    assert [picture.png for picture in shown] == [None] * 4
    assert all(picture.caption.endswith(".") for picture in shown)


def test_a_wall_no_pixel_of_which_is_used_still_shows_where_it_is_off(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    residual, spread, *_ = maps(wall, inliers=np.zeros_like(wall.reference.inliers))
    assert residual.png is not None
    assert "striped): 100.0 % of the pixels" in residual.caption
    assert spread.png is None


def test_depth_without_a_spread_has_no_noise(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    residual, _, noise, _ = maps(wall, depth_std_m=np.full_like(wall.reference.depth_m, np.nan))
    assert (residual.png is None, noise.png is None) == (False, True)


def test_depth_of_a_refused_wall_is_said_to_be_off_the_boards_plane(measured: Measured) -> None:
    wall = measured()
    refused = MeasuredWall(wall.record.model_copy(update={"residual_m": None}), wall.reference)
    assert "the plane is the board's" in maps(refused)[0].caption
    assert "the plane is the board's" not in maps(wall)[0].caption


def test_saturation_is_drawn_where_there_is_any(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    bare = maps(wall)[3]
    assert bare.caption == "No pixel is saturated: the brightest is 48 of 255 counts on average."
    share = np.zeros_like(wall.reference.saturated)
    share[:, :16], share[:, :8] = 0.1, 0.9
    blinded = maps(wall, saturated=share)[3]
    assert "25.0 % of the pixels were at full scale in some frame, 12.5 % in half" in blinded.caption
    assert decoded(blinded).shape[1] > decoded(bare).shape[1]


def test_one_saturated_pixel_is_not_rounded_away(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    share = np.zeros_like(wall.reference.saturated)
    share[5, 5] = 1.0
    assert "less than 0.1 % of the pixels were at full scale" in maps(wall, saturated=share)[3].caption
