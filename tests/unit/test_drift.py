from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.drift import MIN_PIXELS, TOLERANCE_C, DriftCheck, settings_changed
from nlos_calibration.errors import CalibrationError
from nlos_calibration.reference import BareWall

from nlos_cam.calibrate.synthetic import SMALL, Pose, measured, wall_from_lidar

TINY = SMALL.scaled(32, 24)
POSE: Pose = (0.2, 45.0, 0.0)
SETTINGS = {"laser_power": 60.0, "depth_units": 0.00025, "ldd_temperature": 31.0, "noise_estimation": 7.0}


@pytest.fixture
def wall() -> BareWall:
    return measured(
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


def test_a_setting_that_changed_is_told_with_both_values(wall: BareWall) -> None:
    now = SETTINGS | {"laser_power": 40.0, "min_distance": 190.0}
    assert settings_changed(wall, now) == ("laser_power was 60 and is 40", "min_distance was 0 and is 190")


@pytest.mark.parametrize(
    "change",
    [
        {"ldd_temperature": 50.0},
        {"noise_estimation": 900.0},
        {"frames_queue_size": 2.0},
        {"depth_units": 0.000250000011874363},
        {"only_this_firmware_tells": 1.0},
    ],
)
def test_what_is_no_setting_or_no_change_is_not_told(wall: BareWall, change: dict[str, float]) -> None:
    assert settings_changed(wall, SETTINGS | change) == ()


def test_settings_are_told_from_the_frame_on_that_has_them(wall: BareWall, check: DriftCheck) -> None:
    check.look(wall.depth_m, SETTINGS)
    assert check.warnings == ()
    check.look(wall.depth_m, SETTINGS | {"laser_power": 40.0})
    (line,) = check.warnings
    assert "laser_power was 60 and is 40" in line
    assert "calibrate the wall again" in line
    check.look(wall.depth_m, SETTINGS)
    assert check.warnings == ()


def test_settings_that_change_in_place_are_seen(wall: BareWall, check: DriftCheck) -> None:
    settings = dict(SETTINGS)
    check.look(wall.depth_m, settings)
    settings["laser_power"] = 40.0
    check.look(wall.depth_m, settings)
    assert len(check.warnings) == 1


def test_a_temperature_is_told_by_name_beyond_the_tolerance(check: DriftCheck) -> None:
    check.look_at({"ldd_temperature": 40.0 + TOLERANCE_C, "apd_temperature": 30.0})
    assert check.warnings == ()
    check.look_at({"ldd_temperature": 41.0 + TOLERANCE_C})
    (line,) = check.warnings
    assert line == "ldd_temperature is 46 degrees C and was 40 when the wall was measured: calibrate the wall again"
    check.look_at({"ldd_temperature": 30.0})
    assert check.warnings[0].endswith("let the lidar warm up")


def test_a_temperature_that_rose_and_fell_as_much_meanwhile_is_not_told(check: DriftCheck) -> None:
    check.look_at({"apd_temperature": 37.0})
    assert check.warnings == ()
    check.look_at({"apd_temperature": 39.0})
    assert len(check.warnings) == 1


def test_a_temperature_at_the_limit_does_not_flicker(check: DriftCheck) -> None:
    told = 0
    for over_c in (0.5, -0.5) * 5:
        check.look_at({"ldd_temperature": 40.0 + TOLERANCE_C + over_c})
        told += len(check.warnings)
    assert told == 10
    check.look_at({"ldd_temperature": 40.0})
    assert check.warnings == ()


def test_of_several_temperatures_the_first_is_told_and_how_many_more(check: DriftCheck) -> None:
    check.look_at({"ldd_temperature": 80.0, "apd_temperature": 80.0})
    (warning,) = check.warnings
    assert warning.startswith("ldd_temperature is 80")
    assert "(1 more of its temperatures are off)" in warning


def test_what_is_no_temperature_of_the_reference_is_not_told(check: DriftCheck) -> None:
    check.look_at({"apd_temperature": -9999.0, "another_temperature": 99.0, "ldd_temperature": float("nan")})
    assert check.warnings == ()


def test_a_frame_of_another_size_is_refused_at_the_door(check: DriftCheck) -> None:
    with pytest.raises(CalibrationError, match=r"a frame of 64 x 48 pixels .* a bare wall of 32 x 24: open the camera"):
        check.look(np.zeros((48, 64), np.float32), {})


@pytest.mark.parametrize("left", [0, 1, MIN_PIXELS - 1])
def test_a_reference_with_hardly_a_good_pixel_is_told_as_such(wall: BareWall, left: int) -> None:
    inliers = np.zeros(wall.depth_m.shape, np.bool_)
    inliers.flat[np.flatnonzero(wall.inliers)[:left]] = True
    check = DriftCheck(replace(wall, inliers=inliers), wall_from_lidar(POSE))
    for _ in range(40):
        check.look(wall.depth_m, {})
    (line,) = check.warnings
    assert "good pixels to watch, 30 needed" in line
    assert check.drift is None
    assert check.wall_share == 0.0
