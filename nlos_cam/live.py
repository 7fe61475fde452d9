"""The streaming loop: a reader thread, a bounded queue, and each frame's way to a reconstruction, timed."""

import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from threading import Condition, Event, Thread
from types import TracebackType
from typing import Self

import numpy as np
from nlos_calibration.rig import Rig

from nlos_cam.camera.base import Camera
from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame, LidarMaps, maps_from_frame
from nlos_cam.reconstruct import Clock, Network, Reconstruction, reconstruct
from nlos_cam.view.viewer import Moment, Viewer

QUEUE_FRAMES = 3
JOIN_TIMEOUT_S = 10.0
POLL_S = 0.1
"""How often a wait looks up, so that a signal is answered."""
SAME_CLOCK_S = 10.0
"""Timestamps this close to the host's time of day are host time; others have a zero of their own."""
REMEMBERED = 100_000
"""Latencies are told of the last frames only (55 minutes at 30 frames/s): memory stays bounded."""


@dataclass(frozen=True)
class Arrival:
    """A frame, and when the reader had it."""

    frame: Frame
    arrived_s: float


class FrameReader:
    """A thread that reads frames into a queue of three while entered.

    When the queue is full it drops the oldest frame and counts it by number, or, if it `keeps_all`, waits. Iterating
    ends where the frames end, or when `stop` is set; their source's exception is raised to whoever iterates.
    """

    def __init__(self, frames: Iterable[Frame], *, keeps_all: bool, stop: Event, clock: Clock = time.time) -> None:
        self.dropped: list[int] = []
        """Frame numbers."""
        self._least_delay_s = float("inf")
        self._frames, self._keeps_all, self._clock = frames, keeps_all, clock
        self._stop, self._left = stop, False
        self._queue: deque[Arrival] = deque()
        self._changed = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._thread = Thread(target=self._read, name="frame reader", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._left = True
            self._changed.notify_all()
        self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive() and error is None:
            raise CameraLostError(f"the camera did not stop within {JOIN_TIMEOUT_S:.0f} s: replug it")

    def __iter__(self) -> Iterator[Arrival]:
        while (arrival := self._next()) is not None:
            yield arrival

    def _next(self) -> Arrival | None:
        with self._changed:
            while not (self._queue or self._ended or self._stop.is_set()):
                self._changed.wait(POLL_S)
            if self._stop.is_set():
                return None
            if self._queue:
                self._changed.notify_all()
                return self._queue.popleft()
            if self._error is not None:
                raise self._error
            return None

    def _read(self) -> None:
        try:
            for frame in self._frames:
                if not self._put(Arrival(frame, self._clock())):
                    return
        except BaseException as error:  # noqa: BLE001  whatever it was, the consumer raises it
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _put(self, arrival: Arrival) -> bool:
        """Queue a frame; False if nobody wants more."""
        with self._changed:
            while self._keeps_all and len(self._queue) == QUEUE_FRAMES and not self._unwanted:
                self._changed.wait(POLL_S)
            if len(self._queue) == QUEUE_FRAMES:
                self.dropped.append(self._queue.popleft().frame.frame_number)
            self._queue.append(arrival)
            self._least_delay_s = min(self._least_delay_s, arrival.arrived_s - arrival.frame.timestamp_s)
            self._changed.notify_all()
            return not self._unwanted

    @property
    def offset_s(self) -> float:
        """What makes host time of a timestamp: 0 if it is that already, else such that the fastest delivery took 0."""
        return 0.0 if abs(self._least_delay_s) < SAME_CLOCK_S else self._least_delay_s

    @property
    def _unwanted(self) -> bool:
        return self._left or self._stop.is_set()


@dataclass(frozen=True)
class Step:
    """One frame's way through the loop."""

    frame: Frame
    maps: LidarMaps
    reconstruction: Reconstruction
    published_s: float
    stages_s: Mapping[str, float]


def steps(reader: FrameReader, rig: Rig, network: Network, clock: Clock = time.time) -> Generator[Step]:
    """Reconstruct every frame that the reader gives, in order."""
    begun_s = clock()
    for arrival in reader:
        got_s = clock()
        maps = maps_from_frame(arrival.frame)
        mapped_s = clock()
        reconstruction = reconstruct(maps, rig, network, clock)
        stages_s = {"wait": got_s - begun_s, "maps": mapped_s - got_s, **reconstruction.timings_s}
        yield Step(arrival.frame, maps, reconstruction, clock(), stages_s)
        begun_s = clock()


def warm_up(camera: Camera, rig: Rig, network: Network) -> None:
    """Reconstruct a frame without any return, before the camera is entered.

    What is compiled or allocated on first use would otherwise hold up the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark, none = np.zeros(shape, np.uint8), np.full(shape, np.nan, np.float32)
    blank = Frame(none, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    reconstruct(maps_from_frame(blank), rig, network)


@dataclass(frozen=True)
class LiveReport:
    """What a live run did. Start-up, until the first frame's result, is in no figure."""

    frames: int
    fps: float
    dropped: int
    """Frames that the camera took and that came to no result."""
    latency_ms: Mapping[str, float]
    """p50, p95 and p99 from timestamp to result; `FrameReader.offset_s` tells how clocks are matched."""
    stages_ms: Mapping[str, float]
    """Median by stage: wait (for a frame), maps, network, view (handing over to it)."""


class Tally:
    """Collects what LiveReport tells."""

    def __init__(self) -> None:
        self.frames = 0
        self._ages_s: deque[float] = deque(maxlen=REMEMBERED)
        self._stages_s: deque[Mapping[str, float]] = deque(maxlen=REMEMBERED)
        self._first_s = self._last_s = 0.0

    def add(self, step: Step, view_s: float) -> None:
        if self.frames == 0:
            self._first_s = step.published_s
        self.frames += 1
        self._last_s = step.published_s
        self._ages_s.append(step.published_s - step.frame.timestamp_s)
        self._stages_s.append({**step.stages_s, "view": view_s})

    @property
    def seconds(self) -> float:
        """From the first result to the last."""
        return self._last_s - self._first_s

    def report(self, *, dropped: int, offset_s: float) -> LiveReport:
        latencies_ms = (np.array(self._ages_s) - offset_s) * 1e3 if self.frames else np.zeros(1)
        latency_ms = {f"p{share}": float(np.percentile(latencies_ms, share)) for share in (50, 95, 99)}
        names = self._stages_s[0] if self._stages_s else {}
        stages_ms = {name: float(np.median([s[name] for s in self._stages_s])) * 1e3 for name in names}
        fps = (self.frames - 1) / self.seconds if self.seconds > 0 else 0.0
        return LiveReport(self.frames, fps, dropped, latency_ms, stages_ms)


def run_live(
    camera: Camera,
    rig: Rig,
    network: Network,
    viewer: Viewer,
    *,
    stop: Event,
    seconds: float | None = None,
    recorded: bool = False,
    clock: Clock = time.time,
) -> LiveReport:
    """Reconstruct an entered camera's frames and show them, until it ends, `stop` is set, or `seconds` have passed.

    One that is `recorded` loses no frame and is shown at the speed it was recorded. Raises what the camera raises.
    """
    tally = Tally()
    frames = paced(camera, stop, clock) if recorded else camera
    with FrameReader(frames, keeps_all=recorded, stop=stop, clock=clock) as reader:
        for step in steps(reader, rig, network, clock):
            latency_s = step.published_s - step.frame.timestamp_s - reader.offset_s
            viewer.show(Moment(step.frame, step.reconstruction, step.published_s, latency_s))
            tally.add(step, clock() - step.published_s)
            if seconds is not None and tally.seconds >= seconds:
                break
    dropped = len(reader.dropped) + camera.dropped + camera.incomplete
    return tally.report(dropped=dropped, offset_s=reader.offset_s)


def paced(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Frames no sooner, after the first, than their timestamps say."""
    offset_s: float | None = None
    for frame in frames:
        offset_s = clock() - frame.timestamp_s if offset_s is None else offset_s
        if stop.wait(max(0.0, frame.timestamp_s + offset_s - clock())):
            return
        yield frame
