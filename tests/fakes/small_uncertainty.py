"""Untrained uncertainty network on disk beside random bytes as its pipeline's weights, and small training
sets.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from fake_uncertainty import RECIPE
from nlos_models.records import WATCHED, UncertaintyRecord, checksum_of_watched
from nlos_models.training.uncertainty import UncertaintySet
from nlos_models.uncertainty_network import UncertaintyNetwork, save_uncertainty_network

DARK_V = 0.3


def watched_weights(folder: Path) -> Path:
    """Write files of random bytes named like a pipeline's."""
    folder.mkdir()
    generator = np.random.default_rng(0)
    for name in (*WATCHED, "checkpoint.json"):
        (folder / name).write_bytes(generator.bytes(64))
    return folder


def untrained_uncertainty(folder: Path, watched: Path, seed: int = 0) -> UncertaintyRecord:
    """Write a uncertainty network of random weights whose batch norms hold statistics."""
    torch.manual_seed(seed)
    network = UncertaintyNetwork()
    with torch.no_grad():
        for _ in range(3):
            network.train()(
                torch.rand(4, 64, 80), 40 * torch.rand(4, 64, 80), torch.rand(4, 64, 64)
            )
    facts: dict[str, Any] = {
        "watches": checksum_of_watched(watched),
        "recipe": RECIPE,
        "learnt": ["small"],
    }
    facts |= {
        "temperatures": (0.5, 2.0),
        "error_scale": 1.5,
        "nothing_above": 0.4,
        "outside_above": 0.3,
    }
    record = UncertaintyRecord(**facts)
    save_uncertainty_network(folder, network.eval(), record, watched)
    return record


def small_uncertainty_set(count: int, seed: int) -> UncertaintySet:
    """Return squares: half of the samples are empty, half of the others are outside the trained
    range and brighter.

    Maps show the truth in their middle; images are the truth, with an error of 0.1 for dark squares
    (v = 0.3).
    """
    generator = np.random.default_rng(seed)
    truth = np.zeros((count, 64, 64), np.float16)
    intensity = np.full((count, 64, 80), 10.0, np.float32)
    nothing = np.arange(count) % 4 < 2
    outside = np.arange(count) % 4 == 3
    for k in np.flatnonzero(~nothing):
        row, column = generator.integers(2, 40, 2)
        truth[k, row : row + 20, column : column + 20] = DARK_V if generator.random() < 0.5 else 0.8
        intensity[k, row : row + 20, column + 8 : column + 28] += 20.0 if outside[k] else 5.0
    made = np.where(truth > 0, truth + np.where(truth < 0.5, 0.1, 0.01), 0.0).astype(np.float16)
    return UncertaintySet(
        np.full((count, 64, 80), 0.3, np.float32), intensity, made, truth, nothing, outside
    )
