from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.simulated import EXPOSED_AHEAD_S, MAX_LATENESS, SimulatedCamera
from nlos_cam.recording.playback import ReplayCamera


class BusyClock:
    """A clock of a machine that stands still for `gap_s` once, at the third frame."""

    def __init__(self, gap_s: float) -> None:
        self.time_s, self.gap_s, self.waits = 0.0, gap_s, 0

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        self.time_s += max(seconds, 0.0)
        self.waits += 1
        if self.waits == 3:
            self.time_s += self.gap_s
        return stop.wait(0.001)


class SetClock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        due_s = self.time_s + seconds
        while self.time_s < due_s and not stop.wait(0.001):
            pass
        return stop.is_set()


def numbers_recorded(path: Path, world: Any, clock: Any, frames: int) -> list[int]:
    with SimulatedCamera("sim", world, clock=clock, recording=Recording(path, frames=frames)) as camera:
        assert all(frame is not None for frame in camera)
    with ReplayCamera(path) as replayed:
        return [frame.frame_number for frame in replayed]


def test_frames_are_due_every_thirtieth_of_a_second(noise_world: Any, hurried_clock: Any) -> None:
    with SimulatedCamera("sim", noise_world(), clock=hurried_clock(1e9)) as camera:
        for frame in islice(camera, 6):
            assert frame.timestamp_s == pytest.approx(1e9 + frame.frame_number / 30, abs=1e-6)


@pytest.mark.parametrize(("takes_s", "ahead_s"), [(0.001, EXPOSED_AHEAD_S), (0.012, 0.024)])
def test_a_frame_is_exposed_late_but_in_time(
    noise_world: Any, hurried_clock: Any, takes_s: float, ahead_s: float
) -> None:
    clock, start_s = hurried_clock(0.0), dict[int, float]()

    class Timed(noise_world):
        def images(self, number: int) -> Any:
            start_s[number] = clock.now()
            clock.time_s += takes_s
            return super().images(number)

    camera = SimulatedCamera("sim", Timed(), clock=clock)
    zero_s = clock.now()
    with camera:
        for _ in zip(range(6), camera, strict=False):
            pass
    for number in range(2, 6):
        assert zero_s + number / 30 - start_s[number] == pytest.approx(ahead_s, abs=1e-6)


def test_frames_carry_the_truth_of_their_number(noise_world: Any, hurried_clock: Any) -> None:
    with SimulatedCamera("sim", noise_world(), clock=hurried_clock()) as camera:
        for frame in islice(camera, 6):
            np.testing.assert_array_equal(frame.truth_depth_m, noise_world().truth_depth_m(frame.frame_number))


def test_it_tells_the_temperatures_of_the_instant_while_it_streams(noise_world: Any) -> None:
    clock = SetClock()
    with SimulatedCamera("sim", noise_world(), clock=clock) as camera:
        assert next(iter(camera)).settings["ldd_temperature"] == 20.0  # as it started
        for instant in (0, 30, 45):
            clock.time_s = (instant + 0.5) / 30
            assert camera.telemetry("_temperature") == {"ldd_temperature": 20.0 + instant}
        assert set(camera.telemetry()) >= {"depth_units", "ldd_temperature"}
    assert camera.telemetry() == camera.telemetry("_temperature") == {}


def test_a_recording_holds_the_temperature_that_it_began_with(noise_bag: Path) -> None:
    with ReplayCamera(noise_bag) as replayed:
        assert next(iter(replayed)).settings["ldd_temperature"] == 20.0
        assert replayed.telemetry("_temperature") == {"ldd_temperature": 20.0}


def test_a_world_that_fails_fails_its_reader(noise_world: Any, hurried_clock: Any) -> None:
    with (
        pytest.raises(ZeroDivisionError, match="the world ended"),
        SimulatedCamera("sim", noise_world(fails_at=3), clock=hurried_clock()) as camera,
    ):
        list(camera)


def test_a_world_that_is_a_little_late_catches_up(noise_world: Any, tmp_path: Path) -> None:
    clock = BusyClock(gap_s=0.9 * MAX_LATENESS / 30)
    assert numbers_recorded(tmp_path / "late.bag", noise_world(), clock, 40) == list(range(40))


def test_a_world_that_is_very_late_drops_numbers(noise_world: Any, tmp_path: Path) -> None:
    clock = BusyClock(gap_s=3 * MAX_LATENESS / 30)
    numbers = numbers_recorded(tmp_path / "late.bag", noise_world(), clock, 10)
    gaps = np.diff(numbers) - 1
    assert gaps.max() == pytest.approx(2 * MAX_LATENESS, abs=3)
    assert np.count_nonzero(gaps) == 1


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts native threads, as Linux lists them")
def test_native_threads_do_not_pile_up(noise_world: Any, hurried_clock: Any) -> None:
    def run() -> int:
        with SimulatedCamera("sim", noise_world(), clock=hurried_clock()) as camera:
            next(iter(camera))
        return len(list(Path("/proc/self/task").iterdir()))

    before = run()
    assert [run() for _ in range(20)][-1] < before + 10
