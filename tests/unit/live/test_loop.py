import threading
from collections import Counter
from collections.abc import Callable
from itertools import count as count_up
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_wall import WallCamera, measured_wall
from nlos_calibration import MeasuredWall, load_rig
from small_frames import FrameCamera, ListViewer, sheet_network, small_frame

from nlos_cam.errors import CameraLostError
from nlos_cam.live.loop import pace, run_live
from nlos_cam.live.statistics import OUTSIDE_LATENCY, STALLED, RunReport
from nlos_cam.reconstruct import CalibratedRig, Pipeline, Verdict
from nlos_cam.view import Moment, NullViewer

RIG = load_rig("paper-rig")
PERIOD_S = 1 / 30


def pipeline(
    network: Callable[..., np.ndarray] = sheet_network, wall: MeasuredWall | None = None
) -> Pipeline:
    return Pipeline(CalibratedRig(RIG, wall), network)


def test_pace_yields_frames_at_their_timestamps() -> None:
    waits_s = []
    now_s = [100.0]

    class Waits(Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits_s.append(timeout)
            now_s[0] += timeout or 0.0
            return self.is_set()

    stop = Waits()
    given = []
    for each in pace(map(small_frame, (0, 1, 4, 2)), stop, lambda: now_s[0]):
        given.append(each.frame_number)
        now_s[0] += 0.01

    assert given == [0, 1, 4, 2]
    assert waits_s == pytest.approx([0.0, PERIOD_S - 0.01, 3 * PERIOD_S - 0.01, 0.0])

    stop.set()

    assert list(pace([small_frame(0)], stop, lambda: 0.0)) == []


@pytest.mark.parametrize("other", [1, 100_000])
def test_pace_goes_on_where_the_recordings_clock_is_set(other: int) -> None:
    now_s = [0.0]

    class Waits(Event):
        def wait(self, timeout: float | None = None) -> bool:
            now_s[0] += timeout or 0.0
            return False

    numbers = (1000, 1001, other, other + 1, other + 2)
    passed_s = [now_s[0] for _ in pace(map(small_frame, numbers), Waits(), lambda: now_s[0])]

    assert passed_s == pytest.approx([0, PERIOD_S, PERIOD_S, 2 * PERIOD_S, 3 * PERIOD_S])


class Lockstep(ListViewer):
    """Viewer, camera and clock in one step: a frame arrives 5 ms after its timestamp, once the last
    was shown.
    """

    def __init__(self, count: int, offset_s: float) -> None:
        super().__init__()
        self._now_s = 0.0
        self._shown = threading.Semaphore(1)
        self.camera = FrameCamera(
            count, self._on_frame, make=lambda number: small_frame(number, offset_s)
        )

    def _on_frame(self, number: int) -> None:
        while not self._shown.acquire(timeout=0.05) and not self.camera.closed.is_set():
            pass
        self._now_s = number * PERIOD_S + 0.005

    def clock(self) -> float:
        return self._now_s

    def show(self, moment: Moment) -> None:
        super().show(moment)
        self._shown.release()


def run_in_lockstep(offset_s: float = 0.0) -> tuple[Lockstep, RunReport]:
    lockstep = Lockstep(31, offset_s)
    report = run_live(lockstep.camera, pipeline(), lockstep, stop=Event(), clock=lockstep.clock)
    return lockstep, report


def test_run_live_reports_every_stage_of_every_frame() -> None:
    lockstep, report = run_in_lockstep()

    assert report.frames == len(lockstep.moments) == 31
    assert report.dropped == 0
    assert set(report.stages_ms) == {
        "delivery",
        "wait",
        "queue",
        "maps",
        "bench",
        "network",
        "view",
    }

    medians_ms = {name: times["p50"] for name, times in report.stages_percentiles_ms.items()}

    assert medians_ms == report.stages_ms


def test_run_live_reports_percentiles_in_order() -> None:
    _, report = run_in_lockstep()

    assert set(report.latency_ms) == {"p50", "p95", "p99"}
    assert report.latency_ms["p50"] <= report.latency_ms["p95"] <= report.latency_ms["p99"]


@pytest.mark.parametrize(("offset_s", "delivery_ms"), [(0.0, 5.0), (1e6, 0.0), (-1e6, 0.0)])
def test_run_live_reports_latency_on_any_clock(offset_s: float, delivery_ms: float) -> None:
    lockstep, report = run_in_lockstep(offset_s)

    assert report.stages_ms["delivery"] == pytest.approx(delivery_ms, abs=1.0)
    assert report.latency_ms["p50"] == pytest.approx(delivery_ms, abs=1.0)
    assert report.fps == pytest.approx(30.0, rel=0.04)

    for moment in lockstep.moments[-5:]:  # once the fastest delivery is known
        parts_s = sum(
            seconds
            for stage, seconds in moment.result.stages_s.items()
            if stage not in OUTSIDE_LATENCY
        )
        assert 0.0 <= parts_s <= moment.latency_s + 1e-6


def test_run_live_warns_while_the_lidar_is_moved(tmp_path: Path) -> None:
    begins = list[tuple[str, bool]]()
    viewer = ListViewer()
    clock = count_up(1.0)
    camera = WallCamera(150, moved=range(30, 80))
    method = pipeline(wall=measured_wall(tmp_path))
    run: Any = {
        "stop": Event(),
        "recorded": True,
        "clock": lambda: next(clock),
    }  # the recording is never ahead of it
    report = run_live(camera, method, viewer, **run, on_warning=lambda *about: begins.append(about))
    [(warning, frames)] = report.warnings.items()

    assert [each for _, each in begins] == [True, False]
    assert begins[1][0] == warning

    warned = [
        moment.result.frame.frame_number for moment in viewer.moments if moment.result.warnings
    ]

    assert len(warned) == frames
    assert warned[0] in range(30, 80)
    assert warned[-1] in range(79, 150)


def test_run_live_counts_and_survives_failed_frames(caplog: pytest.LogCaptureFixture) -> None:
    viewer = ListViewer()
    logged = list[Moment]()
    sheet = sheet_network()
    network = Mock(
        spec=sheet_network,
        side_effect=[*[sheet] * 3, *[ZeroDivisionError("an odd frame")] * 2, *[sheet] * 5],
    )
    report = run_live(
        FrameCamera(10),
        pipeline(network),
        viewer,
        stop=Event(),
        recorded=True,
        on_moment=logged.append,
    )

    assert [moment.result.frame.frame_number for moment in viewer.moments] == [
        0,
        1,
        2,
        5,
        6,
        7,
        8,
        9,
    ]
    assert [moment.dropped for moment in viewer.moments] == [0, 0, 0, 2, 2, 2, 2, 2]
    assert logged == viewer.moments
    assert report.counts == {"failed": 2}
    assert report.dropped == 2
    assert all(moment.latency_s >= 0.0 for moment in viewer.moments)
    assert "frame 3 " in caplog.text
    assert "ZeroDivisionError: an odd frame" in caplog.text


def test_run_live_reports_before_it_raises_the_cameras_error() -> None:
    camera = FrameCamera(None, Mock(side_effect=[None, None, CameraLostError("unplugged")]))
    reports = list[RunReport]()
    camera.counts = Counter(restarted=3)
    with pytest.raises(CameraLostError, match="unplugged"):
        run_live(
            camera, pipeline(), NullViewer(), stop=Event(), recorded=True, on_error=reports.append
        )
    [report] = reports

    assert report.frames == 2
    assert report.counts == {"restarted": 3}


def test_run_live_ends_in_time_without_further_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.reconstruct.frame_reader.ABANDON_AFTER_S", 0.01)
    shown = Event()
    now_s = [0.0]
    viewer = ListViewer()
    viewer.show = lambda _: shown.set()  # type: ignore[method-assign]

    def on_frame(number: int) -> None:
        if number == 5:
            assert shown.wait(60.0)
            now_s.append(1000.0)
            assert camera.closed.wait(60.0)

    camera = FrameCamera(None, on_frame)
    report = run_live(
        camera, pipeline(), viewer, stop=Event(), seconds=500.0, clock=lambda: now_s[-1]
    )

    assert camera.closed.is_set()
    assert report.frames <= 5


class Stalling(ListViewer):
    """Viewer whose camera yields nothing between frames 4 and 5 until the stall was shown twice; 40
    degrees warm.

    The clock goes on by 0.3 s whenever it is read during the stall.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 100.0
        self.stalling = False
        self._shown = Event()
        self._shown_twice = Event()
        self.camera = FrameCamera(
            10, self._on_frame, make=lambda number: small_frame(number, 100.0)
        )
        self.camera.telemetry = lambda _="": {"ldd_temperature": 40.0}  # type: ignore[method-assign]

    def _on_frame(self, number: int) -> None:
        if number == 5:
            assert self._shown.wait(60.0)
            self.stalling = True
            assert self._shown_twice.wait(60.0)
            self.stalling = False

    def clock(self) -> float:
        self.now_s += 0.3 if self.stalling else 0.0
        return self.now_s

    def show(self, moment: Moment) -> None:
        super().show(moment)
        if moment.result.frame.frame_number == 4:
            self._shown.set()
        if sum(moment.result.verdict is Verdict.STALLED for moment in self.moments) == 2:
            self._shown_twice.set()


def test_run_live_shows_a_stall_with_the_last_moment() -> None:
    viewer = Stalling()
    begins = list[tuple[str, bool]]()
    run: Any = {"stop": Event(), "recorded": True, "clock": viewer.clock}
    report = run_live(
        viewer.camera, pipeline(), viewer, **run, on_warning=lambda *about: begins.append(about)
    )
    frames = [
        moment.result.frame.frame_number
        for moment in viewer.moments
        if moment.result.verdict is not Verdict.STALLED
    ]

    assert frames == list(range(10))

    again = [moment for moment in viewer.moments if moment.result.verdict is Verdict.STALLED]

    assert len(again) >= 2
    assert {moment.result.frame.frame_number for moment in again} == {4}
    assert all(later.latency_s > before.latency_s for before, later in pairwise(again))
    assert begins == [(STALLED, True), (STALLED, False)]
    assert (report.frames, report.counts, report.verdicts) == (10, {"stalls": 1}, {})
    assert report.stalled_s >= 1.0
    assert {moment.celsius["ldd_temperature"] for moment in viewer.moments} == {40.0}
