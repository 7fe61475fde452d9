"""Someone measures a bare wall with a lidar whose ranges are off."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_calibration.errors import CalibrationError, WallRefusedError
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.noise import depth_noise_m
from nlos_calibration.wall import wall_depth

from nlos_cam.calibrate import measure

TAPE_M = 0.2
PINHOLE = load_rig("paper-rig").pinhole.scaled(64, 48)
RAY_LENGTH = np.linalg.norm(PINHOLE.rays(), axis=-1)


def bare_wall_m() -> np.ndarray:
    pose = wall_from_plane(normal_from_angles(np.radians(45.0), np.radians(2.0)), TAPE_M)
    depth_m = wall_depth(pose, PINHOLE)
    depth_m[depth_m > 9.0] = np.nan
    return depth_m


def measured(depth_m: np.ndarray) -> Any:
    noise_m = np.random.default_rng(1).normal(0.0, depth_noise_m(depth_m)) / 8.0
    depth = SimpleNamespace(mean_m=lambda: depth_m + noise_m, noise=lambda: None)
    capture: Any = SimpleNamespace(statistics=SimpleNamespace(depth=depth), intrinsics=PINHOLE)
    return measure.measure_by_depth(capture, TAPE_M)


@pytest.mark.parametrize("short_m", [-0.03, -0.02, 0.02])
def test_offset_of_depth_is_fitted_with_the_tape(short_m: float) -> None:
    fit, facts = measured(bare_wall_m() - short_m)

    assert facts["range_offset_m"] == pytest.approx(short_m, abs=1e-3)
    assert fit.distance_m == pytest.approx(TAPE_M, abs=1e-6)
    assert fit.facing_deg == pytest.approx(45.0, abs=0.2)


@pytest.mark.parametrize("short_m", [-0.12, -0.05, 0.05, 0.12])
@pytest.mark.parametrize("kind", ["depths", "ranges along the rays"])
def test_large_offset_is_named(short_m: float, kind: str) -> None:
    share = 1.0 if kind == "depths" else 1.0 / RAY_LENGTH
    with pytest.raises(CalibrationError, match=f"{kind} are {abs(short_m) * 1e3:.0f} mm") as raised:
        measured(bare_wall_m() - short_m * share)

    assert "remove everything" not in str(raised.value)


def test_clutter_is_not_called_an_offset() -> None:
    depth_m = bare_wall_m()
    depth_m[20:40, 10:40] -= 0.05
    with pytest.raises(WallRefusedError, match="remove"):
        measured(depth_m)
