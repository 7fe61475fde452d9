"""Objects in colour: repeatable by seed, never dark enough for background, and there and back as images."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.silhouette import KEPT_SHARE

from nlos_cam.colour_objects import (
    BLACK_V,
    TEXTURES,
    albedo_from_image,
    colour_images,
    colour_object,
    image_from_albedo,
)
from nlos_cam.objects.depth_image import object_box
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.surface import Surface

BOX = object_box(load_rig("paper-rig"))


def test_the_seed_decides_all_and_the_shape_is_that_of_depth() -> None:
    one, again, other = colour_object(5, BOX), colour_object(5, BOX), colour_object(6, BOX)
    np.testing.assert_array_equal(one.albedo, again.albedo)
    assert not np.array_equal(one.albedo, other.albedo)
    category, depth_m = object_depth(5, BOX)
    assert one.category == category
    np.testing.assert_array_equal(one.depth_m, depth_m)


@pytest.mark.parametrize("name", TEXTURES)
def test_every_texture_is_an_albedo_that_stays_a_silhouette(name: str) -> None:
    depth_m = object_depth(1, BOX)[1]
    for seed in range(20):
        albedo = TEXTURES[name](np.random.default_rng(seed), depth_m)
        assert Surface(albedo).over((64, 64)).shape == (64, 64, 3)
        bright = image_from_albedo(albedo, depth_m).max(0)[~np.isnan(depth_m)]
        assert bright.min() > KEPT_SHARE * bright.max()


def test_textures_differ_as_their_names_say() -> None:
    depth_m = object_depth(1, BOX)[1]
    made = {name: make(np.random.default_rng(3), depth_m) for name, make in TEXTURES.items()}
    colours = {name: len(np.unique(albedo.reshape(-1, 3), axis=0)) for name, albedo in made.items()}
    assert colours["plain"] == 1
    assert colours["stripes"] == colours["layers"] == 2
    assert 2 <= colours["patches"] <= 4
    assert colours["gradient"] > 100
    near = made["layers"][depth_m == np.nanmin(depth_m)]
    assert (near == near[0]).all()


def test_layers_of_nothing_are_an_albedo_too() -> None:
    albedo = TEXTURES["layers"](np.random.default_rng(0), np.full((64, 64), np.nan, np.float32))
    assert np.isfinite(albedo).all()


def test_seeds_come_in_every_texture() -> None:
    assert {colour_object(seed, BOX).texture for seed in range(40)} == set(TEXTURES)


def test_an_albedo_is_an_image_and_back() -> None:
    one = colour_object(2, BOX)
    image = one.image
    hidden = np.isnan(one.depth_m)
    assert image.shape == (3, 64, 64)
    assert (image[:, hidden] == 0).all()
    assert image[:, ~hidden].min() >= BLACK_V
    back = albedo_from_image(image)
    assert np.isnan(back[hidden]).all()
    np.testing.assert_allclose(back[~hidden], one.albedo[~hidden], atol=1e-6)


def test_black_is_not_background() -> None:
    image = image_from_albedo(np.zeros((64, 64, 3)), np.full((64, 64), 0.2))
    np.testing.assert_allclose(albedo_from_image(image), 0, atol=1e-6)


def test_images_for_a_vae_are_those_of_the_objects_in_order() -> None:
    images = colour_images(7, 2, BOX)
    assert images.dtype == np.float16
    for image, seed in zip(images, (7, 8), strict=True):
        np.testing.assert_array_equal(image, colour_object(seed, BOX).image.astype(np.float16))
