from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from nlos_cam.errors import CameraError, CameraLostError

Make = Callable[..., Any]
UNIT = 0.00025


def test_a_device_without_a_stream_is_told(fake_l515: Make, fake_camera: Make) -> None:
    with pytest.raises(CameraError, match="offers no confidence at 640 x 480"):
        fake_camera(fake_l515(streams=("depth", "infrared")))


def test_frames_from_before_the_settings_are_not_delivered(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    with fake_camera(device) as camera:
        device.deliver(range(5, 8))
        frames = iter(camera)
        assert [next(frames).frame_number for _ in range(3)] == [5, 6, 7]


def test_pixels_become_metres_and_levels(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    with fake_camera(device) as camera:
        device.deliver(range(1, 2))
        frame = next(iter(camera))
    np.testing.assert_allclose(frame.depth_m, 240 * UNIT, rtol=1e-6)
    assert (frame.ir == 240).all()
    assert (frame.confidence == 15).all()
    assert frame.truth_depth_m is None


def test_a_device_that_falls_silent_is_lost_and_says_what_came(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    with fake_camera(device) as camera:
        camera.silence_s = 0.01
        device.deliver(range(1, 3))
        device.runs = []
        with pytest.raises(CameraLostError, match="so far 2 depth, 2 infrared, 2 confidence"):
            list(camera)


def test_a_device_that_does_not_start_is_left_closed(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    device.start_error = RuntimeError("failed to set power state")
    with pytest.raises(CameraError, match="failed to set power state"):
        fake_camera(device).__enter__()
    assert device.did == ["stop", "close"]


def test_a_device_that_does_not_tell_its_unit_is_told(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    del device.options["depth_units"]
    with pytest.raises(CameraError, match="does not tell its depth unit"):
        fake_camera(device)


def test_leaving_stops_and_closes(fake_l515: Make, fake_camera: Make) -> None:
    device = fake_l515()
    with fake_camera(device):
        pass
    assert device.did[-2:] == ["stop", "close"]
