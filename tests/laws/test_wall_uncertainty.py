"""The wall fit's stated uncertainty holds as often as it says, for any noise and number of
frames.
"""

from typing import Any

import numpy as np
import pytest
from wall_trials import WallConditions, trial

pytestmark = pytest.mark.slow


def outcomes(count: int, **conditions: Any) -> list[dict[str, Any]]:
    tried = [
        trial(WallConditions(**conditions), np.random.default_rng([7, n])) for n in range(count)
    ]
    return [one for one in tried if one]


def inside(count: int, at_least: int, **conditions: Any) -> Any:
    found = outcomes(count, **conditions)
    assert len(found) > at_least
    return np.array([one["inside"] for one in found])


@pytest.mark.parametrize("frames", [1, 6, 20])
@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
def test_wall_interval_holds_the_truth_as_often_as_stated(noise: float, frames: int) -> None:
    """120 trials each: a share of 95 % is found between 89 and 99.5 % but for once in a
    thousand.
    """
    found = inside(120, 110, noise=noise, frames=frames)

    assert (found.mean(axis=0) >= 0.88).all()
    assert found.mean() <= 0.985


@pytest.mark.parametrize(
    ("count", "at_least", "share", "conditions"),
    [
        *(
            (120, 80, 0.87, {"scene": s, "outliers": o, "frames": 6})
            for s in ("bare", "no return")
            for o in (0.2, 0.4)
        ),
        (
            300,
            290,
            0.86,
            {"scene": "rippled", "frames": 20},
        ),  # what neighbouring pixels have in common
        (300, 290, 0.86, {"scene": "patchy", "frames": 20}),
        (80, 75, 0.87, {"flicker": 0.05, "frames": 20}),
    ],
)
def test_interval_allows_outliers_ripples_and_flicker(
    count: int, at_least: int, share: float, conditions: dict
) -> None:
    assert (inside(count, at_least, **conditions).mean(axis=0) >= share).all()


def test_wall_error_falls_with_more_frames_and_less_noise() -> None:
    def facing_error_deg(**conditions: float) -> float:
        return float(
            np.median([abs(one["facing_error_deg"]) for one in outcomes(40, **conditions)])
        )

    assert facing_error_deg(frames=30) < 0.4 * facing_error_deg(frames=1)
    assert facing_error_deg(noise=1.0) < 0.5 * facing_error_deg(noise=4.0)
