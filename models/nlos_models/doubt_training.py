"""Training of an uncertainty ("doubt") network on a pipeline's images of ordinary objects, empty
benches and outliers, and its calibration: temperatures, error scale and thresholds, fitted on
held-out maps.

And fit of the quality model that watches its answers, judged on kinds of objects that were left out
of the fit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from nlos_models.arrays import Float16, Float32, Float64, Int64, Mask
from nlos_models.data import flip_some, shuffled
from nlos_models.doubt_network import MAX_ERROR_V, MIN_ERROR_V, DoubtNetwork, DoubtOutput
from nlos_models.quality import (
    GOOD_IOU,
    LEVELS,
    OUTPUTS,
    PRECISION,
    QualityEstimate,
    QualityModel,
    QualityRecord,
    normalised,
)
from nlos_models.recipe import Recipe
from nlos_models.tasks import in_channels_last, parts_of
from nlos_models.train import Running, Scores, fit


@dataclass(frozen=True)
class DoubtSet:
    """Maps, the images that a pipeline reconstructed from them, and the ground truth."""

    depth_m: Float32
    """(n, 64, 80): NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80)."""
    made: Float16
    """(n, 64, 64): the pipeline's images."""
    truth: Float16
    """(n, 64, 64): 0 for background."""
    nothing: Mask
    """(n,): nothing is hidden."""
    outside: Mask
    """(n,): out of distribution: the object or its appearance is unlike the pipeline's training
    set.
    """

    def __len__(self) -> int:
        return len(self.nothing)

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "DoubtSet":
        """Return the samples chosen by flags (n,) or by indices."""
        return DoubtSet(**{name: values[chosen] for name, values in vars(self).items()})


class DoubtBatch(NamedTuple):
    """Batch of a `DoubtSet` as float32 tensors."""

    depth_m: Tensor
    intensity: Tensor
    made: Tensor
    truth: Tensor
    nothing: Tensor
    outside: Tensor


def as_doubt_batch(some: DoubtSet) -> DoubtBatch:
    """Return samples as float32 tensors."""
    maps = (some.depth_m, some.intensity)
    images = (some.made, some.truth)
    return DoubtBatch._make(
        torch.from_numpy(a.astype(np.float32)) for a in (*maps, *images, some.nothing, some.outside)
    )


def doubt_batches(
    samples: DoubtSet, batch: int, generator: torch.Generator
) -> Iterator[DoubtBatch]:
    """Yield one epoch, shuffled and mirrored at random."""
    for index in shuffled(len(samples), batch, generator):
        chosen = as_doubt_batch(samples.where(index.numpy()))
        flips = torch.rand(len(index), generator=generator) < 0.5
        yield DoubtBatch._make([*flip_some(list(chosen[:4]), flips), *chosen[4:]])


def doubt_loss(output: DoubtOutput, batch: DoubtBatch) -> Tensor:
    """Return the cross-entropies of both verdicts and of the surface, plus the mean negative
    log-likelihood of errors.

    Errors count where image and truth both have a surface, as Laplace-distributed with scale b:
    -log p(e) is log b + e / b up to a constant, and its mean over e is least where b is the
    expected absolute error.
    """
    cross_entropy = functional.binary_cross_entropy_with_logits
    loss = cross_entropy(output.nothing, batch.nothing) + cross_entropy(
        output.outside, batch.outside
    )
    there = (batch.truth > 0).float()
    loss = loss + cross_entropy(output.surface, there)
    shared = (there > 0) & (batch.made > 0)
    error = (batch.made - batch.truth).abs()[shared]
    log_error = output.log_error.float()[shared].clamp(min=float(np.log(MIN_ERROR_V)))
    if not error.numel():
        return loss
    return loss + (log_error + error * torch.exp(-log_error)).mean()


@torch.inference_mode()
def predict(network: DoubtNetwork, samples: DoubtSet) -> DoubtOutput:
    """Return the raw outputs of a network in eval mode for a whole set, on the CPU."""
    parts = parts_of(np.arange(len(samples)))
    device = next(network.parameters()).device
    outputs = [
        network(*(t.to(device) for t in as_doubt_batch(samples.where(part))[:3])) for part in parts
    ]
    return DoubtOutput(*(torch.cat(values).float().cpu() for values in zip(*outputs, strict=True)))


def train_doubt(
    recipe: Recipe,
    training: DoubtSet,
    held_out: DoubtSet,
    folder: Path,
    running: Running | None = None,
) -> tuple[DoubtNetwork, Scores]:
    """Train an uncertainty network; a second call resumes. Returns it in eval mode, and its
    held-out loss.
    """
    running = running or Running()
    torch.manual_seed(recipe.seed)
    network = DoubtNetwork()
    bare = training.where(training.nothing)
    network.learn_bare(torch.from_numpy(bare.depth_m), torch.from_numpy(bare.intensity))
    network = in_channels_last(network)
    whole = as_doubt_batch(held_out)
    forward = running.maybe_compile(network)

    figures = fit(
        network,
        recipe=recipe,
        steps_per_epoch=len(training) // recipe.batch,
        batches=lambda generator: doubt_batches(training, recipe.batch, generator),
        loss=lambda batch, _: doubt_loss(forward(*batch[:3]), batch),
        score=lambda: {"held_out_loss": float(doubt_loss(predict(network, held_out), whole))},
        folder=folder,
        running=running,
    )
    return network.cpu().eval(), figures


TEMPERATURES = np.geomspace(1.0, 5.0, 65)
"""Candidates, from 1 up: for classes without overlap the likelihood grows down to a temperature of
0.
"""
MAX_FALSE_ALARMS = 0.15
"""Share of ordinary objects that may count as out of distribution, in exchange for finding nine in
ten that are.
"""
MAX_FALSE_OBJECTS = 0.001
"""Share of empty benches that may count as hiding an object: a tenth of the required limit."""


@dataclass(frozen=True)
class Calibration:
    """Fitted fields of `DoubtRecord`."""

    temperatures: tuple[float, float]
    error_scale: float
    nothing_above: float
    outside_above: float


def error_scale(expected: Float64, error: Float64) -> float:
    """Return the factor of expected errors b (n,) under which Laplace-distributed errors e (n,) are
    likeliest.

    The sum of log(f b) + e / (f b) is least at f = mean(e / b).
    """
    return float(np.mean(error / expected))


def temperature(logits: Float64, truth: Mask) -> float:
    """Return the divisor of logits (n,) under which the truth (n,) is likeliest."""
    x = torch.from_numpy(logits)
    y = torch.from_numpy(truth.astype(np.float64))
    losses = [float(functional.binary_cross_entropy_with_logits(x / t, y)) for t in TEMPERATURES]
    return float(TEMPERATURES[int(np.argmin(losses))])


def shared_errors(made: NDArray[np.floating], truth: NDArray[np.floating]) -> tuple[Mask, Float64]:
    """Return the mask of pixels with surface in images (n, 64, 64) and truths, and the errors of v
    there (pixels,).
    """
    shared = (made > 0) & (truth > 0)
    return shared, np.abs(made.astype(np.float64) - truth)[shared]


def calibrate(network: DoubtNetwork, held_out: DoubtSet) -> Calibration:
    """Fit a network's error scale on ordinary objects, and its temperatures and thresholds on all
    samples.

    The set needs ordinary objects, outliers and empty benches.
    """
    output = predict(network, held_out)
    logits = (output.nothing.double(), output.outside.double())
    truths = (held_out.nothing, held_out.outside)
    temperatures = tuple(
        temperature(x.numpy(), truth) for x, truth in zip(logits, truths, strict=True)
    )
    nothing, outside = (_sigmoid(x.numpy() / t) for x, t in zip(logits, temperatures, strict=True))
    usual = ~held_out.nothing & ~held_out.outside
    shared, error = shared_errors(held_out.made[usual], held_out.truth[usual])
    expected = np.exp(output.log_error.numpy()[usual][shared].astype(np.float64)).clip(
        MIN_ERROR_V, MAX_ERROR_V
    )
    return Calibration(
        (temperatures[0], temperatures[1]),
        error_scale(expected, error),
        min(0.5, float(np.quantile(nothing[held_out.nothing], MAX_FALSE_OBJECTS))),
        float(np.quantile(outside[usual], 1 - MAX_FALSE_ALARMS)),
    )


def _sigmoid(logits: Float64) -> Float64:
    return 1 / (1 + np.exp(-logits))


FOLDS = 6
"""Groups of kinds, or of objects, that are left out in turn."""
WIDTH = 32
PASSES = 16
MIN_STEPS = 1200
BATCH = 256
RATE = 5e-3
DECAY = 1e-2
KINDS_WEIGHT = 0.2
"""Of one of the 18 kinds in the quantiles of the IoU; a generic shape counts 1."""
MIN_SPREAD = 1e-4
"""Of a figure that hardly differs between frames; it outlasts the rounding of the record."""
MIN_TRUSTED = 20
"""Fewest frames of left-out objects from which a share of good ones is estimated."""
CONFIDENCE = 1.645
"""Standard deviations of the one-sided 95 % limit (Wilson) that PRECISION is asked of."""


@dataclass(frozen=True)
class QualitySet:
    """Figures and true quality of n reconstructions."""

    figures: Float32
    """(n, FEATURES or WITH_SURFACE)."""
    iou: Float32
    """(n,): silhouette IoU."""
    error_v: Float32
    """(n,): mean absolute error of v where both have a surface; NaN without such a pixel."""
    kind: NDArray[np.str_]
    """(n,)."""
    generic: Mask
    """(n,): a generic shape rather than one of the 18 kinds."""


def families(kind: str) -> set[str]:
    """Return what a kind is composed of: itself, or the families of a carved shape or of a pair."""
    return set(kind.removeprefix("carved ").split(" and "))


def left_out_folds(kinds: Sequence[str]) -> list[tuple[Int64, Int64]]:
    """Return (rows to fit, rows to judge) for each group of kinds: the fit sees no family of the
    group.
    """
    of_row = [families(kind) for kind in kinds]
    every = sorted(set().union(*of_row))
    folds: list[tuple[Int64, Int64]] = []
    for number in range(min(FOLDS, len(every))):
        group = set(every[number::FOLDS])
        fitted = np.flatnonzero([not group & own for own in of_row])
        judged = np.flatnonzero([min(own) in group for own in of_row])
        folds.append((fitted, judged))
    return folds


def left_out_rows(count: int) -> list[tuple[Int64, Int64]]:
    """Return (rows to fit, rows to judge) for each of FOLDS groups of rows at random, the same for
    a count.
    """
    group = np.random.default_rng(0).integers(0, FOLDS, count)
    return [(np.flatnonzero(group != fold), np.flatnonzero(group == fold)) for fold in range(FOLDS)]


def fit_quality(samples: QualitySet, watches: str) -> QualityRecord:
    """Fit a quality model; its threshold comes from objects, its figures from kinds, left out of
    further fits.
    """
    good = samples.iou >= GOOD_IOU
    count = len(samples.iou)
    above = trusted_above(
        QualityEstimate.of(_left_out(samples, left_out_rows(count), watches), None).good,
        good,
        samples.generic,
    )
    outputs = _left_out(samples, left_out_folds(samples.kind.tolist()), watches)
    figures = judged_figures(QualityEstimate.of(outputs, above), samples)
    whole = _fit(samples, np.arange(count), watches)
    return whole.model_copy(update={"trusted_above": above, "figures": figures})


def _left_out(samples: QualitySet, folds: Sequence[tuple[Int64, Int64]], watches: str) -> Float32:
    """Return the outputs (n, OUTPUTS) of models that were fitted without the objects they judge."""
    outputs = np.full((len(samples.iou), OUTPUTS), np.nan, np.float32)
    for fitted, judged in folds:
        outputs[judged] = QualityModel(_fit(samples, fitted, watches)).outputs(
            samples.figures[judged]
        )
    return outputs


def _fit(samples: QualitySet, rows: Int64, watches: str) -> QualityRecord:
    """Return the model of some rows, without a threshold."""
    figures = samples.figures[rows]
    means = figures.mean(0)
    spreads = figures.std(0).clip(min=MIN_SPREAD)
    x = torch.from_numpy(normalised(figures, means, spreads))
    iou = torch.from_numpy(samples.iou[rows])
    error = torch.from_numpy(samples.error_v[rows])
    generic = torch.from_numpy(samples.generic[rows]).float()
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    network = nn.Sequential(
        nn.Linear(x.shape[1], WIDTH),
        nn.ReLU(),
        nn.Linear(WIDTH, WIDTH),
        nn.ReLU(),
        nn.Linear(WIDTH, OUTPUTS),
    )
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    steps = max(MIN_STEPS, PASSES * len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps)
    for _ in range(steps):
        some = torch.randint(0, len(x), (BATCH,), generator=generator)
        loss = quality_loss(network(x[some]), iou[some], error[some], generic[some])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    layers = [torch.cat([layer.weight.T, layer.bias[None]]).detach().numpy() for layer in linear]
    rounded = [np.round(each.astype(np.float64), 5).tolist() for each in (means, spreads, *layers)]
    return QualityRecord(
        watches=watches,
        objects=len(rows),
        means=rounded[0],
        spreads=rounded[1],
        layers=list(rounded[2:]),
    )


def quality_loss(output: Tensor, iou: Tensor, error_v: Tensor, generic: Tensor) -> Tensor:
    """Return the quantile losses of the IoU, the cross-entropies of the probabilities, and the
    error's likelihood.

    In the quantiles one of the 18 kinds counts KINDS_WEIGHT: a user's object is seldom one. Whether
    an outline is good is learnt apart for generic shapes and for the 18 kinds: a confident answer
    is nearly always right on a kind that the networks have learnt, and often wrong on a shape that
    merely looks like one.
    """
    level = torch.tensor(LEVELS)
    off = iou[:, None] - torch.sigmoid(output[:, : len(LEVELS)])
    good = (iou >= GOOD_IOU).float()
    kinds = 1 - generic
    weight = generic + KINDS_WEIGHT * kinds
    loss = (
        10 * (torch.maximum(level * off, (level - 1) * off).mean(1) * weight).sum() / weight.sum()
    )
    shares = (good, generic), (good, kinds), (kinds, torch.ones_like(kinds))
    for logit, (truth, counts) in zip(output[:, len(LEVELS) : -1].unbind(1), shares, strict=True):
        entropy = functional.binary_cross_entropy_with_logits(logit, truth, reduction="none")
        loss = loss + (entropy * counts).sum() / counts.sum().clamp(min=1)
    known = ~torch.isnan(error_v)
    log_error = output[known, -1]
    error = error_v[known]
    return loss + 0.3 * (log_error + error * torch.exp(-log_error)).mean()


def trusted_above(good: Float32, is_good: Mask, generic: Mask) -> float | None:
    """Return the least probability from which on at least PRECISION of each share's frames are
    good; None for none.

    Judged by the lower 95 % limit over all frames, over generic shapes and over the 18 kinds.
    """
    for above in np.unique(good.round(3)):
        chosen = good >= above
        shares = [is_good[chosen & share] for share in (np.ones_like(generic), generic, ~generic)]
        if chosen.sum() >= MIN_TRUSTED and all(
            lower_limit(each) >= PRECISION for each in shares if each.size
        ):
            return float(above)
    return None


def lower_limit(hits: Mask) -> float:
    """Return the lower limit of a share (Wilson)."""
    n = len(hits)
    p = float(hits.mean())
    z = CONFIDENCE
    return (p + z * z / (2 * n) - z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))) / (
        1 + z * z / n
    )


def judged_figures(estimate: QualityEstimate, samples: QualitySet) -> dict[str, float]:
    """Return correlation, error, coverage and trust by share of the data."""
    shares = {
        "all": np.ones_like(samples.generic),
        "kinds": ~samples.generic,
        "generic": samples.generic,
    }
    found = dict[str, float]()
    for name, share in shares.items():
        if share.sum() < 3:
            continue
        predicted_iou = estimate.iou[share]
        iou = samples.iou[share]
        trusted = estimate.trusted[share]
        found[f"{name}_objects"] = float(share.sum())
        found[f"{name}_correlation"] = correlation(predicted_iou[:, 1], iou)
        found[f"{name}_mean_error"] = float(np.abs(predicted_iou[:, 1] - iou).mean())
        found[f"{name}_bias"] = float((predicted_iou[:, 1] - iou).mean())
        found[f"{name}_within_interval"] = float(
            ((iou >= predicted_iou[:, 0]) & (iou <= predicted_iou[:, 2])).mean()
        )
        found[f"{name}_depth_correlation"] = correlation(
            estimate.error_v[share], samples.error_v[share]
        )
        found[f"{name}_good"] = float((iou >= GOOD_IOU).mean())
        found[f"{name}_trusted"] = float(trusted.mean())
        if trusted.any():
            found[f"{name}_trusted_good"] = float((iou[trusted] >= GOOD_IOU).mean())
    return {name: round(value, 4) for name, value in found.items()}


def correlation(one: Float32 | Float64, other: Float32 | Float64) -> float:
    """Return Pearson's correlation where both are known; 0 where either is constant."""
    known = ~(np.isnan(one) | np.isnan(other))
    one = one[known]
    other = other[known]
    return (
        float(np.corrcoef(one, other)[0, 1])
        if known.sum() > 2 and one.std() * other.std() > 0
        else 0.0
    )
