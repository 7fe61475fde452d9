import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, MIN_CORNERS, even_contrast, find_corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.rig import load_rig

TOOLS = Path(__file__).parents[2] / "tools"
PINHOLE = load_rig("bare-wall").pinhole
A4 = BOARDS["a4"]


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_view")


@pytest.fixture
def clean(views: ModuleType) -> Float64:
    """A noiseless view at 0.2 m and 45 degrees."""
    return of_bench(views)[0]


def of_bench(views: ModuleType, **light: float) -> tuple[Float64, Float64]:
    """A noiseless view, and where its corners are."""
    seen = views.View(load_rig("bare-wall").wall_from_lidar, PINHOLE)
    placed = views.at_near_edge(A4, seen)
    return views.clean_view(A4, seen, placed, views.Light(**light)), views.corners_px(A4, seen, placed)


def test_corners_are_found_to_a_fraction_of_a_pixel(views: ModuleType) -> None:
    clean, true_px = of_bench(views)
    mean = views.frames_of(clean, np.random.default_rng(1), 30).mean(axis=0)
    found = find_corners(mean, A4)
    assert len(found.ids) >= 25
    errors_px = found.pixels - true_px[found.ids]
    assert np.sqrt(np.mean(errors_px**2)) < 0.15
    assert np.abs(np.median(errors_px, axis=0)).max() < 0.1


@pytest.mark.parametrize("counts", [6.0, 24.0, 200.0, 600.0])
def test_dim_and_washed_out_frames_still_show_the_board(views: ModuleType, counts: float) -> None:
    clean, true_px = of_bench(views, brightest_counts=counts)
    mean = views.frames_of(clean, np.random.default_rng(1), 30).mean(axis=0)
    found = find_corners(mean, A4)
    assert len(found.ids) >= 20
    assert np.median(np.linalg.norm(found.pixels - true_px[found.ids], axis=1)) < 0.3


@pytest.mark.parametrize("gain", [0.01, 0.5, 5.0, 1000.0])
def test_the_gain_of_an_image_does_not_matter(views: ModuleType, clean: Float64, gain: float) -> None:
    mean = views.frames_of(clean, np.random.default_rng(1), 30).mean(axis=0)
    one, other = find_corners(mean, A4), find_corners(gain * mean, A4)
    np.testing.assert_array_equal(one.ids, other.ids)
    np.testing.assert_allclose(one.pixels, other.pixels, atol=0.02)


def test_the_mean_shows_what_a_single_dim_frame_does_not(views: ModuleType) -> None:
    clean, _ = of_bench(views, brightest_counts=3.0)
    frames = views.frames_of(clean, np.random.default_rng(1), 60)
    with pytest.raises(BoardRefusedError):
        find_corners(frames[0], A4)
    assert len(find_corners(frames.mean(axis=0), A4).ids) >= 16


def test_contrast_is_made_even_over_the_falloff(clean: Float64) -> None:
    lit = clean > 0.5
    near, far = lit.copy(), lit.copy()
    near[:, 320:], far[:, :320] = False, False
    before = np.ptp(clean[near]) / np.ptp(clean[far])
    even = even_contrast(clean).astype(float)
    assert np.ptp(even[near]) / np.ptp(even[far]) < 0.5 * before


def test_a_mirrored_board_is_told_from_none(clean: Float64) -> None:
    with pytest.raises(BoardRefusedError, match="mirrored"):
        find_corners(clean[:, ::-1] + np.random.default_rng(0).normal(0.0, 0.1, clean.shape), A4)


@pytest.mark.parametrize("value", [0, 17, 255])
def test_an_image_without_a_board_is_refused(value: int) -> None:
    with pytest.raises(BoardRefusedError, match=r"no board .* toner"):
        find_corners(np.full((480, 640), value, np.uint8), A4)


def test_the_advice_is_for_the_light_that_was_looked_in() -> None:
    with pytest.raises(BoardRefusedError, match=r"no board .* in colour: .* light the room"):
        find_corners(np.zeros((480, 640), np.uint8), A4, "colour")


def test_too_little_of_a_board_is_refused_with_what_was_seen(views: ModuleType, clean: Float64) -> None:
    noisy = views.frames_of(clean, np.random.default_rng(1), 30).mean(axis=0)
    noisy[:, 150:] = 0.0
    with pytest.raises(BoardRefusedError, match=rf"^\d corners of .* markers\), {MIN_CORNERS} needed"):
        find_corners(noisy, A4)


def test_another_board_is_not_taken_for_this_one(clean: Float64) -> None:
    with pytest.raises(BoardRefusedError):
        find_corners(clean, BOARDS["a3"].model_copy(update={"dictionary": "DICT_4X4_250", "squares_x": 5}))
