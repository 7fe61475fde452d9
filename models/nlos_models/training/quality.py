"""Fit of the quality model that watches an uncertainty network's answers, judged on kinds of
objects that were left out of the fit.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from nlos_cam.files import write_checked
from nlos_models.arrays import Float32, Float64, Int64, Mask
from nlos_models.quality import (
    GOOD_IOU,
    LEVELS,
    OUTPUTS,
    PRECISION,
    QUALITY,
    QualityEstimate,
    QualityModel,
    QualityRecord,
    normalised,
)

OnFit = Callable[[int, int], None]
"""Called with the fits done and in all."""
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
    # A carved shape or a pair has a family in common with others: rows at random would test a fit
    # on shapes that it has seen.
    of_row = [families(kind) for kind in kinds]
    every = sorted(set().union(*of_row))
    folds: list[tuple[Int64, Int64]] = []
    for number in range(min(FOLDS, len(every))):
        group = set(every[number::FOLDS])
        fitted = np.flatnonzero([not group & own for own in of_row])
        judged = np.flatnonzero([min(own) in group for own in of_row])
        folds.append((fitted, judged))
    return folds


def can_leave_out(kinds: Sequence[str]) -> bool:
    """Return whether objects of these kinds remain for a fit without any group of them."""
    return all(len(fitted) for fitted, _ in left_out_folds(kinds))


def left_out_rows(count: int) -> list[tuple[Int64, Int64]]:
    """Return (rows to fit, rows to judge) for each of FOLDS groups of rows at random, the same for
    a count.
    """
    # The same groups at every fit, so that figures differ by the data alone.
    group = np.random.default_rng(0).integers(0, FOLDS, count)
    return [(np.flatnonzero(group != fold), np.flatnonzero(group == fold)) for fold in range(FOLDS)]


def fit_quality(
    samples: QualitySet, watches: str, on_fit: OnFit = lambda _done, _total: None
) -> QualityRecord:
    """Fit a quality model; its threshold comes from objects, its figures from kinds, left out of
    further fits.

    A fit takes seconds on an idle core, and there are 13: `on_fit` is called after each.
    """
    # The threshold decides about frames of known and of unknown objects alike, so that it comes
    # from objects left out; the figures that are printed are harder, of kinds left out.
    good = samples.iou >= GOOD_IOU
    count = len(samples.iou)
    by_row = left_out_rows(count)
    by_kind = left_out_folds(samples.kind.tolist())
    total = len(by_row) + len(by_kind) + 1
    done = 0

    def fit(rows: Int64) -> QualityRecord:
        nonlocal done
        found = _fit(samples, rows, watches)
        done += 1
        on_fit(done, total)
        return found

    known = QualityEstimate.of(_left_out(samples, by_row, fit), None)
    above = trusted_above(known.good, good, samples.generic)
    outputs = _left_out(samples, by_kind, fit)
    figures = judged_figures(QualityEstimate.of(outputs, above), samples)
    # What is kept has seen all frames; the fits above only measure.
    whole = fit(np.arange(count))
    return whole.model_copy(update={"trusted_above": above, "figures": figures})


def write_quality(folder: Path, record: QualityRecord) -> None:
    """Write a quality model beside the weights that it watches, with its checksum. Raises OSError,
    FileBusyError.
    """
    text = json.dumps(record.model_dump(mode="json"))
    write_checked(folder, {QUALITY: f"{text}\n".encode()})


def _left_out(
    samples: QualitySet,
    folds: Sequence[tuple[Int64, Int64]],
    fit: Callable[[Int64], QualityRecord],
) -> Float32:
    """Return the outputs (n, OUTPUTS) of models that were fitted without the objects they judge."""
    # NaN where no fold judges a row, so that a forgotten one cannot pass as an answer.
    outputs = np.full((len(samples.iou), OUTPUTS), np.nan, np.float32)
    for fitted, judged in folds:
        outputs[judged] = QualityModel(fit(fitted)).outputs(samples.figures[judged])
    return outputs


def _fit(samples: QualitySet, rows: Int64, watches: str) -> QualityRecord:
    """Return the model of some rows, without a threshold."""
    figures = samples.figures[rows]  # (rows, 35 or 54)
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

    # Few figures, a small network, strong decay: the folds below, not the training loss, tell
    # whether it has learnt more than its own frames. A set of any size has at least MIN_STEPS
    # steps, since the rate's cycle needs some hundreds.
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
        layers=rounded[2:],
    )


def quality_loss(output: Tensor, iou: Tensor, error_v: Tensor, generic: Tensor) -> Tensor:
    """Return the quantile losses of the IoU, the cross-entropies of the probabilities, and the
    error's likelihood.

    In the quantiles one of the 18 kinds counts KINDS_WEIGHT: a user's object is seldom one. Whether
    an outline is good is learnt apart for generic shapes and for the 18 kinds: a confident answer
    is nearly always right on a kind that the networks have learnt, and often wrong on a shape that
    merely looks like one.
    """
    # Quantile ("pinball") loss: its mean is least where a share `level` of the IoUs lies below.
    level = torch.tensor(LEVELS)
    off = iou[:, None] - torch.sigmoid(output[:, : len(LEVELS)])  # (b, 3)
    pinball = torch.maximum(level * off, (level - 1) * off).mean(1)
    kinds = 1 - generic
    weight = generic + KINDS_WEIGHT * kinds
    loss = 10 * (pinball * weight).sum() / weight.sum()

    # A good outline on any shape; on one of the 18 kinds; and whether it is such a kind.
    good = (iou >= GOOD_IOU).float()
    shares = (good, generic), (good, kinds), (kinds, torch.ones_like(kinds))
    for logit, (truth, counts) in zip(output[:, len(LEVELS) : -1].unbind(1), shares, strict=True):
        entropy = functional.binary_cross_entropy_with_logits(logit, truth, reduction="none")
        loss = loss + (entropy * counts).sum() / counts.sum().clamp(min=1)

    # Laplace-distributed depth errors, as in `uncertainty_loss`; without a shared pixel, none.
    known = ~torch.isnan(error_v)
    log_error = output[known, -1]
    error = error_v[known]
    return loss + 0.3 * (log_error + error * torch.exp(-log_error)).mean()


def trusted_above(good: Float32, is_good: Mask, generic: Mask) -> float | None:
    """Return the least probability from which on at least PRECISION of each share's frames are
    good; None for none.

    Judged by the lower 95 % limit over all frames, over generic shapes and over the 18 kinds.
    """
    # From low to high: the first threshold that holds trusts most frames.
    for above in np.unique(good.round(3)):
        chosen = good >= above
        if chosen.sum() < MIN_TRUSTED:
            return None
        shares = [is_good[chosen & share] for share in (np.ones_like(generic), generic, ~generic)]
        if all(lower_limit(each) >= PRECISION for each in shares if each.size):
            return float(above)
    return None


def lower_limit(hits: Mask) -> float:
    """Return the lower limit of a share (Wilson 1927)."""
    n = len(hits)
    p = float(hits.mean())
    z = CONFIDENCE

    # The p' that solves |p - p'| = z sqrt(p' (1 - p') / n); it is right for small n and for p near
    # 1, where p - z sqrt(p (1 - p) / n) would say 1 after a few hits in a row.
    center = p + z * z / (2 * n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (center - half) / (1 + z * z / n)


def judged_figures(estimate: QualityEstimate, samples: QualitySet) -> dict[str, float]:
    """Return correlation, error, coverage and trust by share of the data."""
    shares = {
        "all": np.ones_like(samples.generic),
        "kinds": ~samples.generic,
        "generic": samples.generic,
    }
    found = dict[str, float]()
    for name, share in shares.items():
        # A correlation needs three frames.
        if share.sum() < 3:
            continue
        predicted_iou = estimate.iou[share]  # (n, 3)
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
    if known.sum() < 3 or one.std() * other.std() == 0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
