import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import Event
from typing import Any, Self

import numpy as np
import pytest
from fake_wall import WallCamera, measured_wall
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam.errors import CameraLostError, SceneError
from nlos_cam.frames import Frame
from nlos_cam.live import frame_queue
from nlos_cam.live.loop import paced, run_live, warm_up
from nlos_cam.live.statistics import OUTSIDE_LATENCY, RunReport
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import Pipeline
from nlos_cam.view.viewer import Moment, NullViewer

RIG = load_rig("paper-rig")
PERIOD_S = 1 / 30
SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)


def network(*_: np.ndarray) -> np.ndarray:
    return np.full((1, 64, 64), 0.5, np.float32)


def processing(by: Callable[..., np.ndarray] = network) -> Pipeline:
    return Pipeline(CalibratedRig(RIG), by)


def frame(number: int, offset_s: float = 0.0) -> Frame:
    depth_m = np.full((64, 80), 0.3, np.float32)
    return Frame(depth_m, np.full((64, 80), 9, np.uint8), depth_m, offset_s + number * PERIOD_S, number, SMALL)


class FakeCamera:
    """Yields as many frames as it is told to, or without end; `on_frame` runs before each."""

    uri, intrinsics, incomplete, dropped = "fake", SMALL, 0, 0

    def __init__(self, count: int | None, on_frame: Callable[[int], None] = lambda _: None) -> None:
        self._count, self._on_frame, self.offset_s = count, on_frame, 0.0
        self.counts: Counter[str] = Counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def telemetry(self, _: str = "") -> Mapping[str, float]:
        return {}

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        while self._count is None or number < self._count:
            self._on_frame(number)
            yield frame(number, self.offset_s)
            number += 1


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


class Hurried:
    """A clock that a recording is never ahead of."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        self.now_s += 1.0
        return self.now_s


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
    report = run_live(camera, processing(), viewer, stop=Event(), clock=clock)
    assert report.frames == len(viewer.moments) == 31
    assert report.dropped == 0
    assert set(report.stages_ms) == {"delivery", "wait", "queue", "maps", "bench", "network", "view"}
    assert set(report.latency_ms) == {"p50", "p95", "p99"}
    assert report.latency_ms["p50"] <= report.latency_ms["p95"] <= report.latency_ms["p99"]
    assert {name: times["p50"] for name, times in report.stages_percentiles_ms.items()} == report.stages_ms
    assert report.stages_ms["delivery"] == pytest.approx(delivery_ms, abs=1.0)
    assert report.latency_ms["p50"] == pytest.approx(delivery_ms, abs=1.0)
    assert report.fps == pytest.approx(30.0, rel=0.04)
    for moment in viewer.moments[-5:]:  # once the fastest delivery is known
        parts_s = sum(seconds for stage, seconds in moment.stages_s.items() if stage not in OUTSIDE_LATENCY)
        assert 0.0 <= parts_s <= moment.latency_s + 1e-6


def test_the_viewer_sees_every_frame_in_order() -> None:
    viewer = ListViewer()
    run_live(FakeCamera(20), processing(), viewer, stop=Event(), recorded=True)
    assert [moment.frame.frame_number for moment in viewer.moments] == list(range(20))
    assert all(moment.latency_s >= 0.0 for moment in viewer.moments)


def test_a_run_ends_after_the_seconds_it_is_given() -> None:
    camera, clock, viewer = lockstep_camera(1000, 0.0)
    report = run_live(camera, processing(), viewer, stop=Event(), seconds=1.0, clock=clock)
    assert report.frames == pytest.approx(31, abs=2)


def test_warming_up_runs_the_way_of_a_frame_once_and_takes_none_from_the_camera() -> None:
    seen: list[tuple[int, ...]] = []
    warm_up(FakeCamera(0), processing(lambda depth_m, _: seen.append(depth_m.shape) or network()))
    assert seen == [(1, 64, 80)]


def test_a_lidar_that_moves_is_warned_of_while_it_is_elsewhere(tmp_path: Path) -> None:
    told, viewer = list[tuple[str, bool]](), ListViewer()
    camera, method = (
        WallCamera(150, moved=range(30, 80)),
        Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), network),
    )
    run: Any = {"stop": Event(), "recorded": True, "clock": Hurried(), "on_warning": lambda *about: told.append(about)}
    report = run_live(camera, method, viewer, **run)
    [(warning, frames)] = report.warnings.items()
    assert [begins for _, begins in told] == [True, False]
    assert told[1][0] == warning
    warned = [moment.frame.frame_number for moment in viewer.moments if moment.warnings]
    assert len(warned) == frames
    assert warned[0] in range(30, 80)
    assert warned[-1] in range(79, 150)


def failing_at(*numbers: int) -> Callable[..., np.ndarray]:
    """A network that fails on these frames, counted from 0."""
    calls = iter(range(10_000))

    def fails(*_: np.ndarray) -> np.ndarray:
        if next(calls) in numbers:
            raise ZeroDivisionError("an odd frame")
        return network()

    return fails


def test_a_frame_that_comes_to_no_result_is_counted_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    viewer, logged = ListViewer(), list[Moment]()
    camera, method = FakeCamera(10), processing(failing_at(3, 4))
    report = run_live(camera, method, viewer, stop=Event(), recorded=True, on_moment=logged.append)
    assert [moment.frame.frame_number for moment in viewer.moments] == [0, 1, 2, 5, 6, 7, 8, 9]
    assert [moment.dropped for moment in viewer.moments] == [0, 0, 0, 2, 2, 2, 2, 2]
    assert logged == viewer.moments
    assert (report.counts, report.dropped) == ({"failed": 2}, 2)
    assert "frame 3 came to no result (ZeroDivisionError: an odd frame)" in caplog.text


def test_an_error_that_is_not_the_frames_ends_the_run_at_once() -> None:
    bare = Pipeline(CalibratedRig(load_rig("bare-wall")), network)
    with pytest.raises(SceneError, match="object_box"):
        run_live(FakeCamera(9), bare, ListViewer(), stop=Event(), recorded=True)


def test_what_the_camera_raises_is_raised_once_the_report_is_told() -> None:
    def fail_at_two(number: int) -> None:
        if number == 2:
            raise CameraLostError("unplugged")

    camera, until_then = FakeCamera(None, fail_at_two), list[RunReport]()
    camera.counts = Counter(restarted=3)
    with pytest.raises(CameraLostError, match="unplugged"):
        run_live(camera, processing(), NullViewer(), stop=Event(), recorded=True, on_error=until_then.append)
    [report] = until_then
    assert (report.frames, report.counts) == (2, {"restarted": 3})


def test_a_run_ends_after_its_seconds_also_where_no_frame_comes_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_queue, "LET_GO_AFTER_S", 0.01)
    shown, left, now_s, viewer = Event(), Event(), [0.0], ListViewer()
    viewer.show = lambda _: shown.set()  # type: ignore[method-assign]

    class Silent(FakeCamera):
        def __exit__(self, *_: object) -> None:
            left.set()

    def on_frame(number: int) -> None:
        if number == 5:
            assert shown.wait(10.0)
            now_s.append(1000.0)
            assert left.wait(10.0)

    camera = Silent(None, on_frame)
    report = run_live(camera, processing(), viewer, stop=Event(), seconds=500.0, clock=lambda: now_s[-1])
    assert left.is_set()
    assert report.frames <= 5
