"""What a rendering holds, and how beams become cells. Its laws are in tests/laws."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.material import Surface
from nlos_cam.render.renderer import render, three_bounce, transient
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=4, relay_rows=3)
DEPTH = np.full((4, 4), 0.25, np.float32)


def test_maps_are_of_cells_and_echoes_of_beams() -> None:
    for beams in (1, 2):
        rendering = render(Scene(RIG, DEPTH), replace(COARSE, beams_per_cell=beams))
        for image in (rendering.depth_m, rendering.intensity, rendering.margin):
            assert image.shape == (64, 80)
            assert image.dtype == np.float32
        assert rendering.multi.peak.shape == (64 * beams, 80 * beams)
        assert rendering.colour is None
        assert transient(Scene(RIG, DEPTH), replace(COARSE, beams_per_cell=beams)).shape[:2] == (64 * beams, 80 * beams)


def test_a_cell_takes_the_median_of_its_beams_depths() -> None:
    rendering = render(Scene(RIG), replace(COARSE, beams_per_cell=2))
    every = render(Scene(RIG), COARSE)
    both = np.isfinite(rendering.depth_m) & np.isfinite(every.depth_m)
    assert both.mean() > 0.5
    assert np.median(np.abs(rendering.depth_m - every.depth_m)[both]) < 1e-3


def test_colour_is_the_winning_echo_in_each_channel() -> None:
    albedo = np.array([1.0, 0.5, 0.0])
    rendering = render(Scene(RIG, DEPTH, Surface(albedo)), COARSE)
    assert rendering.colour is not None
    wins = rendering.multi.peak == rendering.intensity
    assert wins.any()
    assert not wins.all()
    np.testing.assert_allclose(
        rendering.colour[wins], rendering.intensity[wins, None] * albedo / albedo.mean(), rtol=1e-5, atol=1e-30
    )
    np.testing.assert_allclose(rendering.colour[~wins], np.repeat(rendering.intensity[~wins, None], 3, 1), rtol=1e-6)


def test_some_beams_are_those_of_all() -> None:
    every = three_bounce(Scene(RIG, DEPTH), COARSE)
    chosen = np.array([4000, 7, 2500])
    np.testing.assert_array_equal(three_bounce(Scene(RIG, DEPTH), COARSE, chosen=chosen), every[chosen])
    dark = np.flatnonzero(~every.any(1))[:3]
    assert not three_bounce(Scene(RIG, DEPTH), COARSE, chosen=dark).any()


def test_a_backend_that_is_none_is_refused_with_those_that_are() -> None:
    with pytest.raises(SceneError, match=r"no backend 'abacus': choose one of cpu, "):
        render(Scene(RIG, DEPTH), COARSE, backend="abacus")
