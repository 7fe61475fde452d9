"""Uncertainty ("doubt") network: features, outputs in range, training with exact resume, loss and calibration."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_doubter import RECIPE
from nlos_models import Running, doubt_training
from nlos_models.doubt_network import MAX_ERROR_V, MIN_ERROR_V, CalibratedDoubt, DoubtNetwork, DoubtOutput
from small_doubt import DARK_V, small_doubt_set
from small_maps import hard_maps

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def network() -> DoubtNetwork:
    torch.manual_seed(0)
    return DoubtNetwork().eval().requires_grad_(requires_grad=False)


def test_bare_wall_is_median_of_cells_and_gives_zero_features(network: DoubtNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    bare_m, counts = torch.rand(64, 80, generator=generator), 40 * torch.rand(64, 80, generator=generator)
    depth_m = bare_m.repeat(5, 1, 1)
    depth_m[0], depth_m[1, 0, 0] = bare_m + 0.3, torch.nan
    network.learn_bare(depth_m, counts.repeat(5, 1, 1))
    assert float(network.features(bare_m[None], counts[None]).abs().max()) == 0.0
    assert float(network.features(bare_m[None] + 0.05, counts[None] + 5)[:, :4].min()) > 0.4


def test_cell_without_return_sets_its_own_feature_alone(network: DoubtNetwork) -> None:
    depth_m, intensity = torch.full((1, 64, 80), 0.3), torch.full((1, 64, 80), 9.0)
    depth_m[0, 3, 4] = torch.nan
    assert network.features(depth_m, intensity)[0, :, 3, 4].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("name", ["all zero", "saturated", "half invalid", "all invalid"])
@pytest.mark.parametrize("v", [0.0, 1.0])
def test_doubt_of_hard_maps_is_finite_and_in_range(network: DoubtNetwork, name: str, v: float) -> None:
    calibrated = CalibratedDoubt(network, (1.0, 2.0), 3.0).eval()
    nothing, outside, error_v, surface = calibrated(*hard_maps(name), torch.full((1, 64, 64), v))
    for probability in (nothing, outside, surface):
        assert bool(((probability >= 0) & (probability <= 1)).all())
    assert float(error_v.min()) >= MIN_ERROR_V
    assert float(error_v.max()) <= MAX_ERROR_V
    assert error_v.shape == surface.shape == (1, 64, 64)


def test_calibration_scales_error_and_divides_logits(network: DoubtNetwork) -> None:
    maps, image = hard_maps("saturated"), torch.full((1, 64, 64), 0.5)
    plain, scaled = (
        CalibratedDoubt(network, t, s).eval()(*maps, image) for t, s in (((1.0, 1.0), 1.0), ((2.0, 4.0), 1.5))
    )
    torch.testing.assert_close(scaled[2], 1.5 * plain[2])
    for one, other, divisor in zip(plain[:2], scaled[:2], (2.0, 4.0), strict=True):
        torch.testing.assert_close(torch.logit(other) * divisor, torch.logit(one))


QUICK = RECIPE.model_copy(
    update={"objects": 128, "epochs": 8, "batch": 16, "learning_rate": 5e-3, "schedule": "one-cycle"}
)
Trained = tuple[DoubtNetwork, Path]


def _train(folder: Path, steps: list[int], **running: Any) -> DoubtNetwork:
    sets = small_doubt_set(128, 0), small_doubt_set(32, 1)
    return doubt_training.train_doubt(
        QUICK, *sets, folder, Running(on_step=lambda done, _: steps.append(done), **running)
    )[0]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("run")
    return _train(folder, []), folder


def _assert_same(one: DoubtNetwork, other: DoubtNetwork) -> None:
    torch.testing.assert_close(one.state_dict(), other.state_dict())


@pytest.mark.slow
def test_doubt_network_learns_empty_unusual_and_uncertain(trained: Trained) -> None:
    fresh = small_doubt_set(64, 2)
    said = doubt_training.predict(trained[0], fresh)
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
    fitted, said = doubt_training.calibrate(trained[0], some), doubt_training.predict(trained[0], some)
    nothing, outside = (
        torch.sigmoid(logits / t).numpy() for logits, t in zip(said[:2], fitted.temperatures, strict=True)
    )
    usual = ~some.nothing & ~some.outside
    assert (outside[usual] > fitted.outside_above + 1e-6).mean() <= doubt_training.MAX_FALSE_ALARMS + 1 / usual.sum()
    assert (nothing[some.nothing] < fitted.nothing_above).mean() <= 1 / some.nothing.sum()
    assert fitted.nothing_above <= 0.5
    assert fitted.error_scale > 0


def test_doubt_loss_ignores_error_where_nothing_is_hidden() -> None:
    some = small_doubt_set(8, 0)
    batch = doubt_training.as_doubt_batch(some.where(some.nothing))
    one, other = (torch.full((len(batch.made), 64, 64), value) for value in (-3.0, 1.0))
    flat = torch.zeros(len(batch.made))
    losses = [
        float(doubt_training.doubt_loss(DoubtOutput(flat, flat, log_error, one), batch)) for log_error in (one, other)
    ]
    assert losses[0] == losses[1]


def test_doubt_loss_is_least_at_mean_error() -> None:
    some = small_doubt_set(64, 0)
    batch = doubt_training.as_doubt_batch(some.where(~some.nothing))
    shared = (batch.truth > 0) & (batch.made > 0)
    mean = float((batch.made - batch.truth).abs()[shared].mean().log())
    flat, pixels = torch.zeros(len(batch.made)), torch.zeros_like(batch.made)
    losses = [
        float(doubt_training.doubt_loss(DoubtOutput(flat, flat, pixels + log_error, pixels), batch))
        for log_error in (mean, mean - 0.2, mean + 0.2)
    ]
    assert losses[0] < min(losses[1:])


def test_doubt_batches_mirror_maps_with_their_images() -> None:
    some = small_doubt_set(32, 0)
    batch = next(iter(doubt_training.doubt_batches(some, 32, torch.Generator().manual_seed(0))))
    assert sorted(batch.nothing.tolist()) == sorted(some.nothing.astype(float).tolist())
    bright = (batch.intensity[:, :, 8:72] > 12).float()
    torch.testing.assert_close(bright, (batch.truth > 0).float())
    torch.testing.assert_close((batch.made > 0).float(), bright)


@pytest.mark.parametrize(("factor", "unit"), [(0.25, 1.0), (1.0, 1.0), (8.0, 1.0), (1.0, 1000.0)])
def test_error_scale_undoes_factor_in_any_unit(factor: float, unit: float) -> None:
    expected = np.random.default_rng(1).uniform(0.01, 0.2, 20_000)
    error = np.abs(np.random.default_rng(0).laplace(0.0, expected))
    scale = doubt_training.error_scale(expected, error)
    assert factor * doubt_training.error_scale(factor * unit * expected, unit * error) == pytest.approx(scale)
    assert scale == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("true", [1.0, 2.0, 3.0])
def test_temperature_finds_overconfidence(true: float) -> None:
    generator = np.random.default_rng(3)
    logits = generator.normal(0.0, 2.0, 50_000)
    truth = generator.random(50_000) < 1 / (1 + np.exp(-logits))
    assert doubt_training.temperature(true * logits, truth) == pytest.approx(true, rel=0.1)
    assert doubt_training.temperature(np.where(truth, 9.0, -9.0), truth) == 1.0  # separable


def test_shared_errors_are_of_pixels_in_both_images() -> None:
    made, truth = np.array([[[0.5, 0.5], [0.0, 0.0]]]), np.array([[[0.25, 0.0], [0.5, 0.0]]])
    shared, error = doubt_training.shared_errors(made, truth)
    assert shared.tolist() == [[[True, False], [False, False]]]
    assert error.tolist() == [0.25]
