"""The losses of the two steps. SI states neither reduction: pixels and latent entries are summed, samples averaged."""

import torch
from torch import Tensor

from nlos_models.recipe import ImageLoss


def image_error(image: Tensor, truth: Tensor, surface_weight: float = 1.0, kind: ImageLoss = "squared") -> Tensor:
    """Error of images (n, channels, 64, 64): summed over pixels and channels, averaged over the batch.

    What is surface with probability p at v is, by squared error, best answered with w p v / (1 - p + w p), where w is
    `surface_weight`: at 1 doubt of the outline is told as distance, above it less so. By absolute error it is best
    answered with v where w p > 1 - p and with 0 elsewhere: doubt stays doubt.
    """
    truth = truth.float()
    off = image.float() - truth
    error = off.square() if kind == "squared" else off.abs()
    return torch.where(truth > 0, surface_weight * error, error).sum((1, 2, 3)).mean()


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(q || N(0, 1)) of latents (n, latent): summed over entries, averaged over the batch."""
    mean, log_variance = mean.float(), log_variance.float()
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()


def variational_share(done: float, warm_up: float) -> float:
    """How much of its noise and divergence a VAE has when such a share of its run is done: all, without a warm-up.

    With one it begins as a plain autoencoder, for that share of the run; both then rise evenly over as much again.
    """
    return min(1.0, max(0.0, done / warm_up - 1)) if warm_up else 1.0


def latent_error(latent: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Squared error of latents (n, latent) in units of the encoder's own doubt, so that empty entries weigh little."""
    weight = torch.exp(-log_variance.float()).clamp(max=100.0)
    return (weight * (latent.float() - mean.float()).square()).sum(1).mean()
