"""Quality of captured frames: saturation, invalid depth, confidence, temporal noise and jitter."""

from dataclasses import dataclass
from math import sqrt

import numba
import numpy as np
from nlos_calibration.arrays import Float32

from nlos_cam.camera import FRAMES_PER_S
from nlos_cam.frames import SATURATED, Frame

MIN_PAIRS = 8
"""Valid pairs of frames that a pixel's noise needs."""
SAMPLED_EVERY = 8
"""Spacing of the pixels, along rows and columns, from which the shift of the whole scene is
estimated.
"""


@dataclass(frozen=True)
class Quality:
    """Quality over all frames; None where it cannot be computed."""

    frames_seen: int = 0
    saturated_share: float | None = None
    """Share of pixels with infrared at 255."""
    invalid_share: float | None = None
    """Share of pixels without depth."""
    confidence_mean: float | None = None
    """Over all pixels; 0 to 15."""
    temporal_noise_mm: float | None = None
    """Median over pixels of the standard deviation of depth in time, without movement of the whole
    camera.
    """
    jitter_ms: float | None = None
    """Standard deviation of the intervals between frames, relative to those of their numbers at 30
    frames/s.
    """


# Temporal noise. Depth of a pixel at frame t is z + e_t with independent e_t of variance s^2, so
# the difference of two frames has variance Var(e_t - e_{t-1}) = 2 s^2, and
#     s = sqrt(mean((z_t - z_{t-1})^2) / 2).
# Differences of consecutive frames, not deviations from a mean: slow drift hardly adds to them. A
# push of the camera shifts all pixels at once; the median difference over the image is that shift,
# and is subtracted from each pair first.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_squares(
    depth_m: Float32, before_m: Float32, shift_m: float, squares: Float32, pairs: Float32
) -> None:
    """Add the squared differences of two frames to the sums of each pixel, where both are valid."""
    for i in range(depth_m.size):
        difference = depth_m[i] - before_m[i] - np.float32(shift_m)
        valid = difference == difference  # noqa: PLR0124  false for NaN
        squares[i] += difference * difference if valid else np.float32(0.0)
        pairs[i] += np.float32(valid)


class QualityMeter:
    """Running quality of frames of one size, in constant memory; for one thread."""

    def __init__(self) -> None:
        self._frames = self._pixels = 0
        self._saturated = self._invalid = self._confidence = 0
        self._before: Frame | None = None
        self._squares = np.zeros(0, np.float32)
        self._pairs = np.zeros(0, np.float32)
        self._lateness = _Spread()

    def add(self, frame: Frame) -> None:
        """Take the next frame."""
        self._frames += 1
        self._pixels += frame.ir.size
        self._saturated += int(np.count_nonzero(frame.ir == SATURATED))
        self._invalid += int(np.count_nonzero(np.isnan(frame.depth_m)))
        self._confidence += int(frame.confidence.sum(dtype=np.int64))
        if self._before:
            self._add_pair(self._before, frame)
        else:
            self._squares = np.zeros(frame.depth_m.size, np.float32)
            self._pairs = np.zeros(frame.depth_m.size, np.float32)
        self._before = frame

    def _add_pair(self, before: Frame, frame: Frame) -> None:
        numbers = frame.frame_number - before.frame_number
        self._lateness.add(frame.timestamp_s - before.timestamp_s - numbers / FRAMES_PER_S)
        shift_m = _shift_m(frame.depth_m, before.depth_m)
        _add_squares(
            frame.depth_m.ravel(), before.depth_m.ravel(), shift_m, self._squares, self._pairs
        )

    def quality(self) -> Quality:
        """Return the quality of the frames so far."""
        if self._pixels == 0:
            return Quality()
        return Quality(
            frames_seen=self._frames,
            saturated_share=self._saturated / self._pixels,
            invalid_share=self._invalid / self._pixels,
            confidence_mean=self._confidence / self._pixels,
            temporal_noise_mm=_noise_mm(self._squares, self._pairs),
            jitter_ms=self._lateness.deviation_ms(),
        )


class _Spread:
    """Running standard deviation of times, by Welford's update (numerically stable for large
    means).
    """

    def __init__(self) -> None:
        self._count = 0
        self._mean_s = 0.0
        self._squares_s2 = 0.0

    def add(self, time_s: float) -> None:
        self._count += 1
        deviation_s = time_s - self._mean_s
        self._mean_s += deviation_s / self._count
        self._squares_s2 += deviation_s * (time_s - self._mean_s)

    def deviation_ms(self) -> float | None:
        return 1e3 * sqrt(self._squares_s2 / self._count) if self._count else None


def _shift_m(depth_m: Float32, before_m: Float32) -> float:
    """Return the median change of depth over a sparse grid of pixels; 0 where none is valid."""
    sparse = (slice(SAMPLED_EVERY // 2, None, SAMPLED_EVERY),) * 2
    difference = (depth_m[sparse] - before_m[sparse]).ravel()
    valid = difference[~np.isnan(difference)]
    return float(np.median(valid)) if valid.size else 0.0


def _noise_mm(squares: Float32, pairs: Float32) -> float | None:
    valid = pairs >= MIN_PAIRS
    if not valid.any():
        return None
    mean_square_m2 = float(np.median(squares[valid] / pairs[valid]))
    return 1e3 * sqrt(mean_square_m2 / 2)
