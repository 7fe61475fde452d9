"""Someone measures a bare wall with a lidar whose ranges are off, or that is upside down."""

import sys
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig, load_wall
from nlos_calibration.errors import CalibrationError, WallRefusedError
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.noise import depth_noise_m
from nlos_calibration.wall import wall_depth

from nlos_cam.calibrate import measure
from nlos_cam.camera import SimulatedCamera

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
    capture: Any = SimpleNamespace(
        statistics=SimpleNamespace(depth=depth), intrinsics=PINHOLE, parts_m=()
    )
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


Run = Callable[..., Any]
BARE = "calibrate", "--wall", "--camera", "sim:bare-wall", "--frames", 15, "--out", "wall.toml"
RECORD = Path("wall.toml")
REPORT = Path("wall.html")


@pytest.fixture
def upside_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SimulatedCamera, "roll_deg", 180.0)


@pytest.mark.usefixtures("upside_down")
@pytest.mark.parametrize("said", [(), ("--upright",)])
def test_camera_upside_down_is_refused(run: Run, said: tuple[str, ...]) -> None:
    answer = run(*BARE, *said, code=1)

    assert "upside down" in answer["error"]["message"]
    assert "turn it over" in answer["error"]["message"]
    assert not RECORD.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("upside_down")
def test_camera_that_hangs_on_purpose_is_measured(run: Run) -> None:
    assert run(*BARE, "--upside-down")["way_up"] == "upside down"
    assert load_wall(RECORD).way_up == "upside down"
    assert "Pictures turn with the camera" in REPORT.read_text(encoding="utf-8")


def test_upright_camera_is_recorded_by_gravity(run: Run) -> None:
    run(*BARE)
    record = load_wall(RECORD)

    assert record.way_up == "upright"
    assert record.gravity_m_s2[1] == pytest.approx(9.81, abs=0.01)
    assert "by gravity" in REPORT.read_text(encoding="utf-8")


@pytest.mark.slow
def test_upright_camera_contradicts_upside_down(run: Run) -> None:
    answer = run(*BARE, "--upside-down", code=1)
    assert "leave out --upside-down" in answer["error"]["message"]


@pytest.fixture
def without_accelerometer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.camera.live_camera.Accelerometer.of", lambda *_: None)


class Terminal(StringIO):
    """Keyboard of a person at a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("without_accelerometer")
def test_owner_is_asked_once_whether_the_camera_is_upright(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("\n"))

    assert run(*BARE).err.count("Is the camera upright") == 1
    assert load_wall(RECORD).way_up == "upright"
    assert "its owner said" in REPORT.read_text(encoding="utf-8")


@pytest.mark.usefixtures("without_accelerometer")
def test_owner_who_says_upside_down_hears_what_to_do(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("n\n"))

    assert "turn it over" in run(*BARE, code=1)["error"]["message"]
    assert not RECORD.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("without_accelerometer")
@pytest.mark.parametrize(
    ("options", "way_up"),
    [((), "unknown"), (("--upright",), "upright"), (("--upside-down",), "upside down")],
)
def test_nobody_is_asked_without_a_terminal(
    run: Run, options: tuple[str, ...], way_up: str
) -> None:
    run(*BARE, *options)
    report = REPORT.read_text(encoding="utf-8")

    assert load_wall(RECORD).way_up == way_up
    assert ("Not known: which way up" in report) == (way_up == "unknown")
