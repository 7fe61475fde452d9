"""Accelerometers through librealsense: in a live camera, in its recordings, and in playback."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import roll_deg, way_up
from nlos_calibration.gravity import G_M_S2
from rewritten_bags import Messages, rewrite

from nlos_cam.camera import SimulatedCamera, gravity_of
from nlos_cam.camera.accelerometer import Accelerometer
from nlos_cam.camera.simulated import level_gravity
from nlos_cam.frames import Frame
from nlos_cam.recording import ReplayCamera

UP = (0.0, -G_M_S2, 0.0)
QUARTER = 8
"""Frames after which a quarter of a second's samples have come."""


@pytest.fixture
def frames(noise_world: Any, hurried_clock: Any) -> Callable[[int], list[Frame]]:
    """Read the first frames of a simulated camera."""

    def read(count: int) -> list[Frame]:
        with SimulatedCamera("sim:noise", noise_world(), clock=hurried_clock()) as camera:
            return list(islice(camera, count))

    return read


@pytest.mark.parametrize("roll", [0.0, 12.0, -90.0, 180.0])
def test_camera_reports_gravity_of_its_roll(
    frames: Callable[[int], list[Frame]], monkeypatch: pytest.MonkeyPatch, roll: float
) -> None:
    monkeypatch.setattr(SimulatedCamera, "roll_deg", roll)
    found = frames(QUARTER + 4)[-1].gravity_m_s2

    assert np.linalg.norm(found) == pytest.approx(G_M_S2, abs=1e-5)
    assert abs(roll_deg(found)) == pytest.approx(abs(roll), abs=1e-4)


def test_gravity_waits_for_a_quarter_of_a_second(frames: Callable[[int], list[Frame]]) -> None:
    assert frames(1)[0].gravity_m_s2 is None


def test_recording_replays_its_gravity(
    noise_world: Any,
    recorded: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SimulatedCamera, "roll_deg", 30.0)
    path = recorded(tmp_path / "rolled.bag", frames=20)
    with ReplayCamera(path) as camera:
        found = [frame.gravity_m_s2 for frame in camera]

    expected = level_gravity(noise_world().rig, 30.0)

    assert len(found) == 20
    np.testing.assert_allclose(found, np.tile(expected, (20, 1)), atol=1e-5)


def test_damaged_accelerometer_costs_no_frame(noise_bag: Path, tmp_path: Path) -> None:
    def cut(topic: str, time_ns: int, raw: bytes) -> Messages:
        yield time_ns, raw[:40] if topic.endswith("/imu/data") else raw

    with ReplayCamera(rewrite(noise_bag, tmp_path / "cut.bag", cut)) as camera:
        frames = list(camera)

    assert len(frames) == 20
    assert frames[-1].gravity_m_s2 is None


def test_gravity_is_rotated_into_the_lidars_frame() -> None:
    # the sensor's x axis is the lidar's y: turned by 90 degrees about the optical axis
    lidar_from_sensor = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    samples = [(-G_M_S2, 0.0, 0.0)]

    assert gravity_of(samples, np.eye(3)) == (G_M_S2, 0.0, 0.0)
    assert gravity_of(samples, lidar_from_sensor) == pytest.approx((0.0, G_M_S2, 0.0))
    assert way_up(gravity_of([UP], np.eye(3))) == "upright"


@pytest.mark.parametrize("samples", [[], [(0.0, -2.0, 0.0)], [UP, (0.0, G_M_S2, 0.0)]])
def test_moved_or_silent_accelerometer_gives_no_gravity(samples: list[Any]) -> None:
    assert gravity_of(samples, np.eye(3)) is None


class Stubborn:
    """Motion sensor that does not start."""

    def refuse(self, *_: Any) -> None:
        raise RuntimeError("no permission")

    open = start = stop = close = refuse


def test_accelerometer_that_does_not_start_is_no_error() -> None:
    class Profile:
        def fps(self) -> int:
            return 100

        def get_extrinsics_to(self, _: Any) -> None:
            raise RuntimeError("not known")

    found = Accelerometer(Stubborn(), Profile(), None)
    found.start()

    assert found.gravity() is None

    found.stop()
