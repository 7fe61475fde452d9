"""The streaming loop: each frame's way from a camera to a reconstruction and to a viewer, timed.

What the loop shows: a moment of each step, and the last one again while the camera stalls.

What can be seen to be amiss with a frame: blank, half invalid, saturated.
"""

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from threading import Event

import numpy as np

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live.frame_queue import FrameReader
from nlos_cam.live.statistics import DELIVERY, OnWarning, RunReport, RunStatistics, ignore
from nlos_cam.live.telemetry import Telemetry, telemetry_of
from nlos_cam.reconstruct import (
    Arrival,
    Clock,
    FrameResult,
    Pipeline,
    PreparedFrame,
    Reconstruction,
    Verdict,
    frame_issues,
    reconstruct,
)
from nlos_cam.view import Moment, Viewer


class LiveDisplay:
    """Makes moments of steps, and shows them; the last one again while the camera stalls."""

    def __init__(
        self,
        viewer: Viewer,
        dropped: Callable[[], int],
        reader: FrameReader,
        thermometer: Telemetry,
        clock: Clock,
    ) -> None:
        self._viewer, self._dropped, self._reader = viewer, dropped, reader
        self._thermometer, self._clock = thermometer, clock
        self._last: Moment | None = None

    def show(self, step: FrameResult) -> Moment:
        """Of one step, as it is shown."""
        stages_s = {**self._delivery_s(step), **step.stages_s}
        self._last = moment = Moment(
            step.frame,
            step.reconstruction,
            step.published_s,
            self._age_s(step.frame, step.published_s),
            step.difference,
            step.warnings,
            step.verdict,
            step.check,
            stages_s,
            self._dropped(),
            self._thermometer.celsius,
        )
        self._viewer.show(moment)
        return moment

    def stalled(self) -> None:
        """Show the last moment again, as old as it is; none, where there was none."""
        if self._last is not None:
            now_s = self._clock()
            age_s, verdict = self._age_s(self._last.frame, now_s), Verdict.STALLED
            again = replace(self._last, published_s=now_s, latency_s=age_s, verdict=verdict, dropped=self._dropped())
            self._viewer.show(again)

    def _delivery_s(self, step: FrameResult) -> dict[str, float]:
        return {} if step.arrived_s is None else {DELIVERY: self._age_s(step.frame, step.arrived_s)}

    def _age_s(self, frame: Frame, now_s: float) -> float:
        return now_s - frame.timestamp_s - self._reader.offset_s


def describe_counts(counts: Mapping[str, int]) -> str:
    """Counts by name as a person reads them; empty where there are none."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())


def watched(frames: Iterable[Frame], seen: Counter[str]) -> Iterator[Frame]:
    """The same frames; what is amiss with them is counted in `seen`."""
    for frame in frames:
        seen.update(frame_issues(frame))
        yield frame


USUAL_DEPTH_M = 0.3


def warm_up(camera: Camera, processing: Pipeline, clock: Clock = time.perf_counter) -> Mapping[str, float]:
    """Reconstruct a frame that is all the same, before the camera is entered; seconds by stage.

    What is compiled or allocated on first use would otherwise hold up the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark, flat = np.zeros(shape, np.uint8), np.full(shape, USUAL_DEPTH_M, np.float32)
    frame = Frame(flat, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    made = reconstruct(
        maps_from_frame(frame), processing.bench.rig, processing.network, clock, processing.uncertainty_model
    )
    return made.timings_s


def run_live(
    camera: Camera,
    processing: Pipeline,
    viewer: Viewer,
    *,
    stop: Event,
    seconds: float | None = None,
    recorded: bool = False,
    clock: Clock = time.time,
    on_error: Callable[[RunReport], None] = lambda _: None,
    on_warning: OnWarning = ignore,
    on_moment: Callable[[Moment], None] = lambda _: None,
) -> RunReport:
    """Reconstruct an entered camera's frames and show them, until it ends, `stop` is set, or `seconds` have passed.

    One that is `recorded` loses no frame and is shown at the speed it was recorded. A camera that keeps the loop's end
    waiting is left. A frame that comes to no result is counted. While none comes, the last is shown again, as stalled.
    `on_warning` hears when a warning begins and ends, `on_moment` of each frame's result once it is shown.
    Raises what the camera raises, and NlosCamError where none comes to a result, once `on_error` has had the report.
    """
    tally = RunStatistics(on_warning)
    frames, thermometer = with_telemetry(camera, camera)
    frames = watched(paced(frames, stop, clock) if recorded else frames, tally.seen)

    def enough() -> bool:
        return seconds is not None and tally.lasted_s(clock()) >= seconds

    def leave() -> None:
        camera.__exit__(None, None, None)

    def look_up() -> None:
        if tally.stall.look(clock(), reader.newest_s):
            moments.stalled()

    def report() -> RunReport:
        tally.stall.close(clock())
        return tally.report(camera, reader)

    reader = FrameReader(
        frames, lossless=recorded, stop=stop, clock=clock, enough=enough, let_go=leave, on_wait=look_up
    )
    moments = LiveDisplay(viewer, lambda: sum(tally.lost(camera, reader).values()), reader, thermometer, clock)
    try:
        with reader, processing.checks:
            for step in iterate_results(reader, processing, clock, tally.fail, thermometer):
                moment = moments.show(step)
                tally.add(step, clock() - step.published_s)
                on_moment(moment)
    except Exception:
        on_error(report())
        raise
    return report()


def paced(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Frames no sooner, after the first, than their timestamps say."""
    offset_s: float | None = None
    for frame in frames:
        offset_s = clock() - frame.timestamp_s if offset_s is None else offset_s
        if stop.wait(max(0.0, frame.timestamp_s + offset_s - clock())):
            return
        yield frame


FRAMES_TOGETHER = 4
"""Where nobody waits for them, the networks take so many frames at once: two thirds of the time for each."""


MAX_BATCHES_AHEAD = 2
"""So many times as many are worked on while others are judged: for about as long as a physics check takes."""


OnFailure = Callable[[Frame, Exception, int], None]
"""Called with a frame that came to no result, why, and how many have in a row; raises to end there."""


def _refuse(frame: Frame, error: Exception, in_a_row: int) -> None:
    del frame, in_a_row
    raise error


def with_telemetry(frames: Iterable[Frame], camera: Camera) -> tuple[Iterable[Frame], Telemetry]:
    """The same frames, and the camera's thermometer, read as they pass."""
    thermometer = telemetry_of(camera)
    return thermometer.watch(frames), thermometer


def iterate_results(
    reader: FrameReader,
    processing: Pipeline,
    clock: Clock = time.time,
    on_failure: OnFailure = _refuse,
    thermometer: Telemetry | None = None,
) -> Generator[FrameResult]:
    """Reconstruct every frame that the reader gives, in order."""
    start_s, in_a_row = clock(), 0
    for arrival in reader:
        try:
            _follow(thermometer, arrival, processing)
            step = processing.process(arrival, clock, start_s)
        except Exception as error:  # noqa: BLE001  whatever an odd frame leads to, who called decides
            in_a_row += 1
            on_failure(arrival.frame, error, in_a_row)
        else:
            in_a_row = 0
            yield step
        start_s = clock()


def iterate_batched(
    reader: FrameReader, processing: Pipeline, clock: Clock = time.time, thermometer: Telemetry | None = None
) -> Generator[FrameResult]:
    """The same steps in the same order, for frames that nobody waits for: the networks take several at once.

    Which ones does not depend on how fast they come, so the same frames give the same bits. What one leads to ends it.
    """
    ahead = deque[tuple[Sequence[PreparedFrame], Future[list[Reconstruction]]]]()
    with ThreadPoolExecutor(os.cpu_count(), "networks") as threads:
        for together in _batches(reader, processing, clock, thermometer):
            ahead.append((together, threads.submit(processing.reconstruct, together, clock)))
            if len(ahead) > MAX_BATCHES_AHEAD:
                yield from _finished(*ahead.popleft(), processing, clock)
        for lot in ahead:
            yield from _finished(*lot, processing, clock)


def _batches(
    reader: FrameReader, processing: Pipeline, clock: Clock, thermometer: Telemetry | None
) -> Generator[Sequence[PreparedFrame]]:
    """What the lidar saw, FRAMES_TOGETHER at a time; fewer at the end."""
    together, start_s = list[PreparedFrame](), clock()
    for arrival in reader:
        _follow(thermometer, arrival, processing)
        together.append(processing.prepare(arrival, clock, start_s))
        if len(together) == FRAMES_TOGETHER:
            yield together
            together = []
        start_s = clock()
    if together:
        yield together


def _finished(
    together: Sequence[PreparedFrame], making: Future[list[Reconstruction]], processing: Pipeline, clock: Clock
) -> Generator[FrameResult]:
    """The steps of frames taken together, once they are made."""
    for seen, made in zip(together, making.result(), strict=True):
        yield processing.finish(seen, made, clock)


def _follow(thermometer: Telemetry | None, arrival: Arrival, processing: Pipeline) -> None:
    """Have the bench follow the lidar's temperature."""
    if thermometer and (celsius := thermometer.at(arrival.frame)):
        processing.bench.update_temperatures(celsius)
