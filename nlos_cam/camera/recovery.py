"""What is tried for a live camera that falls silent, in stages from the mildest."""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event
from typing import Any

from nlos_cam.camera.protocol import Clock
from nlos_cam.errors import CameraError, CameraLostError

BACK_OFF_S = (0.5, 1.0, 2.0)
"""Before each restart of the streams; as many restarts come before a reset."""
GONE_WITHIN_S = 5.0
"""A device that is reset leaves the bus within this."""
BACK_WITHIN_S = 30.0
"""After a reset; an L515 needs about 12 s."""
POLL_S = 0.25
NO_INTRINSICS = "intrinsics for resolution"
"""The SDK says this of a device that lost its calibration: only a reset cures it."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Hooks:
    """What can be done with the device. Each may raise CameraError or the SDK's RuntimeError."""

    start: Callable[[Any], None]
    """Start the streams of this device, or raise and leave them stopped."""
    stop: Callable[[], None]
    is_connected: Callable[[], bool]
    reconnect: Callable[[], Any | None]
    """The device anew; None while it is not there."""
    reset: Callable[[], None]


class Recovery:
    """For one silence: restarts the streams, then resets the device, then gives up; an unplugged one is waited for.

    Counts `restarted`, `reset` and `replugged`. Every wait ends when `left` is set.
    """

    def __init__(self, uri: str, hooks: Hooks, clock: Clock, left: Event, counts: Counter[str]) -> None:
        self._uri, self._hooks, self._clock, self._left, self._counts = uri, hooks, clock, left, counts
        self._tries = 0
        self._failure = ""

    def recover(self, what: str, replug_s: float) -> None:
        """Return with streams that run, or when `left` is set; `what` befell the camera is for the log and the error.

        Raises CameraLostError. Where still no frame comes, call it again: the next stage is tried.
        """
        self._hooks.stop()
        while not self._left.is_set():
            if not self._is_connected():
                if self._await_replug(what, replug_s):
                    return
            elif self._try_next(what):
                return

    def _is_connected(self) -> bool:
        try:
            return self._hooks.is_connected()
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
            return False

    def _try_next(self, what: str) -> bool:
        self._tries += 1
        if self._tries <= len(BACK_OFF_S):
            log.warning("%s: starting its streams again (%d of %d)", what, self._tries, len(BACK_OFF_S))
            return self._restart(BACK_OFF_S[self._tries - 1])
        if self._tries == len(BACK_OFF_S) + 1:
            return self.reset()
        failed = f" ({self._failure})" if self._failure else ""
        raise CameraLostError(
            f"{what}, nor after {len(BACK_OFF_S)} restarts of its streams and a reset{failed}: unplug it, let it cool "
            "for a minute, plug it into another USB 3 port"
        )

    def _restart(self, back_off_s: float) -> bool:
        if self._clock.wait(self._left, back_off_s):
            return False
        self._counts["restarted"] += 1
        return self._starts_if_there()

    def reset(self) -> bool:
        """Reset the device, and start its streams when it is back; whether that came about."""
        log.warning("%s is being reset, which takes about 15 s", self._uri)
        self._hooks.stop()
        self._counts["reset"] += 1
        try:
            self._hooks.reset()
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
        gone_by_s = self._clock.now() + GONE_WITHIN_S
        while self._clock.now() < gone_by_s and self._is_connected():
            if self._clock.wait(self._left, POLL_S):
                return False
        return self._starts_within(BACK_WITHIN_S)

    def _await_replug(self, what: str, replug_s: float) -> bool:
        log.warning("%s is not on USB any more: waiting %.0f s for it to be plugged in again", self._uri, replug_s)
        if self._starts_within(replug_s):
            self._counts["replugged"] += 1
            log.warning("%s is back", self._uri)
            return True
        if self._left.is_set():
            return False
        failed = f" ({self._failure})" if self._failure else ""
        raise CameraLostError(
            f"{what}: it was unplugged and did not start within {replug_s:.0f} s{failed}: plug it into a USB 3 port, "
            "start again"
        )

    def _starts_within(self, seconds: float) -> bool:
        until_s = self._clock.now() + seconds
        while not self._left.is_set():
            if self._starts_if_there():
                return True
            if self._clock.now() >= until_s or self._clock.wait(self._left, POLL_S):
                return False
        return False

    def _starts_if_there(self) -> bool:
        try:
            device = self._hooks.reconnect()
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
            return False
        return device is not None and self._starts(device)

    def _starts(self, device: Any) -> bool:
        try:
            self._hooks.start(device)
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
            if NO_INTRINSICS in self._failure:
                self._tries = max(self._tries, len(BACK_OFF_S))
            return False
        return True
