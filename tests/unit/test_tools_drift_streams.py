"""Holds the drawn reference against one that is collected from frames, and what hides the wall against its words."""

import numpy as np
import pytest
from nlos_calibration.reference import BareWallStatistics
from nlos_calibration.wall import wall_depth

from nlos_cam.calibrate.synthetic import (
    REFERENCE_FRAMES,
    SMALL,
    Pose,
    WallStream,
    detours,
    measured,
    sensed,
    sheet,
    wall_from_lidar,
)

TINY = SMALL.scaled(80, 60)
POSE: Pose = (0.2, 30.0, 0.0)


def test_the_reference_is_as_one_from_frames() -> None:
    generator = np.random.default_rng(0)
    drawn, collected = measured(POSE, TINY, generator), BareWallStatistics(TINY)
    truth_m, cells = wall_depth(wall_from_lidar(POSE), TINY), np.zeros((64, 80), np.float32)
    for _ in range(REFERENCE_FRAMES):
        collected.add(sensed(truth_m, generator).astype(np.float32), np.full((60, 80), 40, np.uint8), cells, cells)
    wall = collected.reference(drawn.inliers, serial="", settings={})
    for reference in (drawn, wall):
        pulls = (reference.depth_m - truth_m) / (0.0005 + 0.002 * truth_m) * np.sqrt(REFERENCE_FRAMES)
        assert np.nanstd(pulls) == pytest.approx(1.0, abs=0.05)
    assert np.nanmean(drawn.depth_std_m / wall.depth_std_m) == pytest.approx(1.0, abs=0.03)
    assert set(vars(drawn)) == set(vars(wall))
    for name in ("depth_m", "ir", "saturated", "map_depth_m"):
        assert getattr(drawn, name).dtype == getattr(wall, name).dtype
        assert getattr(drawn, name).shape == getattr(wall, name).shape


def test_detours_are_longer_and_move_and_a_sheet_is_nearer() -> None:
    stream = WallStream(POSE, TINY)
    depth_m = np.full(len(stream.pixels), 0.3)
    hide = detours(stream.places, 0.6, 1)
    first, later = hide(depth_m, 0) - depth_m, hide(depth_m, 10) - depth_m
    assert (first > 0.0).mean() == pytest.approx(0.6, abs=0.01)
    assert first[first > 0.0].min() >= 0.03 - 1e-9
    assert first.max() <= 0.4 + 1e-9
    assert ((first > 0.0) != (later > 0.0)).any()
    nearer = depth_m - sheet(stream.places, 0.5)(depth_m, 0)
    assert (nearer > 0.0).mean() == pytest.approx(0.5, abs=0.05)
    assert nearer[nearer > 0.0].min() >= 0.05


def test_the_same_seed_gives_the_same_drift() -> None:
    drifts = []
    for _ in range(2):
        stream = WallStream(POSE, TINY, seed=3)
        assert stream.show(stream.moved(0.003), 30) is not None
        drifts.append(stream.check.drift)
    assert drifts[0] == drifts[1]
