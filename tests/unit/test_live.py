import threading
from collections.abc import Callable, Iterator
from threading import Event
from typing import Self

import numpy as np
import pytest
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam import live
from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.live import QUEUE_FRAMES, FrameReader, paced, run_live, steps, warm_up
from nlos_cam.view.viewer import Moment, NullViewer

RIG = load_rig("paper-rig")
PERIOD_S = 1 / 30
SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)


def network(*_: np.ndarray) -> np.ndarray:
    return np.full((1, 64, 64), 0.5, np.float32)


def frame(number: int, offset_s: float = 0.0) -> Frame:
    depth_m = np.full((64, 80), 0.3, np.float32)
    return Frame(depth_m, np.full((64, 80), 9, np.uint8), depth_m, offset_s + number * PERIOD_S, number, SMALL)


class FakeCamera:
    """Yields as many frames as it is told to, or without end; `on_frame` runs before each."""

    uri, intrinsics, incomplete, dropped = "fake", SMALL, 0, 0

    def __init__(self, count: int | None, on_frame: Callable[[int], None] = lambda _: None) -> None:
        self._count, self._on_frame, self.offset_s = count, on_frame, 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        while self._count is None or number < self._count:
            self._on_frame(number)
            yield frame(number, self.offset_s)
            number += 1


def read_behind(reader: FrameReader) -> None:
    """Wait until the camera has ended: a consumer as late as can be."""
    reader._thread.join(10.0)
    assert not reader._thread.is_alive()


def test_a_recording_is_read_whole_and_in_order_by_a_late_consumer() -> None:
    with FrameReader(FakeCamera(50), keeps_all=True, stop=Event()) as reader:
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert numbers == list(range(50))
    assert reader.dropped == []


def test_a_full_queue_drops_the_oldest_and_tells_which() -> None:
    with FrameReader(FakeCamera(10), keeps_all=False, stop=Event()) as reader:
        read_behind(reader)
        numbers = [arrival.frame.frame_number for arrival in reader]
    assert numbers == [7, 8, 9]
    assert reader.dropped == list(range(10 - QUEUE_FRAMES))


def test_a_recording_is_paced_by_its_timestamps() -> None:
    waits_s, now_s = [], [100.0]

    class Waits(Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits_s.append(timeout)
            now_s[0] += timeout or 0.0
            return self.is_set()

    stop = Waits()
    given = []
    for each in paced(map(frame, (0, 1, 4, 2)), stop, lambda: now_s[0]):
        given.append(each.frame_number)
        now_s[0] += 0.01
    assert given == [0, 1, 4, 2]
    assert waits_s == pytest.approx([0.0, PERIOD_S - 0.01, 3 * PERIOD_S - 0.01, 0.0])
    stop.set()
    assert list(paced([frame(0)], stop, lambda: 0.0)) == []


@pytest.mark.parametrize("keeps_all", [True, False])
def test_every_frame_is_either_given_or_counted_as_dropped(keeps_all: bool) -> None:
    with FrameReader(FakeCamera(200), keeps_all=keeps_all, stop=Event()) as reader:
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
        FrameReader(FakeCamera(None, fail_at_two), keeps_all=True, stop=Event()) as reader,
    ):
        seen.extend(arrival.frame.frame_number for arrival in reader)
    assert seen == [0, 1]


def test_stop_ends_an_endless_camera() -> None:
    stop = Event()
    with FrameReader(FakeCamera(None), keeps_all=True, stop=stop) as reader:
        for arrival in reader:
            if arrival.frame.frame_number == 5:
                stop.set()
    assert not reader._thread.is_alive()


def test_leaving_early_ends_the_thread() -> None:
    with FrameReader(FakeCamera(None), keeps_all=True, stop=Event()) as reader:
        next(iter(reader))
    assert not reader._thread.is_alive()


def test_a_camera_that_hangs_is_told_after_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "JOIN_TIMEOUT_S", 0.05)
    release = Event()
    reader = FrameReader(FakeCamera(None, lambda _: release.wait(10.0)), keeps_all=True, stop=Event())
    with pytest.raises(CameraLostError, match="did not stop"), reader:
        pass
    release.set()
    read_behind(reader)


def test_steps_times_every_stage_with_the_clock_it_is_given() -> None:
    ticks = iter(range(10_000))
    with FrameReader(FakeCamera(3), keeps_all=True, stop=Event(), clock=lambda: 0.0) as reader:
        done = list(steps(reader, RIG, network, lambda: float(next(ticks))))
    assert [step.frame.frame_number for step in done] == [0, 1, 2]
    for step in done:
        assert step.stages_s == {"wait": 1.0, "maps": 1.0, "network": 1.0}


class ListViewer(NullViewer):
    def __init__(self) -> None:
        self.moments: list[Moment] = []

    def show(self, moment: Moment) -> None:
        self.moments.append(moment)


class Metronome:
    """A clock that the camera sets: a frame arrives 5 ms after its timestamp, and nothing else takes time."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def on_frame(self, number: int) -> None:
        self.now_s = number * PERIOD_S + 0.005

    def __call__(self) -> float:
        return self.now_s


def lockstep_camera(count: int, offset_s: float) -> tuple[FakeCamera, Metronome, ListViewer]:
    """A camera that gives the next frame once the viewer has seen the one before."""
    clock, viewer = Metronome(), ListViewer()
    shown = threading.Semaphore(1)

    def on_frame(number: int) -> None:
        assert shown.acquire(timeout=10.0)
        clock.on_frame(number)

    def show(moment: Moment) -> None:
        viewer.moments.append(moment)
        shown.release()

    viewer.show = show  # type: ignore[method-assign]
    camera = FakeCamera(count, on_frame)
    camera.offset_s = offset_s
    return camera, clock, viewer


@pytest.mark.parametrize(("offset_s", "delivery_ms"), [(0.0, 5.0), (1e6, 0.0), (-1e6, 0.0)])
def test_latency_is_told_on_any_clock(offset_s: float, delivery_ms: float) -> None:
    camera, clock, viewer = lockstep_camera(31, offset_s)
    report = run_live(camera, RIG, network, viewer, stop=Event(), clock=clock)
    assert report.frames == len(viewer.moments) == 31
    assert report.dropped == 0
    assert set(report.stages_ms) == {"wait", "maps", "network", "view"}
    assert set(report.latency_ms) == {"p50", "p95", "p99"}
    assert report.latency_ms["p50"] <= report.latency_ms["p95"] <= report.latency_ms["p99"]
    assert report.latency_ms["p50"] == pytest.approx(delivery_ms, abs=1.0)
    assert report.fps == pytest.approx(30.0, rel=0.04)


def test_the_viewer_sees_every_frame_in_order() -> None:
    viewer = ListViewer()
    run_live(FakeCamera(20), RIG, network, viewer, stop=Event(), recorded=True)
    assert [moment.frame.frame_number for moment in viewer.moments] == list(range(20))
    assert all(moment.latency_s >= 0.0 for moment in viewer.moments)


def test_a_run_ends_after_the_seconds_it_is_given() -> None:
    camera, clock, viewer = lockstep_camera(1000, 0.0)
    report = run_live(camera, RIG, network, viewer, stop=Event(), seconds=1.0, clock=clock)
    assert report.frames == pytest.approx(31, abs=2)


def test_what_the_camera_lost_counts_as_dropped() -> None:
    camera = FakeCamera(4)
    camera.incomplete, camera.dropped = 2, 3  # type: ignore[misc]
    assert run_live(camera, RIG, network, NullViewer(), stop=Event(), recorded=True).dropped == 5


def test_a_run_without_a_frame_reports_zeros() -> None:
    report = run_live(FakeCamera(0), RIG, network, NullViewer(), stop=Event())
    assert (report.frames, report.fps, report.dropped, report.stages_ms) == (0, 0.0, 0, {})
    assert set(report.latency_ms.values()) == {0.0}


def test_warming_up_runs_the_way_of_a_frame_once_and_takes_none_from_the_camera() -> None:
    seen: list[tuple[int, ...]] = []

    def noting(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        seen.append(depth_m.shape)
        return network(depth_m, intensity)

    warm_up(FakeCamera(0), load_rig("paper-rig"), noting)
    assert seen == [(1, 64, 80)]
