"""The laws of turning down, for every range and every wall: ends, falls, never dark, never further than needed."""

from itertools import pairwise

import numpy as np
import pytest

from nlos_cam.camera.laser_power import STRIDES, PowerLimits, turn_down, weaker
from nlos_cam.frames import MAX_SATURATED, saturated_share

RANGES = [
    PowerLimits(0, 100, 1),
    PowerLimits(5, 95, 5),
    PowerLimits(0, 100, 30),
    PowerLimits(1, 3, 1),
    PowerLimits(0, 1, 0.01),
]


class Wall:
    """Saturates above a laser power; keeps what was put and how often it was looked at."""

    def __init__(self, power: float, saturates_above: float) -> None:
        self.power, self.saturates_above = power, saturates_above
        self.put_values: list[float] = []

    def look(self) -> float:
        return 0.5 if self.power > self.saturates_above else 0.0

    def put(self, power: float) -> bool:
        self.put_values.append(power)
        self.power = power
        return True


@pytest.mark.parametrize("limits", RANGES)
@pytest.mark.parametrize("part", [0.0, 0.15, 0.5, 0.77, 1.0, 2.0])
def test_it_ends_falling_above_darkness_and_no_further_than_needed(limits: PowerLimits, part: float) -> None:
    threshold = limits.least + part * (limits.most - limits.least)
    wall = Wall(limits.most, threshold)
    settled = turn_down(limits.most, limits, wall.look, wall.put)
    tried = [limits.most, *wall.put_values]
    assert settled.power == tried[-1] == wall.power
    assert len(tried) <= STRIDES + 2
    assert all(lower < higher for higher, lower in pairwise(tried))
    assert min(tried) >= max(limits.least, min(limits.step, limits.most))
    assert min(tried) > 0
    assert all(power > threshold for power in tried[:-1])
    if settled.power > threshold:
        assert settled.saturated == 0.5
        assert not list(weaker(settled.power, limits))
    else:
        assert settled.saturated == 0.0


@pytest.mark.parametrize("share", [0.0, MAX_SATURATED])
def test_an_image_that_is_good_enough_is_left_alone(share: float) -> None:
    assert turn_down(93, PowerLimits(0, 100, 1), lambda: share, lambda _: pytest.fail("was set")).power == 93


def test_without_frames_nothing_is_changed() -> None:
    settled = turn_down(93, PowerLimits(0, 100, 1), lambda: None, lambda _: pytest.fail("was set"))
    assert (settled.power, settled.saturated) == (93, None)


def test_a_power_that_does_not_take_ends_it() -> None:
    put: list[float] = []
    settled = turn_down(93, PowerLimits(0, 100, 1), lambda: 0.5, put.append)
    assert put == [83]
    assert (settled.power, settled.saturated) == (93, 0.5)


def test_strides_are_whole_steps() -> None:
    assert list(weaker(95, PowerLimits(0, 100, 30))) == [65, 35, 30]
    assert list(weaker(30, PowerLimits(0, 100, 1))) == [20, 10, 1]


@pytest.mark.parametrize(("value", "nearest"), [(-1, 5), (5, 5), (7, 5), (8, 10), (94, 95), (1000, 95)])
def test_the_nearest_allowed_value(value: float, nearest: float) -> None:
    assert PowerLimits(5, 95, 5).nearest(value) == nearest


def test_the_share_of_saturated_pixels() -> None:
    ir = np.full((10, 100), 254, np.uint8)
    assert saturated_share(ir) == 0.0
    ir[0, :2] = 255
    assert saturated_share(ir) == 0.002
