from dataclasses import replace
from unittest.mock import Mock, call

import numpy as np
import pytest
from small_frames import result_of, small_frame

from nlos_cam.reconstruct import FrameResult, Quality, QualityLog, RecentValues, Verdict, WarningLog
from nlos_cam.reconstruct.network import Uncertainty


def warned(number: int, *warnings: str) -> FrameResult:
    return result_of(small_frame(number), warnings=warnings)


def test_warning_log_ignores_numbers_in_a_warning() -> None:
    on_warning = Mock()
    log = WarningLog(on_warning)
    log.add(warned(1, "46.5 degrees"))
    log.add(warned(2, "48 degrees"))
    log.add(warned(3, "48 degrees", "48 mm"))
    log.add(warned(4))

    assert on_warning.call_args_list == [
        call("46.5 degrees", True),
        call("48 mm", True),
        call("48 degrees", False),
        call("48 mm", False),
    ]
    assert log.frames == {"48 degrees": 3, "48 mm": 1}


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


def test_quality_is_summarized_over_detected_objects_alone() -> None:
    log = QualityLog()

    assert log.summary == {}

    log.add(predicted(0.6, Verdict.SEEN, trusted=False))
    log.add(predicted(0.8, Verdict.SEEN, trusted=True))
    log.add(predicted(0.1, Verdict.OUTSIDE, trusted=False))
    expected = {"expected_iou": 0.7, "expected_error_mm": 7.0, "trusted": 0.5}

    assert log.summary == pytest.approx(expected)
