from threading import Event

import pytest
from small_frames import FrameCamera

from nlos_cam.errors import CameraLostError
from nlos_cam.live.frame_queue import QUEUE_FRAMES, FrameReader


def wait_for_end(reader: FrameReader) -> None:
    """Wait until the camera has ended: the consumer is as late as can be."""
    reader._thread.join(60.0)
    assert not reader._thread.is_alive()


def numbers_of(reader: FrameReader) -> list[int]:
    return [arrival.frame.frame_number for arrival in reader]


@pytest.mark.parametrize("lossless", [True, False])
def test_reader_yields_every_frame_or_drops_the_oldest(lossless: bool) -> None:
    with FrameReader(FrameCamera(200), lossless=lossless, stop=Event()) as reader:
        if not lossless:
            wait_for_end(reader)
        numbers = numbers_of(reader)
    assert numbers == list(range(0 if lossless else 200 - QUEUE_FRAMES, 200))
    assert reader.dropped == list(range(numbers[0]))


def test_reader_ends_with_the_stop_event_or_when_left() -> None:
    stop = Event()
    with FrameReader(FrameCamera(None), lossless=True, stop=stop) as reader:
        for arrival in reader:
            if arrival.frame.frame_number == 5:
                stop.set()
    assert not reader._thread.is_alive()
    with FrameReader(FrameCamera(None), lossless=True, stop=Event()) as reader:
        next(iter(reader))
    assert not reader._thread.is_alive()


def test_reader_closes_or_reports_a_source_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.live.frame_queue.ABANDON_AFTER_S", 0.01)
    release = Event()
    source = FrameCamera(None, lambda _: release.wait(60.0))
    with FrameReader(source, lossless=True, stop=Event(), abandon_source=release.set) as reader:
        pass
    assert not reader._thread.is_alive()
    monkeypatch.setattr("nlos_cam.live.frame_queue.JOIN_TIMEOUT_S", 0.05)
    release.clear()
    with pytest.raises(CameraLostError), FrameReader(source, lossless=True, stop=Event()) as reader:
        pass
    release.set()
    wait_for_end(reader)
