"""A few images of plates, and maps that show them as no lidar would: enough for a network to learn from."""

import numpy as np
from nlos_models.data import Half, MapSet


def small_images(count: int, seed: int) -> Half:
    """Images (n, 64, 64): one bright square each."""
    generator, images = np.random.default_rng(seed), np.zeros((count, 64, 64), np.float16)
    for image in images:
        row, column = generator.integers(8, 30, 2)
        image[row : row + 24, column : column + 24] = generator.uniform(0.3, 1)
    return images


def small_maps(count: int, seed: int) -> MapSet:
    """The same images, and maps (n, 64, 80) in which they are to be seen; no return beside them."""
    images = small_images(count, seed)
    intensity = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8))) * 50
    depth = np.where(intensity > 0, intensity / 100, np.float32(np.nan)).astype(np.float32)
    return MapSet(depth, intensity, images)
