"""Laws of turning down: it ends, falls, never goes dark, and never further than needed."""

from itertools import pairwise

import pytest

from nlos_cam.camera.laser_power import STRIDES, PowerLimits, turn_down, weaker
from nlos_cam.frames import MAX_SATURATED

RANGES = [
    PowerLimits(0, 100, 1),
    PowerLimits(5, 95, 5),
    PowerLimits(0, 100, 30),
    PowerLimits(1, 3, 1),
    PowerLimits(0, 1, 0.01),
]


@pytest.mark.parametrize("limits", RANGES)
@pytest.mark.parametrize("part", [0.0, 0.15, 0.5, 0.77, 1.0, 2.0])
def test_turn_down_falls_above_darkness_as_far_as_needed(limits: PowerLimits, part: float) -> None:
    threshold, tried = limits.min + part * (limits.max - limits.min), [limits.max]
    settled = turn_down(
        limits.max, limits, lambda: 0.5 if tried[-1] > threshold else 0.0, lambda power: not tried.append(power)
    )
    assert settled.power == tried[-1]
    assert len(tried) <= STRIDES + 2
    assert all(lower < higher for higher, lower in pairwise(tried))
    assert min(tried) >= max(limits.min, min(limits.step, limits.max))
    assert min(tried) > 0
    assert all(power > threshold for power in tried[:-1])
    assert settled.saturated == (0.5 if settled.power > threshold else 0.0)
    assert settled.power <= threshold or not list(weaker(settled.power, limits))


@pytest.mark.parametrize("share", [0.0, MAX_SATURATED, None])
def test_turn_down_leaves_a_good_or_missing_image_alone(share: float | None) -> None:
    settled = turn_down(93, PowerLimits(0, 100, 1), lambda: share, lambda _: pytest.fail("was set"))
    assert (settled.power, settled.saturated) == (93, share)


def test_turn_down_ends_where_a_power_does_not_take() -> None:
    put: list[float] = []
    settled = turn_down(93, PowerLimits(0, 100, 1), lambda: 0.5, put.append)
    assert put == [83]
    assert (settled.power, settled.saturated) == (93, 0.5)
