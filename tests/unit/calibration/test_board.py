import numpy as np
import pytest
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, MIN_CORNERS, Board, find_corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.rig import load_rig
from pydantic import ValidationError
from synthetic_scenes import Illumination, at_near_edge, clean_infrared, corners_px, infrared_frames

from nlos_cam.calibrate.synthetic import View

SMALL = {"squares_x": 4, "squares_y": 5, "square_mm": 20.0, "marker_mm": 15.0}
A4 = BOARDS["a4"]
PINHOLE = load_rig("bare-wall").pinhole


def of_bench(**light: float) -> tuple[Float64, Float64]:
    """A noiseless view at 0.2 m and 45 degrees, and where its corners are."""
    seen = View(load_rig("bare-wall").wall_from_lidar, PINHOLE)
    placed = at_near_edge(A4, seen)
    return clean_infrared(A4, seen, placed, Illumination(**light)), corners_px(A4, seen, placed)


def mean_of(clean: Float64, frames: int = 30) -> Float64:
    return infrared_frames(clean, np.random.default_rng(1), frames).mean(axis=0)


@pytest.fixture(scope="module")
def clean() -> Float64:
    return of_bench()[0]


def test_measured_board_is_the_same_board_scaled() -> None:
    board = BOARDS["a4"].measured(29.1)
    np.testing.assert_allclose(board.corners_m, 0.97 * BOARDS["a4"].corners_m, atol=1e-8)
    assert board.marker_mm / board.square_mm == pytest.approx(0.75)
    np.testing.assert_array_equal(board.pattern(32), BOARDS["a4"].pattern(32))


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"marker_mm": 20.0}, "marker_mm"),
        ({"squares_x": 11, "squares_y": 11}, "60"),
        ({"color": "red"}, "color"),
    ],
)
def test_board_that_cannot_exist_is_refused(changed: dict[str, object], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        Board.model_validate(SMALL | changed)


@pytest.mark.parametrize(("counts", "least", "error_px"), [(None, 25, 0.15), (6.0, 20, 0.3), (600.0, 20, 0.3)])
def test_find_corners_locates_them_at_any_brightness(counts: float | None, least: int, error_px: float) -> None:
    clean, true_px = of_bench() if counts is None else of_bench(brightest_counts=counts)
    found = find_corners(mean_of(clean), A4)
    assert len(found.ids) >= least
    errors_px = found.pixels - true_px[found.ids]
    assert np.median(np.linalg.norm(errors_px, axis=1)) < error_px
    assert counts or np.sqrt(np.mean(errors_px**2)) < error_px
    assert counts or np.abs(np.median(errors_px, axis=0)).max() < 0.1


@pytest.mark.slow
def test_find_corners_needs_the_mean_of_dim_frames() -> None:
    frames = infrared_frames(of_bench(brightest_counts=3.0)[0], np.random.default_rng(1), 60)
    with pytest.raises(BoardRefusedError):
        find_corners(frames[0], A4)
    assert len(find_corners(frames.mean(axis=0), A4).ids) >= 16


@pytest.mark.parametrize("value", [0, 17, 255])
def test_find_corners_without_a_board_advises_on_the_light(value: int) -> None:
    blank = np.full((480, 640), value, np.uint8)
    with pytest.raises(BoardRefusedError, match="toner"):
        find_corners(blank, A4)
    with pytest.raises(BoardRefusedError, match="in colour"):
        find_corners(blank, A4, "colour")


def test_find_corners_refuses_mirrored_hidden_and_other_boards(clean: Float64) -> None:
    mirrored = clean[:, ::-1] + np.random.default_rng(0).normal(0.0, 0.1, clean.shape)
    with pytest.raises(BoardRefusedError, match="mirrored"):
        find_corners(mirrored, A4)
    hidden = mean_of(clean)
    hidden[:, 150:] = 0.0
    with pytest.raises(BoardRefusedError, match=rf"^\d corners .*{MIN_CORNERS} "):
        find_corners(hidden, A4)
    with pytest.raises(BoardRefusedError):
        find_corners(clean, BOARDS["a3"].model_copy(update={"dictionary": "DICT_4X4_250", "squares_x": 5}))
