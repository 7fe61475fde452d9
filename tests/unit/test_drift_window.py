from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.drift import LEAST_FRAMES, WINDOW_FRAMES, Drift, DriftWindow
from nlos_calibration.wall_tracker import Sight

MANY = 10**6
STILL = Drift(0.0, 0.0, 0.0, 0.0, 1e-5, 0.01, 0.01, 1e-5, uniform=False)


def filled(sights: np.ndarray, reference_frames: int = MANY) -> DriftWindow:
    window = DriftWindow(reference_frames)
    for sight in sights:
        window.add(Sight(*sight.tolist()), 0.5)
    return window


def sights(count: int, seed: int = 0) -> np.ndarray:
    """Of a wall 2 mm farther, each uncertain by 0.1 mm and 0.05 degrees."""
    middle, spread = np.array([0.002, 0.0, 0.0, 0.0027, 50.0]), np.array([1e-4, 0.05, 0.05, 1e-4, 5.0])
    return middle + spread * np.random.default_rng(seed).standard_normal((count, 5))


def test_too_few_frames_say_nothing() -> None:
    assert filled(sights(LEAST_FRAMES - 1)).drift() is None
    window = filled(sights(LEAST_FRAMES))
    assert window.drift() is not None
    for _ in range(WINDOW_FRAMES - LEAST_FRAMES + 1):
        window.add(None, 0.0)
    assert window.drift() is None


def test_the_uncertainty_is_not_below_what_the_medians_spread() -> None:
    drifts = [drift for seed in range(200) if (drift := filled(sights(WINDOW_FRAMES, seed)).drift())]
    spread_m = np.std([drift.distance_m for drift in drifts])
    assert 1.0 < np.mean([drift.distance_std_m for drift in drifts]) / spread_m < 1.6
    spread_deg = np.std([drift.yaw_deg for drift in drifts])
    assert 1.0 < np.mean([drift.yaw_std_deg for drift in drifts]) / spread_deg < 1.6


def test_a_reference_of_few_frames_is_as_uncertain_as_they_are() -> None:
    few, many = (filled(sights(WINDOW_FRAMES), frames).drift() for frames in (1, MANY))
    assert few is not None
    assert many is not None
    assert few.distance_std_m > 3.0 * many.distance_std_m


def test_a_frame_or_two_are_outvoted() -> None:
    frames = sights(WINDOW_FRAMES)
    frames[::5] += 1.0
    drift = filled(frames).drift()
    assert drift is not None
    assert drift.distance_m == pytest.approx(0.002, abs=1e-4)


def test_the_share_is_that_of_the_last_second() -> None:
    window = DriftWindow(MANY)
    assert window.share == 0.0
    window.add(None, 0.8)
    assert window.share == pytest.approx(0.8)
    for _ in range(WINDOW_FRAMES):
        window.add(None, 0.2)
    assert window.share == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("drift", "tolerances"),
    [
        (replace(STILL, distance_m=-0.002), 2.0),
        (replace(STILL, yaw_deg=0.5), 2.5),
        (replace(STILL, pitch_deg=-0.5), 2.5),
        (replace(STILL, distance_m=0.005, range_m=0.003, uniform=True), 3.0),
    ],
)
def test_a_drift_is_held_against_the_tolerances(drift: Drift, tolerances: float) -> None:
    assert drift.tolerances() == pytest.approx(tolerances)
    assert drift.tolerances(4.0) < tolerances


def test_a_wall_that_is_hardly_seen_is_not_sharp() -> None:
    assert STILL.sharp
    assert not replace(STILL, distance_std_m=0.001).sharp
    assert not replace(STILL, pitch_std_deg=0.2).sharp


def test_another_drift_is_one_by_more_than_a_tolerance() -> None:
    assert not STILL.apart(replace(STILL, distance_m=0.0009, yaw_deg=0.1))
    assert STILL.apart(replace(STILL, distance_m=0.0011))
    assert STILL.apart(replace(STILL, yaw_deg=0.15, pitch_deg=0.15))
    uniform = replace(STILL, uniform=True)
    assert STILL.apart(uniform)
    assert uniform.apart(replace(uniform, range_m=-0.0011))
    assert not uniform.apart(replace(uniform, distance_m=0.0011))


def test_a_line_says_what_drifted_by_how_much_and_what_to_do() -> None:
    assert str(replace(STILL, distance_m=0.0018, distance_std_m=0.0002, yaw_deg=-0.3, pitch_deg=0.4)) == (
        "the lidar has moved: the wall is 1.80 +- 0.20 mm farther and turned by 0.50 +- 0.01 degrees from the "
        "calibration: calibrate the wall again"
    )
    shorter = str(replace(STILL, range_m=-0.0013, uniform=True))
    assert "1.30 +- 0.01 mm shorter than in the calibration" in shorter
    assert shorter.endswith("calibrate the wall again")
