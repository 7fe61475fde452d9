"""The stages, on hooks that note what was done; tests of LiveCamera hold them on a fake SDK."""

from collections import Counter
from collections.abc import Callable
from threading import Event
from typing import Any

import pytest
from fake_lidar import NapClock

from nlos_cam.camera.recovery import BACK_OFF_S, Hooks, Recovery
from nlos_cam.errors import CameraError, CameraLostError

WHAT = "l515 gave no whole frame"


class Bench:
    """A device of which is told when it is there, and which starts fail."""

    def __init__(self, there: Callable[[float], bool] = lambda _: True, failing: tuple[str, ...] = ()) -> None:
        self.clock, self.left, self.counts, self.did = NapClock(), Event(), Counter[str](), list[str]()
        self.zero_s, self.there, self.failing = self.clock.now(), there, list(failing)
        hooks = Hooks(self.start, lambda: self.did.append("stop"), self.is_connected, self.reconnect, self.reset)
        self.recovery = Recovery("l515", hooks, self.clock, self.left, self.counts)

    def is_connected(self) -> bool:
        return self.there(self.clock.now() - self.zero_s)

    def reconnect(self) -> Any | None:
        return "device" if self.is_connected() else None

    def start(self, device: Any) -> None:
        assert device == "device"
        if self.failing and (why := self.failing.pop(0)):
            raise RuntimeError(why)
        self.did.append("start")

    def reset(self) -> None:
        self.did.append("reset")

    def recover(self) -> None:
        self.recovery.recover(WHAT, replug_s=60.0)


def test_streams_restart_with_back_off_then_comes_a_reset_then_the_end() -> None:
    bench = Bench()
    for _ in range(4):
        bench.recover()
    with pytest.raises(CameraLostError, match=r"no whole frame, nor after 3 restarts of its streams and a reset: unpl"):
        bench.recover()
    assert bench.did == ["stop", "start"] * 3 + ["stop", "stop", "reset", "start", "stop"]
    assert tuple(nap for nap in bench.clock.naps if nap >= 0.5) == BACK_OFF_S
    assert bench.counts == {"restarted": 3, "reset": 1}


def test_a_restart_that_fails_is_followed_by_the_next_at_once() -> None:
    bench = Bench(failing=("busy", "busy"))
    bench.recover()
    assert bench.counts == {"restarted": 3}
    assert bench.did == ["stop", "start"]


def test_what_failed_is_in_the_last_word() -> None:
    bench = Bench(failing=("failed to set power state",) * 200)
    with pytest.raises(CameraLostError, match="failed to set power state"):
        bench.recover()


def test_lost_intrinsics_are_cured_by_a_reset_at_once() -> None:
    bench = Bench(failing=("intrinsics for resolution 640,480 doesn't exist",))
    bench.recover()
    assert bench.counts == {"restarted": 1, "reset": 1}


def test_after_a_reset_it_is_waited_for_until_it_was_gone_and_came_back() -> None:
    """An L515 is still listed for a moment, and needs about 12 s."""
    bench = Bench(there=lambda now_s: not 1.0 < now_s < 12.0)
    assert bench.recovery.reset()
    assert bench.did == ["stop", "reset", "start"]
    assert 12.0 <= bench.clock.now() - bench.zero_s < 12.5


def test_a_device_that_does_not_come_back_from_a_reset_is_lost() -> None:
    bench = Bench(there=lambda now_s: now_s < 5.0)
    for _ in range(3):
        bench.recover()
    with pytest.raises(CameraLostError, match="plug it into"):
        bench.recover()
    assert bench.counts["reset"] == 1


def test_an_unplugged_device_is_started_when_it_is_back() -> None:
    bench = Bench(there=lambda now_s: now_s > 40.0)
    bench.recover()
    assert bench.counts == {"replugged": 1}
    assert bench.did == ["stop", "start"]
    assert bench.clock.now() - bench.zero_s == pytest.approx(40.0, abs=0.5)


def test_an_unplugged_device_that_stays_away_is_lost() -> None:
    bench = Bench(there=lambda _: False)
    with pytest.raises(CameraLostError, match=r"it was unplugged and did not start within 60 s: plug it into a USB 3"):
        bench.recover()
    assert bench.clock.now() - bench.zero_s == pytest.approx(60.0, abs=0.5)


def test_a_device_that_is_back_but_not_ready_is_tried_again() -> None:
    bench = Bench(there=lambda now_s: now_s > 2.0, failing=("not yet", "not yet"))
    bench.recover()
    assert bench.counts == {"replugged": 1}


def test_a_bus_that_cannot_be_listed_counts_as_unplugged(caplog: pytest.LogCaptureFixture) -> None:
    bench, listings = Bench(), [CameraError("librealsense cannot list its devices")]

    def there(_: float) -> bool:
        if listings:
            raise listings.pop()
        return True

    bench.there = there
    bench.recover()
    assert bench.counts == {"replugged": 1}
    assert "waiting 60 s" in caplog.text


@pytest.mark.parametrize("there", [True, False])
def test_nothing_is_tried_for_a_camera_that_was_left(there: bool) -> None:
    bench = Bench(there=lambda _: there)
    bench.left.set()
    bench.recover()
    assert "start" not in bench.did
    assert not bench.counts


def test_leaving_ends_the_wait_for_a_device() -> None:
    bench = Bench(there=lambda _: False)

    def wait(_: Event, seconds: float) -> bool:
        bench.left.set()
        bench.clock.time_s += seconds
        return True

    bench.clock.wait = wait
    bench.recover()
    assert bench.clock.now() - bench.zero_s < 1.0
