"""The bounded queue between the SDK's threads, which deliver samples, and whoever iterates over a camera."""

from collections import Counter, deque
from collections.abc import Callable
from threading import Condition

from nlos_cam.camera.streams import FrameSet, Pairing, Sample

CAPACITY = 8
"""Sets: a quarter of a second, and 10 MB at 640 x 480."""


class Inbox:
    """Pairs what the SDK's threads put, and keeps the sets until they are taken.

    A full inbox drops its oldest set and counts it, so that a live device never waits; a `lossless` one makes the SDK
    wait, which holds up a recording's playback.
    """

    def __init__(self, *, lossless: bool, on_set: Callable[[FrameSet], None] | None = None) -> None:
        self.arrived: Counter[str] = Counter()
        """Samples so far, by stream."""
        self._lossless, self._on_set = lossless, on_set
        self._pairing = Pairing()
        self._evicted = 0
        self._sets: deque[FrameSet] = deque()
        self._changed = Condition()
        self.closed = False
        self._finished = False
        self._failure: Exception | None = None

    @property
    def incomplete(self) -> int:
        """Sets that lacked a stream."""
        return self._pairing.incomplete

    @property
    def dropped(self) -> int:
        """Sets that never came, or that nobody took in time."""
        return self._pairing.dropped + self._evicted

    @property
    def counts(self) -> Counter[str]:
        """What else the pairing saw, by name."""
        with self._changed:
            return Counter(self._pairing.counts)

    @property
    def ended(self) -> bool:
        """Whether nothing is left to take, and nothing will come."""
        return (self._finished or self.closed) and not self._sets

    def expect(self, shape: tuple[int, int]) -> None:
        """Take only samples of this shape (rows, columns) for good ones."""
        self._pairing.shape = shape

    def put(self, sample: Sample) -> None:
        """Take a sample from an SDK thread."""
        with self._changed:
            self._changed.wait_for(self._has_room)
            if self.closed or self._finished:
                return
            self.arrived[sample.stream] += 1
            complete = self._pairing.add(sample)
            if complete is None:
                return
            self._sets.append(complete)
            if len(self._sets) > CAPACITY and not self._lossless:
                self._sets.popleft()
                self._evicted += 1
            self._changed.notify_all()
        if self._on_set:
            self._on_set(complete)

    def _has_room(self) -> bool:
        return not self._lossless or len(self._sets) < CAPACITY or self._finished or self.closed

    def take(self, timeout_s: float) -> FrameSet | None:
        """The oldest set; None when none came in time or `ended`. Raises what `fail` was given."""
        with self._changed:
            self._changed.wait_for(lambda: self._sets or self._finished or self.closed, timeout_s)
            if self._sets:
                self._changed.notify_all()
                return self._sets.popleft()
            if self._failure and not self.closed:
                raise self._failure
            return None

    def finish(self) -> None:
        """Nothing more will come; what is here can still be taken."""
        with self._changed:
            self._finished = True
            if self._lossless:  # a live device is left in the middle of a set; a recording's end is the end
                self._pairing.finish()
            self._changed.notify_all()

    def fail(self, error: Exception) -> None:
        """Nothing more will come, because of this error."""
        self._failure = error
        self.finish()

    def close(self) -> None:
        """Nobody will take any more: let go of everybody who waits."""
        with self._changed:
            self.closed = True
            self._sets.clear()
            self._changed.notify_all()
