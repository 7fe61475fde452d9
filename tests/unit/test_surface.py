"""What a surface is made of: what is refused, what a material makes, how an albedo lies over cells."""

import numpy as np
import pytest
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.render.material import Material, Surface, brdf_range, phong, retroreflective


@pytest.mark.parametrize("albedo", [-0.1, 1.1, np.nan, np.inf, np.array([0.5, 2.0, 0.5])])
def test_an_albedo_that_is_none_is_refused_with_its_range(albedo: float | np.ndarray) -> None:
    with pytest.raises(SceneError, match=r"albedo runs from .* to .*: it must lie in 0 to 1"):
        Surface(albedo)


@pytest.mark.parametrize("shape", [(2,), (4, 4, 2), (1, 4, 4, 3)])
def test_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(SceneError, match=r"albedo has shape .*: give one, three"):
        Surface(np.ones(shape))


@pytest.mark.parametrize(("shape", "channels"), [((), 1), ((3,), 3), ((5, 5), 1), ((5, 5, 3), 3)])
def test_an_albedo_lies_over_every_cell(shape: tuple[int, ...], channels: int) -> None:
    surface = Surface(np.full(shape, 0.5))
    assert surface.coloured == (channels == 3)
    np.testing.assert_array_equal(surface.over((5, 5)), np.full((5, 5, channels), 0.5))


def test_materials_by_name_share_their_albedo_out() -> None:
    assert Material().surface.brdf is None
    for kind, make in (("phong", phong), ("retroreflective", retroreflective)):
        material = Material(kind=kind, specular=0.3, exponent=7, albedo=(0.1, 0.2, 0.3))
        assert material.surface.coloured
        assert material.brdf is not None
        assert material.brdf(0.6, 0.7, 0.8) == pytest.approx(make(0.7, 0.3, 7)(0.6, 0.7, 0.8))


@pytest.mark.parametrize(
    "wrong", [{"kind": "velvet"}, {"specular": 1.1}, {"exponent": 0.5}, {"albedo": 2.0}, {"gloss": 1}]
)
def test_a_material_that_is_none_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Material.model_validate(wrong)


def test_the_range_of_a_brdf_holds_its_lobe() -> None:
    assert brdf_range(phong(0.25, 0.0, 20)) == (0.25, 0.25)
    for kind in (phong, retroreflective):
        low, high = brdf_range(kind(0.5, 0.5, 20))
        assert (low, high) == pytest.approx((0.5, 0.5 + 0.5 * 11))
