"""The streams that a lidar delivers through librealsense, and how three single frames become one set.

Numbers that mean the same instant on every stream, where librealsense counts the frames of each by itself.

It does on kernels without the patch that passes an L515's metadata on. A stream that begins a frame late, or loses one,
is then behind the others' numbers until it is started again, while its timestamps are right.

A set of streams, as a Frame in SI units.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nlos_calibration import Intrinsics
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.frames import Frame

TELLING = 3
"""Numbers in a row of which the streams' timestamps differ by the same number of frames."""


class StreamOffsets:
    """Raises the numbers of a stream that is behind, once timestamps have told by how much."""

    def __init__(self, frames_per_s: float) -> None:
        self._frames_per_s = frames_per_s
        self._behind: Counter[str] = Counter()
        """In frames, by stream."""
        self._lags: Mapping[str, int] = {}
        self._told = 0

    def add(self, sample: "Sample") -> "Sample":
        """The sample with its number as the other streams count."""
        behind = self._behind[sample.stream]
        return replace(sample, number=sample.number + behind) if behind else sample

    def note(self, times_s: Mapping[str, float]) -> None:
        """Take note of when the frames of one number were taken, by stream."""
        first_s = min(times_s.values())
        lags = {stream: round((time_s - first_s) * self._frames_per_s) for stream, time_s in times_s.items()}
        self._told = self._told + 1 if lags == self._lags else 1
        self._lags = lags
        if self._told == TELLING:
            self._behind.update(lags)


FORMATS = {"depth": "z16", "infrared": "y8", "confidence": "raw8"}
"""The streams that are needed, by the SDK's names, and the pixel format of each."""
BYTES_PER_PIXEL = {"depth": 2, "infrared": 1, "confidence": 1}
FRAMES_PER_S = 30
SAME_INSTANT_S = 0.5 / FRAMES_PER_S
"""Frames of one number whose timestamps differ by more were not taken together."""
WAITING_SETS = 30
"""Numbers that may wait for a stream; beyond that, the one that waited longest is given up."""
LATE_NUMBERS = 30
"""A number this little behind the last one decided is late; one further back is of a count that began anew."""
MAX_GAP = 300 * FRAMES_PER_S
"""Numbers between two sets that are taken as dropped (5 minutes' worth); beyond a wider gap the count began anew."""
STALL_S = 5 / FRAMES_PER_S
"""Two sets that are further apart in time than their numbers say, by more than this, were held up."""


@dataclass(frozen=True)
class Sample:
    """One frame of one stream, copied out of the SDK."""

    stream: str
    number: int
    timestamp_s: float
    pixels: NDArray[Any]


@dataclass(frozen=True)
class FrameSet:
    """The three streams of one instant, as the SDK delivers them."""

    number: int
    timestamp_s: float
    depth_z16: NDArray[np.uint16]
    ir: NDArray[np.uint8]
    confidence_raw8: NDArray[np.uint8]
    """The level, 0 to 15, in the upper four bits."""


def stream_name(profile: Any) -> str:
    """The SDK's name of a profile's stream: depth, infrared, confidence, color, ..."""
    return profile.stream_type().name


def is_needed(profile: Any) -> bool:
    """Whether this is one of the three streams, in the format that we read."""
    return FORMATS.get(stream_name(profile)) == profile.format().name


def sample_from_sdk(frame: Any) -> Sample:
    """Copy an SDK frame, so that the SDK has its memory back at once."""
    pixels = np.array(frame.get_data())
    return Sample(stream_name(frame.get_profile()), frame.get_frame_number(), frame.get_timestamp() / 1e3, pixels)


def intrinsics_of(profile: Any) -> Intrinsics:
    """The pinhole of a video profile; the L515's depth has no distortion."""
    found = profile.as_video_stream_profile().get_intrinsics()
    return Intrinsics(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)


class Occurrences:
    """Counts by name, in frames: what befalls two or three streams of one frame is one occurrence."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._streams: dict[tuple[str, int], Counter[str]] = {}

    def note(self, name: str, sample: Sample) -> None:
        """Count, unless the frame's other streams made it count as often already."""
        streams = self._streams.setdefault((name, sample.number), Counter())
        most = max(streams.values(), default=0)
        streams[sample.stream] += 1
        if streams[sample.stream] > most:
            self.counts[name] += 1
        if len(self._streams) > WAITING_SETS:
            del self._streams[next(iter(self._streams))]


class FrameSynchronizer:
    """Makes sets of samples with one number and instant, each once and in order, and counts what did not become one.

    Every number is decided once, in order: a set, incomplete, or dropped. A set decides all numbers before it, since
    streams come in order. Memory is bounded whatever comes. Samples must have `shape` (rows, columns), where given.
    Streams that are counted apart are numbered alike, by `StreamOffsets`.
    """

    def __init__(self, shape: tuple[int, int] | None = None) -> None:
        self.shape = shape
        self.incomplete = 0
        """Numbers of which something came, but not all streams, or not of one instant, or not of the shape."""
        self.dropped = 0
        """Numbers of which nothing came, after the first that was decided."""
        self._occurrences = Occurrences()
        self._alignment = StreamOffsets(FRAMES_PER_S)
        self._waiting: dict[int, dict[str, Sample]] = {}
        self._decided: int | None = None
        """The highest number that is."""
        self._sets: deque[int] = deque(maxlen=LATE_NUMBERS + 1)
        """The last numbers that became sets."""
        self._zero_s: float | None = None
        """Of the last set: its time, less what its number stands for."""

    @property
    def counts(self) -> Counter[str]:
        """What else was seen, by name.

        duplicate: it came again. out_of_order: it came after its number was decided as incomplete or dropped.
        wrong_size: another shape. stalled: nothing came for a while, though no number is missing. renumbered: the
        device began to count anew. stray: no set, and far from all other numbers, so that it is not `incomplete`.
        """
        return self._occurrences.counts

    def add(self, sample: Sample) -> FrameSet | None:
        """Take a sample; the set that it completes, if it does."""
        sample = self._alignment.add(sample)
        number = sample.number
        if self._decided is not None and self._decided - LATE_NUMBERS <= number <= self._decided:
            self._occurrences.note("duplicate" if number in self._sets else "out_of_order", sample)
            return None
        samples = self._waiting.setdefault(number, {})
        if self.shape not in {None, sample.pixels.shape}:
            self._occurrences.note("wrong_size", sample)
        elif sample.stream in samples:
            self._occurrences.note("duplicate", sample)
        else:
            samples[sample.stream] = sample
        if len(samples) == len(FORMATS):
            return self._complete(number)
        if len(self._waiting) > WAITING_SETS:
            self._give_up(next(iter(self._waiting)))
        return None

    def finish(self) -> None:
        """Give up whatever still waits: no more samples will come."""
        for number in sorted(self._waiting):
            self._give_up(number)

    def _complete(self, number: int) -> FrameSet | None:
        samples = self._waiting.pop(number)
        self._decide(number)
        times_s = {stream: sample.timestamp_s for stream, sample in samples.items()}
        self._alignment.note(times_s)
        if max(times_s.values()) - min(times_s.values()) > SAME_INSTANT_S:
            self.incomplete += 1
            return None
        depth, ir, confidence = (samples[stream] for stream in FORMATS)
        self._sets.append(number)
        self._note_stall(number, depth.timestamp_s)
        return FrameSet(number, depth.timestamp_s, depth.pixels, ir.pixels, confidence.pixels)

    def _decide(self, number: int) -> None:
        """Decide every number before this one."""
        before, self._decided = self._decided, number
        if before is None:
            self._pass_over(lambda waiting: waiting < number)
        elif before < number <= before + MAX_GAP:
            incomplete = self._pass_over(lambda waiting: before < waiting < number)
            self.dropped += number - before - 1 - incomplete
        else:
            self._occurrences.counts["renumbered"] += 1
            self._sets.clear()
            self._zero_s = None
            self._pass_over(lambda waiting: not number < waiting <= number + WAITING_SETS)

    def _pass_over(self, chosen: Callable[[int], bool]) -> int:
        """Count waiting numbers as incomplete; how many they are."""
        numbers = [number for number in self._waiting if chosen(number)]
        for number in numbers:
            del self._waiting[number]
        self.incomplete += len(numbers)
        return len(numbers)

    def _give_up(self, number: int) -> None:
        """Decide a number that waited in vain, if it is the next one that can be; else forget it."""
        after = self._decided
        ahead = [waiting for waiting in self._waiting if after is None or after < waiting <= after + MAX_GAP]
        del self._waiting[number]
        if ahead and number == min(ahead):
            self._decide(number)
            self.incomplete += 1
        else:
            self._occurrences.counts["stray"] += 1

    def _note_stall(self, number: int, timestamp_s: float) -> None:
        zero_s = timestamp_s - number / FRAMES_PER_S
        if self._zero_s is not None and zero_s - self._zero_s > STALL_S:
            self._occurrences.counts["stalled"] += 1
        self._zero_s = zero_s


def frame_in_si(
    found: FrameSet,
    unit_m: float,
    intrinsics: Intrinsics,
    settings: Mapping[str, float],
    truth_depth_m: Float32 | None = None,
) -> Frame:
    """The frame of a set whose depth counts in units of `unit_m`."""
    depth_m = found.depth_z16 * np.float32(unit_m)
    depth_m[found.depth_z16 == 0] = np.nan
    return Frame(
        depth_m=depth_m,
        ir=found.ir,
        confidence=found.confidence_raw8 >> np.uint8(4),
        timestamp_s=found.timestamp_s,
        frame_number=found.number,
        intrinsics=intrinsics,
        settings=settings,
        truth_depth_m=truth_depth_m,
    )
