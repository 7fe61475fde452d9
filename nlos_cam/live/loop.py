"""Live loop: a camera's frames through the pipeline to a viewer, with statistics and stall
display.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from math import inf
from threading import Event
from typing import Self

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame
from nlos_cam.live.control import RunControl
from nlos_cam.live.statistics import DELIVERY, RunReport, RunStatistics
from nlos_cam.reconstruct import (
    Arrival,
    Clock,
    FrameReader,
    FrameResult,
    OnWarning,
    Pipeline,
    Verdict,
    ignore,
    iterate_results,
)
from nlos_cam.recording import Telemetry, with_telemetry
from nlos_cam.view import Moment, Viewer

ADVICE = "plug it straight into a USB 3 port; `nlos-cam doctor` says what is wrong"
"""Advice on the page while no frame comes, unless the camera has logged a warning of its own."""
FALL_S = 0.2
PAUSE_S = 10.0
"""Steps of a recording's time, back and on, beyond which its clock was set between two frames."""


class LiveDisplay:
    """Display of results as moments, and of the last one again while the camera stalls. Used by the
    loop's thread.
    """

    def __init__(
        self,
        viewer: Viewer,
        count_dropped: Callable[[], int],
        reader: FrameReader,
        telemetry: Telemetry,
        clock: Clock,
    ) -> None:
        self._viewer = viewer
        self._count_dropped = count_dropped
        self._reader = reader
        self._telemetry = telemetry
        self._clock = clock
        self._last: FrameResult | None = None

    def show(self, result: FrameResult) -> Moment:
        """Show a result, and return its moment."""
        if result.arrived_s is not None:
            delivery_s = self._age_s(result, result.arrived_s)
            result = replace(result, stages_s={DELIVERY: delivery_s, **result.stages_s})
        self._last = result
        return self._show(result, result.published_s)

    def show_stall(self) -> None:
        """Show the last result again, if any, with its present age."""
        if self._last is not None:
            self._show(replace(self._last, verdict=Verdict.STALLED), self._clock())

    def _show(self, result: FrameResult, time_s: float) -> Moment:
        moment = Moment(
            result,
            time_s,
            latency_s=self._age_s(result, time_s),
            dropped=self._count_dropped(),
            celsius=self._telemetry.celsius,
        )
        self._viewer.show(moment)
        return moment

    def _age_s(self, result: FrameResult, now_s: float) -> float:
        return now_s - result.timestamp_s - self._reader.offset_s


class CameraNotes(logging.Handler):
    """The camera's newest warning while entered, for the page: what it does about a stall, and why;
    the terminal shows the same.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.newest = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.newest = record.getMessage()
        # Without any other handler Python prints a warning itself; this one would keep it from that.
        if logging.lastResort and not logging.getLogger().handlers:
            logging.lastResort.handle(record)

    def __enter__(self) -> Self:
        logging.getLogger("nlos_cam.camera").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("nlos_cam.camera").removeHandler(self)


def pace(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Yield recorded frames at the intervals of their timestamps, or later.

    Where the recording's own clock is set, back by more than FALL_S or on by more than PAUSE_S, the
    intervals count from that frame on.
    """
    offset_s = 0.0
    before_s = inf
    for frame in frames:
        time_s = frame.timestamp_s
        if not before_s - FALL_S <= time_s <= before_s + PAUSE_S:
            offset_s = clock() - time_s
        before_s = time_s
        if stop.wait(max(0.0, time_s + offset_s - clock())):
            return
        yield frame


def _note_if_paused(control: RunControl, statistics: RunStatistics, arrival: Arrival) -> bool:
    """Return True, and note the frame, if the run is paused: then it is not reconstructed."""
    if not control.pipeline.paused:
        return False
    # The camera delivers: a stall is over, though nothing is reconstructed.
    statistics.stall.frame_arrived(arrival.arrived_s)
    control.pass_frame()
    return True


def run_live(
    camera: Camera,
    pipeline: Pipeline,
    viewer: Viewer,
    *,
    stop: Event,
    seconds: float | None = None,
    recorded: bool = False,
    clock: Clock = time.time,
    on_error: Callable[[RunReport], None] = ignore,
    on_warning: OnWarning = ignore,
    on_moment: Callable[[Moment], None] = ignore,
    control: RunControl | None = None,
) -> RunReport:
    """Reconstruct and show an entered camera's frames until it ends, `stop` is set, or `seconds`
    have passed.

    A `recorded` camera loses no frame and is shown at the speed of its recording. If the camera
    does not stop in time, its context is closed from here. Frames that fail are counted. While no
    frame comes, the last one is shown again, as stalled. `on_warning` is called when a warning
    begins and ends, `on_moment` for each result shown. While `control` is paused, frames are read
    and not reconstructed. Raises the camera's errors, and NlosCamError if frame after frame fails,
    after `on_error` has received the report.
    """
    statistics = RunStatistics(on_warning)
    control = control or RunControl(clock=clock)
    control.attach(camera, pipeline)
    frames, telemetry = with_telemetry(camera)
    if recorded:
        frames = pace(frames, stop, clock)

    def should_stop() -> bool:
        return seconds is not None and statistics.duration_s(clock()) >= seconds

    def on_idle() -> None:
        if statistics.stall.update(clock(), reader.newest_s):
            silent_s = clock() - (reader.newest_s or 0.0)
            control.set_state("stalled", f"no frame for {silent_s:.0f} s: {notes.newest or ADVICE}")
            display.show_stall()

    def count_dropped() -> int:
        return sum(statistics.lost(camera, reader).values())

    def report() -> RunReport:
        statistics.stall.close(clock())
        return statistics.report(camera, reader)

    reader = FrameReader(
        control.watch(frames),
        lossless=recorded,
        stop=stop,
        clock=clock,
        should_stop=should_stop,
        abandon_source=lambda: camera.__exit__(None, None, None),
        on_idle=on_idle,
    )
    notes = CameraNotes()
    is_paused = partial(_note_if_paused, control, statistics)
    display = LiveDisplay(viewer, count_dropped, reader, telemetry, clock)
    results = iterate_results(reader, pipeline, clock, statistics.fail, telemetry, is_paused)
    try:
        with notes, reader, pipeline.checks:
            for result in results:
                notes.newest = ""
                moment = display.show(result)
                statistics.add(result, clock() - result.published_s)
                statistics.pace.update(statistics.frames, reader.dropped)
                control.warnings = statistics.pace.warnings
                control.add(moment)
                control.note_drops(reader.dropped)
                on_moment(moment)
    except Exception:
        on_error(report())
        raise
    finally:
        control.end()
    return report()
