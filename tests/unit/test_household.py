"""What makes each small thing of the house one, seen straight from the wall."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nlos_cam.objects.generators import Category, baskets, bell, bowl, cup, hat, lamp

View = Callable[..., NDArray[np.float32]]


def _widths(depth: NDArray[np.float32]) -> NDArray[np.int64]:
    counts = np.isfinite(depth).sum(axis=1)
    return counts[counts > 0]


@pytest.mark.parametrize("kind", [baskets, bell, bowl, hat, lamp], ids=lambda kind: kind.name)
def test_what_is_turned_on_a_lathe_is_the_same_on_both_sides(straight_view: View, kind: Category) -> None:
    surface = np.isfinite(straight_view(kind))
    assert (surface != surface[:, ::-1]).mean() < 0.01


@pytest.mark.parametrize("kind", [baskets, bowl], ids=lambda kind: kind.name)
def test_the_hollow_is_deeper_than_the_rim_before_it(straight_view: View, kind: Category) -> None:
    column = straight_view(kind)[:, 32]
    column = column[np.isfinite(column)]
    assert column.max() - column.min() > 0.05
    assert np.abs(np.diff(column)).max() > 0.02


def test_a_baskets_handle_is_an_arch_that_one_sees_through(straight_view: View) -> None:
    surface = np.isfinite(straight_view(baskets, tip=10.0))
    column = surface[:, 32]
    assert np.count_nonzero(np.diff(column.astype(int)) == 1) == 2


def test_more_ribs_are_more_rows(straight_view: View) -> None:
    few, many = (straight_view(baskets, ribs=ribs, tip=10.0) for ribs in (3.0, 5.0))
    waves = [np.count_nonzero(np.diff(np.sign(np.diff(depth[40:, 32]))) > 0) for depth in (few, many)]
    assert waves[0] < waves[1]


def test_a_bell_widens_downwards_and_hangs_from_a_ring(straight_view: View) -> None:
    depth = straight_view(bell)
    widths = _widths(depth)
    assert widths[len(widths) * 4 // 5] > 1.3 * widths[len(widths) * 2 // 5] > 2 * widths[0]


def test_a_cups_handle_is_a_hole_beside_it(straight_view: View) -> None:
    surface = np.isfinite(straight_view(cup))
    rows = np.flatnonzero(surface.any(axis=1))
    middle = surface[rows[len(rows) // 2]]
    assert np.count_nonzero(np.diff(middle.astype(int)) == 1) == 2


def test_a_hats_brim_is_wider_than_its_crown_and_lower(straight_view: View) -> None:
    widths = _widths(straight_view(hat))
    assert widths[len(widths) // 3] * 1.4 < widths[len(widths) * 2 // 3 :].max()


def test_a_lamp_is_thin_between_shade_and_foot(straight_view: View) -> None:
    widths = _widths(straight_view(lamp))
    stem = widths[len(widths) * 3 // 5]
    assert stem * 3 < min(widths[: len(widths) // 3].max(), widths[-8:].max())
