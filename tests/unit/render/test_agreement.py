"""Agreement of echoes with the true ones."""

from dataclasses import replace

import numpy as np
import pytest
from depth_maps import depth_map
from nlos_calibration import load_rig

from nlos_cam.render import EchoMaps, Scene, agreement, render
from nlos_cam.render.agreement import relative_error

BIN_M = 0.01
COUNT = 100


@pytest.fixture
def truth() -> EchoMaps:
    """Echoes with intensities from 1 to 2, each in the middle of a bin."""
    generator = np.random.default_rng(1)
    path = (generator.integers(40, 200, COUNT) + 0.5) * BIN_M
    return EchoMaps(generator.uniform(1, 2, COUNT), path, path / 2)


def test_echoes_agree_with_themselves(truth: EchoMaps) -> None:
    same = agreement(truth, truth, BIN_M)

    assert same.bin_exact == 1.0
    assert same.bin_within_1 == 1.0
    assert max(same.intensity_error_max, same.depth_error_mm, same.depth_error_mean_mm) == 0


def test_depth_without_common_entries_has_no_error(truth: EchoMaps) -> None:
    nothing = replace(truth, depth_m=np.full(COUNT, np.nan))
    assert agreement(nothing, truth, BIN_M).depth_error_mm == 0


def test_intensity_errors_are_relative(truth: EchoMaps) -> None:
    off = np.linspace(0, 0.1, COUNT)
    found = agreement(replace(truth, intensity=truth.intensity * (1 + off)), truth, BIN_M)

    assert found.intensity_error_median == pytest.approx(np.median(off))
    assert found.intensity_error_p99 == pytest.approx(np.quantile(off, 0.99))
    assert found.intensity_error_max == pytest.approx(0.1)


def test_moved_echoes_count_by_bins(truth: EchoMaps) -> None:
    step = np.zeros(COUNT)
    step[:20] = 2 * BIN_M
    step[20:50] = -BIN_M
    moved = replace(truth, path_m=truth.path_m + step, depth_m=truth.depth_m + step)
    found = agreement(moved, truth, BIN_M)

    np.testing.assert_allclose((found.bin_exact, found.bin_within_1), (0.5, 0.8))
    np.testing.assert_allclose(found.depth_error_mean_mm, 0.2 * 20 + 0.3 * 10)


def test_echo_lost_by_one_side_is_in_another_bin(truth: EchoMaps) -> None:
    lost = truth.path_m.copy()
    lost[:10] = np.nan
    one_side = replace(truth, path_m=lost)

    assert agreement(one_side, truth, BIN_M).bin_within_1 == pytest.approx(0.9)
    assert agreement(one_side, one_side, BIN_M).bin_exact == 1


def test_relative_error_without_true_light_is_0_or_1() -> None:
    found = relative_error(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(found, [0, 1, 1])


def test_echoes_of_cells_are_those_of_beams_that_win() -> None:
    depth = depth_map(16, np.nan, (np.s_[5:9, 4:12], 0.2 + 0.002 * np.arange(8)))
    scene = Scene(load_rig("paper-rig"), depth)
    rendering = render(scene, "draft")
    cells = EchoMaps.of_cells(rendering, scene)
    beams = EchoMaps.of_beams(rendering)
    wins = cells.intensity == beams.intensity

    assert wins.sum() > 500
    np.testing.assert_allclose(cells.path_m[wins], beams.path_m[wins], rtol=1e-5)
