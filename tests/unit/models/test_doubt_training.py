"""Training of a doubt network on a small set, exact resuming, its loss, and the calibration of its outputs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_doubter import RECIPE
from nlos_models.doubt_network import DoubtNetwork, DoubtOutput
from nlos_models.doubt_training import (
    MAX_FALSE_ALARMS,
    as_doubt_batch,
    calibrate,
    doubt_batches,
    doubt_loss,
    error_scale,
    predict,
    shared_errors,
    temperature,
    train_doubt,
)
from nlos_models.train import Running
from small_doubt import DARK_V, small_doubt_set

pytestmark = pytest.mark.usefixtures("one_thread")

QUICK = RECIPE.model_copy(
    update={"objects": 128, "epochs": 8, "batch": 16, "learning_rate": 5e-3, "schedule": "one-cycle"}
)
Trained = tuple[DoubtNetwork, Path]


def _train(folder: Path, steps: list[int], **running: Any) -> DoubtNetwork:
    sets = small_doubt_set(128, 0), small_doubt_set(32, 1)
    return train_doubt(QUICK, *sets, folder, Running(on_step=lambda done, _: steps.append(done), **running))[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("run")
    return _train(folder, []), folder


def _assert_same(one: DoubtNetwork, other: DoubtNetwork) -> None:
    torch.testing.assert_close(one.state_dict(), other.state_dict())


@pytest.mark.slow
def test_doubt_network_learns_empty_unusual_and_uncertain(trained: Trained) -> None:
    fresh = small_doubt_set(64, 2)
    said = predict(trained[0], fresh)
    assert ((said.nothing.numpy() > 0) == fresh.nothing).mean() > 0.9
    there = ~fresh.nothing
    assert np.corrcoef(said.outside.numpy()[there], fresh.outside[there])[0, 1] > 0.8
    dark, bright = (said.log_error.numpy()[fresh.truth == value].mean() for value in np.float16([DARK_V, 0.8]))
    assert dark > bright + 0.3


@pytest.mark.slow
def test_stopped_doubt_run_resumes_to_same_weights(trained: Trained, tmp_path: Path) -> None:
    steps = list[int]()
    with pytest.raises(KeyboardInterrupt):
        _train(tmp_path, steps, stop=lambda: len(steps) == 11)
    _assert_same(_train(tmp_path, steps), trained[0])
    assert steps == list(range(1, 65))


@pytest.mark.slow
def test_calibrated_limits_keep_their_false_alarm_rates(trained: Trained) -> None:
    some = small_doubt_set(200, 3)
    fitted, said = calibrate(trained[0], some), predict(trained[0], some)
    nothing, outside = (
        torch.sigmoid(logits / t).numpy() for logits, t in zip(said[:2], fitted.temperatures, strict=True)
    )
    usual = ~some.nothing & ~some.outside
    assert (outside[usual] > fitted.outside_above + 1e-6).mean() <= MAX_FALSE_ALARMS + 1 / usual.sum()
    assert (nothing[some.nothing] < fitted.nothing_above).mean() <= 1 / some.nothing.sum()
    assert fitted.nothing_above <= 0.5
    assert fitted.error_scale > 0


def test_doubt_loss_ignores_error_where_nothing_is_hidden() -> None:
    some = small_doubt_set(8, 0)
    batch = as_doubt_batch(some.where(some.nothing))
    one, other = (torch.full((len(batch.made), 64, 64), value) for value in (-3.0, 1.0))
    flat = torch.zeros(len(batch.made))
    losses = [float(doubt_loss(DoubtOutput(flat, flat, log_error, one), batch)) for log_error in (one, other)]
    assert losses[0] == losses[1]


def test_doubt_loss_is_least_at_mean_error() -> None:
    some = small_doubt_set(64, 0)
    batch = as_doubt_batch(some.where(~some.nothing))
    shared = (batch.truth > 0) & (batch.made > 0)
    mean = float((batch.made - batch.truth).abs()[shared].mean().log())
    flat, pixels = torch.zeros(len(batch.made)), torch.zeros_like(batch.made)
    losses = [
        float(doubt_loss(DoubtOutput(flat, flat, pixels + log_error, pixels), batch))
        for log_error in (mean, mean - 0.2, mean + 0.2)
    ]
    assert losses[0] < min(losses[1:])


def test_doubt_batches_mirror_maps_with_their_images() -> None:
    some = small_doubt_set(32, 0)
    batch = next(iter(doubt_batches(some, 32, torch.Generator().manual_seed(0))))
    assert sorted(batch.nothing.tolist()) == sorted(some.nothing.astype(float).tolist())
    bright = (batch.intensity[:, :, 8:72] > 12).float()
    torch.testing.assert_close(bright, (batch.truth > 0).float())
    torch.testing.assert_close((batch.made > 0).float(), bright)


@pytest.mark.parametrize(("factor", "unit"), [(0.25, 1.0), (1.0, 1.0), (8.0, 1.0), (1.0, 1000.0)])
def test_error_scale_undoes_factor_in_any_unit(factor: float, unit: float) -> None:
    expected = np.random.default_rng(1).uniform(0.01, 0.2, 20_000)
    error = np.abs(np.random.default_rng(0).laplace(0.0, expected))
    scale = error_scale(expected, error)
    assert factor * error_scale(factor * unit * expected, unit * error) == pytest.approx(scale)
    assert scale == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("true", [1.0, 2.0, 3.0])
def test_temperature_finds_overconfidence(true: float) -> None:
    generator = np.random.default_rng(3)
    logits = generator.normal(0.0, 2.0, 50_000)
    truth = generator.random(50_000) < 1 / (1 + np.exp(-logits))
    assert temperature(true * logits, truth) == pytest.approx(true, rel=0.1)
    assert temperature(np.where(truth, 9.0, -9.0), truth) == 1.0  # separable


def test_shared_errors_are_of_pixels_in_both_images() -> None:
    made, truth = np.array([[[0.5, 0.5], [0.0, 0.0]]]), np.array([[[0.25, 0.0], [0.5, 0.0]]])
    shared, error = shared_errors(made, truth)
    assert shared.tolist() == [[[True, False], [False, False]]]
    assert error.tolist() == [0.25]
