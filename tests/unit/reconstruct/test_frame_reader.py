from threading import Event

import numpy as np
import pytest
from small_frames import FrameCamera, small_frame

from nlos_cam.errors import CameraLostError
from nlos_cam.reconstruct import FrameReader, frame_issues
from nlos_cam.reconstruct.frame_reader import QUEUE_FRAMES

PIXELS = 80 * 64


@pytest.mark.parametrize(
    ("depths", "issues"),
    [(0, ("blank",)), (PIXELS // 2, ("half_invalid",)), (PIXELS // 2 + 1, ())],
)
def test_frame_without_half_of_its_depth_has_an_issue(depths: int, issues: tuple[str]) -> None:
    frame = small_frame(0)
    frame.depth_m.ravel()[depths:] = np.nan

    assert frame_issues(frame) == issues


@pytest.mark.parametrize(("saturated", "issues"), [(5, ()), (6, ("saturated",))])
def test_more_than_a_thousandth_saturated_is_an_issue(saturated: int, issues: tuple[str]) -> None:
    assert PIXELS // 1000 == 5

    frame = small_frame(0)
    frame.ir[:] = 254
    frame.ir.ravel()[:saturated] = 255

    assert frame_issues(frame) == issues


def wait_for_end(reader: FrameReader) -> None:
    """Wait until the camera has ended: the consumer is as late as can be."""
    reader._thread.join(60.0)
    assert not reader._thread.is_alive()


def test_lossless_reader_yields_every_frame() -> None:
    with FrameReader(FrameCamera(200), lossless=True, stop=Event()) as reader:
        numbers = [arrival.frame.frame_number for arrival in reader]

    assert numbers == list(range(200))
    assert reader.dropped == 0


def test_full_reader_drops_the_oldest_frames() -> None:
    with FrameReader(FrameCamera(200), lossless=False, stop=Event()) as reader:
        wait_for_end(reader)
        numbers = [arrival.frame.frame_number for arrival in reader]

    assert numbers == list(range(200 - QUEUE_FRAMES, 200))
    assert reader.dropped == 200 - QUEUE_FRAMES


def test_reader_counts_issues_and_gives_each_frame_its_own() -> None:
    camera = FrameCamera(30)
    camera._make = lambda number: small_frame(number) if number % 3 else blank_frame(number)
    with FrameReader(camera, lossless=True, stop=Event()) as reader:
        issues = [arrival.issues for arrival in reader]

    assert issues == [() if number % 3 else ("blank",) for number in range(30)]
    assert reader.issues == {"blank": 10}


def blank_frame(number: int) -> object:
    frame = small_frame(number)
    frame.depth_m[:] = np.nan
    return frame


def test_reader_ends_with_the_stop_event() -> None:
    stop = Event()
    with FrameReader(FrameCamera(None), lossless=True, stop=stop) as reader:
        for arrival in reader:
            if arrival.frame.frame_number == 5:
                stop.set()

    assert not reader._thread.is_alive()


def test_reader_ends_when_left() -> None:
    with FrameReader(FrameCamera(None), lossless=True, stop=Event()) as reader:
        next(iter(reader))
    assert not reader._thread.is_alive()


def test_reader_closes_a_source_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.reconstruct.frame_reader.ABANDON_AFTER_S", 0.01)
    release = Event()
    source = FrameCamera(None, lambda _: release.wait(60.0))
    with FrameReader(source, lossless=True, stop=Event(), abandon_source=release.set) as reader:
        pass

    assert not reader._thread.is_alive()


def test_reader_reports_a_source_that_cannot_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.reconstruct.frame_reader.ABANDON_AFTER_S", 0.01)
    monkeypatch.setattr("nlos_cam.reconstruct.frame_reader.JOIN_TIMEOUT_S", 0.05)
    release = Event()
    source = FrameCamera(None, lambda _: release.wait(60.0))
    reader = FrameReader(source, lossless=True, stop=Event())
    with pytest.raises(CameraLostError), reader:
        pass
    release.set()
    wait_for_end(reader)
