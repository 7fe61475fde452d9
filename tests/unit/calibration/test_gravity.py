"""Laws of the way up of a lidar: rolls add up, and a turn is found by its angle."""

from itertools import pairwise
from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from nlos_calibration import roll_deg, turn_problem, way_up
from nlos_calibration.gravity import G_M_S2, TURNED_DEG, WayUp, is_gravity, turned_deg

DEGREES = st.floats(-179.0, 179.0)
PITCHES = st.floats(-50.0, 50.0)


def gravity(roll: float, pitch: float = 0.0) -> tuple[float, float, float]:
    """Return gravity in the frame of a lidar that looks up by `pitch` and is rolled clockwise."""
    across = G_M_S2 * cos(radians(pitch))
    return (
        across * sin(radians(roll)),
        across * cos(radians(roll)),
        -G_M_S2 * sin(radians(pitch)),
    )


@given(DEGREES, PITCHES)
def test_roll_is_that_of_the_lidar_at_any_pitch(roll: float, pitch: float) -> None:
    assert roll_deg(gravity(roll, pitch)) == pytest.approx(roll, abs=1e-6)


@given(DEGREES, PITCHES)
def test_way_up_is_the_nearest_quarter_of_a_turn(roll: float, pitch: float) -> None:
    assume(min(abs(abs(roll) - 45), abs(abs(roll) - 135)) > 1e-6)
    quarter = round(abs(roll) / 90)
    expected: WayUp = ("upright", "on its side", "upside down")[quarter]
    assert way_up(gravity(roll, pitch)) == expected


@pytest.mark.parametrize("pitch", [-90.0, -65.0, 65.0, 90.0])
def test_way_up_of_a_lidar_that_looks_up_or_down_is_unknown(pitch: float) -> None:
    assert way_up(gravity(180.0, pitch)) == "unknown"


@given(DEGREES, DEGREES, PITCHES)
def test_turn_is_symmetric_and_at_most_the_roll(one: float, other: float, pitch: float) -> None:
    apart = abs(one - other) if abs(one - other) <= 180 else 360 - abs(one - other)
    turned = turned_deg(gravity(one, pitch), gravity(other, pitch))

    assert turned == pytest.approx(turned_deg(gravity(other, pitch), gravity(one, pitch)))
    assert turned <= apart + 1e-6


@given(DEGREES, st.floats(0.0, 180.0))
def test_level_lidar_was_turned_by_its_roll(roll: float, turn: float) -> None:
    found = turned_deg(gravity(roll), gravity(roll + turn))
    assert found == pytest.approx(turn, abs=1e-5)


@given(DEGREES, st.floats(0.0, 180.0))
def test_turn_beyond_the_tolerance_is_one_line(roll: float, turn: float) -> None:
    assume(abs(turn - TURNED_DEG) > 1e-3)
    problem = turn_problem(gravity(roll + turn), gravity(roll))

    assert bool(problem) == (turn > TURNED_DEG)
    assert "\n" not in problem


@pytest.mark.parametrize(
    ("measured", "now", "fits"),
    [
        ("unknown", 0.0, True),
        ("unknown", 180.0, False),
        ("unknown", 90.0, False),
        ("upright", 3.0, True),
        ("upright", 180.0, False),
        ("upside down", 180.0, True),
        ("upside down", 0.0, False),
    ],
)
def test_lidar_is_as_its_owner_said_or_upright(measured: WayUp, now: float, fits: bool) -> None:
    assert (not turn_problem(gravity(now), None, measured)) == fits


def test_lidar_without_accelerometer_has_no_problem() -> None:
    assert turn_problem(None, gravity(0.0), "upright") == ""


@given(st.floats(0.0, 30.0))
def test_only_a_mean_as_long_as_gravity_is_gravity(length: float) -> None:
    assert is_gravity((0.0, length, 0.0)) == (abs(length - G_M_S2) <= 1.0)
    assert not is_gravity((0.0, float("nan"), length))


def test_turns_add_up_about_one_axis() -> None:
    rolls = np.linspace(0, 90, 7)
    steps = [turned_deg(gravity(a), gravity(b)) for a, b in pairwise(rolls)]
    assert sum(steps) == pytest.approx(turned_deg(gravity(0), gravity(90)))
