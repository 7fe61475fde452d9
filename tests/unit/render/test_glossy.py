"""Glossy transport on lattices of directions (agreement with the reference: tests/laws)."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.render import (
    Accuracy,
    Scene,
    Surface,
    TransportJob,
    backend_reference,
    beam_sums,
    glossy,
    phong,
    prepare,
    retroreflective,
)
from nlos_cam.render.echoes import strongest
from nlos_cam.render.material import Brdf

COARSE = Accuracy("coarse", relay_columns=24, relay_rows=20)
BRDF = phong(0.4, 0.6, 10)
DEPTH = np.random.default_rng(0).uniform(0.15, 0.3, (4, 4)).astype(np.float32)
KINDS = (phong, retroreflective)


def job_of(brdf: Brdf, accuracy: Accuracy = COARSE, every: int = 200) -> TransportJob:
    scene = Scene(load_rig("paper-rig"), DEPTH, Surface(1.0, brdf))
    job = prepare(scene, accuracy, ("three-bounce", "tilt", "brdf")).job
    assert job is not None
    return job.select(np.arange(0, len(job.length_m), every))


@pytest.mark.slow
@pytest.mark.parametrize("error", [1.5e-2, 1e-3])
@pytest.mark.parametrize("exponent", [1, 2.5, 20, 200, 1000])
@pytest.mark.parametrize("kind", KINDS)
def test_light_of_a_lobe_agrees_with_the_reference(
    kind: Any, exponent: float, error: float
) -> None:
    job = job_of(kind(0.3, 0.7, exponent), replace(COARSE, scatter_error=error))
    found = glossy.histograms(job).sum(1)
    exact = backend_reference.histograms(job).sum(1)

    assert np.abs(found - exact).sum() < error * exact.sum()


@pytest.mark.slow
def test_lobe_without_diffuse_part_agrees_with_the_reference() -> None:
    job = job_of(retroreflective(0.0, 1.0, 50))
    found = glossy.histograms(job).sum(1)
    exact = backend_reference.histograms(job).sum(1)

    assert np.abs(found - exact).sum() < COARSE.scatter_error * exact.sum()


def test_lattice_is_finer_for_less_error() -> None:
    steps = [glossy.lobe_of(BRDF, error).step for error in (1e-1, 1e-2, 1e-3)]
    assert steps == sorted(set(steps), reverse=True)


def test_lattice_is_finer_for_a_narrower_lobe() -> None:
    steps = [glossy.lobe_of(phong(0.5, 0.5, n), 1e-2).step for n in (30, 100, 1000)]
    assert steps == sorted(set(steps), reverse=True)


def test_exponent_is_kept_to_a_part_in_256() -> None:
    lobe = glossy.lobe_of(phong(0.5, 0.5, 2.3), 1e-2)
    assert abs(lobe.whole + lobe.fraction / 256 - 2.3) <= 1 / 512


@pytest.mark.slow
@pytest.mark.parametrize("decided", [True, False])
@pytest.mark.parametrize("sub_bins", [1, 8])
def test_echoes_are_strongest_bins_bit_for_bit(
    sub_bins: int, decided: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_of(BRDF, replace(COARSE, sub_bins=sub_bins), every=9)
    best = strongest(glossy.histograms(job), job.bin_m)
    monkeypatch.setattr(glossy, "TABLE_BYTES", 1)  # patches in several blocks
    # With bounds of infinity no window decides, and every beam sums all of its bins.
    factor = beam_sums.ROUNDED if decided else np.float32(np.inf)
    monkeypatch.setattr(glossy, "ROUNDED", factor)
    found = glossy.echoes(job)
    for name in ("peak", "runner_up", "path_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(best, name))


@pytest.mark.slow
def test_histograms_are_never_negative() -> None:
    assert glossy.histograms(job_of(retroreflective(0.0, 1.0, 300))).min() >= 0
