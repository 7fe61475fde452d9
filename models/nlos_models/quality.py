"""Quality of one reconstruction, predicted from its image and uncertainty: overlap of the outline,
and depth error.

A small network in numpy on some fifty figures of the image, of the uncertainty network's answer
and, where the reconstructing network has one, of its own probability of a surface, fitted to
reconstructions of known objects by `train quality` (`uncertainty`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlos_cam.files import TEXT_LIMIT, read_checked
from nlos_models.arrays import Float32, Mask
from nlos_models.errors import CheckpointError, first_problem
from nlos_models.quality_figures import (
    FEATURES,
    WITH_SURFACE,
    UncertaintyEstimate,
    quality_features,
)
from nlos_models.records import UNCERTAINTY, UNCERTAINTY_RECORD, checksum_of_watched

QUALITY = "quality.json"
UNCERTAINTY_FILES = f"{UNCERTAINTY}.safetensors", UNCERTAINTY_RECORD
GOOD_IOU = 0.75
PRECISION = 0.9
"""A frame is trusted where its silhouette IoU is at least the first in at least the second of like
frames.
"""
LEVELS = 0.1, 0.5, 0.9
"""Quantiles of the predicted IoU."""
OUTPUTS = len(LEVELS) + 4
"""Logits of the IoU's quantiles, of a good outline on any shape and on one of the 18 kinds, and of
such a kind; then the logarithm of the depth error. Older records have two fewer:
they lack those on kinds."""
KINDS_ODDS = 0.03
"""Factor on the fit's odds of one of the 18 kinds: a user's object is seldom one, and the networks
read kinds into other shapes."""
CLIP = 4.0
"""Limit of a normalised figure, in spreads: a strange frame is not extrapolated to."""


class QualityRecord(BaseModel):
    """Weights of a quality model, and what it was fitted to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    watches: str
    """Checksum of the files of the uncertainty network whose answers it takes."""
    objects: int
    means: list[float]
    spreads: list[float]
    layers: list[list[list[float]]]
    """Each layer (inputs + 1, outputs), the last row its bias, with ReLU between layers."""
    trusted_above: float | None = None
    """Least probability of a good outline from which on a frame is trusted; None: no frame is."""
    figures: dict[str, float] = Field(default_factory=dict)
    """Of frames whose kind was left out of the fit, by share of the data."""


@dataclass(frozen=True)
class QualityEstimate:
    """Predicted quality of n reconstructions."""

    iou: Float32
    """(n, 3): quantiles of the silhouette IoU at LEVELS, rising."""
    good: Float32
    """(n,): probability that the IoU is at least GOOD_IOU, for an object that is seldom one of the
    18 kinds.
    """
    error_v: Float32
    """(n,): expected mean absolute error of v where image and truth both have a surface."""
    trusted: Mask
    """(n,)."""

    @classmethod
    def of(cls, outputs: Float32, trusted_above: float | None) -> Self:
        """Return the estimate of a model's outputs (n, OUTPUTS); without a threshold no frame is
        trusted.
        """
        # Three quantiles fitted apart may cross; sorted they are at least as near (Chernozhukov
        # et al. 2010).
        iou = np.sort(_sigmoid(outputs[:, : len(LEVELS)]), 1)
        good = _sigmoid(outputs[:, len(LEVELS)])
        if outputs.shape[1] == OUTPUTS:
            # Law of total probability over "is one of the 18 kinds". The fit's set has many
            # kinds, a user's bench few: prior odds times KINDS_ODDS is an addition to the logit
            # (Saerens et al. 2002).
            of_kind = _sigmoid(outputs[:, -3])
            known = _sigmoid(outputs[:, -2] + np.float32(np.log(KINDS_ODDS)))
            good = (known * of_kind + (1 - known) * good).astype(np.float32)
        return cls(
            iou,
            good,
            np.exp(outputs[:, -1]),
            good >= (np.inf if trusted_above is None else trusted_above),
        )


class QualityModel:
    """Quality model that is ready to run."""

    def __init__(self, record: QualityRecord) -> None:
        self.record = record
        self._means, self._spreads, *self._layers = (
            np.asarray(each, np.float32) for each in (record.means, record.spreads, *record.layers)
        )

    def __call__(
        self, image: Float32, estimate: UncertaintyEstimate, surface: Float32 | None = None
    ) -> QualityEstimate:
        """Return the quality of images (n, 64, 64) in v with their uncertainty.

        A model that was fitted with a network's probability of a surface takes the estimate's where
        none is given.
        """
        if len(self._means) == FEATURES:
            surface = None
        elif surface is None:
            surface = estimate.p_surface
        figures = quality_features(image, estimate, surface)
        return QualityEstimate.of(self.outputs(figures), self.record.trusted_above)

    def outputs(self, figures: Float32) -> Float32:
        """Return the network's outputs (n, OUTPUTS) for figures of n frames."""
        x = normalised(figures, self._means, self._spreads)
        for number, layer in enumerate(self._layers):
            # ReLU before each layer but the first; the last row of a layer is its bias.
            x = (np.maximum(x, 0.0) if number else x) @ layer[:-1] + layer[-1]
        return x


def normalised(figures: Float32, means: Float32, spreads: Float32) -> Float32:
    """Return figures (n, k) in spreads from the mean, clipped."""
    return ((figures - means) / spreads).clip(-CLIP, CLIP)


def _sigmoid(x: Float32) -> Float32:
    return (1 / (1 + np.exp(-x.clip(-30.0, 30.0)))).astype(np.float32)


def load_quality_model(folder: Path) -> QualityModel | None:
    """Load the quality model beside a checkpoint's weights; None where there is none.

    Raises CheckpointError where it cannot be read or was fitted to another uncertainty network.
    """
    path = folder / QUALITY
    if not path.exists():
        return None
    advice = "fit it again with `train quality`, or remove it"
    try:
        record = QualityRecord.model_validate_json(read_checked(path, TEXT_LIMIT))
    except ValidationError as error:
        raise CheckpointError(f"{path} is not a quality model: {first_problem(error)}") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}): {advice}") from error
    if not _fits(record):
        raise CheckpointError(f"{path} has layers that do not fit each other: {advice}")
    if record.watches != (found := checksum_of_watched(folder, UNCERTAINTY_FILES)):
        other = f"another uncertainty network ({record.watches}, not {found})"
        raise CheckpointError(f"{path} was fitted to {other}: {advice}")
    return QualityModel(record)


def _fits(record: QualityRecord) -> bool:
    """Return True if the layers take the normalised figures, and each the outputs of the one
    before.
    """
    sizes: Sequence[tuple[int, ...]] = []
    try:
        sizes = [np.asarray(layer, np.float32).shape for layer in record.layers]
    except ValueError:  # rows of different lengths
        return False
    inputs = len(record.means)
    if (
        not sizes
        or inputs not in {FEATURES, WITH_SURFACE}
        or inputs != len(record.spreads)
        or min(record.spreads) <= 0
    ):
        return False
    for size in sizes:
        if len(size) != 2 or size[0] != inputs + 1:
            return False
        inputs = size[1]
    return inputs in {OUTPUTS, OUTPUTS - 2}
