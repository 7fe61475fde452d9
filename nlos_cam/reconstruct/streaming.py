"""Iteration over a camera's frames: each at once (live), or several together (recordings)."""

import os
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

import numpy as np

from nlos_cam.camera import Camera
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.reconstruct.frame_reader import Arrival, FrameReader
from nlos_cam.reconstruct.network import Clock, Reconstruction, reconstruct
from nlos_cam.reconstruct.pipeline import FrameResult, Pipeline, PreparedFrame

USUAL_DEPTH_M = 0.3
BATCH_FRAMES = 4
"""Frames per call of the networks for a recording: two thirds of the time per frame."""
MAX_BATCHES_AHEAD = 2
"""Batches in the networks while earlier ones are finished: about the duration of a physics
check.
"""

OnFailure = Callable[[Frame, Exception, int], None]
"""Called with a frame that failed, its error, and the number of failures in a row; raises to end
the run.
"""


class Temperatures(Protocol):
    """Source of a device's temperatures."""

    def at(self, frame: Frame) -> Mapping[str, float] | None:
        """Return the last reading up to a frame, by name; None if there is no new one."""
        ...


def warm_up(camera: Camera, pipeline: Pipeline) -> None:
    """Reconstruct a flat frame before the camera is entered.

    Compiling and allocating on first use would delay the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark = np.zeros(shape, np.uint8)
    flat = np.full(shape, USUAL_DEPTH_M, np.float32)
    frame = Frame(flat, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    reconstruct(
        maps_from_frame(frame),
        pipeline.bench.rig,
        pipeline.network,
        uncertainty_model=pipeline.uncertainty_model,
    )


def _raise_error(frame: Frame, error: Exception, in_a_row: int) -> None:
    del frame, in_a_row
    raise error


def iterate_results(
    reader: FrameReader,
    pipeline: Pipeline,
    clock: Clock = time.time,
    on_failure: OnFailure = _raise_error,
    temperatures: Temperatures | None = None,
    is_paused: Callable[[Arrival], bool] = lambda _: False,
) -> Generator[FrameResult]:
    """Yield the result of every frame of an entered reader, in order; frames for which `is_paused`
    have none.
    """
    start_s = clock()
    in_a_row = 0
    for arrival in reader:
        if is_paused(arrival):
            start_s = clock()
            continue

        try:
            _update_temperatures(temperatures, arrival, pipeline)
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
    temperatures: Temperatures | None = None,
) -> Generator[FrameResult]:
    """Yield the same results in the same order, with several frames per call of the networks: for
    recordings.

    Batches do not depend on timing, so the same frames give the same bits. The first error ends the
    iteration.
    """
    ahead = deque[tuple[Sequence[PreparedFrame], Future[list[Reconstruction]]]]()

    def finish_oldest() -> Generator[FrameResult]:
        batch, reconstructions = ahead.popleft()
        for prepared, reconstruction in zip(batch, reconstructions.result(), strict=True):
            yield pipeline.finish(prepared, reconstruction, clock)

    with ThreadPoolExecutor(os.cpu_count(), "networks") as threads:
        for batch in _batches(reader, pipeline, clock, temperatures):
            ahead.append((batch, threads.submit(pipeline.reconstruct, batch, clock)))
            if len(ahead) > MAX_BATCHES_AHEAD:
                yield from finish_oldest()
        while ahead:
            yield from finish_oldest()


def _batches(
    reader: FrameReader, pipeline: Pipeline, clock: Clock, temperatures: Temperatures | None
) -> Generator[Sequence[PreparedFrame]]:
    """Yield the prepared frames, BATCH_FRAMES at a time; fewer at the end."""
    batch = list[PreparedFrame]()
    start_s = clock()
    for arrival in reader:
        _update_temperatures(temperatures, arrival, pipeline)
        batch.append(pipeline.prepare(arrival, clock, start_s))
        if len(batch) == BATCH_FRAMES:
            yield batch
            batch = []
        start_s = clock()
    if batch:
        yield batch


def _update_temperatures(
    temperatures: Temperatures | None, arrival: Arrival, pipeline: Pipeline
) -> None:
    celsius = temperatures.at(arrival.frame) if temperatures else None
    if celsius:
        pipeline.bench.update_temperatures(celsius)
