"""Metrics and losses against hand-made images and latents."""

import numpy as np
import pytest
import torch
from nlos_models import metrics
from nlos_models.arrays import Float32
from nlos_models.training.losses import image_error, kl_divergence, latent_error, variational_share
from nlos_models.training.recipe import ImageLoss

EMPTY = np.zeros((1, 64, 64), np.float32)


def _square(v: float, rows: slice = slice(10, 20), columns: slice = slice(10, 20)) -> np.ndarray:
    image = EMPTY.copy()
    image[:, rows, columns] = v
    return image


def _colored(color: tuple[float, float, float], rows: slice = slice(16, 48)) -> Float32:
    image = np.zeros((1, 3, 64, 64), np.float32)
    image[:, :, rows, 16:48] = 0.1 + 0.9 * np.array(color, np.float32)[:, None, None]
    return image


def test_every_metric_of_an_equal_image_is_perfect() -> None:
    for score in (
        metrics.accuracy_mean_abs,
        metrics.accuracy_within_2_percent,
        metrics.silhouette_iou,
    ):
        assert [score(image, image) for image in (EMPTY, _square(0.7))] == [1, 1]
    assert metrics.foreground_rmse_mm(_square(0.7), _square(0.7), 300.0) == 0


def test_accuracies_count_every_pixel() -> None:
    assert metrics.accuracy_mean_abs(_square(0.5), EMPTY)[0] == pytest.approx(1 - 0.5 * 100 / 4096)
    assert metrics.accuracy_within_2_percent(_square(0.515), _square(0.5))[0] == 1
    assert metrics.accuracy_within_2_percent(_square(0.53), _square(0.5))[0] == pytest.approx(
        1 - 100 / 4096
    )


def test_silhouette_iou_takes_surface_above_5_percent() -> None:
    shifted = _square(0.9, columns=slice(15, 25))

    assert metrics.silhouette_iou(_square(0.4), shifted)[0] == pytest.approx(50 / 150)
    assert metrics.silhouette_iou(_square(0.06), _square(1.0)) == 1
    assert metrics.silhouette_iou(_square(0.04), _square(1.0)) == 0
    assert metrics.silhouette_iou(EMPTY, _square(0.5)) == 0


def test_foreground_rmse_is_over_shared_pixels() -> None:
    image = _square(0.6, columns=slice(10, 30))

    assert metrics.foreground_rmse_mm(image, _square(0.5), 300.0)[0] == pytest.approx(30, rel=1e-5)

    for image, truth in (
        (EMPTY, EMPTY),
        (EMPTY, _square(0.5)),
        (_square(0.5, rows=slice(40, 50)), _square(0.5)),
    ):
        assert np.isnan(metrics.foreground_rmse_mm(image, truth, 300.0))


def test_foreground_rmse_takes_faint_pixels_as_the_farthest() -> None:
    assert metrics.foreground_rmse_mm(_square(0.06), _square(metrics.MIN_V), 300.0)[
        0
    ] == pytest.approx(0, abs=1e-6)
    assert metrics.foreground_rmse_mm(_square(0.06), _square(0.2), 300.0)[0] == pytest.approx(
        30, rel=1e-5
    )


def test_color_metrics_of_a_wrong_color() -> None:
    truth = _colored((0.9, 0.2, 0.1))
    image = _colored((0.9, 0.5, 0.1))

    assert [value.item() for value in metrics.color_metrics(truth, truth).values()] == [
        1.0,
        1.0,
        0.0,
        0.0,
    ]
    assert metrics.color_silhouette_iou(image, truth) == 1.0
    assert metrics.color_error(image, truth) == pytest.approx(0.3 / 3, rel=1e-5)
    assert metrics.color_accuracy_mean_abs(image, truth) == pytest.approx(
        1 - 0.25 * 0.9 * 0.3 / 3, rel=1e-5
    )
    assert metrics.root_mean_square_error(image, truth) == pytest.approx(
        np.sqrt(0.25 / 3) * 0.9 * 0.3, rel=1e-5
    )


def test_wrong_silhouette_is_no_error_of_color() -> None:
    truth = _colored((0.9, 0.2, 0.1))
    image = _colored((0.9, 0.2, 0.1), slice(16, 32))

    assert metrics.color_silhouette_iou(image, truth) == 0.5
    assert metrics.color_error(image, truth) == 0.0
    assert np.isnan(metrics.color_error(np.zeros_like(truth), truth)).all()


def test_channel_below_black_is_black() -> None:
    black = _colored((0.9, 0.2, 0.0))
    below = _colored((0.9, 0.2, 0.0))
    below[:, 2, 16:48, 16:48] = 0.03  # below black is black

    assert metrics.color_error(below, black) == 0.0


def test_color_metrics_do_not_depend_on_channel_order() -> None:
    generator = np.random.default_rng(0)
    image, truth = generator.random((2, 4, 3, 64, 64), dtype=np.float32)
    turned = metrics.color_metrics(image[:, [2, 0, 1]], truth[:, [2, 0, 1]])
    for name, value in metrics.color_metrics(image, truth).items():
        np.testing.assert_allclose(value, turned[name], rtol=1e-12)

    np.testing.assert_array_equal(
        metrics.brightness(image), metrics.brightness(image[:, [2, 0, 1]])
    )


@pytest.mark.parametrize(("share", "weight"), [(0.75, 1.0), (0.75, 4.0), (0.25, 2.0)])
def test_squared_error_is_least_at_weighted_mean(share: float, weight: float) -> None:
    v = 0.6
    truth = torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = v
    best = weight * share * v / (1 - share + weight * share)
    losses = [
        image_error(torch.full_like(truth, best + off), truth, weight).item()
        for off in (-0.01, 0.0, 0.01)
    ]

    assert min(losses) == losses[1]
    assert losses[0] == pytest.approx(losses[2], rel=1e-4)


@pytest.mark.parametrize(
    ("share", "weight", "best"), [(0.75, 1.0, 0.6), (0.25, 1.0, 0.0), (0.25, 4.0, 0.6)]
)
def test_absolute_error_is_least_at_weighted_median(
    share: float, weight: float, best: float
) -> None:
    truth = torch.zeros(4, 1, 8, 8)
    truth[: round(4 * share)] = 0.6
    losses = {
        v: image_error(torch.full_like(truth, v), truth, weight, "absolute").item()
        for v in (0.0, 0.2, 0.4, 0.6)
    }

    assert min(losses, key=lambda v: losses[v]) == best


@pytest.mark.parametrize("kind", ["squared", "absolute"])
def test_image_error_sums_pixels_and_averages_samples(kind: ImageLoss) -> None:
    generator = torch.Generator().manual_seed(0)
    image, truth = (torch.rand(2, 3, 64, 64, generator=generator) for _ in range(2))
    truth *= truth.amax(1, keepdim=True) > 0.5
    channels = sum(image_error(image[:, [k]], truth[:, [k]], 2.0, kind) for k in range(3))

    torch.testing.assert_close(image_error(image, truth, 2.0, kind), channels)

    image = torch.zeros(2, 1, 64, 64)
    truth = torch.zeros(2, 1, 64, 64)
    image[0, 0, 3, 4] = 1.0
    image[0, 0, 5, 6] = 0.5

    assert image_error(image, truth).item() == pytest.approx((1 + 0.25) / 2)
    assert image_error(torch.ones(1, 1, 64, 64, dtype=torch.bfloat16), truth[:1]).item() == 4096


@pytest.mark.parametrize(
    ("done", "share"), [(0.0, 0.0), (0.2, 0.0), (0.25, 0.25), (0.3, 0.5), (0.4, 1.0), (1.0, 1.0)]
)
def test_variational_share_rises_after_warm_up(done: float, share: float) -> None:
    assert variational_share(done, warm_up=0.2) == pytest.approx(share)
    assert variational_share(done, warm_up=0.0) == 1.0


@pytest.mark.parametrize(("mean", "spread"), [(0.0, 1.0), (2.0, 2.0), (-0.5, 0.25)])
def test_kl_divergence_matches_closed_form(mean: float, spread: float) -> None:
    normal = torch.distributions.Normal
    entries = torch.ones(3, 256)
    expected = (
        256 * torch.distributions.kl_divergence(normal(mean, spread), normal(0.0, 1.0)).item()
    )
    found = kl_divergence(mean * entries, (spread**2 * entries).log()).item()

    assert found == pytest.approx(expected, rel=1e-5)
    assert (found == 0) == (mean == 0)


def test_latent_error_is_weighted_by_encoder_variance() -> None:
    latent = torch.ones(1, 2)
    mean = torch.zeros(1, 2)
    sure = torch.full((1, 2), 0.25).log()
    unsure = torch.full((1, 2), 4.0).log()

    assert latent_error(latent, mean, sure).item() == pytest.approx(2 / 0.25)
    assert latent_error(latent, mean, unsure).item() == pytest.approx(2 / 4)
    assert latent_error(mean, mean, sure).item() == 0


@pytest.mark.parametrize("limit", [-10.0, 10.0])
@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16, torch.float16])
def test_latent_losses_stay_finite_at_log_variance_limits(
    limit: float, precision: torch.dtype
) -> None:
    mean = torch.full((2, 256), 3.0, dtype=precision)
    log_variance = torch.full((2, 256), limit, dtype=precision)
    for value in (kl_divergence(mean, log_variance), latent_error(-mean, mean, log_variance)):
        assert value.dtype == torch.float32
        assert torch.isfinite(value)
