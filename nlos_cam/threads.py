"""Hand-offs between threads: a bounded queue of items, and a slot that holds the newest value."""

from collections import deque
from threading import Condition
from typing import Generic, TypeVar

T = TypeVar("T")


class BoundedQueue(Generic[T]):
    """Bounded queue between threads; with a capacity of 1, a slot for the newest item.

    `put` drops the oldest item of a full queue; a producer that must lose none calls
    `wait_for_room` first. The producer ends the queue with `finish`, the consumer with `close`.
    Every method may be called from any thread.
    """

    def __init__(self, capacity: int) -> None:
        self.changed = Condition()
        """Reentrant; held by a caller that combines several calls into one step."""
        self.finished = self.closed = False
        self._capacity = capacity
        self._items: deque[T] = deque()
        self._error: BaseException | None = None

    def __len__(self) -> int:
        return len(self._items)

    @property
    def ended(self) -> bool:
        """True once the queue is empty and nothing more will come."""
        return (self.finished or self.closed) and not self._items

    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Wait until an item fits, or the queue has ended; return False after the timeout."""
        with self.changed:
            return self.changed.wait_for(
                lambda: len(self._items) < self._capacity or self.finished or self.closed, timeout_s
            )

    def put(self, item: T) -> T | None:
        """Append an item, and return the one that it pushed out of a full queue; without effect
        once ended.
        """
        with self.changed:
            if self.finished or self.closed:
                return None
            dropped = self._items.popleft() if len(self._items) == self._capacity else None
            self._items.append(item)
            self.changed.notify_all()
            return dropped

    def wait_for_item(self, timeout_s: float | None = None) -> bool:
        """Wait until an item can be taken, or the queue has ended; return False after the
        timeout.
        """
        with self.changed:
            return bool(
                self.changed.wait_for(
                    lambda: self._items or self.finished or self.closed, timeout_s
                )
            )

    def take(self, timeout_s: float | None = None) -> T | None:
        """Return the oldest item; None after the timeout or once ended. Raise the producer's error
        after its items.
        """
        with self.changed:
            if self.wait_for_item(timeout_s) and self._items:
                self.changed.notify_all()
                return self._items.popleft()
            if self._error and not self.closed:
                raise self._error
            return None

    def finish(self, error: BaseException | None = None) -> None:
        """Accept no more items, optionally because of an error; those that wait can still be
        taken.
        """
        with self.changed:
            self.finished = True
            self._error = self._error or error
            self.changed.notify_all()

    def close(self) -> None:
        """Discard all items and wake every thread that waits."""
        with self.changed:
            self.closed = True
            self._items.clear()
            self.changed.notify_all()


class LatestValue(Generic[T]):
    """Slot for the newest value, watched by any number of readers: slow ones skip values, writers
    never wait.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._value: T | None = None
        self._count = 0
        self._closed = False

    @property
    def closed(self) -> bool:
        return self._closed

    def put(self, value: T) -> None:
        with self._changed:
            self._value = value
            self._count = self._count + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Wake every reader; there will be no more values."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def after(self, count: int, timeout_s: float) -> tuple[int, T] | None:
        """Return the newest value and its count, once that exceeds `count`; None if closed or after
        the timeout.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._count > count, timeout_s)
            if self._closed or self._count <= count or self._value is None:
                return None
            return self._count, self._value

    def fresh(self, count: int, patience_s: float, timeout_s: float) -> tuple[int, T] | None:
        """Return the next value rather than the present one, if it comes within `patience_s`; else
        as `after`.
        """
        with self._changed:
            present = self._count
            if present > count:
                self._changed.wait_for(lambda: self._closed or self._count > present, patience_s)
        return self.after(count, timeout_s)
