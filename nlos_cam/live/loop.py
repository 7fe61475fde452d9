"""Live loop: a camera's frames through the pipeline to a viewer, with statistics and stall
display.
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
from nlos_cam.live.control import RunControl
from nlos_cam.live.frame_queue import FrameReader, ignore
from nlos_cam.live.statistics import DELIVERY, OnWarning, RunReport, RunStatistics
from nlos_cam.live.telemetry import Telemetry, with_telemetry
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

USUAL_DEPTH_M = 0.3
BATCH_FRAMES = 4
"""Frames per batch of the networks in a replay: two thirds of the time per frame."""
MAX_BATCHES_AHEAD = 2
"""Batches in the networks while earlier ones are finished: about the duration of a physics
check.
"""

OnFailure = Callable[[Frame, Exception, int], None]
"""Called with a frame that failed, its error, and the number of failures in a row; raises to end
the run.
"""


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
        self._last: Moment | None = None

    def show(self, result: FrameResult) -> Moment:
        """Show a result, and return its moment."""
        frame = result.frame
        delivery = (
            {} if result.arrived_s is None else {DELIVERY: self._age_s(frame, result.arrived_s)}
        )
        self._last = moment = Moment(
            frame,
            result.reconstruction,
            published_s=result.published_s,
            latency_s=self._age_s(frame, result.published_s),
            difference=result.difference,
            warnings=result.warnings,
            verdict=result.verdict,
            check=result.check,
            stages_s={**delivery, **result.stages_s},
            dropped=self._count_dropped(),
            celsius=self._telemetry.celsius,
        )
        self._viewer.show(moment)
        return moment

    def show_stall(self) -> None:
        """Show the last moment again, if any, with its present age."""
        if self._last is not None:
            now_s = self._clock()
            age_s = self._age_s(self._last.frame, now_s)
            dropped = self._count_dropped()
            stalled = Verdict.STALLED
            self._viewer.show(
                replace(
                    self._last, published_s=now_s, latency_s=age_s, verdict=stalled, dropped=dropped
                )
            )

    def _age_s(self, frame: Frame, now_s: float) -> float:
        return now_s - frame.timestamp_s - self._reader.offset_s


def describe_counts(counts: Mapping[str, int]) -> str:
    """Return counts by name as text, "3 out of order, 1 blank"; empty if there are none."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())


def count_issues(frames: Iterable[Frame], counts: Counter[str]) -> Iterator[Frame]:
    """Yield the same frames, and add their issues to `counts`."""
    for frame in frames:
        counts.update(frame_issues(frame))
        yield frame


def pace(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Yield recorded frames at the intervals of their timestamps, or later."""
    offset_s: float | None = None
    for frame in frames:
        offset_s = clock() - frame.timestamp_s if offset_s is None else offset_s
        if stop.wait(max(0.0, frame.timestamp_s + offset_s - clock())):
            return
        yield frame


def warm_up(
    camera: Camera, pipeline: Pipeline, clock: Clock = time.perf_counter
) -> Mapping[str, float]:
    """Reconstruct a flat frame before the camera is entered, and return its seconds by stage.

    Compiling and allocating on first use would delay the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark = np.zeros(shape, np.uint8)
    flat = np.full(shape, USUAL_DEPTH_M, np.float32)
    maps = maps_from_frame(
        Frame(flat, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    )
    return reconstruct(
        maps, pipeline.bench.rig, pipeline.network, clock, pipeline.uncertainty_model
    ).timings_s


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
    frames = control.watch(
        count_issues(pace(frames, stop, clock) if recorded else frames, statistics.issues)
    )

    def should_stop() -> bool:
        return seconds is not None and statistics.duration_s(clock()) >= seconds

    def on_idle() -> None:
        if statistics.stall.update(clock(), reader.newest_s):
            control.set_state("stalled", f"no frame for {clock() - (reader.newest_s or 0.0):.0f} s")
            display.show_stall()

    def report() -> RunReport:
        statistics.stall.close(clock())
        return statistics.report(camera, reader)

    reader = FrameReader(
        frames,
        lossless=recorded,
        stop=stop,
        clock=clock,
        should_stop=should_stop,
        abandon_source=lambda: camera.__exit__(None, None, None),
        on_idle=on_idle,
    )
    display = LiveDisplay(
        viewer, lambda: sum(statistics.lost(camera, reader).values()), reader, telemetry, clock
    )
    try:
        with reader, pipeline.checks:
            results = iterate_results(
                reader, pipeline, clock, statistics.fail, telemetry, lambda: control.paused
            )
            for result in results:
                moment = display.show(result)
                statistics.add(result, clock() - result.published_s)
                statistics.pace.update(statistics.frames, len(reader.dropped))
                control.warnings = statistics.pace.warnings
                control.add(moment)
                on_moment(moment)
    except Exception:
        on_error(report())
        raise
    finally:
        control.end()
    return report()


def _raise_error(frame: Frame, error: Exception, in_a_row: int) -> None:
    del frame, in_a_row
    raise error


def iterate_results(
    reader: FrameReader,
    pipeline: Pipeline,
    clock: Clock = time.time,
    on_failure: OnFailure = _raise_error,
    telemetry: Telemetry | None = None,
    is_paused: Callable[[], bool] = lambda: False,
) -> Generator[FrameResult]:
    """Yield the result of every frame of an entered reader, in order; frames that come while paused
    have none.
    """
    start_s = clock()
    in_a_row = 0
    for arrival in reader:
        if is_paused():
            start_s = clock()
            continue
        try:
            _update_temperatures(telemetry, arrival, pipeline)
            result = pipeline.process(arrival, clock, start_s)
        except Exception as error:  # noqa: BLE001  whatever an odd frame leads to, the caller decides
            in_a_row += 1
            on_failure(arrival.frame, error, in_a_row)
        else:
            in_a_row = 0
            yield result
        start_s = clock()


def iterate_batched(
    reader: FrameReader,
    pipeline: Pipeline,
    clock: Clock = time.time,
    telemetry: Telemetry | None = None,
) -> Generator[FrameResult]:
    """Yield the same results in the same order, with several frames per call of the networks: for
    replays.

    Batches do not depend on timing, so the same frames give the same bits. The first error ends the
    iteration.
    """
    ahead = deque[tuple[Sequence[PreparedFrame], Future[list[Reconstruction]]]]()

    def finish_oldest() -> Generator[FrameResult]:
        batch, reconstructions = ahead.popleft()
        for prepared, reconstruction in zip(batch, reconstructions.result(), strict=True):
            yield pipeline.finish(prepared, reconstruction, clock)

    with ThreadPoolExecutor(os.cpu_count(), "networks") as threads:
        for batch in _batches(reader, pipeline, clock, telemetry):
            ahead.append((batch, threads.submit(pipeline.reconstruct, batch, clock)))
            if len(ahead) > MAX_BATCHES_AHEAD:
                yield from finish_oldest()
        while ahead:
            yield from finish_oldest()


def _batches(
    reader: FrameReader, pipeline: Pipeline, clock: Clock, telemetry: Telemetry | None
) -> Generator[Sequence[PreparedFrame]]:
    """Yield the prepared frames, BATCH_FRAMES at a time; fewer at the end."""
    batch = list[PreparedFrame]()
    start_s = clock()
    for arrival in reader:
        _update_temperatures(telemetry, arrival, pipeline)
        batch.append(pipeline.prepare(arrival, clock, start_s))
        if len(batch) == BATCH_FRAMES:
            yield batch
            batch = []
        start_s = clock()
    if batch:
        yield batch


def _update_temperatures(telemetry: Telemetry | None, arrival: Arrival, pipeline: Pipeline) -> None:
    if telemetry and (celsius := telemetry.at(arrival.frame)):
        pipeline.bench.update_temperatures(celsius)
