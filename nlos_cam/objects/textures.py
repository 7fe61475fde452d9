"""What a seed paints a hidden object with, and the image of its albedo (simulation only: the L515 sees no colour)."""

from collections.abc import Callable, Sequence
from colorsys import hsv_to_rgb
from typing import NamedTuple

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_models import BLACK_V
from numpy.typing import NDArray

SATURATION, VALUE = (0.5, 0.9), (0.7, 1.0)
"""Of colours, as hue, saturation and value have them: no surface is so dark that it passes for background."""
TEXTURE_STREAM = 3
"""Keeps a texture's random numbers apart from those of its object's shape, noise and rig."""

Generator = np.random.Generator


class Coat(NamedTuple):
    """What an object is painted with."""

    texture: str
    albedo: Float32
    """(64, 64, 3) in red, green and blue; background cells have one too, which nothing sees."""


def painted(seed: int, depth_m: Float32, textures: Sequence[str]) -> Coat:
    """One of the textures in random colours, on an object's depth map (64, 64); the seed decides all."""
    generator = np.random.default_rng([seed, TEXTURE_STREAM])
    texture = str(generator.choice(list(textures)))
    return Coat(texture, TEXTURES[texture](generator, depth_m).astype(np.float32))


def image_from_albedo(albedo: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Float32:
    """Albedo (64, 64, 3) as v (3, 64, 64): 0 where depth (64, 64) is NaN, else 0.1 (black) to 1 in each channel."""
    v = np.moveaxis(BLACK_V + (1 - BLACK_V) * np.asarray(albedo), -1, 0)
    return np.where(np.isnan(depth_m), 0.0, v).astype(np.float32)


def _colours(generator: Generator, count: int) -> Float64:
    """Colours (count, 3) whose hues lie apart."""
    hues = (generator.uniform() + (np.arange(count) + generator.uniform(-0.2, 0.2, count)) / count) % 1.0
    return np.array([hsv_to_rgb(hue, generator.uniform(*SATURATION), generator.uniform(*VALUE)) for hue in hues])


def _grid(n: int) -> tuple[Float64, Float64]:
    """How far right and how far up each cell of an image lies, from -1 to 1."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(1, -1, n))
    return x, y


def _along(generator: Generator, n: int) -> Float64:
    """How far each cell lies along a random direction, from about -1 to 1."""
    (x, y), angle = _grid(n), generator.uniform(0, np.pi)
    return x * np.cos(angle) + y * np.sin(angle)


def _plain(generator: Generator, depth_m: Float32) -> Float64:
    """One colour all over."""
    return np.broadcast_to(_colours(generator, 1)[0], (*depth_m.shape, 3))


def _patches(generator: Generator, depth_m: Float32) -> Float64:
    """Parts side by side, each in its colour: a cell takes that of the nearest of some points."""
    count, (x, y) = int(generator.integers(2, 5)), _grid(len(depth_m))
    points = generator.uniform(-0.7, 0.7, (count, 2))
    nearest = np.argmin([(x - a) ** 2 + (y - b) ** 2 for a, b in points], axis=0)
    return _colours(generator, count)[nearest]


def _layers(generator: Generator, depth_m: Float32) -> Float64:
    """Two colours: of what stands out towards the wall, and of the rest."""
    split = np.nanquantile(depth_m, generator.uniform(0.3, 0.7)) if (~np.isnan(depth_m)).any() else np.inf
    return _colours(generator, 2)[(depth_m > split).astype(int)]


def _stripes(generator: Generator, depth_m: Float32) -> Float64:
    """Two colours in turn, 3 to 8 cm to the pair in the paper's box."""
    period = generator.uniform(0.25, 0.65)
    phase = _along(generator, len(depth_m)) / period + generator.uniform()
    return _colours(generator, 2)[(phase % 1.0 < 0.5).astype(int)]


def _gradient(generator: Generator, depth_m: Float32) -> Float64:
    """One colour that turns into another across the object."""
    share = np.clip(0.5 + 0.7 * _along(generator, len(depth_m)), 0.0, 1.0)[..., None]
    start, end = _colours(generator, 2)
    return start + share * (end - start)


TEXTURES: dict[str, Callable[[Generator, Float32], Float64]] = {
    "plain": _plain,
    "patches": _patches,
    "layers": _layers,
    "stripes": _stripes,
    "gradient": _gradient,
}
