"""Losses against hand-made examples: sums over entries, means over samples."""

import pytest
import torch
from nlos_models.losses import image_error, kl_divergence, latent_error, variational_share
from nlos_models.recipe import ImageLoss


def test_image_error_sums_pixels_and_averages_samples() -> None:
    image, truth = torch.zeros(2, 1, 64, 64), torch.zeros(2, 1, 64, 64)
    image[0, 0, 3, 4], image[0, 0, 5, 6] = 1.0, 0.5
    assert image_error(image, truth).item() == pytest.approx((1 + 0.25) / 2)
    assert image_error(torch.ones(1, 1, 64, 64, dtype=torch.bfloat16), truth[:1]).item() == 4096


@pytest.mark.parametrize(("share", "weight"), [(0.75, 1.0), (0.75, 4.0), (0.25, 2.0)])
def test_squared_error_is_least_at_weighted_mean(share: float, weight: float) -> None:
    v, truth = 0.6, torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = v
    best = weight * share * v / (1 - share + weight * share)
    losses = [image_error(torch.full_like(truth, best + off), truth, weight).item() for off in (-0.01, 0.0, 0.01)]
    assert min(losses) == losses[1]
    assert losses[0] == pytest.approx(losses[2], rel=1e-4)


@pytest.mark.parametrize(("share", "weight", "best"), [(0.75, 1.0, 0.6), (0.25, 1.0, 0.0), (0.25, 4.0, 0.6)])
def test_absolute_error_is_least_at_weighted_median(share: float, weight: float, best: float) -> None:
    truth = torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = 0.6
    losses = {v: image_error(torch.full_like(truth, v), truth, weight, "absolute").item() for v in (0.0, 0.2, 0.4, 0.6)}
    assert min(losses, key=lambda v: losses[v]) == best


@pytest.mark.parametrize("kind", ["squared", "absolute"])
def test_image_error_in_color_is_sum_over_channels(kind: ImageLoss) -> None:
    generator = torch.Generator().manual_seed(0)
    image, truth = (torch.rand(2, 3, 64, 64, generator=generator) for _ in range(2))
    truth *= truth.amax(1, keepdim=True) > 0.5
    channels = sum(image_error(image[:, [k]], truth[:, [k]], 2.0, kind) for k in range(3))
    torch.testing.assert_close(image_error(image, truth, 2.0, kind), channels)


@pytest.mark.parametrize(("done", "share"), [(0.0, 0.0), (0.2, 0.0), (0.25, 0.25), (0.3, 0.5), (0.4, 1.0), (1.0, 1.0)])
def test_variational_share_rises_after_warm_up(done: float, share: float) -> None:
    assert variational_share(done, warm_up=0.2) == pytest.approx(share)
    assert variational_share(done, warm_up=0.0) == 1.0


@pytest.mark.parametrize(("mean", "spread"), [(0.0, 1.0), (2.0, 2.0), (-0.5, 0.25)])
def test_kl_divergence_matches_closed_form(mean: float, spread: float) -> None:
    normal, entries = torch.distributions.Normal, torch.ones(3, 256)
    expected = 256 * torch.distributions.kl_divergence(normal(mean, spread), normal(0.0, 1.0)).item()
    found = kl_divergence(mean * entries, (spread**2 * entries).log()).item()
    assert found == pytest.approx(expected, rel=1e-5)
    assert (found == 0) == (mean == 0)


def test_latent_error_is_weighted_by_encoder_variance() -> None:
    latent, mean = torch.ones(1, 2), torch.zeros(1, 2)
    sure, unsure = torch.full((1, 2), 0.25).log(), torch.full((1, 2), 4.0).log()
    assert latent_error(latent, mean, sure).item() == pytest.approx(2 / 0.25)
    assert latent_error(latent, mean, unsure).item() == pytest.approx(2 / 4)
    assert latent_error(mean, mean, sure).item() == 0


@pytest.mark.parametrize("limit", [-10.0, 10.0])
@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16, torch.float16])
def test_latent_losses_stay_finite_at_log_variance_limits(limit: float, precision: torch.dtype) -> None:
    mean = torch.full((2, 256), 3.0, dtype=precision)
    log_variance = torch.full((2, 256), limit, dtype=precision)
    for value in (kl_divergence(mean, log_variance), latent_error(-mean, mean, log_variance)):
        assert value.dtype == torch.float32
        assert torch.isfinite(value)
