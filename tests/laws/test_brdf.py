"""Laws of materials: energy, reciprocity, Lambert's law as a special case."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig

from nlos_cam.render.material import Brdf, Surface, phong, retroreflective
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
KINDS = (phong, retroreflective)
SOME = np.arange(5120)[::61]
PHONG = phong(0.4, 0.6, 10)


def _given_back(brdf: Brdf, cos_in: float) -> float:
    """The integral of f cos / pi over the hemisphere of outgoing light."""
    cos_out, turn = np.meshgrid((np.arange(2000) + 0.5) / 2000, np.linspace(0, np.pi, 2001)[1:] - np.pi / 4000)
    across = np.sqrt((1 - cos_in**2) * (1 - cos_out**2)) * np.cos(turn)
    return float(2 * (brdf(cos_in, cos_out, cos_in * cos_out + across) * cos_out).mean())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("exponent", [1, 20, 500])
@pytest.mark.parametrize("cos_in", [1e-3, 0.3, 0.7, 1.0])
def test_no_more_light_leaves_than_came(kind: Any, exponent: float, cos_in: float) -> None:
    for specular in (0.0, 0.5, 1.0):
        assert _given_back(kind(1 - specular, specular, exponent), cos_in) <= 1 + 2e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("exponent", [1, 20, 500])
def test_along_the_normal_all_of_it_leaves(kind: Any, exponent: float) -> None:
    assert _given_back(kind(0.5, 0.5, exponent), 1.0) == pytest.approx(1, abs=2e-3)


cosines = st.floats(0.01, 1.0)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, derandomize=True)
@given(cos_in=cosines, cos_out=cosines, turn=st.floats(0, np.pi))
def test_it_is_the_same_both_ways_and_never_negative(kind: Any, cos_in: float, cos_out: float, turn: float) -> None:
    between = cos_in * cos_out + np.sqrt((1 - cos_in**2) * (1 - cos_out**2)) * np.cos(turn)
    brdf = kind(0.3, 0.7, 20)
    assert brdf(cos_in, cos_out, between) == pytest.approx(brdf(cos_out, cos_in, between))
    assert brdf(cos_in, cos_out, between) >= 0.3


def test_each_is_brightest_where_its_name_says() -> None:
    """At 45 degrees: a mirror sends light on to the other side, a retroreflector back."""
    half = np.cos(np.pi / 4)
    onward, back = (half, half, 0.0), (half, half, 1.0)
    for brdf, bright, dark in ((phong(0, 1, 20), onward, back), (retroreflective(0, 1, 20), back, onward)):
        assert brdf(*bright) > 10
        assert brdf(*dark) < 0.1


def test_without_its_lobe_phong_is_lambert(implementation: Any) -> None:
    """The albedo is the diffuse share; a plan would say so at once, so the effects are named."""
    depth = np.random.default_rng(0).uniform(0.2, 0.3, (6, 6)).astype(np.float32)
    effects = ["three-bounce", "occluder", "tilt", "brdf"]
    dull = implementation.three_bounce(Scene(RIG, depth, Surface(1.0, phong(0.6, 0.0, 20))), SOME, effects)
    plain = implementation.three_bounce(Scene(RIG, depth, Surface(0.6)), SOME, effects)
    np.testing.assert_allclose(dull, plain, rtol=1e-4, atol=1e-6 * plain.max())


def test_tables_of_a_brdf_agree_with_the_brute_force_to_the_accuracys_error(every_implementation: Any) -> None:
    depth = np.random.default_rng(0).uniform(0.2, 0.3, (6, 6)).astype(np.float32)
    scene, effects = Scene(RIG, depth, Surface(1.0, PHONG)), ["three-bounce", "occluder", "tilt", "brdf"]
    found = [one.three_bounce(scene, SOME, effects).sum(1) for one in every_implementation]
    exact = three_bounce(scene, "reference", effects=["three-bounce", "occluder", "tilt"], chosen=SOME).sum(1)
    for part in found[:-1]:
        assert np.abs(part - found[-1]).sum() < 1e-2 * found[-1].sum()
    assert np.abs(found[-1] - exact).sum() > 0.05 * exact.sum()
