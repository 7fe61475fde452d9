"""Recovery of a live camera that went silent, in stages from the mildest."""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event
from typing import Any

from nlos_cam.camera.protocol import WaitingClock
from nlos_cam.errors import CameraError, CameraLostError

BACK_OFF_S = (0.5, 1.0, 2.0)
"""Waits before the restarts of the streams; a reset follows the last of them."""
GONE_WITHIN_S = 5.0
"""Time within which a device that is reset leaves the bus."""
BACK_WITHIN_S = 30.0
"""Time within which it comes back after a reset; an L515 needs about 12 s."""
POLL_S = 0.25
NO_INTRINSICS = "intrinsics for resolution"
"""Part of the SDK's message for a device that lost its calibration, which only a reset restores."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Hooks:
    """Operations on the device. Each may raise CameraError or the SDK's RuntimeError."""

    start: Callable[[Any], None]
    """Start the streams of this device, or raise and leave them stopped."""
    stop: Callable[[], None]
    is_connected: Callable[[], bool]
    reconnect: Callable[[], Any | None]
    """Return a new handle of the device; None while it is not connected."""
    reset: Callable[[], None]


class Recovery:
    """Recovery from one silence: restarts of the streams, then a reset, then an error; waits for an
    unplugged device.

    Stateful, for the thread that iterates over the camera. Counts `restarted`, `reset` and
    `replugged`. Every wait ends when `left` is set.
    """

    def __init__(
        self, uri: str, hooks: Hooks, clock: WaitingClock, left: Event, counts: Counter[str]
    ) -> None:
        self._uri = uri
        self._hooks = hooks
        self._clock = clock
        self._left = left
        self._counts = counts
        self._tries = 0
        self._failure = ""

    def recover(self, silence: str, replug_s: float) -> None:
        """Return once streams run or `left` is set; `silence` describes the failure for log and
        error.

        Raises CameraLostError. If no frame comes even so, call again for the next stage.
        """
        self._hooks.stop()
        while not self._left.is_set():
            if not self._is_connected():
                if self._await_replug(silence, replug_s):
                    return
            elif self._try_next(silence):
                return

    def _is_connected(self) -> bool:
        try:
            return self._hooks.is_connected()
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
            return False

    def _try_next(self, silence: str) -> bool:
        self._tries += 1
        if self._tries <= len(BACK_OFF_S):
            log.warning(
                "%s: restarting its streams (%d of %d)", silence, self._tries, len(BACK_OFF_S)
            )
            return self._restart(BACK_OFF_S[self._tries - 1])
        if self._tries == len(BACK_OFF_S) + 1:
            return self.reset()
        raise CameraLostError(
            f"{silence}, nor after {len(BACK_OFF_S)} restarts of its streams and a"
            f" reset{self._reason()}: unplug it, let it cool for a minute, plug it into another USB"
            " 3 port"
        )

    def _restart(self, back_off_s: float) -> bool:
        if self._clock.wait(self._left, back_off_s):
            return False
        self._counts["restarted"] += 1
        return self._starts_if_there()

    def reset(self) -> bool:
        """Reset the device and start its streams when it is back; return True if that succeeded."""
        log.warning("%s: resetting the device, which takes about 15 s", self._uri)
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

    def _await_replug(self, silence: str, replug_s: float) -> bool:
        log.warning(
            "%s was unplugged: waiting up to %.0f s for it to be plugged in again",
            self._uri,
            replug_s,
        )
        if self._starts_within(replug_s):
            self._counts["replugged"] += 1
            log.warning("%s is back", self._uri)
            return True
        if self._left.is_set():
            return False
        raise CameraLostError(
            f"{silence}: it was unplugged and did not start within {replug_s:.0f}"
            f" s{self._reason()}: plug it into a USB 3 port and start again"
        )

    def _reason(self) -> str:
        return f" ({self._failure})" if self._failure else ""

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
            if device is None:
                return False
            self._hooks.start(device)
        except (RuntimeError, CameraError) as error:
            self._failure = str(error)
            if NO_INTRINSICS in self._failure:
                self._tries = max(self._tries, len(BACK_OFF_S))
            return False
        return True
