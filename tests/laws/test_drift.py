"""A check of drift is silent while the lidar stands, whatever is in the way, and warns when it
moves.
"""

import numpy as np
import pytest
from nlos_calibration import TOLERANCE_DEG, TOLERANCE_M, Intrinsics, wall_depth
from nlos_calibration.drift import BLIND_FRAMES, WINDOW_FRAMES
from synthetic_scenes import (
    PINHOLE,
    SMALL,
    WallPose,
    WallStream,
    chained,
    multipath,
    noisy_depth,
    occluding_sheet,
)
from synthetic_walls import view

POSES = [
    (0.2, 45.0, 0.0),
    (0.15, 15.0, 0.0),
    (0.3, 70.0, -8.0),
    (0.3, 15.0, 5.0),
    (0.2, -60.0, 10.0),
    (0.2, 0.0, 0.0),
]
SHIFTS = [(0.002, 0.0, 0.0), (-0.002, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5)]
REPORTED_FRAMES = 60
SIGMAS = 4.5
poses = pytest.mark.parametrize("pose", POSES)


def assert_right(stream: WallStream, shift: WallPose) -> None:
    """Check that the drift is the lidar's move within its uncertainty, which must be small."""
    drift = stream.check.drift
    assert abs(drift.distance_m - shift[0]) < SIGMAS * drift.distance_std_m < TOLERANCE_M
    assert abs(drift.yaw_deg - shift[1]) < SIGMAS * drift.yaw_std_deg < 2 * TOLERANCE_DEG
    assert abs(drift.pitch_deg - shift[2]) < SIGMAS * drift.pitch_std_deg < 2 * TOLERANCE_DEG


@poses
@pytest.mark.parametrize("intrinsics", [SMALL, PINHOLE], ids=["320", "640"])
def test_drift_check_is_silent_at_noise_alone(pose: WallPose, intrinsics: Intrinsics) -> None:
    stream = WallStream(pose, intrinsics)

    assert stream.show(pose, 500) is None
    assert_right(stream, (0.0, 0.0, 0.0))
    assert stream.check.wall_share > 0.95


@poses
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_drift_check_is_silent_at_objects_and_occluders(pose: WallPose, share: float) -> None:
    stream = WallStream(pose, seed=1)
    for seed in range(3):
        assert stream.show(pose, 100, multipath(stream.places, share, seed)) is None

    assert stream.check.wall_share == pytest.approx(1.0 - share, abs=0.05)

    for hide in (
        occluding_sheet(stream.places, 0.4),
        chained(multipath(stream.places, 0.5, 4), occluding_sheet(stream.places, 0.7)),
    ):
        assert stream.show(pose, 100, hide) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("pose", [POSES[0], (0.3, 75.0, -8.0)])
def test_drift_check_is_silent_at_detours_beyond_the_wall(pose: WallPose, seed: int) -> None:
    """At a grazing angle a detour of centimetres looks like a wall turned by a degree."""
    stream = WallStream(pose, seed=seed)

    assert stream.show(pose, 200, multipath(stream.places, 0.9, seed, beyond=True)) is None
    assert stream.check.wall_share == pytest.approx(0.1, abs=0.05)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("pose", [POSES[0], (0.3, 65.0, -8.0)])
def test_drift_check_is_silent_at_detours_across_the_wall(pose: WallPose, seed: int) -> None:
    """Detours behind an occluder have any depth, also the wall's."""
    stream = WallStream(pose, seed=seed)
    hide = chained(
        occluding_sheet(stream.places, 0.3),
        multipath(stream.places, 0.8, seed, beyond=seed % 2 == 0),
    )

    assert stream.show(pose, 200, hide) is None


@poses
@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_drift_check_measures_a_knock_beside_an_object(
    pose: WallPose, shift: WallPose, share: float
) -> None:
    stream = WallStream(pose, seed=3)
    hide = [multipath(stream.places, share, 5)] if share else []

    assert stream.show(pose, 40, *hide) is None

    reported = stream.show(stream.moved(*shift), REPORTED_FRAMES, *hide)

    assert reported > 3 or share  # a frame or two are no news
    assert_right(stream, shift)


@pytest.mark.parametrize(
    "shift", [(0.01, 0.0, 0.0), (0.0, -5.0, 0.0), (0.03, 5.0, -3.0), (-0.02, -8.0, 2.0)]
)
@pytest.mark.parametrize("pose", POSES[:2])
def test_drift_check_measures_a_large_move_beside_both(pose: WallPose, shift: WallPose) -> None:
    stream = WallStream(pose, seed=4)
    hide = chained(multipath(stream.places, 0.3, 6), occluding_sheet(stream.places, 0.8))

    assert stream.show(pose, 40, hide) is None
    assert stream.show(stream.moved(*shift), 3 * REPORTED_FRAMES, hide) is not None
    assert_right(stream, shift)


@poses
def test_drift_check_warning_ends_when_the_lidar_is_back(pose: WallPose) -> None:
    stream = WallStream(pose, seed=5)

    assert stream.show(stream.moved(0.002, 0.5, -0.5), REPORTED_FRAMES) is not None

    stream.show(pose, WINDOW_FRAMES)

    assert stream.check.warnings == ()


@poses
def test_drift_check_names_a_range_that_drifts(pose: WallPose) -> None:
    stream = WallStream(pose, seed=6)

    assert stream.show(pose, 60, lambda depth_m, _: depth_m + 0.7 * TOLERANCE_M) is None

    stream.show(pose, 60, lambda depth_m, _: depth_m + 1.5 * TOLERANCE_M)
    (line,) = stream.check.warnings

    assert "range" in line

    drift = stream.check.drift

    assert abs(drift.range_m - 1.5 * TOLERANCE_M) < SIGMAS * drift.range_std_m < 0.2 * TOLERANCE_M


@pytest.mark.parametrize("pose", POSES[:5])
def test_drift_check_separates_a_move_from_a_range_drift(pose: WallPose) -> None:
    """Not where the wall is faced squarely: both are the same there."""
    stream = WallStream(pose, seed=7)
    stream.show(stream.moved(0.002), REPORTED_FRAMES)
    (line,) = stream.check.warnings

    assert "moved" in line


@pytest.mark.parametrize(
    "offset_m", [0.7 * TOLERANCE_M, TOLERANCE_M, 1.1 * TOLERANCE_M, 1.5 * TOLERANCE_M]
)
def test_drift_check_warnings_do_not_flicker(offset_m: float) -> None:
    """Neither at the limit nor while a drift grows slowly."""
    stream = WallStream(POSES[0], seed=8)
    seen = [()]
    for _ in range(600):
        stream.show(
            stream.pose, 1, lambda depth_m, number: depth_m + offset_m * min(number / 300, 1.0)
        )
        if seen[-1] != stream.check.warnings:
            seen.append(stream.check.warnings)

    assert len(seen) <= 2


def test_drift_check_warns_of_a_wall_out_of_view_until_back() -> None:
    stream = WallStream(POSES[0], seed=9)
    stream.show(stream.pose, 40)

    assert (
        stream.show(stream.pose, BLIND_FRAMES - 1, lambda depth_m, _: np.full_like(depth_m, np.nan))
        is None
    )
    assert stream.check.drift is None
    assert stream.check.wall_share == 0.0
    assert stream.show(stream.pose, 60, multipath(stream.places, 0.97, 1)) is not None

    (line,) = stream.check.warnings

    assert "%" in line

    stream.show(stream.pose, 2 * WINDOW_FRAMES)

    assert stream.check.warnings == ()


def test_drift_check_keeps_its_warning_while_the_wall_is_hidden() -> None:
    stream = WallStream(POSES[0], seed=10)
    stream.show(stream.moved(0.003), REPORTED_FRAMES)
    before = stream.check.warnings
    stream.show(stream.pose, REPORTED_FRAMES, lambda depth_m, _: np.full_like(depth_m, np.nan))

    assert stream.check.warnings == before != ()


def test_drift_check_measures_whole_frames_with_holes() -> None:
    """As from a camera: every pixel has depth, except whole columns and whole frames."""
    stream = WallStream(POSES[0], PINHOLE, seed=11)
    generator = np.random.default_rng(1)
    depth_m = wall_depth(view(*stream.moved(0.002), PINHOLE).pose, PINHOLE)
    depth_m[:, 200:400] = np.nan
    for number in range(40):
        frame = noisy_depth(depth_m, generator) if number % 4 else np.full_like(depth_m, np.nan)
        stream.check.observe(frame.astype(np.float32), {})
    drift = stream.check.drift

    assert abs(drift.distance_m - 0.002) < SIGMAS * drift.distance_std_m < TOLERANCE_M

    (line,) = stream.check.warnings

    assert "moved" in line
