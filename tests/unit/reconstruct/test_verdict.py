from dataclasses import replace

import numpy as np
import pytest

from nlos_cam.reconstruct.network import Doubt, Reconstruction
from nlos_cam.reconstruct.physics_check import PhysicsCheckResult
from nlos_cam.reconstruct.verdict import STEADY_FRAMES, FrameConditions, Verdict, VerdictFilter, VerdictLimits

LIMITS = VerdictLimits(nothing=0.5, outside=0.3, unexplained=0.8)
SURFACE_M = np.full((64, 64), 0.2, np.float32)


def found(nothing: float = 0.0, outside: float = 0.0, depth_m: np.ndarray = SURFACE_M) -> Reconstruction:
    doubt = Doubt(nothing, outside, np.full((64, 64), 0.01, np.float32), np.ones((64, 64), np.float32))
    return Reconstruction(depth_m, np.eye(4), doubt.error_m, {}, doubt)


def checked(score: float) -> FrameConditions:
    blank = np.zeros((64, 80), np.float32)
    return FrameConditions(check=PhysicsCheckResult(0, blank, blank, score, 0.1))


ALL = FrameConditions(saturated=True, invalid=True, moved=True, check=checked(1.0).check)


@pytest.mark.parametrize(
    ("made", "signs", "verdict"),
    [
        (found(), FrameConditions(), Verdict.SEEN),
        (found(nothing=0.5), FrameConditions(), Verdict.NOTHING),
        (found(nothing=0.9, outside=0.9), FrameConditions(), Verdict.NOTHING),
        (found(outside=0.3), FrameConditions(), Verdict.OUTSIDE),
        (found(), checked(0.8), Verdict.OUTSIDE),
        (found(), checked(0.79), Verdict.SEEN),
        (found(nothing=0.9), checked(1.0), Verdict.NOTHING),
        (found(nothing=0.9), FrameConditions(invalid=True), Verdict.OUTSIDE),
        (found(), FrameConditions(invalid=True), Verdict.OUTSIDE),
        (found(depth_m=np.full((64, 64), np.nan, np.float32)), FrameConditions(), Verdict.OUTSIDE),
        (found(nothing=0.9, outside=0.9), FrameConditions(saturated=True, invalid=True), Verdict.SATURATED),
        (found(outside=0.9), ALL, Verdict.WALL_MOVED),
        (found(nothing=0.9), ALL, Verdict.WALL_MOVED),
    ],
)
def test_verdict_is_the_last_that_holds(made: Reconstruction, signs: FrameConditions, verdict: Verdict) -> None:
    assert VerdictFilter(LIMITS).decide(made, signs)[1] == verdict


@pytest.mark.parametrize("signs", [FrameConditions(), ALL])
def test_verdict_hides_the_surface_only_if_nothing_is_there(signs: FrameConditions) -> None:
    shown, _ = VerdictFilter(LIMITS).decide(found(nothing=0.9), signs)
    assert np.isnan(shown.depth_m).all()
    assert np.isfinite(shown.uncertainty_m).all()
    shown, _ = VerdictFilter(LIMITS).decide(found(outside=0.9), signs)
    np.testing.assert_array_equal(shown.depth_m, SURFACE_M)


@pytest.mark.parametrize("judge", [VerdictFilter(None), VerdictFilter(LIMITS)])
def test_verdict_without_doubt_considers_the_lidar_only(judge: VerdictFilter) -> None:
    plain = replace(found(), doubt=None, uncertainty_m=None)
    assert judge.decide(plain, FrameConditions()) == (plain, None)
    assert judge.decide(plain, FrameConditions(saturated=True))[1] == Verdict.SATURATED
    assert judge.decide(plain, FrameConditions(moved=True, saturated=True))[1] == Verdict.WALL_MOVED


def test_verdict_smooths_out_of_distribution_but_not_empty_frames() -> None:
    smoothed, forgetting = VerdictFilter(LIMITS), VerdictFilter(LIMITS)
    p_outside = [0.0] * 10 + [1.0] + [0.0] * 10 + [1.0] * STEADY_FRAMES
    verdicts = [smoothed.decide(found(outside=p), FrameConditions())[1] for p in p_outside]
    assert set(verdicts[:21]) == {Verdict.SEEN}
    assert verdicts[-1] == Verdict.OUTSIDE
    assert STEADY_FRAMES / 30 < 0.2
    p_empty = [0.0] * STEADY_FRAMES + [0.9, 0.0]
    verdicts = [forgetting.decide(found(p, outside=1.0 - p), FrameConditions())[1] for p in p_empty[:-1]]
    assert verdicts[-2:] == [Verdict.OUTSIDE, Verdict.NOTHING]
    assert forgetting.decide(found(), FrameConditions())[1] == Verdict.SEEN
