"""Laws of holding one rendering against another."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy_search import Echoes, agreement, relative_error
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

BIN_M = 0.01


def _echoes() -> Echoes:
    generator = np.random.default_rng(1)
    path = (generator.integers(40, 200, 100) + 0.5) * BIN_M
    return Echoes(generator.uniform(1, 2, 100), path, path / 2)


def test_everything_agrees_with_itself() -> None:
    same = agreement(_echoes(), _echoes(), BIN_M)
    assert (same.bin_exact, same.bin_within_1) == (1.0, 1.0)
    assert max(same.intensity_error_max, same.depth_error_mm, same.depth_error_mean_mm) == 0


def test_errors_are_relative_and_in_order() -> None:
    truth = _echoes()
    off = np.linspace(0, 0.1, 100)
    found = replace(truth, intensity=truth.intensity * (1 + off))
    told = agreement(found, truth, BIN_M)
    np.testing.assert_allclose(told.intensity_error_median, np.median(off))
    np.testing.assert_allclose(told.intensity_error_p99, np.quantile(off, 0.99))
    np.testing.assert_allclose(told.intensity_error_max, 0.1)


def test_an_echo_two_bins_off_is_in_neither_share_and_as_far_off_in_depth() -> None:
    truth = _echoes()
    step = np.zeros(100)
    step[:20], step[20:50] = 2 * BIN_M, -BIN_M
    told = agreement(replace(truth, path_m=truth.path_m + step, depth_m=truth.depth_m + step), truth, BIN_M)
    np.testing.assert_allclose((told.bin_exact, told.bin_within_1), (0.5, 0.8))
    np.testing.assert_allclose(told.depth_error_mean_mm, 0.2 * 20 + 0.3 * 10)


def test_an_echo_that_only_one_has_is_an_error_and_one_that_neither_has_is_none() -> None:
    truth = _echoes()
    lost = truth.path_m.copy()
    lost[:10] = np.nan
    assert agreement(replace(truth, path_m=lost), truth, BIN_M).bin_within_1 == pytest.approx(0.9)
    both = replace(truth, path_m=lost)
    assert agreement(both, both, BIN_M).bin_exact == 1
    np.testing.assert_array_equal(relative_error(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 2.0])), [0, 1, 1])


def test_where_neither_reports_a_depth_none_is_wrong() -> None:
    nothing = replace(_echoes(), depth_m=np.full(100, np.nan))
    assert agreement(nothing, _echoes(), BIN_M).depth_error_mm == 0


def test_cells_of_one_beam_are_that_beam_where_it_wins() -> None:
    rig = load_rig("paper-rig")
    depth = np.full((16, 16), np.nan, np.float32)
    depth[6:10, 6:10] = 0.2
    scene = Scene(rig, depth)
    rendering = render(scene, "draft")
    cells, beams = Echoes.of_cells(rendering, scene), Echoes.of_beams(rendering)
    wins = cells.intensity == beams.intensity
    assert wins.sum() > 500
    np.testing.assert_allclose(cells.path_m[wins], beams.path_m[wins], rtol=1e-5)
