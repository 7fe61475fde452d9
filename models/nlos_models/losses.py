"""Losses of VAE and compressor. SI states no reduction: here pixels and latent entries are summed, samples averaged."""

import torch
from torch import Tensor

from nlos_models.recipe import ImageLoss


def image_error(image: Tensor, truth: Tensor, surface_weight: float = 1.0, kind: ImageLoss = "squared") -> Tensor:
    """Return the error of images (n, channels, 64, 64), summed over pixels and channels, averaged over the batch.

    Suppose that a pixel is a surface at v with probability p, else background (0), and that w is `surface_weight`. The
    expected squared error p w (x - v)^2 + (1 - p) x^2 is least at x = w p v / (1 - p + w p): for w = 1 at p v, so that
    an uncertain outline looks like a larger distance, less so for w > 1. The expected absolute error is least at x = v
    where w p > 1 - p and at x = 0 elsewhere: the outline stays sharp.
    """
    truth = truth.float()
    off = image.float() - truth
    error = off.square() if kind == "squared" else off.abs()
    return torch.where(truth > 0, surface_weight * error, error).sum((1, 2, 3)).mean()


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return KL(q || N(0, 1)) of latents (n, latent), summed over entries, averaged over the batch.

    For q = N(m, s^2) each entry has (m^2 + s^2 - 1 - log s^2) / 2 (Kingma and Welling, 2013, appendix B).
    """
    mean, log_variance = mean.float(), log_variance.float()
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()


def variational_share(done: float, warm_up: float) -> float:
    """Return the weight of a VAE's noise and divergence after a share `done` of its run: 1 without a warm-up.

    With one, the VAE is a plain autoencoder for that share of the run; over an equal share the weight then rises to 1.
    """
    return min(1.0, max(0.0, done / warm_up - 1)) if warm_up else 1.0


def latent_error(latent: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return the squared error of latents (n, latent) in units of the encoder's variance, averaged over the batch.

    Entries that the encoder leaves close to its prior have a variance near 1 and weigh little.
    """
    weight = torch.exp(-log_variance.float()).clamp(max=100.0)
    return (weight * (latent.float() - mean.float()).square()).sum(1).mean()
