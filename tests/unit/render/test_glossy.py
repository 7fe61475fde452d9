"""Eigenfunctions of a BRDF, and the transport with them (agreement with the reference:
tests/laws).
"""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.render import (
    Accuracy,
    Scene,
    Surface,
    beam_sums,
    glossy,
    phong,
    prepare,
    retroreflective,
)
from nlos_cam.render.brdf_table import Brdf, scattered
from nlos_cam.render.echoes import strongest

pytestmark = pytest.mark.slow
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
BRDF = phong(0.4, 0.6, 10)
DEPTH = np.random.default_rng(0).uniform(0.1, 0.3, (4, 4)).astype(np.float32)
SCENE = Scene(load_rig("paper-rig"), DEPTH, Surface(1.0, BRDF))
JOB = prepare(SCENE, COARSE, ("three-bounce", "tilt", "brdf")).job


def _directions(count: int, normal: np.ndarray) -> np.ndarray:
    found = np.random.default_rng(len(normal) + count).normal(
        size=(len(normal), 3)
    )  # on the lit side, uniformly
    return found * np.sign((found * normal).sum(1))[:, None]


@pytest.mark.parametrize("brdf", [BRDF, retroreflective(0.2, 0.8, 30), phong(0.5, 0.5, 1)])
def test_eigenfunctions_sum_to_the_brdf(brdf: Brdf) -> None:
    normal = np.random.default_rng(1).normal(size=(500, 3)) - [0, 0, 1]
    normal[:, 2] = -np.abs(normal[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    one = _directions(1, normal)
    other = _directions(2, normal)
    every = glossy.eigenfunctions(brdf, 48)
    found = (
        np.prod([glossy._at(every, glossy._on_disc(end, normal)) for end in (one, other)], axis=0)
        @ every.sign
    )
    exact = scattered(brdf, one.copy(), np.zeros_like(normal), normal, other.copy())
    assert np.abs(found - exact).sum() < 3e-3 * exact.sum()


def test_rank_follows_the_error_and_the_lobe() -> None:
    kinds = (
        (1e-4, phong(0.5, 0.0, 10)),
        (0.1, BRDF),
        (5e-3, BRDF),
        (1e-3, BRDF),
        (1e-3, phong(0.4, 0.6, 40)),
    )
    jobs = [
        (replace(JOB, accuracy=replace(COARSE, scatter_error=error)), brdf) for error, brdf in kinds
    ]
    ranks = [len(glossy.glossy_basis(job, brdf).sign) for job, brdf in jobs]
    assert ranks == [1, *sorted(set(ranks[1:]))]


def test_directions_that_never_occur_need_no_functions() -> None:
    every = glossy.eigenfunctions(BRDF, 48).first(128)
    spot, point, normal, cell = glossy._sample_paths(JOB, 2000, seed=2)
    one, other = (glossy._at(every, glossy._on_disc(end - point, normal)) for end in (spot, cell))
    (mix, sign), plain = glossy._restricted(JOB, every), one * other * every.sign
    terms = (one @ mix) * (other @ mix) * sign
    exact = plain.sum(1)
    assert np.abs(terms.sum(1) - exact).sum() < 1e-4 * exact.sum()
    assert glossy._rank(terms, exact, 1e-2 * exact.sum()) < 0.8 * glossy._rank(
        plain, exact, 1e-2 * exact.sum()
    )


def test_a_lobe_too_sharp_for_the_limit_has_no_basis(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit, least in (("STAGES", ((48, 10),)), ("SIDES", (3,)), ("GRID_BYTES", 1)):
        with monkeypatch.context() as few:
            few.setattr(glossy, limit, least)
            assert glossy.glossy_basis(JOB, BRDF) is None


@pytest.mark.parametrize("sub_bins", [1, 8])
def test_echoes_are_strongest_bins_of_histograms_bit_for_bit(
    sub_bins: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = replace(
        JOB.select(np.arange(0, len(JOB.length_m), 9)), accuracy=replace(COARSE, sub_bins=sub_bins)
    )
    whole = glossy.histograms(job)
    assert whole.min() >= 0
    monkeypatch.setattr(glossy, "TABLE_BYTES", 1)  # patches in several blocks
    for factor in (
        beam_sums.ROUNDED,
        np.float32(np.inf),
    ):  # with bounds of infinity no window decides
        monkeypatch.setattr(glossy, "ROUNDED", factor)
        found = glossy.echoes(job)
        best = strongest(whole, job.bin_m)
        for name in ("peak", "runner_up", "path_m"):
            np.testing.assert_array_equal(getattr(found, name), getattr(best, name))
