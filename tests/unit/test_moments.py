from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from threading import Event
from typing import Self

import numpy as np
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam.frames import Frame
from nlos_cam.live.loop import run_live
from nlos_cam.live.statistics import STALLED
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import Pipeline
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.viewer import Moment, NullViewer

SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)
DEPTH_M, IR = np.full((64, 80), 0.3, np.float32), np.full((64, 80), 9, np.uint8)


class Stalling(NullViewer):
    """A camera that gives nothing between frames 4 and 5 until its viewer, itself, was shown so twice; 40 degrees warm.

    Its clock goes on by 0.3 s whenever it is read during the stall.
    """

    uri, intrinsics, incomplete, dropped, counts = "fake", SMALL, 0, 0, Counter[str]()

    def __init__(self) -> None:
        self.now_s, self.stalling = 100.0, False
        self.moments: list[Moment] = []
        self._shown, self._shown_twice = Event(), Event()

    def __enter__(self) -> Self:
        return self

    def __iter__(self) -> Iterator[Frame]:
        for number in range(10):
            if number == 5:
                assert self._shown.wait(10.0)
                self.stalling = True
                assert self._shown_twice.wait(10.0)
                self.stalling = False
            yield Frame(DEPTH_M, IR, IR, 100.0 + number / 30, number, SMALL)

    def telemetry(self, _: str = "") -> Mapping[str, float]:
        return {"ldd_temperature": 40.0}

    def clock(self) -> float:
        self.now_s += 0.3 if self.stalling else 0.0
        return self.now_s

    def show(self, moment: Moment) -> None:
        self.moments.append(moment)
        if moment.frame.frame_number == 4:
            self._shown.set()
        if self.stalled == 2:
            self._shown_twice.set()

    @property
    def stalled(self) -> int:
        return sum(moment.verdict is Verdict.STALLED for moment in self.moments)


def test_a_stall_is_shown_with_the_last_moment_told_once_and_counted_and_frames_go_on() -> None:
    camera, told = Stalling(), list[tuple[str, bool]]()
    method = Pipeline(CalibratedRig(load_rig("paper-rig")), lambda *_: np.full((1, 64, 64), 0.5, np.float32))
    report = run_live(
        camera, method, camera, stop=Event(), recorded=True, clock=camera.clock, on_warning=lambda *a: told.append(a)
    )
    frames = [moment.frame.frame_number for moment in camera.moments if moment.verdict is not Verdict.STALLED]
    assert frames == list(range(10))
    again = [moment for moment in camera.moments if moment.verdict is Verdict.STALLED]
    assert len(again) >= 2
    assert {moment.frame.frame_number for moment in again} == {4}
    assert all(later.latency_s > before.latency_s for before, later in pairwise(again))
    assert told == [(STALLED, True), (STALLED, False)]
    assert (report.frames, report.counts, report.verdicts) == (10, {"stalls": 1}, {})
    assert report.stalled_s >= 1.0


def test_a_moment_carries_the_temperature_read_last() -> None:
    camera = Stalling()
    method = Pipeline(CalibratedRig(load_rig("paper-rig")), lambda *_: np.full((1, 64, 64), 0.5, np.float32))
    run_live(camera, method, camera, stop=Event(), recorded=True, clock=camera.clock)
    assert {moment.celsius["ldd_temperature"] for moment in camera.moments} == {40.0}
