"""A slot between threads that keeps the newest value only."""

from threading import Condition
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """A slow reader skips values; the writer never waits for one. Any number of readers may watch."""

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
            self._value, self._count = value, self._count + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Wake every reader; there will be no more values."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def after(self, count: int, timeout_s: float) -> tuple[int, T] | None:
        """The newest value and its count, once that is more than `count`; None if closed or nothing came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._count > count, timeout_s)
            if self._closed or self._count <= count or self._value is None:
                return None
            return self._count, self._value

    def fresh(self, count: int, patience_s: float, timeout_s: float) -> tuple[int, T] | None:
        """As `after`, but what is there already is passed over for the next one, if that comes within `patience_s`."""
        with self._changed:
            there = self._count
            if there > count:
                self._changed.wait_for(lambda: self._closed or self._count > there, patience_s)
        return self.after(count, timeout_s)
