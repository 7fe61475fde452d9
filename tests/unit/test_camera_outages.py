"""LiveCamera over the faults that an L515 has, on a fake SDK that delivers from a thread of its own."""

import time
from collections.abc import Callable, Iterator
from itertools import islice, pairwise
from threading import Event, Thread
from typing import Any

import pytest
from fake_lidar import FakeLidar

from nlos_cam.camera.l515 import NEAR_WALL, L515Camera
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Frame

Make = Callable[..., Any]
SILENCE_S = 0.3
ENDLESS = 10**6


def entered(camera: L515Camera) -> L515Camera:
    camera.silence_s = SILENCE_S
    return camera


def rises(frames: list[Frame]) -> bool:
    """Whether numbers and timestamps rise together."""
    return all(
        next_one.frame_number > one.frame_number
        and (next_one.timestamp_s - one.timestamp_s) * 30
        == pytest.approx(next_one.frame_number - one.frame_number, abs=0.5)
        for one, next_one in pairwise(frames)
    )


def holes(frames: list[Frame]) -> int:
    return frames[-1].frame_number - frames[0].frame_number + 1 - len(frames)


def test_a_stall_is_cured_by_a_restart_of_the_streams(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30, ENDLESS))
    with entered(fake_camera(lidar)) as camera:
        frames = list(islice(camera, 50))
        assert camera.counts == {"restarted": 1}
    assert rises(frames)
    assert camera.dropped + camera.incomplete == holes(frames) > 0


def test_each_silence_begins_with_a_restart(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30, 30, 30, 30, 30, ENDLESS))
    with entered(fake_camera(lidar)) as camera:
        camera.silence_s = 0.1
        while camera.counts["restarted"] < 5:
            next(iter(camera))
        assert camera.counts == {"restarted": 5}


def test_a_device_that_gives_nothing_from_the_start_is_restarted(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(0, 0, ENDLESS))
    with entered(fake_camera(lidar)) as camera:
        assert next(iter(camera)).depth_m.size
        assert camera.counts == {"restarted": 2}
        assert camera.dropped == camera.incomplete == 0


def test_a_device_that_restarts_do_not_help_is_reset(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30, 0, 0, 0, ENDLESS))
    with entered(fake_camera(lidar)) as camera:
        frames = list(islice(camera, 50))
        assert camera.counts == {"restarted": 3, "reset": 1}
    assert rises(frames)
    assert lidar.did.count("reset") == 1


def test_a_device_that_nothing_helps_is_lost_with_what_came_and_was_tried(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30,))
    with (
        entered(fake_camera(lidar)) as camera,
        pytest.raises(
            CameraLostError, match=r"\(so far (\d+) depth, \1 infrared, \1 confidence\), nor after 3 restarts"
        ),
    ):
        list(camera)
    assert lidar.did[-1] == "close"


def test_numbers_of_which_some_stream_came_are_counted_as_incomplete(fake_camera: Make) -> None:
    lidar = FakeLidar()
    with entered(fake_camera(lidar)) as camera:
        frames = iter(camera)
        lidar.deliver(range(1, 3))
        seen = [next(frames), next(frames)]
        lidar.deliver(range(3, 103), streams=("depth",))
        lidar.runs = [ENDLESS]
        seen.append(next(frames))
        assert camera.incomplete == 70  # the youngest 30 may yet have become sets
        assert camera.incomplete + camera.dropped >= holes(seen)
    assert rises(seen)


def test_a_hot_unplug_and_replug_is_survived_with_the_same_settings(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30, ENDLESS))
    lidar.flaps = 1
    with entered(fake_camera(lidar)) as camera:
        frames = list(islice(camera, 50))
        assert camera.counts == {"replugged": 1}
    assert rises(frames)
    assert lidar.options["visual_preset"] == 5.0
    assert {name: lidar.options[name] for name in NEAR_WALL} == NEAR_WALL
    assert frames[-1].settings["min_distance"] == 0.0


def test_an_unplugged_device_is_told_when_it_does_not_come_back(
    fake_camera: Make, caplog: pytest.LogCaptureFixture
) -> None:
    lidar = FakeLidar()
    with entered(fake_camera(lidar)) as camera:
        lidar.unplug()
        with pytest.raises(CameraLostError, match="it was unplugged and did not start within 60 s"):
            list(camera)
        assert camera.telemetry() == {}
    assert caplog.text.count("waiting 60 s for it to be plugged in again") == 1


def test_another_device_is_not_taken_for_the_one_that_was_unplugged(fake_camera: Make) -> None:
    lidar, other = FakeLidar("f1"), FakeLidar("f2")
    with entered(fake_camera(lidar, other, serial="f1")) as camera:
        lidar.unplug()
        with pytest.raises(CameraLostError, match="unplugged"):
            list(camera)
    assert not other.did


def test_a_device_that_comes_back_on_a_slow_port_is_told(fake_camera: Make) -> None:
    lidar = FakeLidar()
    with entered(fake_camera(lidar)) as camera:
        lidar.unplug()
        lidar.info["usb_type_descriptor"] = "2.1"
        lidar.plug_in()
        with pytest.raises(CameraLostError, match="offers no depth and no infrared and no confidence at 640 x 480"):
            list(camera)


def test_a_device_that_flaps_twenty_times_is_survived_each_time(fake_camera: Make) -> None:
    """The fixture `nothing_left_running` sees to it that no thread is left."""
    lidar = FakeLidar(usb="2.1", runs=(20, ENDLESS))
    lidar.flaps = 20
    with fake_camera(lidar) as camera:
        camera.silence_s = 0.2
        frames = list[Frame]()
        while camera.counts["replugged"] < 20 or len(frames) % 5:
            frames += islice(camera, 1)
        assert camera.counts["replugged"] == 20
        assert camera.dropped + camera.incomplete == holes(frames)
    assert rises(frames)
    assert lidar.did.count("unplugged") == 20


def test_a_lost_calibration_is_cured_by_one_reset_before_entering(fake_camera: Make) -> None:
    lidar = FakeLidar()
    lidar.uncalibrated = True
    camera = fake_camera(lidar)
    assert camera.counts == {"reset": 1}
    assert camera.intrinsics.width == 640


def test_a_calibration_that_stays_lost_is_an_error(fake_camera: Make) -> None:
    lidar = FakeLidar()
    lidar.uncalibrated, lidar.reset_takes = True, 0
    with pytest.raises(CameraError, match="doesn't exist"):
        fake_camera(lidar)


class RealPace:
    """A clock that waits as long as it is asked to."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, stop: Event, seconds: float) -> bool:
        return stop.wait(seconds)


@pytest.fixture
def waiting(fake_camera: Make) -> Iterator[tuple[L515Camera, Thread, list[Exception]]]:
    """A camera that waits for its device, iterated by a thread, and what that raised."""
    lidar, failures = FakeLidar(), list[Exception]()

    def iterate() -> None:
        try:
            list(camera)
        except Exception as error:  # noqa: BLE001  whatever it is, the test looks at it
            failures.append(error)

    with fake_camera(lidar, clock=RealPace()) as camera:
        camera.silence_s = 0.05
        lidar.unplug()
        thread = Thread(target=iterate)
        thread.start()
        yield camera, thread, failures


def test_leaving_ends_a_recovery_within_a_second(waiting: tuple[L515Camera, Thread, list[Exception]]) -> None:
    camera, thread, failures = waiting
    time.sleep(0.3)
    assert thread.is_alive()
    left_s = time.monotonic()
    camera.__exit__(None, None, None)
    thread.join(5.0)
    assert time.monotonic() - left_s < 1.0
    assert not failures


def test_leaving_twice_does_nothing(fake_camera: Make) -> None:
    lidar = FakeLidar()
    with fake_camera(lidar) as camera:
        camera.__exit__(None, None, None)
    assert lidar.did.count("stop") == lidar.did.count("close") == 1
