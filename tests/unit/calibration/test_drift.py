import re
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import WINDOW_FRAMES, BareWall, Drift, DriftCheck, settings_changed
from nlos_calibration.drift import (
    BLIND_ENDS,
    BLIND_FRAMES,
    MIN_FRAMES,
    MIN_PIXELS,
    TOLERANCE_C,
    DriftWindow,
)
from nlos_calibration.errors import CalibrationError
from nlos_calibration.wall import TOLERANCE_DEG, TOLERANCE_M, measures_of, wall_depth
from nlos_calibration.wall_tracker import (
    GRID,
    WallObservation,
    WallTrack,
    noise_scale,
    watched_pixels,
)
from synthetic_scenes import SMALL, WallPose, reference_of_wall, wall_from_lidar

TINY = SMALL.scaled(32, 24)
POSE: WallPose = (0.2, 45.0, 0.0)
SETTINGS = {
    "laser_power": 60.0,
    "depth_units": 0.00025,
    "ldd_temperature": 31.0,
    "noise_estimation": 7.0,
}
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


def observed(check: DriftCheck, frame: np.ndarray, frames: int) -> DriftCheck:
    for _ in range(frames):
        check.observe(frame, {})
    return check


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
def test_settings_changed_names_settings_only(
    wall: BareWall, change: dict[str, float], settings: list[str]
) -> None:
    assert [line.split()[0] for line in settings_changed(wall, SETTINGS | change)] == settings


def test_drift_check_warns_of_a_changed_setting(wall: BareWall, check: DriftCheck) -> None:
    settings = dict(SETTINGS)
    check.observe(wall.depth_m, settings)

    assert check.warnings == ()

    settings["laser_power"] = 40.0  # in place
    check.observe(wall.depth_m, settings)
    (line,) = check.warnings

    assert re.search("laser_power.*60.*40", line)

    check.observe(wall.depth_m, SETTINGS)

    assert check.warnings == ()


@pytest.mark.parametrize(
    "celsius",
    [
        {"apd_temperature": -9999.0},
        {"another_temperature": 99.0},
        {"ldd_temperature": float("nan")},
        {"ldd_temperature": 40.0, "apd_temperature": 37.0},
        {"ldd_temperature": 40.0 + TOLERANCE_C, "apd_temperature": 30.0},
    ],
    ids=["invalid", "unknown", "nan", "within its span", "within the tolerance"],
)
def test_temperature_within_its_limits_raises_no_warning(
    check: DriftCheck, celsius: dict[str, float]
) -> None:
    check.update_temperatures(celsius)
    assert check.warnings == ()


def test_temperature_beyond_the_tolerance_is_named(check: DriftCheck) -> None:
    check.update_temperatures({"ldd_temperature": 41.0 + TOLERANCE_C})
    (line,) = check.warnings

    assert re.search("ldd_temperature.*46.*40", line)


def test_one_warning_stands_for_several_temperatures(check: DriftCheck) -> None:
    check.update_temperatures({"ldd_temperature": 30.0, "apd_temperature": 39.0})
    (line,) = check.warnings

    assert "warm" in line
    assert "1 more" in line


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
    observed(check, wall.depth_m, 40)
    (line,) = check.warnings

    assert str(MIN_PIXELS) in line
    assert (check.drift, check.wall_share) == (None, 0.0)


def filled(observations: np.ndarray, reference_frames: int = MANY) -> DriftWindow:
    window = DriftWindow(reference_frames)
    for observation in observations:
        window.add(WallObservation(*observation.tolist()), 0.5)
    return window


def observations(count: int, seed: int = 0) -> np.ndarray:
    """Return measurements of a wall 2 mm farther, each uncertain by 0.1 mm and 0.05 degrees."""
    middle = np.array([0.002, 0.0, 0.0, 0.0027, 50.0])
    spread = np.array([1e-4, 0.05, 0.05, 1e-4, 5.0])
    return middle + spread * np.random.default_rng(seed).standard_normal((count, 5))


def test_drift_window_needs_enough_frames() -> None:
    assert filled(observations(MIN_FRAMES - 1)).drift() is None

    window = filled(observations(MIN_FRAMES))

    assert window.drift() is not None

    for _ in range(WINDOW_FRAMES - MIN_FRAMES + 1):
        window.add(None, 0.0)

    assert window.drift() is None


def test_drift_window_of_a_short_reference_is_less_certain() -> None:
    few, many = (filled(observations(WINDOW_FRAMES), frames).drift() for frames in (1, MANY))
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


@pytest.mark.parametrize(
    ("change", "is_apart"),
    [
        ({}, False),
        ({"distance_m": 0.0009}, False),
        ({"distance_m": -0.0011}, True),
        ({"yaw_deg": 0.19}, False),
        ({"yaw_deg": 0.15, "pitch_deg": -0.15}, True),
        ({"pitch_deg": -0.21}, True),
        ({"range_m": 0.0, "uniform": True}, True),
    ],
)
def test_drifts_apart_by_a_tolerance_or_in_kind(change: dict[str, float], is_apart: bool) -> None:
    moved = replace(STILL, distance_m=0.004, yaw_deg=0.3, pitch_deg=0.2)
    values = {name: getattr(moved, name) + value for name, value in change.items()}
    other = replace(moved, **values)

    assert moved.apart(other) == is_apart
    assert other.apart(moved) == is_apart


def test_ranges_apart_by_a_tolerance() -> None:
    ranges = [replace(STILL, range_m=range_m, uniform=True) for range_m in (0.0, 0.0009, 0.0011)]
    assert [ranges[0].apart(each) for each in ranges] == [False, False, True]


@pytest.mark.parametrize("spread", ["distance_std_m", "yaw_std_deg", "pitch_std_deg"])
def test_drift_is_sharp_to_half_a_tolerance_of_each_kind(spread: str) -> None:
    tolerance = TOLERANCE_M if spread.endswith("_m") else TOLERANCE_DEG

    assert replace(STILL, **{spread: 0.49 * tolerance}).sharp
    assert not replace(STILL, **{spread: 0.51 * tolerance}).sharp


def test_drift_text_holds_amounts_and_uncertainties() -> None:
    moved = str(
        replace(STILL, distance_m=0.0018, distance_std_m=0.0002, yaw_deg=-0.3, pitch_deg=0.4)
    )

    assert "1.8 ± 0.4 mm" in moved
    assert "0.500 ± 0.020°" in moved
    assert "1.30 ± 0.02 mm" in str(replace(STILL, range_m=-0.0013, uniform=True))


TILTED: WallPose = (0.2, 45.0, -5.0)


@pytest.fixture
def tilted() -> BareWall:
    return reference_of_wall(TILTED, SMALL, np.random.default_rng(0))


def cells(pixels: np.ndarray) -> np.ndarray:
    rows, columns = np.divmod(pixels, SMALL.width)
    return rows * GRID[0] // SMALL.height * GRID[1] + columns * GRID[1] // SMALL.width


def test_watched_pixels_are_a_good_one_of_each_cell(tilted: BareWall) -> None:
    before = watched_pixels(tilted)
    worse = replace(tilted)

    np.testing.assert_array_equal(cells(before), np.unique(cells(np.flatnonzero(tilted.inliers))))

    for number, (field, value) in enumerate(
        {"depth_m": np.nan, "depth_std_m": 0.01, "saturated": 0.1, "inliers": False}.items()
    ):
        array = getattr(tilted, field).copy()
        array.flat[before[number::4]] = value
        worse = replace(worse, **{field: array})
    after = watched_pixels(worse)

    assert not set(before) & set(after)
    np.testing.assert_array_equal(cells(before), cells(after))


def test_noise_scale_is_that_of_the_reference(tilted: BareWall) -> None:
    assert noise_scale(replace(tilted, depth_std_m=2.0 * tilted.depth_std_m)) == pytest.approx(
        2.0, rel=0.05
    )

    single = replace(tilted, depth_std_m=np.full_like(tilted.depth_std_m, np.nan), frames=1)

    np.testing.assert_array_equal(watched_pixels(single), watched_pixels(tilted))
    assert noise_scale(single) == 1.0


def test_a_reference_without_noise_is_where_it_was(tilted: BareWall) -> None:
    quiet = replace(tilted, depth_std_m=np.zeros_like(tilted.depth_std_m))
    check = observed(DriftCheck(quiet, wall_from_lidar(POSE)), quiet.depth_m, 40)

    assert not check.moved
    assert check.warnings == ()


@pytest.mark.parametrize(
    "shift", [(0.0, 0.0, 0.0), (0.001, 0.2, -0.2), (-0.004, 1.0, 2.0), (0.03, -6.0, 5.0)]
)
def test_wall_track_finds_an_exact_pose_exactly(tilted: BareWall, shift: WallPose) -> None:
    exact = replace(
        tilted, depth_m=np.where(tilted.inliers, wall_depth(wall_from_lidar(TILTED), SMALL), np.nan)
    )
    pose = wall_from_lidar((TILTED[0] + shift[0], TILTED[1] + shift[1], TILTED[2] + shift[2]))
    track = WallTrack(exact, wall_from_lidar(TILTED))
    frame = wall_depth(pose, SMALL).astype(np.float32)
    observation = None
    for _ in range(60):
        observation = track.follow(frame)
    now = measures_of(-pose[2, :3] / pose[2, 3], np.zeros((3, 3)))

    assert observation.distance_m == pytest.approx(now.distance_m - TILTED[0], abs=2e-6)
    assert observation.yaw_deg == pytest.approx(now.yaw_deg - TILTED[1], abs=1e-3)
    assert observation.pitch_deg == pytest.approx(now.pitch_deg - TILTED[2], abs=1e-3)
    assert track.share == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("value", [np.nan, 0.0, np.inf, -1.0, 3.0])
def test_wall_track_of_frames_without_the_wall_is_none(tilted: BareWall, value: float) -> None:
    track = WallTrack(tilted, wall_from_lidar(TILTED))
    for _ in range(100):
        assert track.follow(np.full((SMALL.height, SMALL.width), value, np.float32)) is None


def test_a_wall_hidden_for_ten_seconds_is_said_until_seen(tilted: BareWall) -> None:
    check = DriftCheck(tilted, wall_from_lidar(TILTED))
    hidden = np.full_like(tilted.depth_m, np.nan)

    assert not observed(check, hidden, BLIND_FRAMES - 1).moved
    assert observed(check, hidden, 1).moved
    assert not observed(check, tilted.depth_m, WINDOW_FRAMES + BLIND_FRAMES // BLIND_ENDS).moved


@pytest.mark.parametrize(("longer_m", "moved"), [(0.003, False), (0.008, True)])
def test_small_drift_of_the_range_is_no_moved_lidar(
    tilted: BareWall, longer_m: float, moved: bool
) -> None:
    check = DriftCheck(tilted, wall_from_lidar(TILTED))
    length = np.linalg.norm(SMALL.rays(), axis=-1)
    observed(check, (tilted.depth_m + longer_m / length).astype(np.float32), 2 * WINDOW_FRAMES)

    assert check.drift is not None
    assert check.drift.uniform
    assert check.drift.range_m == pytest.approx(longer_m, rel=0.15)
    assert check.moved == moved
