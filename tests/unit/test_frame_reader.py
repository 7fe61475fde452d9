from collections.abc import Callable, Iterator
from itertools import count
from threading import Event

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.live import frame_queue
from nlos_cam.live.frame_queue import QUEUE_FRAMES, FrameReader

SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)


def frames(number: int | None, on_frame: Callable[[int], object] = lambda _: None) -> Iterator[Frame]:
    """As many frames as it is told to give, or without end; `on_frame` runs before each."""
    depth_m, ir = np.full((64, 80), 0.3, np.float32), np.full((64, 80), 9, np.uint8)
    for each in count() if number is None else range(number):
        on_frame(each)
        yield Frame(depth_m, ir, ir, each / 30, each, SMALL)


def read_behind(reader: FrameReader) -> None:
    """Wait until the camera has ended: a consumer as late as can be."""
    reader._thread.join(10.0)
    assert not reader._thread.is_alive()


def test_a_recording_is_read_whole_and_in_order_by_a_late_consumer() -> None:
    with FrameReader(frames(50), keeps_all=True, stop=Event()) as reader:
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert numbers == list(range(50))
    assert reader.dropped == []


def test_a_full_queue_drops_the_oldest_and_tells_which() -> None:
    with FrameReader(frames(10), keeps_all=False, stop=Event()) as reader:
        read_behind(reader)
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert numbers == [7, 8, 9]
    assert reader.dropped == list(range(10 - QUEUE_FRAMES))


@pytest.mark.parametrize("keeps_all", [True, False])
def test_every_frame_is_either_given_or_counted_as_dropped(keeps_all: bool) -> None:
    with FrameReader(frames(200), keeps_all=keeps_all, stop=Event()) as reader:
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert sorted(numbers + reader.dropped) == list(range(200))
    assert numbers == sorted(numbers)


def test_the_cameras_error_is_raised_to_the_consumer_after_the_frames_before_it() -> None:
    def fail_at_two(number: int) -> None:
        if number == 2:
            raise CameraLostError("unplugged")

    seen = []
    with (
        pytest.raises(CameraLostError, match="unplugged"),
        FrameReader(frames(None, fail_at_two), keeps_all=True, stop=Event()) as reader,
    ):
        seen.extend(arrival.frame.frame_number for arrival in reader)
    assert seen == [0, 1]


def test_stop_ends_an_endless_camera() -> None:
    stop = Event()
    with FrameReader(frames(None), keeps_all=True, stop=stop) as reader:
        for arrival in reader:
            if arrival.frame.frame_number == 5:
                stop.set()
    assert not reader._thread.is_alive()


def test_leaving_early_ends_the_thread() -> None:
    with FrameReader(frames(None), keeps_all=True, stop=Event()) as reader:
        next(iter(reader))
    assert not reader._thread.is_alive()


def test_a_camera_that_hangs_is_told_after_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_queue, "JOIN_TIMEOUT_S", 0.05)
    release = Event()
    reader = FrameReader(frames(None, lambda _: release.wait(10.0)), keeps_all=True, stop=Event())
    with pytest.raises(CameraLostError, match="did not stop"), reader:
        pass
    release.set()
    read_behind(reader)


def test_what_keeps_the_reader_waiting_is_told_to_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_queue, "LET_GO_AFTER_S", 0.01)
    release = Event()
    source = frames(None, lambda _: release.wait(10.0))
    reader = FrameReader(source, keeps_all=True, stop=Event(), let_go=release.set)
    with reader:
        pass
    assert not reader._thread.is_alive()


def test_it_is_enough_also_while_no_frame_comes() -> None:
    release, asked = Event(), []

    def enough() -> bool:
        asked.append(True)
        return len(asked) > 2

    source = frames(None, lambda _: release.wait(10.0))
    with FrameReader(source, keeps_all=True, stop=Event(), enough=enough, let_go=release.set) as reader:
        assert list(reader) == []
        release.set()


def test_a_wait_is_heard_of_while_no_frame_comes_and_only_then() -> None:
    release, waits = Event(), list[float | None]()

    def on_wait() -> None:
        waits.append(reader.newest_s)
        release.set()

    source = frames(4, lambda number: number == 3 and release.wait(10.0))
    with FrameReader(source, keeps_all=True, stop=Event(), clock=lambda: 7.0, on_wait=on_wait) as reader:
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert numbers == [0, 1, 2, 3]
    assert waits
    assert waits[-1] == 7.0
    assert FrameReader([], keeps_all=True, stop=Event()).newest_s is None
