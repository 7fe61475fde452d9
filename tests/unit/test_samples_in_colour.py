"""Samples in colour: laws of the four exposures, and what a plan with textures makes of its seeds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import load_rig
from nlos_models.recipe import SIMULATION_ONLY

from nlos_cam.dataset.plan import DatasetPlan, RigSpread
from nlos_cam.dataset.samples import hidden_object, make_samples, procedural_images, sense_colour, sense_object
from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.textures import TEXTURES, image_from_albedo, painted
from nlos_cam.render.material import Material, Surface
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

RIG = load_rig("paper-rig")
QUIET = SensorModel(range_noise_m=0.0, range_noise_per_m=0.0, read_noise_counts=0.0, shot_noise=0.0, dead_share=0.0)
PLAN = DatasetPlan(RIG, 40, accuracy="draft", textures=tuple(TEXTURES))


def _sensed(depth_m: Float32, albedo: Float32, sensor: Sensor, seed: int = 0) -> LidarMaps:
    return sense_colour(Scene(RIG, depth_m, Surface(albedo)), sensor, seed, "draft")


@pytest.fixture(scope="module")
def quiet() -> Sensor:
    return Sensor(RIG, QUIET)


@pytest.fixture(scope="module")
def noisy() -> Sensor:
    return Sensor(RIG, SensorModel())


@pytest.fixture(scope="module")
def shape() -> Float32:
    """A tilted slab without its upper left corner, so large and near that its light wins in many cells."""
    depth_m = np.full((64, 64), np.nan, np.float32)
    depth_m[8:56, 4:52] = np.linspace(0.14, 0.2, 48, dtype=np.float32)
    depth_m[:20, :20] = np.nan
    return depth_m


@pytest.fixture(scope="module")
def paint() -> Float32:
    """Every albedo is a multiple of 1/8, so that the mean of three is the same in any order."""
    return np.random.default_rng(0).choice([0.25, 0.5, 1.0], (64, 64, 3)).astype(np.float32)


@pytest.mark.parametrize("order", [(0, 2, 1), (1, 2, 0), (2, 1, 0)])
def test_exchanging_colours_exchanges_intensities_and_leaves_the_depth(
    quiet: Sensor, shape: Float32, paint: Float32, order: tuple[int, int, int]
) -> None:
    before = _sensed(shape, paint, quiet, 0)
    after = _sensed(shape, paint[..., order], quiet, 0)
    np.testing.assert_array_equal(after.intensity, before.intensity[list(order)])
    np.testing.assert_array_equal(after.depth_m, before.depth_m)
    assert not np.array_equal(before.intensity[0], before.intensity[1])


def test_a_grey_object_looks_as_it_does_in_one_colour(quiet: Sensor, noisy: Sensor, shape: Float32) -> None:
    grey, scene = np.full((64, 64, 3), 0.5, np.float32), Scene(RIG, shape, Surface(0.5))
    maps, alone = _sensed(shape, grey, quiet), sense_object(scene, quiet, 0, "draft")
    np.testing.assert_array_equal(maps.depth_m, alone.depth_m)
    for intensity in maps.intensity:
        np.testing.assert_array_equal(intensity, alone.intensity)
    white = sense_object(scene, noisy, 7, "draft")  # with noise the depth is the white exposure's, and its noise
    np.testing.assert_array_equal(_sensed(shape, grey, noisy, 7).depth_m, white.depth_m)


def test_exposures_agree_with_the_renderers_own_colour_where_one_echo_wins_in_all(
    shape: Float32, paint: Float32
) -> None:
    whole = render(Scene(RIG, shape, Surface(paint)), "draft")
    assert whole.colour is not None
    for channel in range(3):
        alone = render(Scene(RIG, shape, Surface(paint[..., channel])), "draft")
        same = (alone.depth_m == whole.depth_m) & (alone.intensity == alone.multi.peak)
        assert same.sum() > 100
        np.testing.assert_allclose(alone.intensity[same], whole.colour[same, channel], rtol=1e-5)


def test_each_exposure_has_noise_of_its_own_and_the_seed_decides_it(noisy: Sensor, shape: Float32) -> None:
    grey = np.full((64, 64, 3), 0.5, np.float32)
    one, again, other = (_sensed(shape, grey, noisy, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.intensity, again.intensity)
    assert not np.array_equal(one.intensity, other.intensity)
    assert not np.array_equal(one.intensity[0], one.intensity[1])


def test_a_mirrored_object_is_seen_as_mirrored_maps(quiet: Sensor, shape: Float32, paint: Float32) -> None:
    straight = _sensed(shape, paint, quiet, 0)
    mirrored = _sensed(shape[::-1].copy(), paint[::-1], quiet, 0)
    valid = ~np.isnan(straight.depth_m) & ~np.isnan(mirrored.depth_m[::-1])
    apart = np.abs(mirrored.intensity[:, ::-1] - straight.intensity)[:, valid]
    assert (apart <= 1.0).mean() > 0.99  # rounding decides some ties between echoes


def test_a_seed_in_colour_is_that_of_depth_painted() -> None:
    plan = replace(PLAN, spread=RigSpread(place_m=0.01), sensor=QUIET)
    made, plain = make_samples(plan, [40, 41]), make_samples(replace(plan, textures=()), [40, 41])
    assert made["intensity"].shape == (2, 3, 64, 80)
    for name in ("object_depth_m", "seed", "scene", "category"):
        np.testing.assert_array_equal(made[name], plain[name])
    depth_m = hidden_object(plan.objects, 41, plan.box)[1]
    coat = painted(41, depth_m, plan.textures)
    assert made["texture"][1] == coat.texture
    np.testing.assert_array_equal(made["image"][1], image_from_albedo(coat.albedo, depth_m).astype(np.float16))
    np.testing.assert_array_equal(made["image"], procedural_images(40, 2, plan.box, textures=plan.textures))
    rig, model = plan.spread.drawn(plan.rig, plan.sensor, 41)
    again = sense_colour(Scene(rig, depth_m, Surface(coat.albedo)), Sensor(rig, model), 41, "draft")
    np.testing.assert_array_equal(made["depth_m"][1], again.depth_m)
    np.testing.assert_array_equal(made["intensity"][1], again.intensity)


def test_a_plan_in_colour_comes_back_from_its_text_and_one_of_depth_does_not_tell_of_textures() -> None:
    assert DatasetPlan.from_provenance(PLAN.provenance) == PLAN
    assert json.loads(PLAN.provenance)["note"] == SIMULATION_ONLY
    assert not {"textures", "note"} & json.loads(replace(PLAN, textures=()).provenance).keys()
    assert replace(PLAN, textures=()).differences(PLAN) == ["textures"]


@pytest.mark.parametrize("albedo", [0.5, (1.0, 0.5, 0.5)])
def test_an_albedo_beside_the_textures_is_refused(albedo: float) -> None:
    PLAN.check()
    with pytest.raises(SceneError, match="textures give each its own"):
        replace(PLAN, material=Material(albedo=albedo)).check()
