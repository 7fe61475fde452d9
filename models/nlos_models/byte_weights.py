"""Weights stored in a byte each: a quarter of float32, half of float16.

Neighbors in a row share a scale, so that one large weight does not round its whole row. Only
storage changes: networks compute in float32 (see docs/decisions).
"""

import numpy as np

from nlos_models.arrays import Float16, Float32, Int8

GROUPS = 64, 32
"""Weights that share a scale of 16 bits, so that a weight takes 8.25 bits; 32 in rows that do not
divide by 64."""
LARGEST = 127
MIN_WEIGHTS = 4096
"""Of a tensor from which on bytes are worth their scales."""
SCALE = ".scale"
"""Ending of the name of a tensor's scales."""


def fits_bytes(shape: tuple[int, ...]) -> bool:
    """Return True for a weight's shape that is stored in bytes: large, in rows of whole groups."""
    # Biases and norms are few, and a network is more sensitive to them than to single weights.
    size = int(np.prod(shape))
    return len(shape) > 1 and size >= MIN_WEIGHTS and (size // shape[0]) % GROUPS[-1] == 0


def to_bytes(weight: Float32) -> tuple[Int8, Float16]:
    """Return a weight in bytes, of the same shape, and its scales (groups, 1).

    Rounding moves a weight by at most half a scale: about 1/254 of the largest of its group.
    """
    row = weight.size // len(weight)
    groups = weight.reshape(-1, next(each for each in GROUPS if row % each == 0))
    # Symmetric about 0, so that a weight of nothing stays nothing.
    exact = np.abs(groups).max(axis=1, keepdims=True) / np.float32(LARGEST)
    # Rounded up: with a scale that is too small the largest weight would be cut off.
    near = exact.astype(np.float16)
    up = np.nextafter(near, np.float16(np.inf))
    scale = np.where(near.astype(np.float32) < exact, up, near)

    # a group of zeros has no scale; any serves
    safe = np.where(scale > 0, scale, np.float16(1.0)).astype(np.float32)
    rounded = np.clip(np.rint(groups / safe), -LARGEST, LARGEST).astype(np.int8)
    return rounded.reshape(weight.shape), scale


def group_of(stored: Int8, scale: Float16 | Float32) -> int:
    """Return the number of weights that share a scale. Raises ValueError where the scales do not
    fit.
    """
    for group in GROUPS:
        if scale.shape == (stored.size // group, 1) and stored.size % group == 0:
            return group
    raise ValueError(f"{scale.shape} scales for {stored.size} weights")


def from_bytes(stored: Int8, scale: Float16 | Float32) -> Float32:
    """Return the weight of `to_bytes`; earlier files have scales of 32 bits. Raises ValueError as
    `group_of`.
    """
    groups = stored.reshape(-1, group_of(stored, scale)).astype(np.float32)
    return (groups * scale.astype(np.float32)).reshape(stored.shape)
