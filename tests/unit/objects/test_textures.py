"""Textures: repeatable by seed, and never dark enough to count as background."""

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import BLACK_V
from nlos_models.pipeline import KEPT_SHARE

from nlos_cam.objects import TEXTURES, image_from_albedo, object_box, object_depth, paint
from nlos_cam.render import Surface

BOX = object_box(load_rig("paper-rig"))


def test_painted_depends_on_the_seed_and_draws_every_texture() -> None:
    depth_m = object_depth(5, BOX)[1]
    one, again, other = (paint(seed, depth_m, [*TEXTURES]) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.albedo, again.albedo)
    assert one.texture == again.texture
    assert not np.array_equal(one.albedo, other.albedo)
    assert paint(5, depth_m, ["stripes"]).texture == "stripes"
    depth_m = object_depth(1, BOX)[1]
    assert {paint(seed, depth_m, [*TEXTURES]).texture for seed in range(40)} == set(TEXTURES)


@pytest.mark.parametrize("name", TEXTURES)
def test_texture_is_an_albedo_that_keeps_the_silhouette(name: str) -> None:
    depth_m = object_depth(1, BOX)[1]
    for seed in range(20):
        albedo = TEXTURES[name](np.random.default_rng(seed), depth_m)
        assert Surface(albedo).over((64, 64)).shape == (64, 64, 3)
        bright = image_from_albedo(albedo, depth_m).max(0)[~np.isnan(depth_m)]
        assert bright.min() > KEPT_SHARE * bright.max()


def test_textures_have_the_colors_of_their_names() -> None:
    depth_m = object_depth(1, BOX)[1]
    made = {name: make(np.random.default_rng(3), depth_m) for name, make in TEXTURES.items()}
    colours = {name: len(np.unique(albedo.reshape(-1, 3), axis=0)) for name, albedo in made.items()}
    assert colours["plain"] == 1
    assert colours["stripes"] == colours["layers"] == 2
    assert 2 <= colours["patches"] <= 4
    assert colours["gradient"] > 100
    near = made["layers"][depth_m == np.nanmin(depth_m)]
    assert (near == near[0]).all()
    albedo = TEXTURES["layers"](np.random.default_rng(0), np.full((64, 64), np.nan, np.float32))
    assert np.isfinite(albedo).all()


def test_image_is_the_albedo_on_the_surface_and_0_beside_it() -> None:
    depth_m = object_depth(2, BOX)[1]
    albedo = paint(2, depth_m, [*TEXTURES]).albedo
    image, hidden = image_from_albedo(albedo, depth_m), np.isnan(depth_m)
    assert image.shape == (3, 64, 64)
    black = image_from_albedo(np.zeros((64, 64, 3)), np.full((64, 64), 0.2))
    np.testing.assert_allclose(black, BLACK_V, atol=1e-6)  # no background
    assert (image[:, hidden] == 0).all()
    np.testing.assert_allclose(image[:, ~hidden].T, BLACK_V + (1 - BLACK_V) * albedo[~hidden], atol=1e-6)
