from dataclasses import astuple, replace

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.frames import Frame
from nlos_cam.recording.quality import MIN_PAIRS, Quality, QualityMeter

SHAPE = 48, 64
PINHOLE = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)
FRAMES = 60


def noisy(sigma_mm: float = 1.0, count: int = FRAMES, seed: int = 0) -> list[Frame]:
    """Make frames of a flat scene at 0.3 m with Gaussian noise in depth."""
    generator, blank = np.random.default_rng(seed), np.zeros(SHAPE, np.uint8)
    depth_m = (0.3 + generator.normal(0.0, sigma_mm / 1e3, (count, *SHAPE))).astype(np.float32)
    return [Frame(depth_m[number], blank, blank, 1e9 + number / 30, number, PINHOLE) for number in range(count)]


def quality_of(frames: list[Frame]) -> Quality:
    meter = QualityMeter()
    for frame in frames:
        meter.add(frame)
    return meter.quality()


@pytest.mark.parametrize("sigma_mm", [0.0, 0.3, 1.0, 8.0])
def test_noise_is_the_known_standard_deviation(sigma_mm: float) -> None:
    assert quality_of(noisy(sigma_mm)).temporal_noise_mm == pytest.approx(sigma_mm, rel=0.04, abs=0.0)


@pytest.mark.parametrize("change", ["push", "drift"])
def test_noise_ignores_a_push_and_a_slow_drift(change: str) -> None:
    frames = noisy()
    for frame in frames:
        number = frame.frame_number
        frame.depth_m[:] += np.float32((0.1 if number > 30 else 0.0) if change == "push" else 0.0005 * number)
    assert quality_of(frames).temporal_noise_mm == pytest.approx(quality_of(noisy()).temporal_noise_mm, rel=0.02)


@pytest.mark.parametrize(("spoil", "tolerance"), [("moves", 0.1), ("invalid", 0.04)])
def test_noise_ignores_moving_and_invalid_parts(spoil: str, tolerance: float) -> None:
    frames = noisy()
    for frame in frames:
        odd = frame.frame_number % 2
        if spoil == "moves":
            frame.depth_m[:, : 4 * (1 + odd)] += np.float32(0.2)
        else:
            frame.depth_m[:10] = frame.depth_m[10 + odd] = np.nan  # never valid; never twice in a row
    assert quality_of(frames).temporal_noise_mm == pytest.approx(1.0, rel=tolerance)


@pytest.mark.parametrize("spoil", ["too few", "all invalid", "nothing twice"])
def test_noise_is_none_where_too_little_is_valid(spoil: str) -> None:
    frames = noisy(count=MIN_PAIRS if spoil == "too few" else FRAMES)
    for frame in frames:
        if spoil == "all invalid" or (spoil == "nothing twice" and frame.frame_number % 2):
            frame.depth_m[:] = np.nan
    assert quality_of(frames).temporal_noise_mm is None


def test_jitter_is_the_spread_of_intervals() -> None:
    on_time = [frame for frame in noisy() if frame.frame_number % 7]  # some are missing
    assert quality_of(on_time).jitter_ms == pytest.approx(0.0, abs=1e-3)
    late = [replace(frame, timestamp_s=frame.timestamp_s + 0.002 * (frame.frame_number % 2)) for frame in noisy()]
    assert quality_of(late).jitter_ms == pytest.approx(2.0, rel=0.01)


def test_quality_of_no_frame_and_of_one_has_no_spread() -> None:
    assert astuple(quality_of([])) == (0, None, None, None, None, None)
    found = quality_of(noisy(count=1))
    assert (found.frames_seen, found.saturated_share, found.invalid_share) == (1, 0.0, 0.0)
    assert found.temporal_noise_mm is None
    assert found.jitter_ms is None
