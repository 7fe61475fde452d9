"""Reader thread between a camera and a loop, so that a slow loop never blocks the camera."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from threading import Event, Thread
from typing import NamedTuple, Self

from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.reconstruct.network import Clock
from nlos_cam.reconstruct.verdict import frame_issues
from nlos_cam.threads import BoundedQueue

QUEUE_FRAMES = 3
ABANDON_AFTER_S = 1.0
"""A thread still alive after this waits for its camera."""
JOIN_TIMEOUT_S = 10.0
POLL_S = 0.1
"""Interval at which a wait checks for signals."""
SAME_CLOCK_S = 10.0
"""Timestamps this close to the host's time of day are host time; others have a zero of their
own.
"""


class Arrival(NamedTuple):
    """Frame as the reader received it."""

    frame: Frame
    arrived_s: float
    """Time at which the reader received the frame."""
    issues: tuple[str, ...]
    """See `frame_issues`."""


def ignore(*_: object) -> None:
    """Do nothing: the default of callbacks."""


class FrameReader:
    """Thread that reads frames into a bounded queue while entered; iterate from one other thread.

    A full queue drops its oldest frame and counts it, or, if `lossless`, blocks the
    camera. Iteration ends with the frames, once `stop` is set, or once `should_stop` returns True,
    and raises the exception of the frames' source. While no frame comes, it calls `on_idle` every
    POLL_S. Leaving calls `abandon_source` if the thread has not ended after ABANDON_AFTER_S, and
    raises CameraLostError if that does not end it.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        *,
        lossless: bool,
        stop: Event,
        clock: Clock = time.time,
        should_stop: Callable[[], bool] = lambda: False,
        abandon_source: Callable[[], None] = ignore,
        on_idle: Callable[[], None] = ignore,
    ) -> None:
        self.dropped = 0
        """Number of frames."""
        self.issues = Counter[str]()
        """Number of frames by issue, dropped ones included."""
        self.newest_s: float | None = None
        """Arrival of the newest frame; None before the first."""
        self._shortest_delay_s = float("inf")
        self._frames = frames
        self._lossless = lossless
        self._clock = clock
        self._stop = stop
        self._should_stop = should_stop
        self._abandon_source = abandon_source
        self._on_idle = on_idle
        self._queue = BoundedQueue[Arrival](QUEUE_FRAMES)
        self._thread = Thread(target=self._read, name="frame reader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, _: object, error: object, __: object) -> None:
        self._queue.finish()
        self._thread.join(ABANDON_AFTER_S)
        if self._thread.is_alive():
            self._abandon_source()
            self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive() and error is None:
            raise CameraLostError(
                f"the camera did not stop within {JOIN_TIMEOUT_S:.0f} s: replug it"
            )

    def __iter__(self) -> Iterator[Arrival]:
        while not self._is_done:
            has_item = self._queue.wait_for_item(POLL_S)
            if self._is_done:
                return

            if not has_item:
                self._on_idle()
            elif (arrival := self._queue.take()) is not None:
                yield arrival
            else:
                return

    def _read(self) -> None:
        try:
            for frame in self._frames:
                issues = frame_issues(frame)
                self.issues.update(issues)
                self._put(Arrival(frame, self._clock(), issues))
                if self._queue.finished or self._stop.is_set():
                    return
        except BaseException as error:  # noqa: BLE001  whatever it was, the consumer raises it
            self._queue.finish(error)
        finally:
            self._queue.finish()

    def _put(self, arrival: Arrival) -> None:
        while self._lossless and not self._queue.wait_for_room(POLL_S) and not self._stop.is_set():
            pass
        self.newest_s = arrival.arrived_s
        delay_s = arrival.arrived_s - arrival.frame.timestamp_s
        self._shortest_delay_s = min(self._shortest_delay_s, delay_s)
        if self._queue.put(arrival) is not None:
            self.dropped += 1

    @property
    def offset_s(self) -> float:
        """Host time less timestamp: 0 if timestamps are host time, else such that the fastest
        delivery took 0 s.
        """
        return 0.0 if abs(self._shortest_delay_s) < SAME_CLOCK_S else self._shortest_delay_s

    @property
    def _is_done(self) -> bool:
        return self._stop.is_set() or self._should_stop()
