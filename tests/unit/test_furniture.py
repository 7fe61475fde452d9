"""What makes each piece of furniture one, seen straight from the wall."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nlos_cam.objects.generators import computer, cupboard, oven, soundbox, table

View = Callable[..., NDArray[np.float32]]


def _runs(line: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(np.diff(np.pad(line.astype(int), 1)) == 1))


def test_a_computers_screen_is_set_into_its_frame_and_stands_on_a_neck(straight_view: View) -> None:
    depth = straight_view(computer, tip=14.0)
    rows = np.flatnonzero(np.isfinite(depth).any(axis=1))
    screen, edge = depth[rows[12], 32], depth[rows[2], 32]
    assert screen > edge + 0.01
    widths = np.isfinite(depth).sum(axis=1)
    neck = rows[widths[rows[0] : rows[-1]].argmin()]
    assert widths[neck] < 0.5 * widths[rows].max()
    assert rows[0] < neck < rows[-1]


def test_a_computers_keyboard_is_before_its_screen(straight_view: View) -> None:
    depth = straight_view(computer)
    rows = np.flatnonzero(np.isfinite(depth).any(axis=1))
    assert np.nanmean(depth[rows[-3]]) < np.nanmean(depth[rows[5]]) - 0.03


@pytest.mark.parametrize("shelves", [2, 3, 4])
def test_a_cupboards_shelves_show_beside_the_door_that_stands_open(straight_view: View, shelves: int) -> None:
    """Between the boards one looks as far as its back."""
    depth = straight_view(cupboard, shelves=float(shelves), ajar=95.0, tip=0.0)
    columns = np.flatnonzero(np.isfinite(depth).sum(axis=0) > 40)
    inside = depth[:, columns[0] + (columns[-1] - columns[0]) // 3]
    assert _runs(inside > np.nanmin(depth[:, columns[-6]]) + 0.03) == shelves


def test_an_open_door_reaches_towards_the_wall(straight_view: View) -> None:
    wide, less = (straight_view(cupboard, ajar=ajar, tip=0.0) for ajar in (90.0, 60.0))
    assert np.nanmin(wide[:, 34:58]) - np.nanmin(wide) > 0.03
    assert np.nanmin(less[:, 34:58]) - np.nanmin(less) < np.nanmin(wide[:, 34:58]) - np.nanmin(wide)


@pytest.mark.parametrize("knobs", [3, 4, 5])
def test_an_oven_has_its_knobs_in_a_row(straight_view: View, knobs: int) -> None:
    depth = straight_view(oven, knobs=float(knobs), tip=18.0)
    found = [_runs(row < np.nanmedian(row) - 0.01) for row in depth if np.isfinite(row).sum() > 20]
    assert knobs in found


def test_an_ovens_window_is_set_in(straight_view: View) -> None:
    depth = straight_view(oven, tip=18.0)
    rows, columns = np.flatnonzero(np.isfinite(depth).any(axis=1)), np.flatnonzero(np.isfinite(depth).any(axis=0))
    window = depth[rows[len(rows) * 3 // 4]]
    assert window[32] > window[columns[4]] + 0.015


def test_a_soundboxs_cones_are_sunk_and_the_lower_is_the_larger(straight_view: View) -> None:
    depth = straight_view(soundbox)
    front = np.nanmedian(depth)
    sunk = depth > front + 0.01
    upper, lower = sunk[:26], sunk[26:]
    assert lower.any(axis=0).sum() > 1.3 * upper.any(axis=0).sum() > 0


def test_a_larger_woofer_is_a_larger_cone(straight_view: View) -> None:
    small, large = (straight_view(soundbox, woofer=woofer) for woofer in (0.35, 0.45))
    assert (large > np.nanmedian(large) + 0.01).sum() > 1.2 * (small > np.nanmedian(small) + 0.01).sum()


def test_a_table_stands_on_legs(straight_view: View) -> None:
    surface = np.isfinite(straight_view(table, tip=15.0))
    rows = np.flatnonzero(surface.any(axis=1))
    assert _runs(surface[rows[1]]) == 1
    assert _runs(surface[rows[len(rows) * 3 // 4]]) >= 2
    assert not surface[rows[-1], 28:36].any()
