from dataclasses import replace
from unittest.mock import Mock, call

import numpy as np
import pytest
from small_frames import result_of, small_frame

from nlos_cam.reconstruct import FrameResult, Quality, QualityLog, RecentValues, Verdict, WarningLog
from nlos_cam.reconstruct.network import Uncertainty
from nlos_cam.reconstruct.summaries import ENDS_AFTER_FRAMES


def warned(number: int, *warnings: str) -> FrameResult:
    return result_of(small_frame(number), warnings=warnings)


def test_warning_log_ignores_numbers_in_a_warning() -> None:
    on_warning = Mock()
    log = WarningLog(on_warning)
    log.add(warned(1, "46.5 degrees"))
    log.add(warned(2, "48 degrees"))
    log.add(warned(3, "48 degrees", "48 mm"))
    for number in range(4, 5 + ENDS_AFTER_FRAMES):
        log.add(warned(number))

    assert on_warning.call_args_list == [
        call("46.5 degrees", True),
        call("48 mm", True),
        call("48 degrees", False),
        call("48 mm", False),
    ]
    assert log.frames == {"48 degrees": 3, "48 mm": 1}


def test_a_warning_that_comes_and_goes_is_said_once() -> None:
    on_warning = Mock()
    log = WarningLog(on_warning)
    for number in range(4 * ENDS_AFTER_FRAMES):
        log.add(warned(number, *(["the edge is off"] if number % 3 == 0 else [])))

    assert on_warning.call_args_list == [call("the edge is off", True)]


def test_recent_values_replace_the_oldest_in_constant_memory() -> None:
    times = RecentValues(remembered=10)
    for number in range(35):
        times.add({"maps": float(number)})
        assert times._columns["maps"].size == 10

    assert sorted(times.of("maps")) == [float(number) for number in range(25, 35)]


def predicted(iou: float, verdict: Verdict, *, trusted: bool) -> FrameResult:
    """Return a result whose predicted error is a hundredth of its IoU, in metres."""
    quality = Quality((iou - 0.1, iou, iou + 0.1), iou, iou / 100, trusted=trusted)
    plane = np.zeros((64, 64), np.float32)
    result = result_of(small_frame(0), verdict=verdict)
    uncertainty = Uncertainty(0.0, 0.0, plane, plane, quality)
    reconstruction = replace(result.reconstruction, uncertainty=uncertainty)
    return replace(result, reconstruction=reconstruction)


def test_quality_without_a_surface_is_none() -> None:
    seen = predicted(0.6, Verdict.SEEN, trusted=True).reconstruction

    assert seen.quality is not None
    assert seen.without_surface.quality is None


def test_quality_is_summarized_over_detected_objects_alone() -> None:
    log = QualityLog()

    assert log.summary == {}

    log.add(predicted(0.6, Verdict.SEEN, trusted=False))
    log.add(predicted(0.8, Verdict.SEEN, trusted=True))
    log.add(predicted(0.1, Verdict.OUTSIDE, trusted=False))
    expected = {"expected_iou": 0.7, "expected_error_mm": 7.0, "trusted": 0.5}

    assert log.summary == pytest.approx(expected)
