import time
from threading import Event

from nlos_cam.camera.protocol import WallClock


def test_it_starts_at_the_time_of_day_and_never_goes_back() -> None:
    clock = WallClock()
    times = [clock.now() for _ in range(100)]
    assert abs(times[0] - time.time()) < 1.0
    assert times == sorted(times)


def test_a_wait_ends_when_stopped_or_past() -> None:
    clock, stop = WallClock(), Event()
    assert not clock.wait(stop, -1.0)
    stop.set()
    assert clock.wait(stop, 60.0)
