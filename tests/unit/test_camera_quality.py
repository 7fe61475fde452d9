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
    """A flat scene at 0.3 m with Gaussian noise in depth."""
    generator = np.random.default_rng(seed)
    blank = np.zeros(SHAPE, np.uint8)
    return [
        Frame(
            depth_m=(0.3 + generator.normal(0.0, sigma_mm / 1e3, SHAPE)).astype(np.float32),
            ir=blank,
            confidence=blank,
            timestamp_s=1e9 + number / 30,
            frame_number=number,
            intrinsics=PINHOLE,
        )
        for number in range(count)
    ]


def quality_of(frames: list[Frame]) -> Quality:
    meter = QualityMeter()
    for frame in frames:
        meter.add(frame)
    return meter.quality()


def moved(frame: Frame, by_m: float) -> Frame:
    return replace(frame, depth_m=frame.depth_m + np.float32(by_m))


@pytest.mark.parametrize("sigma_mm", [0.3, 1.0, 8.0])
def test_noise_that_is_known_comes_back(sigma_mm: float) -> None:
    assert quality_of(noisy(sigma_mm)).temporal_noise_mm == pytest.approx(sigma_mm, rel=0.04)


def test_a_scene_that_stands_still_has_no_noise() -> None:
    assert quality_of(noisy(0.0)).temporal_noise_mm == 0.0


def test_a_push_of_the_whole_scene_is_no_noise() -> None:
    frames = [moved(frame, 0.1 if frame.frame_number > 30 else 0.0) for frame in noisy()]
    assert quality_of(frames).temporal_noise_mm == pytest.approx(quality_of(noisy()).temporal_noise_mm, rel=0.02)


def test_a_slow_drift_is_no_noise() -> None:
    frames = [moved(frame, 0.0005 * frame.frame_number) for frame in noisy()]
    assert quality_of(frames).temporal_noise_mm == pytest.approx(quality_of(noisy()).temporal_noise_mm, rel=0.02)


def test_what_moves_in_a_part_of_the_image_hardly_counts() -> None:
    frames = noisy()
    for frame in frames:
        frame.depth_m[:, : 4 * (1 + frame.frame_number % 2)] += np.float32(0.2)
    assert quality_of(frames).temporal_noise_mm == pytest.approx(1.0, rel=0.1)


def test_noise_is_of_the_pixels_that_are_valid_in_both_frames_of_a_pair() -> None:
    frames = noisy()
    for frame in frames:
        frame.depth_m[:10] = np.nan  # never
        frame.depth_m[10 + frame.frame_number % 2] = np.nan  # never twice in a row
    assert quality_of(frames).temporal_noise_mm == pytest.approx(1.0, rel=0.04)


@pytest.mark.parametrize("spoil", ["too few", "all invalid", "nothing twice"])
def test_no_noise_is_told_where_there_is_too_little(spoil: str) -> None:
    frames = noisy(count=MIN_PAIRS if spoil == "too few" else FRAMES)
    for frame in frames:
        if spoil == "all invalid" or (spoil == "nothing twice" and frame.frame_number % 2):
            frame.depth_m[:] = np.nan
    assert quality_of(frames).temporal_noise_mm is None


def test_shares_are_exact() -> None:
    frames = noisy(count=4)
    for frame in frames:
        ir, confidence = np.full(SHAPE, 254, np.uint8), np.full(SHAPE, 3, np.uint8)
        ir[: frame.frame_number], confidence[:24] = 255, 15
        frame.depth_m[:, :8] = np.nan
        frames[frame.frame_number] = replace(frame, ir=ir, confidence=confidence)
    found = quality_of(frames)
    assert found.saturated_share == (0 + 1 + 2 + 3) / (4 * 48)
    assert found.invalid_share == 8 / 64
    assert found.confidence_mean == 9.0


def test_frames_on_time_have_no_jitter_though_some_are_missing() -> None:
    frames = [frame for frame in noisy() if frame.frame_number % 7]
    assert quality_of(frames).jitter_ms == pytest.approx(0.0, abs=1e-3)


def test_jitter_is_the_spread_of_the_intervals() -> None:
    frames = [replace(frame, timestamp_s=frame.timestamp_s + 0.002 * (frame.frame_number % 2)) for frame in noisy()]
    assert quality_of(frames).jitter_ms == pytest.approx(2.0, rel=0.01)


def test_nothing_seen_is_told_as_nothing() -> None:
    assert astuple(quality_of([])) == (0, None, None, None, None, None)


def test_one_frame_has_shares_but_no_spread() -> None:
    found = quality_of(noisy(count=1))
    assert (found.frames_seen, found.saturated_share, found.invalid_share) == (1, 0.0, 0.0)
    assert found.temporal_noise_mm is None
    assert found.jitter_ms is None


def test_memory_does_not_grow_with_frames() -> None:
    meter, frames = QualityMeter(), noisy()
    kept: list[set[int]] = []
    for _ in range(3):
        for frame in frames:
            meter.add(frame)
        kept.append({np.asarray(array).nbytes for array in (meter._squares, meter._pairs)})
    assert kept[0] == kept[1] == kept[2] == {48 * 64 * 4}
