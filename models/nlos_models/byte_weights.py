"""Weights stored in a byte each: a quarter of float32, half of float16.

Every GROUP weights of a row share a scale, so that one large weight does not round its whole row.
Only storage changes: networks compute in float32 (see docs/decisions).
"""

import numpy as np

from nlos_models.arrays import Float32, Int8

GROUP = 64
"""Weights that share a scale: of 32 bits, so that a weight takes 8.5."""
LARGEST = 127
MIN_WEIGHTS = 4096
"""Of a tensor from which on bytes are worth their scales."""
SCALE = ".scale"
"""Ending of the name of a tensor's scales."""


def fits_bytes(shape: tuple[int, ...]) -> bool:
    """Return True for a weight's shape that is stored in bytes: large, in rows of whole groups."""
    # Biases and norms are few, and a network is more sensitive to them than to single weights.
    size = int(np.prod(shape))
    return len(shape) > 1 and size >= MIN_WEIGHTS and (size // shape[0]) % GROUP == 0


def to_bytes(weight: Float32) -> tuple[Int8, Float32]:
    """Return a weight in bytes, of the same shape, and its scales (groups, 1).

    Rounding moves a weight by at most half a scale: 1/254 of the largest of its group.
    """
    groups = weight.reshape(-1, GROUP)
    # Scales stay in float32: those of small weights, some 1e-5, have few bits left in float16.
    # Symmetric about 0, so that a weight of nothing stays nothing.
    scale = np.abs(groups).max(axis=1, keepdims=True) / np.float32(LARGEST)

    # a group of zeros has no scale; any serves
    safe = np.where(scale > 0, scale, np.float32(1.0))
    rounded = np.clip(np.rint(groups / safe), -LARGEST, LARGEST).astype(np.int8)
    return rounded.reshape(weight.shape), scale.astype(np.float32)


def from_bytes(stored: Int8, scale: Float32) -> Float32:
    """Return the weight of `to_bytes`. Raises ValueError where the scales do not fit."""
    groups = stored.reshape(-1, GROUP).astype(np.float32)
    if scale.shape != (len(groups), 1):
        raise ValueError(f"{scale.shape} scales for {len(groups)} groups of {GROUP} weights")
    return (groups * scale).reshape(stored.shape)
