"""A thread that reads a camera's frames into a bounded queue, so that a slow loop never holds up a camera."""

import time
from collections.abc import Callable, Iterable, Iterator
from threading import Event, Thread
from types import TracebackType
from typing import Self

from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.reconstruct import Arrival, Clock
from nlos_cam.threads import BoundedQueue

QUEUE_FRAMES = 3
ABANDON_AFTER_S = 1.0
"""What still reads after this is waiting for a camera."""
JOIN_TIMEOUT_S = 10.0
POLL_S = 0.1
"""How often a wait looks up, so that a signal is answered."""
SAME_CLOCK_S = 10.0
"""Timestamps this close to the host's time of day are host time; others have a zero of their own."""


class FrameReader:
    """A thread that reads frames into a queue of three while entered.

    When the queue is full it drops the oldest frame and counts it by number, or, if it `lossless`, waits. Iterating
    ends where the frames end, when `stop` is set, or when it is `enough`, also while no frame comes; their source's
    exception is raised to whoever iterates, whose `on_wait` is called ten times a second while no frame comes. On
    leaving, a source that keeps the thread waiting is told to `let_go`.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        *,
        lossless: bool,
        stop: Event,
        clock: Clock = time.time,
        enough: Callable[[], bool] = lambda: False,
        let_go: Callable[[], None] = lambda: None,
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        self.dropped: list[int] = []
        """Frame numbers."""
        self.newest_s: float | None = None
        """When the newest frame arrived; None before the first."""
        self._least_delay_s = float("inf")
        self._frames, self._keeps_all, self._clock = frames, lossless, clock
        self._stop, self._enough, self._let_go, self._on_wait = stop, enough, let_go, on_wait
        self._queue = BoundedQueue[Arrival](QUEUE_FRAMES)
        self._thread = Thread(target=self._read, name="frame reader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._queue.finish()
        self._thread.join(ABANDON_AFTER_S)
        if self._thread.is_alive():
            self._let_go()
            self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive() and error is None:
            raise CameraLostError(f"the camera did not stop within {JOIN_TIMEOUT_S:.0f} s: replug it")

    def __iter__(self) -> Iterator[Arrival]:
        while not self._is_done:
            has_item = self._queue.wait_for_item(POLL_S)
            if self._is_done:
                return
            if not has_item:
                self._on_wait()
            elif (arrival := self._queue.take()) is not None:
                yield arrival
            else:
                return

    def _read(self) -> None:
        try:
            for frame in self._frames:
                if not self._put(Arrival(frame, self._clock())):
                    return
        except BaseException as error:  # noqa: BLE001  whatever it was, the consumer raises it
            self._queue.finish(error)
        finally:
            self._queue.finish()

    def _put(self, arrival: Arrival) -> bool:
        """Queue a frame; return False once no more are wanted."""
        while self._keeps_all and not self._queue.wait_for_room(POLL_S) and not self._stop.is_set():
            pass
        self.newest_s = arrival.arrived_s
        self._least_delay_s = min(self._least_delay_s, arrival.arrived_s - arrival.frame.timestamp_s)
        if (dropped := self._queue.put(arrival)) is not None:
            self.dropped.append(dropped.frame.frame_number)
        return not (self._queue.finished or self._stop.is_set())

    @property
    def offset_s(self) -> float:
        """What makes host time of a timestamp: 0 if it is that already, else such that the fastest delivery took 0."""
        return 0.0 if abs(self._least_delay_s) < SAME_CLOCK_S else self._least_delay_s

    @property
    def _is_done(self) -> bool:
        return self._stop.is_set() or self._enough()
