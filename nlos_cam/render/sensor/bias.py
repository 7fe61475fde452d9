"""Fixed patterns of the device and of the wall: depth bias of each pixel, and the wall's texture.

Bias is an offset, ripples and drift with temperature, the same for anything in view. Drift is
relative to the warm device: there the common drift is 0 and the patches are complete; at the start
of a warm-up it is the reverse.

Texture (grain, paint, dirt) is a factor of each pixel's light. The wall reflects a beam's direct
return and the first bounce of all its three-bounce paths at one point: its reflectance there is a
factor of the whole echo, and changes no winner (S1, S2, S5). Third bounces come from the whole
relay wall, whose texture they average: not modeled, nor is gloss.
"""

from math import inf

import cv2
import numpy as np
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.render.effects import Plan, included
from nlos_cam.render.sensor.model import SensorModel

BIASES = {
    "range offset": "range_offset_m",
    "ripples": "ripple_m",
    "patchy drift": "patch_drift_m",
    "drift": "drift_m_per_celsius",
}
"""Names of verdicts, with the fields of the model that call for them."""
WAVES = 5.0
"""Number of ripples across the view."""
RIPPLES_SEED = 1
PATCHES_SEED = 2
"""Every simulated device has the same patterns."""
NO_BIAS = np.zeros(0, np.float32)


def ripples(shape: tuple[int, int], waves: float, generator: np.random.Generator) -> Float64:
    """Return a wave (height, width) of amplitude 1 in a random direction, `waves` of it across the
    width.
    """
    # A plane wave sin(k . x + phase) with |k| = 2 pi waves per width.
    rows, columns = np.indices(shape) / shape[1]
    way, phase = generator.uniform(0.0, 2.0 * np.pi, 2)
    return np.sin(2.0 * np.pi * waves * (columns * np.cos(way) + rows * np.sin(way)) + phase)


def smooth_patches(
    shape: tuple[int, int], generator: np.random.Generator, across: int = 12
) -> Float64:
    """Return a smooth pattern (height, width) of standard deviation 1, with about `across` patches
    across the width.
    """
    # White noise on a coarse grid, interpolated by cubics: smooth over about one step of the grid.
    # One step more on each side keeps the interpolation inside.
    height, width = shape
    coarse = generator.standard_normal((across * height // width + 3, across + 3)).astype(
        np.float32
    )
    rows = np.linspace(1, coarse.shape[0] - 2, height)
    columns = np.linspace(1, coarse.shape[1] - 2, width)
    x, y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    pattern = cv2.remap(coarse, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(
        np.float64
    )
    return pattern / pattern.std()


class DepthBias:
    """Depth bias of a device with (height, width) pixels, as far as the verdicts include it."""

    def __init__(self, shape: tuple[int, int], model: SensorModel, verdicts: Plan) -> None:
        offset_m, ripple_m, patch_m, self._per_celsius_m = (
            getattr(model, field) if included(verdicts, name) else 0.0
            for name, field in BIASES.items()
        )
        self._warm_up = model.warm_up
        self._warm_celsius = model.celsius_at(inf)
        self._fixed_m = self._patches_m = NO_BIAS
        if offset_m or ripple_m or patch_m or self._per_celsius_m:
            wave = ripples(shape, WAVES, np.random.default_rng(RIPPLES_SEED))
            self._fixed_m = (ripple_m * wave - offset_m).astype(np.float32).ravel()
        if patch_m:
            # Mean 0 over the view: patches add no common offset.
            pattern = smooth_patches(shape, np.random.default_rng(PATCHES_SEED))
            self._patches_m = (patch_m * (pattern - pattern.mean())).astype(np.float32).ravel()

    def at_m(self, celsius: float | None) -> Float32:
        """Return the bias (n,) of each pixel's depth, at a temperature or in the warm device; empty
        for no bias.
        """
        # fixed + warmth * patches + drift * (T - T_warm), each only if the verdicts include it.
        celsius = self._warm_celsius if celsius is None else celsius
        bias_m = self._fixed_m
        if self._patches_m.size:
            bias_m = bias_m + np.float32(self._warmth(celsius)) * self._patches_m
        if shift_m := self._per_celsius_m * (celsius - self._warm_celsius):
            bias_m = bias_m + np.float32(shift_m)
        return bias_m

    def _warmth(self, celsius: float) -> float:
        """Return 0 at the start of the warm-up, 1 at its end."""
        # Linear in the temperature, as expansion is.
        warm = self._warm_up
        return (
            (celsius - warm.from_celsius) / (warm.to_celsius - warm.from_celsius) if warm else 1.0
        )


TEXTURE_SEED = 3
"""Every simulated wall has the same pattern."""
STAINS = 5
GRAINS = 90
"""Patches across the view: of paint and dirt, and of grain about as small as a cell of the maps."""
EVEN = np.zeros(0, np.float32)


def texture(shape: tuple[int, int], strength: float) -> Float32:
    """Return each pixel's light (n,) relative to that of an even wall, 1 on average; empty for an
    even wall.

    `strength` is the standard deviation of its logarithm, whose variance is half stains, half
    grain.
    """
    if not strength:
        return EVEN
    generator = np.random.default_rng(TEXTURE_SEED)
    pattern = smooth_patches(shape, generator, STAINS) + smooth_patches(shape, generator, GRAINS)
    # A log-normal factor is positive at any strength; divided by its mean it adds no light.
    factor = np.exp(strength * (pattern - pattern.mean()) / pattern.std())
    return (factor / factor.mean()).astype(np.float32).ravel()
