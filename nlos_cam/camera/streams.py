"""The streams that a lidar delivers through librealsense, and how three single frames become one set."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray

FORMATS = {"depth": "z16", "infrared": "y8", "confidence": "raw8"}
"""The streams that are needed, by the SDK's names, and the pixel format of each."""
FRAMES_PER_S = 30
SAME_INSTANT_S = 0.5 / FRAMES_PER_S
"""Frames of one number whose timestamps differ by more were not taken together."""
WAITING_SETS = 30
"""Numbers that may wait for a stream; the oldest beyond that is given up."""


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


class Pairing:
    """Pairs samples by frame number and timestamp, and counts the numbers that did not become a set."""

    def __init__(self) -> None:
        self.incomplete = 0
        """Numbers of which some stream came, and some did not or was of another instant."""
        self.dropped = 0
        """Numbers of which nothing came, between two sets."""
        self._waiting: dict[int, dict[str, Sample]] = {}
        self._last: int | None = None
        self._incomplete_since_last = 0

    def add(self, sample: Sample) -> FrameSet | None:
        """Take a sample; the set that it completes, if it does. A number that was passed over stays so."""
        if self._last is not None and sample.number <= self._last:
            return None
        samples = self._waiting.setdefault(sample.number, {})
        samples[sample.stream] = sample
        if len(samples) == len(FORMATS):
            return self._complete(sample.number)
        if len(self._waiting) > WAITING_SETS:
            self._give_up([min(self._waiting)])
        return None

    def finish(self) -> None:
        """Give up whatever still waits: no more samples will come."""
        self._give_up(list(self._waiting))

    def _complete(self, number: int) -> FrameSet | None:
        """Streams come in order, so whatever is older than a complete set will never be one."""
        samples = self._waiting[number]
        times = [sample.timestamp_s for sample in samples.values()]
        if max(times) - min(times) > SAME_INSTANT_S:
            self._give_up([waiting for waiting in self._waiting if waiting <= number])
            return None
        del self._waiting[number]
        self._give_up([waiting for waiting in self._waiting if waiting < number])
        if self._last is not None:
            self.dropped += number - self._last - 1 - self._incomplete_since_last
        self._last, self._incomplete_since_last = number, 0
        depth, ir, confidence = (samples[stream] for stream in FORMATS)
        return FrameSet(number, depth.timestamp_s, depth.pixels, ir.pixels, confidence.pixels)

    def _give_up(self, numbers: list[int]) -> None:
        for number in numbers:
            del self._waiting[number]
        self.incomplete += len(numbers)
        self._incomplete_since_last += len(numbers)
