"""The last step: the strongest echo of each beam, and who wins a tie."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from nlos_calibration.rig import load_rig

from nlos_cam.render.echoes import MultiBounce, add_direct, compete, nothing, strongest
from nlos_cam.render.geometry import Beams, cast

RIG = load_rig("paper-rig")
BIN_M = 0.01


def _beams(direct: list[float], length_m: float = 0.5) -> Beams:
    n = len(direct)
    every = np.full(n, length_m)
    foot = np.zeros((n, 3))
    lit = np.ones(n, np.bool_)
    return Beams((1, n), foot, foot, every, every, np.full(n, 0.5), lit, np.array(direct), np.zeros(3))


def _multi(peak: list[float], runner_up: list[float], path_m: float = 2.0) -> MultiBounce:
    paths = np.full(len(peak), path_m, np.float32)
    return MultiBounce(np.array(peak, np.float32), np.array(runner_up, np.float32), paths).of((1, len(peak)))


@settings(deadline=None, derandomize=True)
@given(arrays(np.float32, (5, 9), elements=st.sampled_from([0.0, 1e-6, 0.25, 0.5, 1.0])))
def test_the_strongest_two_are_those_of_sorting(histogram: np.ndarray) -> None:
    found = strongest(histogram, BIN_M)
    ordered = np.sort(histogram, axis=1)
    np.testing.assert_array_equal(found.peak, ordered[:, -1])
    np.testing.assert_array_equal(found.runner_up, ordered[:, -2])
    expected = np.where(found.peak > 0, (histogram.argmax(1) + 0.5) * BIN_M, np.nan)  # the first of equals
    np.testing.assert_allclose(found.path_m, expected, rtol=1e-6)


def test_the_stronger_of_direct_return_and_echo_wins_with_its_own_depth() -> None:
    depth, intensity, margin = compete(_beams([0.4, 0.1]), _multi([0.2, 0.2], [0.1, 0.15]))
    np.testing.assert_allclose(depth, [[0.5 * 0.5, 1.0 * 0.5]])
    np.testing.assert_allclose(intensity, [[0.4, 0.2]])
    np.testing.assert_allclose(margin, [[0.5, 0.25]], rtol=1e-6)


def test_a_tie_goes_to_the_direct_return_and_has_no_margin() -> None:
    depth, _, margin = compete(_beams([0.25]), _multi([0.25], [0.0]))
    assert depth == pytest.approx(0.25)
    assert margin == 0


def test_where_nothing_comes_back_there_is_no_depth() -> None:
    depth, intensity, margin = compete(_beams([0.0, 0.1]), nothing(2).of((1, 2)))
    assert np.isnan(depth[0, 0])
    assert intensity.tolist() == [[0.0, pytest.approx(0.1)]]
    assert margin.tolist() == [[0.0, 1.0]]


def test_a_waveform_that_holds_the_direct_return_does_not_count_it_twice() -> None:
    multi = replace(_multi([0.2], [0.05]), direct_included=True)
    depth, intensity, margin = compete(_beams([0.4]), multi)
    assert (depth.item(), intensity.item()) == pytest.approx((0.5, 0.2))
    assert margin.item() == pytest.approx(0.75)


def test_echoes_of_some_beams_are_nothing_for_the_others() -> None:
    which = np.array([False, True, False])
    every = strongest(np.array([[0.0, 2.0]], np.float32), BIN_M).spread_over(which)
    assert every.peak.tolist() == [0.0, 2.0, 0.0]
    np.testing.assert_array_equal(np.isnan(every.path_m), ~which)


def test_the_direct_return_is_added_in_the_bin_of_its_own_path() -> None:
    beams = cast(RIG, RIG.pinhole.scaled(80, 64))
    whole = add_direct(np.zeros((5120, 3), np.float32), beams, BIN_M)
    returned = beams.direct > 0
    np.testing.assert_allclose(whole.sum(1), beams.direct, rtol=1e-6)
    np.testing.assert_array_equal(whole.argmax(1)[returned], np.floor(2 * beams.length_m[returned] / BIN_M))


def test_nothing_returned_leaves_histograms_as_they_were() -> None:
    before = np.ones((2, 4), np.float32)
    np.testing.assert_array_equal(add_direct(before, _beams([0.0, 0.0]), BIN_M), before)
