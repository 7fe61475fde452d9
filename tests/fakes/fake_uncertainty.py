"""Fake uncertainty model: returns given probabilities, and keeps its inputs."""

from collections.abc import Callable

import numpy as np
from nlos_models.inference import UncertaintyEstimate
from nlos_models.records import UncertaintyRecord
from nlos_models.training import UncertaintyRecipe

RECIPE = UncertaintyRecipe(
    task="doubt",
    objects=8,
    outliers=4,
    empties=4,
    held_out=4,
    epochs=1,
    batch=4,
    learning_rate=1e-3,
)
Says = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[float, float]]
"""Of maps and an image (n, ...): how probable nothing and outside are."""


class FakeUncertainty:
    def __init__(self, says: Says = lambda *_: (0.0, 0.0), error_v: float = 0.1) -> None:
        self.record = UncertaintyRecord(watches="0123456789ab", recipe=RECIPE, learnt=[])
        self.quality = None
        self.asked: list[tuple[np.ndarray, ...]] = []
        self._says = says
        self._error_v = error_v

    def __call__(
        self, depth_m: np.ndarray, intensity: np.ndarray, image: np.ndarray
    ) -> UncertaintyEstimate:
        self.asked.append((depth_m, intensity, image))
        nothing, outside = (
            np.array([p], np.float32) for p in self._says(depth_m, intensity, image)
        )
        return UncertaintyEstimate(
            nothing, outside, np.full_like(image, self._error_v), (image > 0).astype(np.float32)
        )
