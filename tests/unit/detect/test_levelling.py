"""Laws of levelling: gain and offset vanish, an effect elsewhere stays."""

import numpy as np
from nlos_calibration import load_rig

from nlos_cam.detect.levelling import level, quiet_cells


def test_gain_and_offset_vanish_and_the_effect_stays() -> None:
    wall = np.linspace(0.2, 0.3, 5120).reshape(64, 80)
    maps = np.stack([wall, 1.02 * wall + 0.004, wall, wall])
    maps[2, :32, 60:] += 0.001
    quiet = np.zeros((64, 80), np.bool_)
    quiet[:, :40] = True
    leveled = level(maps, np.full(wall.shape, 1e-4), quiet)
    np.testing.assert_allclose(leveled[1] - leveled[0], 0, atol=3e-4)
    np.testing.assert_allclose((leveled[2] - leveled[3])[:32, 60:], 0.001, rtol=1e-6)


def test_half_of_the_walls_cells_are_quiet_on_the_papers_rig() -> None:
    quiet = quiet_cells(load_rig("paper-rig"))
    assert 0.4 <= quiet.mean() <= 0.6


def test_every_cell_levels_a_bench_without_a_box() -> None:
    assert quiet_cells(load_rig("bare-wall")).all()
