"""Refining any one grid changes the result towards a limit, and the winner does not drift with the grids."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.renderer import render, three_bounce, transient
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
SOME = np.arange(5120)[::23]
BLUR = 16
"""Bins taken together: finer, what moves from bin to bin is the grid's own noise and not its limit."""


def _hill(cells: int) -> np.ndarray:
    """A smooth surface, sampled at the middles of cells x cells."""
    at = (np.arange(cells) + 0.5) / cells
    x, y = np.meshgrid(at, at)
    return (0.3 - 0.12 * np.sin(np.pi * x) * np.sin(np.pi * y) + 0.03 * x).astype(np.float32)


def _blurred(histogram: np.ndarray) -> np.ndarray:
    bins = 400
    padded = np.pad(histogram, [(0, 0), (0, bins - histogram.shape[1])])
    return padded.reshape(len(padded), -1, BLUR).sum(-1, dtype=np.float64)


def _found(depth: np.ndarray, accuracy: Accuracy) -> np.ndarray:
    return _blurred(three_bounce(Scene(RIG, depth, jump_m=0.5), accuracy, chosen=SOME))


def _relay(cells: int) -> np.ndarray:
    return _found(_hill(32), replace(STOPS["standard"], relay_columns=cells, relay_rows=cells))


def _object(cells: int) -> np.ndarray:
    return _found(_hill(cells), replace(STOPS["standard"], relay_columns=40, relay_rows=32))


def _beams(per_cell: int) -> np.ndarray:
    coarse = Accuracy("coarse", relay_columns=10, relay_rows=10, beams_per_cell=per_cell)
    found = transient(Scene(RIG, _hill(8)), coarse, effects=["three-bounce", "occluder", "tilt"])
    mean = found.reshape(64, per_cell, 80, per_cell, -1).mean((1, 3))
    return _blurred(mean.reshape(5120, -1))


@pytest.mark.parametrize(
    ("grid", "sizes"), [(_relay, (10, 20, 40, 80)), (_object, (8, 16, 32, 64)), (_beams, (1, 2, 4))]
)
def test_refining_a_grid_changes_less_each_time(grid: Any, sizes: tuple[int, ...]) -> None:
    found = [grid(size) for size in sizes]
    steps = [float(np.abs(finer - coarser).sum() / finer.sum()) for coarser, finer in pairwise(found)]
    assert all(later < earlier for earlier, later in pairwise(steps)), steps
    assert 0 < steps[-1] < 0.5 * steps[0]
    assert steps[-1] < 0.05


def test_refining_sub_bins_ends_at_the_brute_force() -> None:
    base, scene = Accuracy("coarse", relay_columns=20, relay_rows=16), Scene(RIG, _hill(16))
    exact = three_bounce(scene, replace(base, sub_bins=0), chosen=SOME)
    errors = [
        float(np.abs(three_bounce(scene, replace(base, sub_bins=n), chosen=SOME) - exact).sum() / exact.sum())
        for n in (1, 4, 16, 64)
    ]
    assert all(later < 0.7 * earlier for earlier, later in pairwise(errors)), errors


def test_which_echo_wins_does_not_drift_with_the_grid() -> None:
    shares: list[float] = []
    for cells in (20, 40, 80, 160):
        rendering = render(Scene(RIG, _hill(32)), replace(STOPS["draft"], relay_columns=cells, relay_rows=cells))
        direct = render(Scene(RIG)).intensity
        shares.append(float((rendering.intensity > direct).mean()))
    assert 0.1 < shares[-1] < 0.95
    assert np.ptp(shares[1:]) < 0.03
