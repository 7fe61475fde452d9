import time
from threading import Event

from nlos_cam.camera.protocol import WallClock


def test_wall_clock_never_goes_back_and_waits_until_stopped() -> None:
    clock, stop = WallClock(), Event()
    before = time.time()
    times = [clock.now() for _ in range(100)]
    assert times == sorted(times)
    assert before - 1.0 < times[0] < time.time() + 1.0
    assert not clock.wait(stop, -1.0)
    stop.set()
    assert clock.wait(stop, 60.0)
