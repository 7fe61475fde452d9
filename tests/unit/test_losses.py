"""Losses against hand-made examples; the reduction is sum over entries, mean over samples."""

import pytest
import torch
from nlos_models.losses import image_error, kl_divergence, latent_error, variational_share
from nlos_models.recipe import ImageLoss


def test_the_image_error_sums_pixels_and_averages_samples() -> None:
    image, truth = torch.zeros(2, 1, 64, 64), torch.zeros(2, 1, 64, 64)
    image[0, 0, 3, 4], image[0, 0, 5, 6] = 1.0, 0.5
    assert image_error(image, truth).item() == pytest.approx((1 + 0.25) / 2)


@pytest.mark.parametrize(("share", "weight"), [(0.75, 1.0), (0.75, 4.0), (0.25, 2.0)])
def test_the_best_answer_to_doubt_lies_nearer_to_the_surface_the_more_surface_counts(
    share: float, weight: float
) -> None:
    v, truth = 0.6, torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = v
    best = weight * share * v / (1 - share + weight * share)
    losses = [image_error(torch.full_like(truth, best + off), truth, weight).item() for off in (-0.01, 0.0, 0.01)]
    assert min(losses) == losses[1]
    assert losses[0] == pytest.approx(losses[2], rel=1e-4)


@pytest.mark.parametrize(("share", "weight", "best"), [(0.75, 1.0, 0.6), (0.25, 1.0, 0.0), (0.25, 4.0, 0.6)])
def test_absolute_error_answers_doubt_with_the_surface_or_with_nothing(
    share: float, weight: float, best: float
) -> None:
    truth = torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = 0.6
    losses = {v: image_error(torch.full_like(truth, v), truth, weight, "absolute").item() for v in (0.0, 0.2, 0.4, 0.6)}
    assert min(losses, key=lambda v: losses[v]) == best


@pytest.mark.parametrize(("done", "share"), [(0.0, 0.0), (0.2, 0.0), (0.25, 0.25), (0.3, 0.5), (0.4, 1.0), (1.0, 1.0)])
def test_a_warm_up_keeps_noise_and_divergence_away_and_lets_them_rise_over_as_much_again(
    done: float, share: float
) -> None:
    assert variational_share(done, warm_up=0.2) == pytest.approx(share)
    assert variational_share(done, warm_up=0.0) == 1.0


def test_kl_is_0_for_the_standard_normal_and_positive_elsewhere() -> None:
    zero = torch.zeros(3, 256)
    assert kl_divergence(zero, zero).item() == 0
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        mean, log_variance = torch.randn(2, 3, 256, generator=generator)
        assert kl_divergence(mean, log_variance) > 0


def test_kl_follows_its_closed_form() -> None:
    mean, log_variance = torch.full((1, 1), 2.0), torch.full((1, 1), 4.0).log()
    expected = torch.distributions.kl_divergence(
        torch.distributions.Normal(2.0, 2.0), torch.distributions.Normal(0.0, 1.0)
    )
    assert kl_divergence(mean, log_variance).item() == pytest.approx(expected.item())


def test_an_error_weighs_by_the_encoders_own_doubt() -> None:
    latent, mean = torch.ones(1, 2), torch.zeros(1, 2)
    sure, unsure = torch.full((1, 2), 0.25).log(), torch.full((1, 2), 4.0).log()
    assert latent_error(latent, mean, sure).item() == pytest.approx(2 / 0.25)
    assert latent_error(latent, mean, unsure).item() == pytest.approx(2 / 4)
    assert latent_error(mean, mean, sure).item() == 0


@pytest.mark.parametrize("limit", [-10.0, 10.0])
@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16, torch.float16])
def test_losses_stay_finite_at_the_ends_of_the_log_variance(limit: float, precision: torch.dtype) -> None:
    mean = torch.full((2, 256), 3.0, dtype=precision)
    log_variance = torch.full((2, 256), limit, dtype=precision)
    for value in (kl_divergence(mean, log_variance), latent_error(-mean, mean, log_variance)):
        assert value.dtype == torch.float32
        assert torch.isfinite(value)


def test_half_precision_images_are_summed_in_single_precision() -> None:
    image, truth = torch.ones(1, 1, 64, 64, dtype=torch.bfloat16), torch.zeros(1, 1, 64, 64)
    assert image_error(image, truth).item() == 4096


@pytest.mark.parametrize("kind", ["squared", "absolute"])
def test_the_error_in_colour_is_that_of_its_channels_together(kind: ImageLoss) -> None:
    generator = torch.Generator().manual_seed(0)
    image, truth = (torch.rand(2, 3, 64, 64, generator=generator) for _ in range(2))
    truth *= truth.amax(1, keepdim=True) > 0.5
    channels = sum(image_error(image[:, [k]], truth[:, [k]], 2.0, kind) for k in range(3))
    torch.testing.assert_close(image_error(image, truth, 2.0, kind), channels)
