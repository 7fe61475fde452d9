from dataclasses import replace

import numpy as np
import pytest
from made_up_moments import NOTHING, bump, full_moment, moment

from nlos_cam.reconstruct.network import Doubt, Quality
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.assessment import RGB, assess, expected_error_m, expected_overlap


def with_doubt(surface: np.ndarray, error_m: float = 0.017, quality: Quality | None = None) -> object:
    shown = full_moment(0)
    spread_m = np.full((64, 64), error_m, np.float32)
    doubt = Doubt(0.0, 0.0, spread_m, surface.astype(np.float32), quality)
    return replace(shown, reconstruction=replace(shown.reconstruction, doubt=doubt, uncertainty_m=spread_m))


def test_expected_overlap_is_exact_for_certain_pixels() -> None:
    mask = np.isfinite(bump(0))
    half = mask & (np.arange(64) < np.argwhere(mask)[:, 1].mean())
    for surface, overlap in ((mask, 1.0), (half, half.sum() / mask.sum()), (~mask, 0.0)):
        assert expected_overlap(with_doubt(surface).reconstruction) == pytest.approx(overlap)  # type: ignore[attr-defined]


def test_expected_overlap_needs_probabilities_and_a_surface() -> None:
    assert expected_overlap(full_moment(0).reconstruction) is None
    assert expected_overlap(moment(0, NOTHING).reconstruction) is None
    assert expected_error_m(moment(0).reconstruction) is None


def test_detected_object_is_graded_by_the_models_numbers() -> None:
    told = assess(with_doubt(0.71 * np.isfinite(bump(0))))  # type: ignore[arg-type]
    assert "71%" in told.detail
    assert "17 mm" in told.detail
    assert told.trusted


@pytest.mark.parametrize("trusted", [True, False])
@pytest.mark.parametrize("verdict", [Verdict.SEEN, Verdict.OUTSIDE])
def test_only_a_trusted_quality_of_a_detected_object_is_green(trusted: bool, verdict: Verdict) -> None:
    predicted = Quality((0.58, 0.71, 0.82), 0.6, 0.017, trusted=trusted)
    shown = replace(with_doubt(np.ones((64, 64)), quality=predicted), verdict=verdict)  # type: ignore[type-var]
    told = assess(shown)  # type: ignore[arg-type]
    assert (told.tone == "good") == (trusted and verdict is Verdict.SEEN)
    if verdict is Verdict.SEEN:
        assert told.detail == "outline typically 71% right (58% to 82%), depth to 17 mm"


@pytest.mark.parametrize("verdict", [*Verdict, None])
def test_no_assessment_is_green_and_only_a_detected_shape_is_trusted(verdict: Verdict | None) -> None:
    told = assess(replace(full_moment(0), verdict=verdict))
    assert told.trusted == (verdict in {Verdict.SEEN, None})
    red, green, blue = told.rgb
    assert green < max(red, blue)
    assert told.headline
    assert set(RGB.values()) >= {told.rgb}
