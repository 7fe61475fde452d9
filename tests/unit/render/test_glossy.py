"""Eigenfunctions of a BRDF, and the transport with them (agreement with the reference: tests/laws)."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.render import Accuracy, Scene, beam_sums, glossy, prepare
from nlos_cam.render.brdf_table import scattered
from nlos_cam.render.echoes import strongest
from nlos_cam.render.material import Brdf, Surface, phong, retroreflective

pytestmark = pytest.mark.slow
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
BRDF = phong(0.4, 0.6, 10)
DEPTH = np.random.default_rng(0).uniform(0.1, 0.3, (4, 4)).astype(np.float32)
SCENE = Scene(load_rig("paper-rig"), DEPTH, Surface(1.0, BRDF))
JOB = prepare(SCENE, COARSE, ("three-bounce", "tilt", "brdf")).job


def _directions(count: int, normal: np.ndarray) -> np.ndarray:
    """Directions on the lit side of normals, uniform on the hemisphere."""
    found = np.random.default_rng(len(normal) + count).normal(size=(len(normal), 3))
    return found * np.sign((found * normal).sum(1))[:, None]


@pytest.mark.parametrize("brdf", [BRDF, retroreflective(0.2, 0.8, 30), phong(0.5, 0.5, 1)])
def test_eigenfunctions_sum_to_the_brdf(brdf: Brdf) -> None:
    normal = np.random.default_rng(1).normal(size=(500, 3)) - [0, 0, 1]
    normal[:, 2] = -np.abs(normal[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    one, other = _directions(1, normal), _directions(2, normal)
    every = glossy.eigenfunctions(brdf, 48)
    ends = (glossy._on_disc(end, normal) for end in (one, other))
    found = (np.prod([glossy._at(every, end) for end in ends], axis=0) * every.sign).sum(1)
    origin = np.zeros_like(normal)
    exact = scattered(brdf, one.copy(), origin, normal, other.copy())
    assert np.abs(found - exact).sum() < 3e-3 * exact.sum()


def test_rank_follows_the_error_and_the_lobe() -> None:
    def rank(error: float, brdf: Brdf = BRDF) -> int:
        found = glossy.glossy_basis(replace(JOB, accuracy=replace(COARSE, scatter_error=error)), brdf)
        assert found.value.shape[2] == len(found.sign)
        return len(found.sign)

    assert rank(0.1) < rank(5e-3) < rank(1e-3) < rank(1e-3, phong(0.4, 0.6, 40))
    assert rank(1e-4, phong(0.5, 0.0, 10)) == 1


def test_directions_that_never_occur_need_no_functions() -> None:
    every = glossy.eigenfunctions(BRDF, 48).first(128)
    spot, point, normal, cell = glossy._sample_paths(JOB, 2000, seed=2)
    one, other = (glossy._at(every, glossy._on_disc(end - point, normal)) for end in (spot, cell))
    exact, (mix, sign) = (one * other * every.sign).sum(1), glossy._restricted(JOB, every)
    terms, limit = (one @ mix) * (other @ mix) * sign, 1e-2 * exact.sum()
    assert np.abs(terms.sum(1) - exact).sum() < 1e-2 * limit
    assert glossy._rank(terms, exact, limit) < 0.8 * glossy._rank(one * other * every.sign, exact, limit)


def test_a_lobe_too_sharp_for_the_limit_has_no_basis(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as few:
        few.setattr(glossy, "STAGES", ((48, 10),))
        assert glossy.glossy_basis(JOB, BRDF) is None
    monkeypatch.setattr(glossy, "SIDES", (3,))  # nor one too sharp for the finest grid
    assert glossy.glossy_basis(JOB, BRDF) is None


@pytest.mark.parametrize("sub_bins", [1, 8])
def test_echoes_are_strongest_bins_of_histograms_bit_for_bit(sub_bins: int, monkeypatch: pytest.MonkeyPatch) -> None:
    job = replace(JOB.select(np.arange(0, len(JOB.length_m), 9)), accuracy=replace(COARSE, sub_bins=sub_bins))
    whole = glossy.histograms(job)
    assert whole.min() >= 0
    monkeypatch.setattr(glossy, "TABLE_BYTES", 1)  # patches in several blocks
    for factor in (beam_sums.ROUNDED, np.float32(np.inf)):  # with bounds of infinity no window decides
        monkeypatch.setattr(glossy, "ROUNDED", factor)
        found, best = glossy.echoes(job), strongest(whole, job.bin_m)
        for name in ("peak", "runner_up", "path_m"):
            np.testing.assert_array_equal(getattr(found, name), getattr(best, name))
