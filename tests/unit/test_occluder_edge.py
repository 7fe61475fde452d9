import numpy as np
import pytest
from nlos_calibration.occluder import find_edge, rows_of
from numpy.typing import NDArray

ROWS, COLUMNS = 40, 100
PITCH_M = 0.002
Y_M = np.linspace(-0.1, 0.1, ROWS)


def met() -> NDArray[np.float64]:
    """A sheet of which each pixel sees 2 mm more of height than the one before."""
    height_m, y_m = np.meshgrid(PITCH_M * np.arange(COLUMNS), Y_M)
    return np.stack([np.full_like(y_m, 0.2), y_m, height_m], axis=-1)


def labels(edge_m: NDArray[np.float64] | float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Sheet and what passed it, by an edge for each row."""
    sheet = met()[..., 2] >= np.broadcast_to(edge_m, ROWS)[:, np.newaxis]
    return sheet, ~sheet


@pytest.mark.parametrize("edge_m", [0.0501, 0.0511, 0.0519])
def test_the_edge_is_within_half_a_pixel_wherever_it_is_in_it(edge_m: float) -> None:
    edge = find_edge(met(), *labels(edge_m))
    assert edge is not None
    assert abs(edge.gap_m - edge_m) <= PITCH_M / 2
    assert edge.gap_std_m == pytest.approx(PITCH_M / np.sqrt(12))
    assert edge.rows == ROWS


def test_a_slanting_edge_is_a_line() -> None:
    edge = find_edge(met(), *labels(0.06 + 0.05 * Y_M))
    assert edge is not None
    assert edge.slope == pytest.approx(0.05, abs=0.005)
    assert edge.gap_m == pytest.approx(0.06, abs=5e-4)


def test_pixels_that_mix_both_widen_the_bracket_and_do_not_shift_it() -> None:
    sheet, passed = labels(0.0601)
    first = sheet.argmax(axis=1)[0]
    passed[:, first - 1], sheet[:, first] = False, False
    edge = find_edge(met(), sheet, passed)
    assert edge is not None
    assert edge.gap_m == pytest.approx(PITCH_M * (first - 0.5))
    assert edge.gap_std_m == pytest.approx(3 * PITCH_M / np.sqrt(12))


def test_strays_on_either_side_and_rows_that_are_off_do_not_move_it() -> None:
    generator = np.random.default_rng(3)
    sheet, passed = labels(0.0601)
    stray = generator.random(sheet.shape) < 0.1
    sheet, passed = sheet ^ stray, passed ^ stray
    sheet[:6], passed[:6] = labels(0.09)[0][:6], labels(0.09)[1][:6]
    edge = find_edge(met(), sheet, passed)
    assert edge is not None
    assert abs(edge.gap_m - 0.0601) < PITCH_M
    assert edge.gap_std_m < 2 * PITCH_M


def test_what_is_seen_over_the_sheets_upper_end_is_not_its_edge() -> None:
    sheet, passed = labels(0.0601)
    over = met()[..., 2] > 0.1
    edge = find_edge(met(), sheet & ~over, passed | over)
    assert edge is not None
    assert abs(edge.gap_m - 0.0601) <= PITCH_M / 2


def test_a_ragged_edge_is_as_uncertain_as_it_is_ragged() -> None:
    ragged_m = 0.06 + np.random.default_rng(0).normal(0.0, 0.004, ROWS)
    edge = find_edge(met(), *labels(ragged_m))
    assert edge is not None
    assert edge.gap_std_m == pytest.approx(0.004, rel=0.3)


def test_there_is_no_edge_where_nothing_passed_or_nothing_stands() -> None:
    sheet, passed = labels(0.06)
    assert find_edge(met(), sheet, np.zeros_like(passed)) is None
    lonely = np.zeros_like(sheet)
    lonely[:, 60] = True
    assert find_edge(met(), lonely, passed) is None
    assert not rows_of(lonely).any()
    assert rows_of(sheet).all()
