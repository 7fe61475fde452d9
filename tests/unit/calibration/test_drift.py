from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import WINDOW_FRAMES, BareWall, Drift, DriftCheck, settings_changed
from nlos_calibration.drift import MIN_FRAMES, MIN_PIXELS, TOLERANCE_C, DriftWindow
from nlos_calibration.errors import CalibrationError
from nlos_calibration.wall_tracker import WallObservation
from synthetic_scenes import SMALL, WallPose, reference_of_wall, wall_from_lidar

TINY = SMALL.scaled(32, 24)
POSE: WallPose = (0.2, 45.0, 0.0)
SETTINGS = {"laser_power": 60.0, "depth_units": 0.00025, "ldd_temperature": 31.0, "noise_estimation": 7.0}
MANY = 10**6
STILL = Drift(0.0, 0.0, 0.0, 0.0, 1e-5, 0.01, 0.01, 1e-5, uniform=False)


@pytest.fixture
def wall() -> BareWall:
    return reference_of_wall(
        POSE,
        TINY,
        np.random.default_rng(0),
        settings=SETTINGS | {"frames_queue_size": 16.0, "min_distance": 0.0},
        celsius={"ldd_temperature": 40.0, "apd_temperature": 30.0},
        celsius_span={"ldd_temperature": 1.0, "apd_temperature": 8.0},
    )


@pytest.fixture
def check(wall: BareWall) -> DriftCheck:
    return DriftCheck(wall, wall_from_lidar(POSE))


@pytest.mark.parametrize(
    ("change", "settings"),
    [
        ({"laser_power": 40.0, "min_distance": 190.0}, ["laser_power", "min_distance"]),
        ({"ldd_temperature": 50.0}, []),
        ({"noise_estimation": 900.0}, []),
        ({"frames_queue_size": 2.0}, []),
        ({"depth_units": 0.000250000011874363}, []),
        ({"only_this_firmware_tells": 1.0}, []),
    ],
)
def test_settings_changed_names_settings_only(wall: BareWall, change: dict[str, float], settings: list[str]) -> None:
    assert [line.split()[0] for line in settings_changed(wall, SETTINGS | change)] == settings


def test_drift_check_warns_of_a_changed_setting(wall: BareWall, check: DriftCheck) -> None:
    settings = dict(SETTINGS)
    check.observe(wall.depth_m, settings)
    assert check.warnings == ()
    settings["laser_power"] = 40.0  # in place
    check.observe(wall.depth_m, settings)
    (line,) = check.warnings
    for part in ("laser_power", "60", "40"):
        assert part in line
    check.observe(wall.depth_m, SETTINGS)
    assert check.warnings == ()


def test_drift_check_warns_of_a_temperature_beyond_tolerance(check: DriftCheck) -> None:
    check.update_temperatures({"ldd_temperature": 40.0 + TOLERANCE_C, "apd_temperature": 30.0})
    assert check.warnings == ()
    check.update_temperatures({"ldd_temperature": 41.0 + TOLERANCE_C})
    (line,) = check.warnings
    for part in ("ldd_temperature", "46", "40"):
        assert part in line
    check.update_temperatures({"ldd_temperature": 30.0, "apd_temperature": 39.0})
    assert "warm" in check.warnings[0]
    assert "1 more" in check.warnings[0]


def test_drift_check_ignores_temperatures_within_span_or_unknown(check: DriftCheck) -> None:
    unknown = {"apd_temperature": -9999.0, "another_temperature": 99.0, "ldd_temperature": float("nan")}
    for celsius in (unknown, {"apd_temperature": 37.0}):
        check.update_temperatures(celsius)
        assert check.warnings == ()


def test_drift_check_temperature_warning_does_not_flicker(check: DriftCheck) -> None:
    for over_c in (0.5, -0.5) * 5:
        check.update_temperatures({"ldd_temperature": 40.0 + TOLERANCE_C + over_c})
        assert len(check.warnings) == 1
    check.update_temperatures({"ldd_temperature": 40.0})
    assert check.warnings == ()


def test_drift_check_refuses_a_frame_of_another_size(check: DriftCheck) -> None:
    with pytest.raises(CalibrationError, match=r"64 x 48 .* 32 x 24"):
        check.observe(np.zeros((48, 64), np.float32), {})


@pytest.mark.parametrize("left", [0, MIN_PIXELS - 1])
def test_drift_check_warns_of_too_few_good_pixels(wall: BareWall, left: int) -> None:
    inliers = np.zeros(wall.depth_m.shape, np.bool_)
    inliers.flat[np.flatnonzero(wall.inliers)[:left]] = True
    check = DriftCheck(replace(wall, inliers=inliers), wall_from_lidar(POSE))
    for _ in range(40):
        check.observe(wall.depth_m, {})
    (line,) = check.warnings
    assert str(MIN_PIXELS) in line
    assert (check.drift, check.wall_share) == (None, 0.0)


def filled(sights: np.ndarray, reference_frames: int = MANY) -> DriftWindow:
    window = DriftWindow(reference_frames)
    for sight in sights:
        window.add(WallObservation(*sight.tolist()), 0.5)
    return window


def drift_of(sights: np.ndarray, reference_frames: int = MANY) -> Drift:
    return filled(sights, reference_frames).drift()


def sights(count: int, seed: int = 0) -> np.ndarray:
    """Return measurements of a wall 2 mm farther, each uncertain by 0.1 mm and 0.05 degrees."""
    middle, spread = np.array([0.002, 0.0, 0.0, 0.0027, 50.0]), np.array([1e-4, 0.05, 0.05, 1e-4, 5.0])
    return middle + spread * np.random.default_rng(seed).standard_normal((count, 5))


def test_drift_window_needs_enough_frames() -> None:
    assert filled(sights(MIN_FRAMES - 1)).drift() is None
    window = filled(sights(MIN_FRAMES))
    assert window.drift() is not None
    for _ in range(WINDOW_FRAMES - MIN_FRAMES + 1):
        window.add(None, 0.0)
    assert window.drift() is None


def test_drift_window_of_a_short_reference_is_less_certain() -> None:
    few, many = (drift_of(sights(WINDOW_FRAMES), frames) for frames in (1, MANY))
    assert few.distance_std_m > 3.0 * many.distance_std_m


@pytest.mark.parametrize(
    ("drift", "tolerances"),
    [
        (replace(STILL, distance_m=-0.002), 2.0),
        (replace(STILL, yaw_deg=0.5), 2.5),
        (replace(STILL, pitch_deg=-0.5), 2.5),
        (replace(STILL, distance_m=0.005, range_m=0.003, uniform=True), 3.0),
    ],
)
def test_drift_is_measured_in_tolerances(drift: Drift, tolerances: float) -> None:
    assert drift.tolerances() == pytest.approx(tolerances)
    assert drift.tolerances(4.0) < tolerances


def test_drift_text_holds_amounts_and_uncertainties() -> None:
    moved = str(replace(STILL, distance_m=0.0018, distance_std_m=0.0002, yaw_deg=-0.3, pitch_deg=0.4))
    assert "1.8 ± 0.4 mm" in moved
    assert "0.500 ± 0.020°" in moved
    assert "1.30 ± 0.02 mm" in str(replace(STILL, range_m=-0.0013, uniform=True))
