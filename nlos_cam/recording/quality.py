"""How good a capture's frames are: saturation, invalid depth, confidence, temporal noise, jitter, in bounded memory."""

from dataclasses import dataclass
from math import sqrt

import numba
import numpy as np
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.camera import FRAMES_PER_S
from nlos_cam.frames import SATURATED, Frame

MIN_PAIRS = 8
"""Pairs of frames in which a pixel must be valid for its noise to count; with fewer in all, no noise is told."""
SAMPLED_EVERY = 8
"""Pixels, along rows and along columns, from which the shift of a whole scene is estimated."""


@dataclass(frozen=True)
class Quality:
    """Over the frames that were seen; None where there was nothing to tell it from."""

    frames_seen: int = 0
    saturated_share: float | None = None
    """Of all pixels: infrared at 255."""
    invalid_share: float | None = None
    """Of all pixels: no depth."""
    confidence_mean: float | None = None
    """Of all pixels; 0 to 15."""
    temporal_noise_mm: float | None = None
    """Median over pixels of the standard deviation in time.

    A pixel's is the root mean square of its depth's differences between frames that follow each other, less the
    median difference of that pair of frames over the image (so that a camera that was pushed is no noise), divided by
    the root of 2. Slow drift hardly shows. Pixels valid in 8 pairs or more.
    """
    jitter_ms: float | None = None
    """Standard deviation of the time from frame to frame, less what their numbers say at 30 frames/s."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_squares(depth_m: Float32, before_m: Float32, shift_m: float, squares: Float32, pairs: Float32) -> None:
    """Add a pair of frames to the sums, pixel by pixel, where both are valid."""
    for i in range(depth_m.size):
        difference = depth_m[i] - before_m[i] - np.float32(shift_m)
        valid = difference == difference  # noqa: PLR0124  false for NaN
        squares[i] += difference * difference if valid else np.float32(0.0)
        pairs[i] += np.float32(valid)


class QualityMeter:
    """Takes frames one by one, and tells their quality at any time. All must be of one size."""

    def __init__(self) -> None:
        self._seen = self._pixels = 0
        self._saturated = self._invalid = self._confidence = 0
        self._before: Frame | None = None
        self._squares = self._pairs = np.zeros(0, np.float32)
        self._late = _Spread()

    def add(self, frame: Frame) -> None:
        self._seen += 1
        self._pixels += frame.ir.size
        self._saturated += int(np.count_nonzero(frame.ir == SATURATED))
        self._invalid += int(np.count_nonzero(np.isnan(frame.depth_m)))
        self._confidence += int(frame.confidence.sum(dtype=np.int64))
        if self._before:
            self._add_pair(self._before, frame)
        else:
            self._squares, self._pairs = (np.zeros(frame.depth_m.size, np.float32) for _ in range(2))
        self._before = frame

    def _add_pair(self, before: Frame, frame: Frame) -> None:
        numbers = frame.frame_number - before.frame_number
        self._late.add(frame.timestamp_s - before.timestamp_s - numbers / FRAMES_PER_S)
        shift_m = _shift_m(frame.depth_m, before.depth_m)
        _add_squares(frame.depth_m.ravel(), before.depth_m.ravel(), shift_m, self._squares, self._pairs)

    def quality(self) -> Quality:
        """What was seen so far."""
        if self._pixels == 0:
            return Quality()
        return Quality(
            frames_seen=self._seen,
            saturated_share=self._saturated / self._pixels,
            invalid_share=self._invalid / self._pixels,
            confidence_mean=self._confidence / self._pixels,
            temporal_noise_mm=_noise_mm(self._squares, self._pairs),
            jitter_ms=self._late.deviation_ms(),
        )


class _Spread:
    """The standard deviation of times that come one by one, by Welford's update."""

    def __init__(self) -> None:
        self._count, self._mean_s, self._squares_s2 = 0, 0.0, 0.0

    def add(self, time_s: float) -> None:
        self._count += 1
        off_s = time_s - self._mean_s
        self._mean_s += off_s / self._count
        self._squares_s2 += off_s * (time_s - self._mean_s)

    def deviation_ms(self) -> float | None:
        return 1e3 * sqrt(self._squares_s2 / self._count) if self._count else None


def _shift_m(depth_m: Float32, before_m: Float32) -> float:
    """How much farther the scene as a whole is: the median over a sparse grid of pixels; 0 where none is valid."""
    sparse = (slice(SAMPLED_EVERY // 2, None, SAMPLED_EVERY),) * 2
    difference = (depth_m[sparse] - before_m[sparse]).ravel()
    valid = difference[~np.isnan(difference)]
    return float(np.median(valid)) if valid.size else 0.0


def _noise_mm(squares: Float32, pairs: NDArray[np.float32]) -> float | None:
    enough = pairs >= MIN_PAIRS
    if not enough.any():
        return None
    return 1e3 * sqrt(float(np.median(squares[enough] / pairs[enough])) / 2)
