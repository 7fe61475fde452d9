import itertools
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from nlos_calibration.rig import load_rig
from nlos_models import Answer
from nlos_models.quality import QualityEstimate
from small_frames import sheet_network

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import depth_from_image, image_from_depth, object_box
from nlos_cam.reconstruct.network import Reconstruction, reconstruct, reconstruct_all

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
HALF = sheet_network()
BLANK_M = np.full((64, 80), np.nan, np.float32)


def some_maps() -> LidarMaps:
    depth_m = np.full((64, 80), 0.3, np.float32)
    depth_m[0, 0] = np.nan
    return LidarMaps(depth_m, np.full((64, 80), 40.0, np.float32), ~np.isnan(depth_m))


@pytest.mark.parametrize("seed", range(3))
def test_reconstruct_inverts_the_image_of_a_depth_map(seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth_m = generator.uniform(BOX.z_near_m, BOX.z_far_m, (64, 64)).astype(np.float32)
    truth_m[generator.random((64, 64)) < 0.5] = np.nan
    found = reconstruct(some_maps(), RIG, lambda *_: image_from_depth(truth_m, BOX)[None])

    np.testing.assert_allclose(found.depth_m, truth_m, atol=1e-6)  # NaN where NaN


def test_reconstruct_all_shares_the_network_time() -> None:
    ticks = itertools.count()
    images = np.repeat(HALF, 4, 0)
    found = reconstruct_all([some_maps()] * 4, RIG, lambda *_: images, lambda: float(next(ticks)))

    assert [each.timings_s for each in found] == [{"network": 0.25}] * 4
    assert [each.uncertainty_m for each in found] == [None] * 4


@pytest.fixture
def uncertainty_model() -> FakeUncertainty:
    return FakeUncertainty(lambda *_: (0.25, 0.5), error_v=0.1)


@pytest.fixture
def uncertain(uncertainty_model: FakeUncertainty) -> Reconstruction:
    """Reconstruction of a sheet with its uncertainty, by a clock of a second a call."""
    ticks = itertools.count()
    return reconstruct(
        some_maps(), RIG, sheet_network, lambda: float(next(ticks)), uncertainty_model
    )


def test_uncertainty_model_adds_probabilities_and_a_stage(uncertain: Reconstruction) -> None:
    assert uncertain.timings_s == {"network": 1.0, "doubt": 1.0}
    assert uncertain.uncertainty.p_empty == 0.25
    assert uncertain.uncertainty.p_out_of_distribution == 0.5


def test_uncertainty_is_an_error_in_metres(uncertain: Reconstruction) -> None:
    apart_m = depth_from_image(HALF[0], BOX) - depth_from_image(HALF[0] + np.float32(0.1), BOX)

    np.testing.assert_allclose(uncertain.uncertainty_m, apart_m, rtol=1e-5)
    assert uncertain.uncertainty_m is uncertain.uncertainty.error_m


@pytest.mark.usefixtures("uncertain")
def test_uncertainty_model_gets_maps_and_image(uncertainty_model: FakeUncertainty) -> None:
    depth_m, intensity, image = uncertainty_model.asked[0]

    np.testing.assert_array_equal(depth_m, some_maps().depth_m[None])
    np.testing.assert_array_equal(intensity, some_maps().intensity[None])
    np.testing.assert_array_equal(image, HALF)


def test_hidden_surface_keeps_its_uncertainty(uncertain: Reconstruction) -> None:
    hidden = uncertain.without_surface

    assert uncertain.has_surface
    assert not hidden.has_surface
    assert hidden.uncertainty_m is uncertain.uncertainty_m
    assert hidden.uncertainty.error_m is uncertain.uncertainty.error_m
    assert hidden.quality is None


def test_maps_without_returns_have_uncertainty_and_no_surface(
    uncertainty_model: FakeUncertainty,
) -> None:
    maps = LidarMaps(BLANK_M, np.zeros((64, 80), np.float32), ~np.isnan(BLANK_M))
    full = np.ones((1, 64, 64), np.float32)
    found = reconstruct(maps, RIG, lambda *_: full, uncertainty_model=uncertainty_model)

    assert not found.has_surface
    assert found.uncertainty_m is not None
    assert not uncertainty_model.asked[0][2].any()


class SurfaceNetwork:
    """Network with a probability of a surface: the image times the first cell's intensity."""

    def answer(self, depth_m: np.ndarray, intensity: np.ndarray) -> Answer:
        images = np.repeat(HALF, len(depth_m), 0)
        return Answer(images, images * intensity[:, :1, :1])

    def __call__(self, *maps: np.ndarray) -> np.ndarray:
        return self.answer(*maps).image


@pytest.fixture
def quality_model(uncertainty_model: FakeUncertainty) -> Mock:
    estimate = QualityEstimate.of(np.zeros((1, 5), np.float32), None)
    uncertainty_model.quality = Mock(return_value=estimate)
    return uncertainty_model.quality


def test_quality_is_predicted_from_each_frames_own_surface(
    uncertainty_model: FakeUncertainty, quality_model: Mock
) -> None:
    bright = some_maps()
    blank = replace(bright, depth_m=BLANK_M, valid=np.zeros((64, 80), bool))
    nothing, found = reconstruct_all(
        [blank, bright], RIG, SurfaceNetwork(), uncertainty_model=uncertainty_model
    )

    assert nothing.quality is None
    assert found.quality.iou == (0.5, 0.5, 0.5)
    np.testing.assert_array_equal(quality_model.call_args.args[2], sheet_network() * 40)


def test_quality_of_a_network_without_probabilities_has_none(
    uncertainty_model: FakeUncertainty, quality_model: Mock
) -> None:
    reconstruct(some_maps(), RIG, sheet_network, uncertainty_model=uncertainty_model)
    assert quality_model.call_args.args[2] is None


def test_reconstruct_refuses_a_rig_without_object_box() -> None:
    with pytest.raises(SceneError, match="bare-wall"):
        reconstruct(some_maps(), load_rig("bare-wall"), sheet_network)
