"""What makes each vehicle one, seen straight from the wall."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nlos_cam.objects.generators import Category, airplane, boat, car, motorcycle, rocket

View = Callable[..., NDArray[np.float32]]


def _widths(depth: NDArray[np.float32]) -> NDArray[np.int64]:
    """Surface cells of each row that has any, from the top."""
    counts = np.isfinite(depth).sum(axis=1)
    return counts[counts > 0]


@pytest.mark.parametrize("kind", [airplane, rocket], ids=["airplane", "rocket"])
def test_what_flies_is_the_same_on_both_sides(straight_view: View, kind: Category) -> None:
    surface = np.isfinite(straight_view(kind))
    assert (surface != surface[:, ::-1]).mean() < 0.01


def test_an_airplanes_wings_are_wider_than_its_tail_and_both_wider_than_its_body(straight_view: View) -> None:
    widths = _widths(straight_view(airplane))
    middle, tail = widths[: len(widths) * 3 // 4].max(), widths[len(widths) * 3 // 4 :].max()
    assert middle > 1.5 * tail > 1.5 * widths[len(widths) // 5]


def test_a_rocket_ends_in_a_point_and_stands_on_fins(straight_view: View) -> None:
    widths = _widths(straight_view(rocket))
    assert widths[0] <= 4
    assert widths[-8:].max() > 1.5 * widths[len(widths) // 2]


def test_a_boats_sail_narrows_upwards_above_its_hull(straight_view: View) -> None:
    widths = _widths(straight_view(boat))
    assert widths[:4].max() <= 6
    assert widths[-10:].max() > 50
    assert np.corrcoef(np.arange(30), widths[5:35])[0, 1] > 0.9


def test_a_car_stands_on_two_wheels_before_its_body(straight_view: View) -> None:
    depth = straight_view(car)
    rows = np.flatnonzero(np.isfinite(depth).any(axis=1))
    ground = np.isfinite(depth[rows[-2]])
    assert np.count_nonzero(np.diff(ground.astype(int)) == 1) == 2
    wheels = depth[rows[-2]][ground].mean()
    assert wheels < np.nanmedian(depth) - 0.005


def test_a_cars_windows_are_set_in(straight_view: View) -> None:
    depth = straight_view(car)
    rows = np.flatnonzero(np.isfinite(depth).any(axis=1))
    cabin = depth[rows[0] : rows[len(rows) // 3]]
    assert np.nanmax(cabin) - np.nanmin(cabin) > 0.01


def test_a_motorcycles_wheels_are_open(straight_view: View) -> None:
    """Between hub and tyre one sees through: the surface has two round holes or more."""
    surface = np.isfinite(straight_view(motorcycle))
    outside = np.zeros_like(surface)
    outside[0] = outside[-1] = outside[:, 0] = outside[:, -1] = True
    outside &= ~surface
    for _ in range(128):  # flood the outside from the border
        grown = outside.copy()
        for axis in (0, 1):
            for step in (-1, 1):
                grown |= np.roll(outside, step, axis)
        outside = grown & ~surface
    holes = ~surface & ~outside
    columns = np.flatnonzero(holes.any(axis=0))
    assert holes.sum() > 60
    assert columns.min() < 20
    assert columns.max() > 44
