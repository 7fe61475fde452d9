from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects import object_box
from nlos_cam.reconstruct import PhysicsCheckResult, Reconstruction
from nlos_cam.reconstruct.network import Uncertainty
from nlos_cam.reconstruct.verdict import (
    STEADY_FRAMES,
    FrameConditions,
    Verdict,
    VerdictFilter,
    VerdictLimits,
)

BOX = object_box(load_rig("paper-rig"))
LIMITS = VerdictLimits(nothing=0.5, outside=0.3, unexplained=0.8)
SURFACE_M = np.full((64, 64), 0.2, np.float32)
NOTHING_M = np.full((64, 64), np.nan, np.float32)
USUAL = FrameConditions()


def reconstruction(
    nothing: float = 0.0, outside: float = 0.0, depth_m: np.ndarray = SURFACE_M
) -> Reconstruction:
    error_m = np.full((64, 64), 0.01, np.float32)
    uncertainty = Uncertainty(nothing, outside, error_m, np.ones((64, 64), np.float32))
    return Reconstruction(depth_m, BOX, error_m, {}, uncertainty)


def checked(score: float) -> FrameConditions:
    blank = np.zeros((64, 80), np.float32)
    return FrameConditions(check=PhysicsCheckResult(0, blank, blank, score, 0.1))


INVALID = FrameConditions(invalid=True)
SATURATED = FrameConditions(saturated=True, invalid=True)
ALL = FrameConditions(saturated=True, invalid=True, moved=True, check=checked(1.0).check)


@pytest.mark.parametrize(
    ("made", "conditions", "verdict"),
    [
        (reconstruction(), USUAL, Verdict.SEEN),
        (reconstruction(nothing=0.5), USUAL, Verdict.NOTHING),
        (reconstruction(nothing=0.9, outside=0.9), USUAL, Verdict.NOTHING),
        (reconstruction(outside=0.3), USUAL, Verdict.OUTSIDE),
        (reconstruction(), checked(0.8), Verdict.OUTSIDE),
        (reconstruction(), checked(0.79), Verdict.SEEN),
        (reconstruction(nothing=0.9), checked(1.0), Verdict.NOTHING),
        (reconstruction(nothing=0.9), INVALID, Verdict.OUTSIDE),
        (reconstruction(), INVALID, Verdict.OUTSIDE),
        (reconstruction(depth_m=NOTHING_M), USUAL, Verdict.OUTSIDE),
        (reconstruction(nothing=0.9, outside=0.9), SATURATED, Verdict.SATURATED),
        (reconstruction(outside=0.9), ALL, Verdict.WALL_MOVED),
        (reconstruction(nothing=0.9), ALL, Verdict.WALL_MOVED),
    ],
)
def test_verdict_is_the_last_that_holds(
    made: Reconstruction, conditions: FrameConditions, verdict: Verdict
) -> None:
    assert VerdictFilter(LIMITS).decide(made, conditions)[1] == verdict


@pytest.mark.parametrize("conditions", [USUAL, ALL])
def test_surface_is_hidden_if_nothing_is_there(conditions: FrameConditions) -> None:
    shown, _ = VerdictFilter(LIMITS).decide(reconstruction(nothing=0.9), conditions)

    assert np.isnan(shown.depth_m).all()
    assert np.isfinite(shown.uncertainty_m).all()


@pytest.mark.parametrize("conditions", [USUAL, ALL])
def test_surface_outside_the_trained_range_is_shown(conditions: FrameConditions) -> None:
    shown, _ = VerdictFilter(LIMITS).decide(reconstruction(outside=0.9), conditions)
    np.testing.assert_array_equal(shown.depth_m, SURFACE_M)


@pytest.mark.parametrize("limits", [None, LIMITS])
@pytest.mark.parametrize(
    ("conditions", "verdict"),
    [
        (USUAL, None),
        (FrameConditions(saturated=True), Verdict.SATURATED),
        (FrameConditions(moved=True, saturated=True), Verdict.WALL_MOVED),
    ],
)
def test_verdict_without_uncertainty_is_of_the_lidar_only(
    limits: VerdictLimits | None, conditions: FrameConditions, verdict: Verdict | None
) -> None:
    plain = replace(reconstruction(), uncertainty=None, uncertainty_m=None)
    assert VerdictFilter(limits).decide(plain, conditions) == (plain, verdict)


def verdicts_of(frames: list[Reconstruction]) -> list[Verdict | None]:
    """Return the verdicts of frames in turn, by one filter."""
    smoothing = VerdictFilter(LIMITS)
    return [smoothing.decide(frame, USUAL)[1] for frame in frames]


def test_one_frame_out_of_distribution_is_smoothed() -> None:
    p_outside = [0.0] * 10 + [1.0] + [0.0] * 10
    verdicts = verdicts_of([reconstruction(outside=p) for p in p_outside])

    assert set(verdicts) == {Verdict.SEEN}


def test_steady_outlier_is_outside_within_a_fifth_second() -> None:
    p_outside = [0.0] * 10 + [1.0] * STEADY_FRAMES
    verdicts = verdicts_of([reconstruction(outside=p) for p in p_outside])

    assert verdicts[-1] == Verdict.OUTSIDE
    assert STEADY_FRAMES / 30 < 0.2


def test_empty_frame_is_not_smoothed_and_forgets_the_object() -> None:
    frames = [reconstruction(outside=1.0)] * STEADY_FRAMES
    frames += [reconstruction(nothing=0.9), reconstruction()]
    verdicts = verdicts_of(frames)

    assert verdicts[-3:] == [Verdict.OUTSIDE, Verdict.NOTHING, Verdict.SEEN]
