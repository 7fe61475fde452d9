"""The two sums of the fast renderer: sub-bins to tables for every shift, tables to histograms."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render import backend_numba, backend_reference
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.backend_numba import LANES, tables
from nlos_cam.render.job import TransportJob
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")


def _job(sub_bins: int, sectors: int = 8) -> TransportJob:
    depth = np.random.default_rng(0).uniform(0.15, 0.3, (6, 6)).astype(np.float32)
    accuracy = Accuracy("own", 5, 4, sub_bins=sub_bins, sectors=sectors)
    effects = ["three-bounce", "tilt", "occluder", "self-occlusion"]
    job = Prepared.of(Scene(RIG, depth, jump_m=0.5), accuracy, effects).job()
    assert job is not None
    return job.some(np.arange(0, 3700, 53))


@pytest.mark.parametrize("per_bin", [1, 4, 8])
def test_a_table_is_the_histogram_later_by_each_number_of_sub_bins(per_bin: int) -> None:
    width = 2 * LANES
    fine = np.zeros((3, width * per_bin), np.float32)
    fine[:, : (width - 1) * per_bin] = np.random.default_rng(0).random((3, (width - 1) * per_bin))
    table = tables(fine, per_bin)
    for shift in range(per_bin):
        later = np.roll(fine, shift, axis=1).reshape(3, width, per_bin).sum(-1)
        np.testing.assert_allclose(table[:, shift], later, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("sub_bins", [1, 8, 64])
def test_the_light_of_each_beam_is_that_of_the_brute_force_whatever_the_sub_bins(sub_bins: int) -> None:
    job = _job(sub_bins)
    fast, slow = backend_numba.histograms(job), backend_reference.histograms(job)
    assert fast.shape == slow.shape
    assert fast.dtype == np.float32
    np.testing.assert_allclose(fast.sum(1), slow.sum(1), rtol=1e-5)


def test_paths_are_off_by_no_more_than_a_sub_bin() -> None:
    """Cumulated light crosses each edge at most one sub-bin early or late."""
    job = _job(8)
    fast, slow = backend_numba.histograms(job), backend_reference.histograms(job)
    moved = np.abs(np.cumsum(fast, 1, dtype=np.float64) - np.cumsum(slow, 1)).sum(1) / slow.sum(1)
    assert moved.max() < 2 / 8


def test_horizon_tables_are_empty_where_nothing_shades() -> None:
    job = _job(8, sectors=3)
    low, high = backend_numba.horizons(job)
    assert low.shape == high.shape == (36, 12)
    assert (low <= high * (1 + 1e-6)).all()
