import itertools
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from nlos_calibration.rig import load_rig
from nlos_models import Answer
from nlos_models.quality import QualityEstimate
from small_frames import sheet_network

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import depth_from_image, image_from_depth, object_box
from nlos_cam.reconstruct.network import (
    Mirrored,
    Reconstruction,
    Uncertainty,
    reconstruct,
    reconstruct_all,
)
from nlos_cam.reconstruct.physics_check import PhysicsCheckResult
from nlos_cam.reconstruct.verdict import (
    STEADY_FRAMES,
    FrameConditions,
    Verdict,
    VerdictFilter,
    VerdictLimits,
)

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
HALF = sheet_network()


def some_maps() -> LidarMaps:
    depth_m = np.full((64, 80), 0.3, np.float32)
    depth_m[0, 0] = np.nan
    return LidarMaps(depth_m, np.full((64, 80), 40.0, np.float32), ~np.isnan(depth_m))


def test_mirrored_answers_alike_to_mirrored_maps_and_takes_every_surface() -> None:
    depth_m = np.full((1, 64, 80), np.nan, np.float32)
    depth_m[0, 20, 30] = 0.4
    depth_m[0, 22, 30] = 0.6
    shifts_down = Mock(
        side_effect=lambda depth_m, _: np.roll(np.nan_to_num(depth_m[:, :, 8:72]), 1, axis=1)
    )
    network = Mirrored(shifts_down)
    image = network(depth_m, depth_m)
    np.testing.assert_array_equal(network(depth_m[:, ::-1], depth_m[:, ::-1]), image[:, ::-1])
    np.testing.assert_allclose(image[0, 18:25, 22], [0, 0.4, 0, 0.5, 0, 0.6, 0], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_reconstruct_inverts_the_image_of_a_depth_map_and_stands_on_the_wall_before_the_box(
    seed: int,
) -> None:
    generator = np.random.default_rng(seed)
    truth_m = generator.uniform(BOX.z_near_m, BOX.z_far_m, (64, 64)).astype(np.float32)
    truth_m[generator.random((64, 64)) < 0.5] = np.nan
    found = reconstruct(some_maps(), RIG, lambda *_: image_from_depth(truth_m, BOX)[None])
    np.testing.assert_allclose(found.depth_m, truth_m, atol=1e-6)  # NaN where NaN
    np.testing.assert_allclose(found.wall_from_object @ [0, 0, 0, 1], [0.45, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(found.wall_from_object[:3, :3], np.eye(3))


def test_reconstruct_all_shares_the_network_time() -> None:
    ticks = itertools.count()
    found = reconstruct_all(
        [some_maps()] * 4, RIG, lambda *_: np.repeat(HALF, 4, 0), lambda: float(next(ticks))
    )
    assert [(each.timings_s, each.uncertainty_m) for each in found] == [
        ({"network": 0.25}, None)
    ] * 4


def test_reconstruct_with_doubt_adds_uncertainty_in_metres_and_a_stage() -> None:
    ticks = itertools.count()
    doubter = FakeDoubter(lambda *_: (0.25, 0.5), error_v=0.1)
    found = reconstruct(some_maps(), RIG, sheet_network, lambda: float(next(ticks)), doubter)
    assert found.timings_s == {"network": 1.0, "doubt": 1.0}
    assert (found.uncertainty.p_empty, found.uncertainty.p_out_of_distribution) == (0.25, 0.5)
    assert found.uncertainty_m is found.uncertainty.error_m
    apart_m = depth_from_image(HALF[0], BOX) - depth_from_image(HALF[0] + np.float32(0.1), BOX)
    np.testing.assert_allclose(found.uncertainty_m, apart_m, rtol=1e-5)
    assert [part.shape for part in doubter.asked[0]] == [(1, 64, 80), (1, 64, 80), (1, 64, 64)]
    for asked, given in zip(
        doubter.asked[0], (some_maps().depth_m, some_maps().intensity, HALF[0]), strict=True
    ):
        np.testing.assert_array_equal(asked[0], given)
    hidden = found.without_surface
    assert found.has_surface
    assert (hidden.has_surface, hidden.uncertainty_m, hidden.uncertainty) == (
        False,
        found.uncertainty_m,
        found.uncertainty,
    )


def test_reconstruct_without_returns_still_asks_for_doubt() -> None:
    doubter = FakeDoubter()
    blank = np.full((64, 80), np.nan, np.float32)
    maps = LidarMaps(blank, np.zeros((64, 80), np.float32), ~np.isnan(blank))
    found = reconstruct(
        maps, RIG, lambda *_: np.ones((1, 64, 64), np.float32), uncertainty_model=doubter
    )
    assert not found.has_surface
    assert found.uncertainty_m is not None
    assert not doubter.asked[0][2].any()


class TellingNetwork:
    """Network that tells how probable a surface is: as much as the first cell's intensity says."""

    def answer(self, depth_m: np.ndarray, intensity: np.ndarray) -> Answer:
        images = np.repeat(HALF, len(depth_m), 0)
        return Answer(images, images * intensity[:, :1, :1])

    def __call__(self, *maps: np.ndarray) -> np.ndarray:
        return self.answer(*maps).image


def test_quality_is_predicted_from_each_frame_s_own_probability_of_a_surface() -> None:
    asked = Mock(return_value=QualityEstimate.of(np.zeros((1, 5), np.float32), None))
    (doubter := FakeDoubter()).quality = asked
    bright = some_maps()
    blank = np.full((64, 80), np.nan, np.float32)
    frames = [replace(bright, depth_m=blank, valid=np.zeros((64, 80), bool)), bright]
    nothing, found = reconstruct_all(frames, RIG, TellingNetwork(), uncertainty_model=doubter)
    assert nothing.uncertainty.quality is None
    assert found.uncertainty.quality.iou == (0.5, 0.5, 0.5)
    np.testing.assert_array_equal(asked.call_args.args[2], sheet_network() * 40)
    reconstruct(bright, RIG, sheet_network, uncertainty_model=doubter)
    assert asked.call_args.args[2] is None


def test_reconstruct_refuses_a_rig_without_object_box() -> None:
    with pytest.raises(SceneError, match="bare-wall"):
        reconstruct(some_maps(), load_rig("bare-wall"), sheet_network)


LIMITS = VerdictLimits(nothing=0.5, outside=0.3, unexplained=0.8)
SURFACE_M = np.full((64, 64), 0.2, np.float32)


def reconstruction(
    nothing: float = 0.0, outside: float = 0.0, depth_m: np.ndarray = SURFACE_M
) -> Reconstruction:
    uncertainty = Uncertainty(
        nothing, outside, np.full((64, 64), 0.01, np.float32), np.ones((64, 64), np.float32)
    )
    return Reconstruction(depth_m, object_box(RIG), uncertainty.error_m, {}, uncertainty)


def checked(score: float) -> FrameConditions:
    blank = np.zeros((64, 80), np.float32)
    return FrameConditions(check=PhysicsCheckResult(0, blank, blank, score, 0.1))


ALL = FrameConditions(saturated=True, invalid=True, moved=True, check=checked(1.0).check)


@pytest.mark.parametrize(
    ("made", "signs", "verdict"),
    [
        (reconstruction(), FrameConditions(), Verdict.SEEN),
        (reconstruction(nothing=0.5), FrameConditions(), Verdict.NOTHING),
        (reconstruction(nothing=0.9, outside=0.9), FrameConditions(), Verdict.NOTHING),
        (reconstruction(outside=0.3), FrameConditions(), Verdict.OUTSIDE),
        (reconstruction(), checked(0.8), Verdict.OUTSIDE),
        (reconstruction(), checked(0.79), Verdict.SEEN),
        (reconstruction(nothing=0.9), checked(1.0), Verdict.NOTHING),
        (reconstruction(nothing=0.9), FrameConditions(invalid=True), Verdict.OUTSIDE),
        (reconstruction(), FrameConditions(invalid=True), Verdict.OUTSIDE),
        (
            reconstruction(depth_m=np.full((64, 64), np.nan, np.float32)),
            FrameConditions(),
            Verdict.OUTSIDE,
        ),
        (
            reconstruction(nothing=0.9, outside=0.9),
            FrameConditions(saturated=True, invalid=True),
            Verdict.SATURATED,
        ),
        (reconstruction(outside=0.9), ALL, Verdict.WALL_MOVED),
        (reconstruction(nothing=0.9), ALL, Verdict.WALL_MOVED),
    ],
)
def test_verdict_is_the_last_that_holds(
    made: Reconstruction, signs: FrameConditions, verdict: Verdict
) -> None:
    assert VerdictFilter(LIMITS).decide(made, signs)[1] == verdict


@pytest.mark.parametrize("signs", [FrameConditions(), ALL])
def test_verdict_hides_the_surface_only_if_nothing_is_there(signs: FrameConditions) -> None:
    shown, _ = VerdictFilter(LIMITS).decide(reconstruction(nothing=0.9), signs)
    assert np.isnan(shown.depth_m).all()
    assert np.isfinite(shown.uncertainty_m).all()
    shown, _ = VerdictFilter(LIMITS).decide(reconstruction(outside=0.9), signs)
    np.testing.assert_array_equal(shown.depth_m, SURFACE_M)


@pytest.mark.parametrize("judge", [VerdictFilter(None), VerdictFilter(LIMITS)])
def test_verdict_without_doubt_considers_the_lidar_only(judge: VerdictFilter) -> None:
    plain = replace(reconstruction(), uncertainty=None, uncertainty_m=None)
    assert judge.decide(plain, FrameConditions()) == (plain, None)
    assert judge.decide(plain, FrameConditions(saturated=True))[1] == Verdict.SATURATED
    assert judge.decide(plain, FrameConditions(moved=True, saturated=True))[1] == Verdict.WALL_MOVED


def test_verdict_smooths_out_of_distribution_but_not_empty_frames() -> None:
    smoothed = VerdictFilter(LIMITS)
    forgetting = VerdictFilter(LIMITS)
    p_outside = [0.0] * 10 + [1.0] + [0.0] * 10 + [1.0] * STEADY_FRAMES
    verdicts = [smoothed.decide(reconstruction(outside=p), FrameConditions())[1] for p in p_outside]
    assert set(verdicts[:21]) == {Verdict.SEEN}
    assert verdicts[-1] == Verdict.OUTSIDE
    assert STEADY_FRAMES / 30 < 0.2
    p_empty = [0.0] * STEADY_FRAMES + [0.9, 0.0]
    verdicts = [
        forgetting.decide(reconstruction(p, outside=1.0 - p), FrameConditions())[1]
        for p in p_empty[:-1]
    ]
    assert verdicts[-2:] == [Verdict.OUTSIDE, Verdict.NOTHING]
    assert forgetting.decide(reconstruction(), FrameConditions())[1] == Verdict.SEEN
