"""Losses of the VAE, the compressor and the direct network.

The supporting information states no reduction of its losses: here pixels and latent entries are
summed, samples averaged, so that the weight of the divergence does not depend on the batch.
"""

import torch
from torch import Tensor
from torch.nn import functional

from nlos_models.metrics import MIN_V
from nlos_models.training.recipe import ImageLoss

MAX_PRECISION = 100.0
"""Largest weight of a latent entry: one over the smallest variance that is believed."""
OVERLAP_WEIGHT = 0.5
DEPTH_WEIGHT = 2.0


def image_error(
    image: Tensor, truth: Tensor, surface_weight: float = 1.0, kind: ImageLoss = "squared"
) -> Tensor:
    """Return the error of images (n, channels, 64, 64), summed over pixels and channels, averaged
    over the batch.

    Suppose that a pixel is a surface at v with probability p, else background (0), and that w is
    `surface_weight`. The expected squared error p w (x - v)^2 + (1 - p) x^2 is least at x = w p v /
    (1 - p + w p): for w = 1 at p v, so that an uncertain outline looks like a larger distance, less
    so for w > 1. The expected absolute error is least at x = v where w p > 1 - p and at x = 0
    elsewhere: the outline stays sharp.
    """
    # Sums over 4096 pixels lose digits in bfloat16, so that the loss is in float32 in any case.
    truth = truth.float()
    off = image.float() - truth
    error = off.square() if kind == "squared" else off.abs()
    weighted = torch.where(truth > 0, surface_weight * error, error)
    return weighted.sum((1, 2, 3)).mean()


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return KL(q || N(0, 1)) of latents (n, latent), summed over entries, averaged over the batch.

    For q = N(m, s^2) each entry has (m^2 + s^2 - 1 - log s^2) / 2 (Kingma and Welling, 2013,
    appendix B).
    """
    mean = mean.float()
    log_variance = log_variance.float()
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1).mean()


def variational_share(done: float, warm_up: float) -> float:
    """Return the weight of a VAE's noise and divergence after a share `done` of its run: 1 without
    a warm-up.

    With one, the VAE is a plain autoencoder for that share of the run; over an equal share the
    weight then rises to 1.
    """
    # From the first step on, the divergence would drive most entries to the prior before the
    # decoder has found a use for them ("posterior collapse"); an autoencoder uses them all.
    return min(1.0, max(0.0, done / warm_up - 1)) if warm_up else 1.0


def latent_error(latent: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return the squared error of latents (n, latent) in units of the encoder's variance, averaged
    over the batch.

    Entries that the encoder leaves close to its prior have a variance near 1 and weigh little.
    """
    # Up to a constant, twice the negative log-likelihood of the compressor's answer under the
    # encoder's posterior N(mean, variance). An entry of nearly no variance would have all weight,
    # so that the weight is bounded.
    weight = torch.exp(-log_variance.float()).clamp(max=MAX_PRECISION)
    return (weight * (latent.float() - mean.float()).square()).sum(1).mean()


def two_heads_error(logits: Tensor, truth: Tensor) -> Tensor:
    """Return the loss of logits (n, 2, 64, 64) against images (n, 64, 64): cross-entropy, overlap
    and depth.

    Cross-entropy of the silhouette, plus 0.5 (1 - soft intersection over union), plus 2 times the
    absolute error of v over the surface; each is a mean over pixels or objects. In color, (n, 4,
    64, 64) against (n, 3, 64, 64), the error of v is the mean of three.
    """
    logits = logits.float()
    truth = truth.float() if truth.dim() == 4 else truth.float()[:, None]
    occupied = logits[:, 0]  # (n, 64, 64)
    values = logits[:, 1:]  # (n, 1 or 3, 64, 64)
    surface = (truth > 0).any(1).float()

    # The cross-entropy makes the probabilities honest, which the cut and the quality model need.
    # Averaged over pixels it hardly sees a small object, so that the measure that counts, the
    # overlap, enters too; +1 keeps its gradient finite for an empty image.
    entropy = functional.binary_cross_entropy_with_logits(occupied, surface)
    share = torch.sigmoid(occupied)
    both = (share * surface).sum((1, 2))
    one = (share + surface - share * surface).sum((1, 2))
    overlap = (both + 1) / (one + 1)

    # The absolute error, whose best answer is the median: a depth between two possible surfaces
    # would be neither. It is a mean over surface pixels alone, of the whole batch, so that large
    # and small objects have the same weight a pixel.
    off = (MIN_V + (1 - MIN_V) * torch.sigmoid(values) - truth).abs().mean(1) * surface
    depth = off.sum() / surface.sum().clamp(min=1)
    return entropy + OVERLAP_WEIGHT * (1 - overlap).mean() + DEPTH_WEIGHT * depth
