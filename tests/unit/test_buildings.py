"""What makes each building one, seen straight from the wall."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nlos_cam.objects.generators import birdhouse, tower

View = Callable[..., NDArray[np.float32]]


def test_a_birdhouses_hole_goes_in_and_its_perch_comes_out(straight_view: View) -> None:
    depth = straight_view(birdhouse)
    front = np.nanmedian(depth)
    assert (depth > front + 0.03).sum() > 20
    assert (depth < front - 0.03).sum() >= 4
    hole, perch = (np.argwhere(where).mean(0) for where in (depth > front + 0.03, depth < front - 0.03))
    assert hole[1] == pytest.approx(31.5, abs=1.5) == perch[1]
    assert hole[0] < perch[0]


def test_a_larger_hole_is_larger(straight_view: View) -> None:
    holes = [
        (depth > np.nanmedian(depth) + 0.03).sum() for depth in (straight_view(birdhouse, hole=h) for h in (0.09, 0.14))
    ]
    assert holes[1] > 1.5 * holes[0]


def test_a_birdhouses_roof_is_a_gable_wider_than_its_walls(straight_view: View) -> None:
    widths = np.isfinite(straight_view(birdhouse)).sum(axis=1)
    rows = np.flatnonzero(widths)
    assert widths[rows[0]] <= 5
    assert widths.max() > 1.15 * widths[rows[-3]]


def test_a_tower_is_slender_with_a_head_of_battlements(straight_view: View) -> None:
    surface = np.isfinite(straight_view(tower, turn=0.0))
    rows = np.flatnonzero(surface.any(axis=1))
    widths = surface.sum(axis=1)
    assert len(rows) > 1.5 * widths.max()
    assert widths[rows[10]] > widths[rows[len(rows) // 2]]
    crown = np.pad(surface[rows[2]].astype(int), 1)
    assert np.count_nonzero(np.diff(crown) == 1) >= 2
