"""Streams that a lidar delivers through librealsense, and their pairing into sets and Frames in SI
units.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from nlos_calibration import Gravity, Intrinsics
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.frames import Frame

FORMATS = {"depth": "z16", "infrared": "y8", "confidence": "raw8"}
"""Streams that a lidar delivers, by the SDK's names, and the pixel format of each."""
OPTIONAL = frozenset({"confidence"})
"""Streams that no result is computed from: a recording may lack them."""
BYTES_PER_PIXEL = {"depth": 2, "infrared": 1, "confidence": 1}
FRAMES_PER_S = 30
SAME_INSTANT_S = 0.5 / FRAMES_PER_S
"""Frames of one number whose timestamps differ by more were not exposed together."""
CONSISTENT_SETS = 3
"""Sets in a row whose streams lag by the same number of frames, before the numbers are
corrected.
"""
WAITING_SETS = 30
"""Numbers that may wait for a stream; beyond that, the one that waited longest is given up."""
LATE_NUMBERS = 30
"""A number at most this far behind the last decided one is late; one further back belongs to a
restarted count.
"""
MAX_GAP = 300 * FRAMES_PER_S
"""Numbers between two sets that count as dropped (5 minutes' worth); beyond a wider gap the count
was restarted.
"""
STALL_S = 5 / FRAMES_PER_S
"""Time between two sets beyond that between their numbers, from which on delivery counts as
stalled.
"""


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
    """Return the SDK's name of a profile's stream: depth, infrared, confidence, color, ..."""
    return profile.stream_type().name


def is_needed(profile: Any) -> bool:
    """Return True for one of the three streams in its format."""
    return FORMATS.get(stream_name(profile)) == profile.format().name


def sample_from_sdk(frame: Any) -> Sample:
    """Copy an SDK frame, so that the SDK can reuse its memory at once."""
    pixels = np.array(frame.get_data())
    return Sample(
        stream_name(frame.get_profile()),
        frame.get_frame_number(),
        frame.get_timestamp() / 1e3,
        pixels,
    )


def intrinsics_of(profile: Any) -> Intrinsics:
    """Return the pinhole of a video profile; the L515's depth has no distortion."""
    found = profile.as_video_stream_profile().get_intrinsics()
    return Intrinsics(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)


class StreamOffsets:
    """Offsets that make frame numbers mean the same instant on every stream.

    librealsense counts the frames of each stream by itself where the kernel does not pass an L515's
    metadata on. A stream that starts late or loses a frame is then behind the others' numbers until
    its restart.
    """

    def __init__(self, frames_per_s: float) -> None:
        self._frames_per_s = frames_per_s
        self._offsets: Counter[str] = Counter()
        self._lags: Mapping[str, int] = {}
        self._repeats = 0

    def add(self, sample: Sample) -> Sample:
        """Return the sample with its number as the other streams count."""
        offset = self._offsets[sample.stream]
        return replace(sample, number=sample.number + offset) if offset else sample

    def note(self, times_s: Mapping[str, float]) -> None:
        """Learn from the timestamps of the frames of one number, by stream."""
        # A stream that lost k frames gives number n to the frame that the others call n + k, so its
        # frame n was exposed k periods after theirs: k is the lag in periods behind the earliest
        # stream, rounded. Exposures of one instant differ by a fraction of a period, and a lag that
        # does not repeat was a late timestamp, not a loss.
        first_s = min(times_s.values())
        lags = {
            stream: round((time_s - first_s) * self._frames_per_s)
            for stream, time_s in times_s.items()
        }
        self._repeats = self._repeats + 1 if lags == self._lags else 1
        self._lags = lags
        if self._repeats == CONSISTENT_SETS:
            self._offsets.update(lags)


class Occurrences:
    """Counts of events by name, in frames: the same event on several streams of one frame counts
    once.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._streams: dict[tuple[str, int], Counter[str]] = {}

    def note(self, name: str, sample: Sample) -> None:
        """Count an event, unless another stream of the frame already had it as often."""
        streams = self._streams.setdefault((name, sample.number), Counter())
        highest = max(streams.values(), default=0)
        streams[sample.stream] += 1
        if streams[sample.stream] > highest:
            self.counts[name] += 1
        if len(self._streams) > WAITING_SETS:
            del self._streams[next(iter(self._streams))]


class FrameSynchronizer:
    """Pairing of samples with one number and instant into sets, each once and in order.

    A set has a sample of each of the `streams`, which include depth and infrared; without
    confidence its levels are 0. Stateful, with bounded memory whatever comes; one thread at a time. Every number is decided
    once, in rising order, as a set, incomplete or dropped. Samples must have `shape` (rows,
    columns), if given.
    """

    # Each stream delivers in rising order. Once all three have delivered number n, whatever is to
    # come below n is a late repeat, so a set decides every number before it: those with some
    # samples are incomplete, those with none were dropped, and with b the last number decided
    # before, n - b - 1 = incomplete + dropped. A number that waits for WAITING_SETS others has lost
    # a stream, and is decided without a set.

    def __init__(
        self, shape: tuple[int, int] | None = None, streams: Collection[str] = tuple(FORMATS)
    ) -> None:
        self.shape = shape
        self._streams = frozenset(streams)
        self.incomplete = 0
        """Numbers with samples, but not of all streams, of one instant and of the shape."""
        self.dropped = 0
        """Numbers without any sample, after the first that was decided."""
        self._occurrences = Occurrences()
        self._offsets = StreamOffsets(FRAMES_PER_S)
        self._waiting: dict[int, dict[str, Sample]] = {}
        self._decided: int | None = None
        """The highest decided number."""
        self._sets: deque[int] = deque(maxlen=LATE_NUMBERS + 1)
        """The last numbers that became sets."""
        self._zero_s: float | None = None
        """Time of number 0, extrapolated from the last set."""

    @property
    def counts(self) -> Counter[str]:
        """Other events, by name.

        duplicate: a sample came again. out_of_order: it came after its number was decided as
        incomplete or dropped. wrong_size: it has another shape. stalled: nothing came for a while,
        though no number is missing. renumbered: the device restarted its count. stray: no set, and
        without a finite time or far from all other numbers, so that it is not `incomplete`.
        """
        return self._occurrences.counts

    def add(self, sample: Sample) -> FrameSet | None:
        """Take a sample, and return the set that it completes, if any."""
        if not isfinite(sample.timestamp_s):
            self._occurrences.counts["stray"] += 1
            return None
        sample = self._offsets.add(sample)
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
        if len(samples) == len(self._streams):
            return self._complete(number)
        if len(self._waiting) > WAITING_SETS:
            self._give_up(next(iter(self._waiting)))
        return None

    def finish(self) -> None:
        """Give up all waiting numbers: no more samples will come."""
        for number in sorted(self._waiting):
            self._give_up(number)

    def _complete(self, number: int) -> FrameSet | None:
        samples = self._waiting.pop(number)
        self._decide(number)
        times_s = {stream: sample.timestamp_s for stream, sample in samples.items()}
        self._offsets.note(times_s)
        if max(times_s.values()) - min(times_s.values()) > SAME_INSTANT_S:
            self.incomplete += 1
            return None
        depth = samples["depth"]
        confidence = (
            samples["confidence"].pixels
            if "confidence" in samples
            else np.zeros(depth.pixels.shape, np.uint8)
        )
        self._sets.append(number)
        self._note_stall(number, depth.timestamp_s)
        return FrameSet(
            number, depth.timestamp_s, depth.pixels, samples["infrared"].pixels, confidence
        )

    def _decide(self, number: int) -> None:
        """Decide every number before this one."""
        before = self._decided
        self._decided = number
        if before is None:
            self._count_incomplete(lambda waiting: waiting < number)
        elif before < number <= before + MAX_GAP:
            incomplete = self._count_incomplete(lambda waiting: before < waiting < number)
            self.dropped += number - before - 1 - incomplete
        else:  # the count was restarted: only numbers that the new one can have given wait on
            self._occurrences.counts["renumbered"] += 1
            self._sets.clear()
            self._zero_s = None
            self._count_incomplete(lambda waiting: not number < waiting <= number + WAITING_SETS)

    def _count_incomplete(self, select: Callable[[int], bool]) -> int:
        """Count the selected waiting numbers as incomplete, and return how many there were."""
        numbers = [number for number in self._waiting if select(number)]
        for number in numbers:
            del self._waiting[number]
        self.incomplete += len(numbers)
        return len(numbers)

    def _give_up(self, number: int) -> None:
        """Decide a number without a set if it is the next in order; else discard it as stray."""
        after = self._decided
        ahead = [
            waiting
            for waiting in self._waiting
            if after is None or after < waiting <= after + MAX_GAP
        ]
        del self._waiting[number]
        if ahead and number == min(ahead):
            self._decide(number)
            self.incomplete += 1
        else:
            self._occurrences.counts["stray"] += 1

    def _note_stall(self, number: int, timestamp_s: float) -> None:
        # t = zero + n / rate with a constant zero while delivery is steady. A dropped frame raises
        # t and n alike; a device that stands still raises t only, and zero with it.
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
    gravity_m_s2: Gravity | None = None,
) -> Frame:
    """Return the frame of a set whose depth counts in units of `unit_m`; a count of 0 is NaN."""
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
        gravity_m_s2=gravity_m_s2,
        truth_depth_m=truth_depth_m,
    )
