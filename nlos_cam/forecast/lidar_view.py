"""What the lidar would show of one object, against the bench with nothing hidden."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.render import DEPTH_UNIT_M, Scene, Sensor, SensorModel, render
from nlos_cam.report import figure_of, png

EXPOSURES = 64
"""Exposures of the empty bench that a cell's noise is taken from: its error is 9 %."""
MIN_DEPTH_NOISE_M = DEPTH_UNIT_M / 12**0.5
MIN_LIGHT_NOISE = 0.05
"""Smallest noise of a cell, of depth (its rounding) and of counts: a cell that has the same value in
every exposure is not without any."""
SURE = 5.0
"""Change, in standard deviations of the noise, from which on a cell shows the object in one frame: by
noise alone one of 5120 cells does in about twenty frames."""
MIN_RETURNS = EXPOSURES // 2
"""Exposures in which an empty bench's cell must have a return: of fewer its noise is not known."""
SHOWN = 30.0
"""Largest change in the picture, in standard deviations."""


@dataclass(frozen=True)
class LidarView:
    """One exposure of an object on a bench, and how far it is from the empty bench."""

    depth_m: Float32
    """(64, 80); NaN where there is no return."""
    intensity: Float32
    """(64, 80); in counts."""
    depth_change: Float64
    """(64, 80); depth less the empty bench's, in standard deviations of its noise; 0 where either
    has no return, the empty bench's in less than half of its exposures."""
    light_change: Float64
    """(64, 80); of the intensity, likewise."""
    farther_m: float
    """Largest depth less the empty bench's of a cell whose depth shows the object, in meters."""

    @classmethod
    def of(cls, rig: Rig, object_depth_m: Float32, seed: int = 0) -> Self:
        """Return the view of a matt object in the paper's radiometry, with the simulated sensor."""
        sensor = Sensor(rig, SensorModel())
        empty = render(Scene(rig)).multi
        drawn = [sensor.maps(empty, np.random.default_rng([seed, k])) for k in range(EXPOSURES)]
        depths_m, lights = (
            np.stack([getattr(maps, name) for maps in drawn]).astype(np.float64)
            for name in ("depth_m", "intensity")
        )

        one = sensor.maps(
            render(Scene(rig, object_depth_m)).multi, np.random.default_rng([seed, EXPOSURES])
        )
        # a cell whose return drops out now and then still has a mean
        returns = np.ma.masked_invalid(depths_m)
        known = returns.count(0) >= MIN_RETURNS
        farther_m = np.where(known, one.depth_m - returns.mean(0).filled(np.nan), np.nan)
        brighter = one.intensity - lights.mean(0)
        depth_noise_m = np.maximum(returns.std(0).filled(0.0), MIN_DEPTH_NOISE_M)
        light_noise = np.maximum(lights.std(0), MIN_LIGHT_NOISE)

        depth_change = np.nan_to_num(farther_m / depth_noise_m)
        return cls(
            one.depth_m,
            one.intensity,
            depth_change,
            np.where(np.isfinite(farther_m), brighter / light_noise, 0.0),
            float(np.max(farther_m[depth_change >= SURE], initial=0.0)),
        )

    @property
    def cells(self) -> int:
        """Cells that show the object in one frame."""
        return int((self._margin >= SURE).sum())

    @property
    def typical_margin(self) -> float:
        """Median change of these cells, in standard deviations of the noise; 0 without any."""
        margin = self._margin[self._margin >= SURE]
        return float(np.median(margin)) if margin.size else 0.0

    @property
    def _margin(self) -> Float64:
        return np.maximum(np.abs(self.depth_change), np.abs(self.light_change))

    def as_json(self) -> dict[str, Any]:
        """Return the figures without the maps."""
        return {
            "cells": self.cells,
            "typical_margin": round(self.typical_margin, 1),
            "farther_m": round(self.farther_m, 4),
        }

    def words(self) -> str:
        """Return what the lidar would show, in a sentence."""
        if not self.cells:
            return (
                "In one frame the lidar would show nothing of it: every cell is within the noise."
            )
        return (
            f"In one frame the lidar would show it in {self.cells} of 5120 cells, typically by"
            f" {self.typical_margin:.0f} times the noise"
            + (
                f", and up to {1e3 * self.farther_m:.0f} mm behind the wall."
                if self.farther_m
                else ", in infrared alone."
            )
        )

    def picture(self) -> bytes:
        """Return the maps and their changes as a PNG: row 0 is on top, as in the networks' input."""
        figure = figure_of(9.6, 6.0)
        shown = (
            ("depth (m)", self.depth_m, "viridis", None),
            ("infrared (counts)", self.intensity, "gray", None),
            ("depth, change over noise", self.depth_change, "coolwarm", SHOWN),
            ("infrared, change over noise", self.light_change, "coolwarm", SHOWN),
        )
        for axes, (title, values, colors, limit) in zip(
            figure.subplots(2, 2).flat, shown, strict=True
        ):
            low = None if limit is None else -limit
            drawn = axes.imshow(values, cmap=colors, vmin=low, vmax=limit)
            axes.set_title(title)
            axes.set_xticks([])
            axes.set_yticks([])
            figure.colorbar(drawn, ax=axes)
        return png(figure)
