"""Noise of locked differences, and the normalization in which a network sees them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32
from nlos_models import CellNormal
from nlos_models.training import DirectRecipe, MapSet

from nlos_cam import dataset as data
from nlos_cam.adapt.plan import Locked
from nlos_cam.render import SensorModel

LARGEST_SHARE = 0.999
"""Share of the differences that stay below the limit of a normalized cell."""
SEED = 0
MIN_COUNTS = -0.9
"""Lowest difference of counts: its logarithm is taken of 1 more."""


@dataclass(frozen=True)
class LockedNoise:
    """Noise of locked differences: standard deviation (2, 64, 80) in m and counts; NaN where
    nothing returns.
    """

    std: Float32

    @classmethod
    def of(cls, rig: Rig, sensor: SensorModel, locked: Locked) -> "LockedNoise":
        """Return the noise on a rig."""
        return cls(data.difference_noise(rig, sensor, locked.radiometry, locked.frames))

    def added_to(self, maps: MapSet) -> MapSet:
        """Return differences with noise, the same at every call."""
        generator = np.random.default_rng(SEED)
        depth_std_m, counts_std = np.nan_to_num(self.std)
        shape = maps.depth_m.shape
        depth_m = maps.depth_m + depth_std_m * generator.standard_normal(shape)
        counts = maps.intensity + counts_std * generator.standard_normal(shape)
        return replace(
            maps,
            depth_m=depth_m.astype(np.float32),
            intensity=np.maximum(counts, MIN_COUNTS).astype(np.float32),
        )

    def fitted(self, recipe: DirectRecipe, normal: CellNormal, some: MapSet) -> DirectRecipe:
        """Set a normalization to this noise, and return the recipe that draws it at each step.

        Everything is divided by a common multiple k of each cell's noise, so that noise of one
        strength in all cells, 1 / k, is the sensor's. k keeps the strongest of `some` differences
        below the limit of the normalization.
        """
        std = np.where(np.isfinite(self.std) & (self.std > 0), self.std, np.inf)
        differences = np.stack([some.depth_m, some.intensity], 1)
        ratio = np.nan_to_num(np.abs(differences) / std)
        multiple = max(1.0, float(np.quantile(ratio, LARGEST_SHARE)) / normal.limit)
        spread = np.where(np.isfinite(std), multiple * std, 1.0)
        # mirrored maps need the same normalization
        spread = (spread + spread[:, ::-1]) / 2
        normal.median.zero_()
        normal.spread.copy_(torch.from_numpy(spread.astype(np.float32)))
        return recipe.model_copy(
            update={"noise": 1.0 / multiple, "wall_texture": 0.0, "range_offset_m": 0.0}
        )
