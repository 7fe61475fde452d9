import time
from threading import Thread

import numpy as np
import pytest

from nlos_cam.camera.session import CAPACITY, SampleQueue
from nlos_cam.camera.streams import FORMATS, Sample


def put(inbox: SampleQueue, numbers: range) -> None:
    for number in numbers:
        for stream in FORMATS:
            inbox.put(Sample(stream, number, number / 30, np.zeros((1, 1))))


def take_all(inbox: SampleQueue) -> list[int]:
    taken: list[int] = []
    while (found := inbox.take(0.0)) is not None:
        taken.append(found.number)
    return taken


def test_a_full_live_inbox_drops_its_oldest_and_counts_it() -> None:
    inbox = SampleQueue(lossless=False)
    put(inbox, range(CAPACITY + 3))
    assert take_all(inbox) == list(range(3, CAPACITY + 3))
    assert inbox.dropped == 3


def test_a_full_lossless_inbox_makes_the_sender_wait() -> None:
    inbox = SampleQueue(lossless=True)
    sender = Thread(target=put, args=(inbox, range(5 * CAPACITY)))
    sender.start()
    taken: list[int] = []
    while len(taken) < 5 * CAPACITY:
        found = inbox.take(5.0)
        assert found is not None
        taken.append(found.number)
    sender.join()
    assert taken == list(range(5 * CAPACITY))
    assert inbox.dropped == 0


def test_a_lossless_inbox_holds_no_more_than_its_capacity() -> None:
    inbox = SampleQueue(lossless=True)
    sender = Thread(target=put, args=(inbox, range(5 * CAPACITY)))
    sender.start()
    while inbox.arrived.total() < 3 * CAPACITY:
        time.sleep(0.001)
    sender.join(0.05)
    assert inbox.arrived.total() == 3 * CAPACITY
    inbox.close()
    sender.join()


def test_closing_lets_a_waiting_sender_go() -> None:
    inbox = SampleQueue(lossless=True)
    sender = Thread(target=put, args=(inbox, range(2 * CAPACITY)))
    sender.start()
    inbox.close()
    sender.join(5.0)
    assert not sender.is_alive()
    assert inbox.ended


def test_what_came_before_the_end_can_still_be_taken() -> None:
    inbox = SampleQueue(lossless=True)
    put(inbox, range(2))
    inbox.finish()
    assert not inbox.ended
    assert take_all(inbox) == [0, 1]
    assert inbox.ended


def test_half_a_set_at_the_end_of_a_recording_is_counted() -> None:
    live, recording = SampleQueue(lossless=False), SampleQueue(lossless=True)
    for inbox in (live, recording):
        inbox.put(Sample("depth", 0, 0.0, np.zeros((1, 1))))
        inbox.finish()
    assert (live.incomplete, recording.incomplete) == (0, 1)


def test_a_failure_reaches_the_taker_after_the_sets_before_it() -> None:
    inbox = SampleQueue(lossless=False)
    put(inbox, range(1))
    inbox.fail(ZeroDivisionError("far away"))
    assert inbox.take(0.0) is not None
    with pytest.raises(ZeroDivisionError, match="far away"):
        inbox.take(0.0)


def test_a_taker_that_waits_in_vain_is_told_none() -> None:
    assert SampleQueue(lossless=False).take(0.001) is None


def test_each_set_is_shown_as_it_passes() -> None:
    seen: list[int] = []
    put(SampleQueue(lossless=False, on_set=lambda found: seen.append(found.number)), range(4))
    assert seen == [0, 1, 2, 3]


def test_what_is_expected_is_a_shape_and_the_rest_is_counted() -> None:
    inbox = SampleQueue(lossless=False)
    inbox.expect((1, 1))
    for number, shape in enumerate([(1, 1), (2, 1), (1, 1)]):
        for stream in FORMATS:
            inbox.put(Sample(stream, number, number / 30, np.zeros(shape)))
    assert take_all(inbox) == [0, 2]
    assert inbox.counts == {"wrong_size": 1}
    inbox.counts["wrong_size"] = 9
    assert inbox.counts == {"wrong_size": 1}
