from collections.abc import Callable
from threading import Event, Thread
from typing import Any

import pytest

from nlos_cam.threads import BoundedQueue, LatestValue


def in_threads(count: int, wait: Callable[[], Any], act: Callable[[], None]) -> list[Any]:
    """Return what `wait` gives in threads of its own, once `act` was called."""
    found: list[Any] = []
    threads = [Thread(target=lambda: found.append(wait())) for _ in range(count)]
    for thread in threads:
        thread.start()
    act()
    for thread in threads:
        thread.join(60.0)
    return found


def filled(*items: int, capacity: int = 2) -> BoundedQueue[int]:
    queue = BoundedQueue[int](capacity)
    for item in items:
        queue.put(item)
    return queue


def test_full_queue_returns_the_oldest_item_it_drops() -> None:
    queue = filled(1, 2)

    assert not queue.wait_for_room(0.0)
    assert queue.put(3) == 1
    assert [queue.take(0.0), queue.take(0.0), queue.take(0.0)] == [2, 3, None]
    assert not queue.wait_for_item(0.0)


@pytest.mark.parametrize("act", ["take", "finish", "close"])
def test_queue_wakes_a_producer_that_waits_for_room(act: str) -> None:
    queue = filled(1, 2)
    assert in_threads(1, lambda: queue.wait_for_room(60.0), getattr(queue, act)) == [True]


@pytest.mark.parametrize(("act", "expected"), [("put", 7), ("finish", None), ("close", None)])
def test_queue_wakes_a_consumer_that_waits(act: str, expected: int | None) -> None:
    queue = filled()
    args = [7] if act == "put" else []

    assert in_threads(1, lambda: queue.take(60.0), lambda: getattr(queue, act)(*args)) == [expected]


def test_finished_queue_gives_items_then_error_closed_nothing() -> None:
    queue = filled(1)
    queue.finish(ZeroDivisionError("far away"))
    queue.finish()

    assert queue.put(2) is None
    assert (queue.ended, queue.take(0.0), queue.ended) == (False, 1, True)

    with pytest.raises(ZeroDivisionError, match="far away"):
        queue.take(0.0)
    queue = filled(1)
    queue.finish(ZeroDivisionError())
    queue.close()

    assert (len(queue), queue.ended, queue.take(0.0)) == (0, True, None)


def test_latest_value_gives_a_late_reader_the_newest() -> None:
    slot = LatestValue[str]()
    for value in "abc":
        slot.put(value)

    assert slot.after(0, 1.0) == (3, "c")
    assert slot.after(3, 0.0) is None


def test_latest_value_wakes_every_waiting_reader() -> None:
    slot = LatestValue[int]()

    assert in_threads(3, lambda: slot.after(0, 60.0), lambda: slot.put(7)) == [(1, 7)] * 3
    assert in_threads(3, lambda: slot.after(1, 60.0), slot.close) == [None] * 3

    slot.put(1)

    assert slot.after(0, 0.0) is None


def test_latest_value_prefers_one_that_comes_soon() -> None:
    slot = LatestValue[str]()
    read = Event()
    slot.put("there")

    assert slot.fresh(0, 0.01, 0.0) == (1, "there")
    assert slot.fresh(1, 60.0, 0.01) is None

    def put_more() -> None:
        while not read.wait(0.005):
            slot.put("fresh")

    writer = Thread(target=put_more)
    writer.start()
    newest = slot.fresh(0, 60.0, 0.0)
    read.set()
    writer.join(60.0)

    assert newest[0] > 1
