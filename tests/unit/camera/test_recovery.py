"""The stages of a recovery, on hooks that note what was done."""

from collections import Counter
from collections.abc import Callable
from threading import Event
from typing import Any

import pytest
from fake_lidar import NapClock

from nlos_cam.camera.recovery import BACK_OFF_S, Hooks, Recovery
from nlos_cam.errors import CameraError, CameraLostError


class Device:
    """A device that is there at some times, whose starts fail, and its recovery."""

    def __init__(self, there: Callable[[float], bool] = lambda _: True, failing: tuple[str, ...] = ()) -> None:
        self.clock, self.left, self.counts, self.did = NapClock(), Event(), Counter[str](), list[str]()
        self.zero_s, self.there, self.failing = self.clock.now(), there, list(failing)
        stop, reset = (lambda: self.did.append("stop")), (lambda: self.did.append("reset"))
        hooks = Hooks(self.start, stop, self.is_connected, lambda: "device" if self.is_connected() else None, reset)
        self.recovery = Recovery("l515", hooks, self.clock, self.left, self.counts)

    @property
    def passed_s(self) -> float:
        return self.clock.now() - self.zero_s

    def is_connected(self) -> bool:
        return self.there(self.passed_s)

    def start(self, device: Any) -> None:
        assert device == "device"
        if self.failing:
            raise RuntimeError(self.failing.pop(0))
        self.did.append("start")

    def recover(self, times: int = 1) -> None:
        for _ in range(times):
            self.recovery.recover("l515 gave no whole frame", replug_s=60.0)


def test_recovery_restarts_with_back_off_then_resets_then_ends() -> None:
    device = Device()
    device.recover(4)
    with pytest.raises(CameraLostError, match=r"3 restarts.*reset"):
        device.recover()
    assert device.did == ["stop", "start"] * 3 + ["stop", "stop", "reset", "start", "stop"]
    assert tuple(nap for nap in device.clock.naps if nap >= 0.5) == BACK_OFF_S
    assert device.counts == {"restarted": 3, "reset": 1}


def test_failed_restart_is_followed_by_the_next_at_once() -> None:
    device = Device(failing=("busy", "busy"))
    device.recover()
    assert device.counts == {"restarted": 3}
    assert device.did == ["stop", "start"]
    with pytest.raises(CameraLostError, match="failed to set power state"):
        Device(failing=("failed to set power state",) * 200).recover()


def test_lost_intrinsics_are_cured_by_a_reset_at_once() -> None:
    device = Device(failing=("intrinsics for resolution 640,480 doesn't exist",))
    device.recover()
    assert device.counts == {"restarted": 1, "reset": 1}


def test_reset_waits_until_the_device_was_gone_and_is_back() -> None:
    """An L515 is still listed for a moment, and needs about 12 s."""
    device = Device(there=lambda now_s: not 1.0 < now_s < 12.0)
    assert device.recovery.reset()
    assert device.did == ["stop", "reset", "start"]
    assert 12.0 <= device.passed_s < 12.5
    gone = Device(there=lambda now_s: now_s < 5.0)
    with pytest.raises(CameraLostError):
        gone.recover(4)
    assert gone.counts["reset"] == 1


@pytest.mark.parametrize(("back_s", "failing"), [(40.0, ()), (2.0, ("not yet", "not yet"))])
def test_unplugged_device_is_started_when_it_is_back(back_s: float, failing: tuple[str, ...]) -> None:
    device = Device(there=lambda now_s: now_s > back_s, failing=failing)
    device.recover()
    assert device.counts == {"replugged": 1}
    assert device.did.count("start") == 1
    assert failing or device.passed_s == pytest.approx(back_s, abs=0.5)


def test_bus_that_cannot_be_listed_counts_as_unplugged(caplog: pytest.LogCaptureFixture) -> None:
    listings = [CameraError("librealsense cannot list its devices")]

    def there(_: float) -> bool:
        if listings:
            raise listings.pop()
        return True

    device = Device(there)
    device.recover()
    assert device.counts == {"replugged": 1}
    assert "60 s" in caplog.text
