"""What the relay wall's own pattern (grain, paint, dirt) does to the light of each pixel: a factor that stays.

The wall reflects a beam's direct return, and the first bounce of all its three-bounce paths, at one and the same point:
its reflectance there is a factor of the whole echo, and changes no winner (S1, S2, S5). Third bounces come from the
whole relay wall, whose texture they average: that is left out, as is any gloss.
"""

import numpy as np

from nlos_cam.frames import Float32
from nlos_cam.render.sensor_bias import patches

TEXTURE_SEED = 3
"""Every wall of ours has the same pattern."""
STAINS, GRAINS = 5, 90
"""Patches across the view: of paint and dirt, and of what is about as small as a cell of the maps."""
EVEN = np.zeros(0, np.float32)


def texture(shape: tuple[int, int], strength: float) -> Float32:
    """What each pixel (n,) of an image (height, width) receives of an even wall's light, 1 on average.

    `strength` is the standard deviation of its logarithm, whose variance is half of stains, half of grain. Empty for
    an even wall.
    """
    if not strength:
        return EVEN
    generator = np.random.default_rng(TEXTURE_SEED)
    pattern = patches(shape, generator, STAINS) + patches(shape, generator, GRAINS)
    factor = np.exp(strength * (pattern - pattern.mean()) / pattern.std())
    return (factor / factor.mean()).astype(np.float32).ravel()
