"""Random textures of hidden objects, and the image of an albedo (simulation only: the laser of an
L515 is infrared).
"""

from collections.abc import Callable, Sequence
from colorsys import hsv_to_rgb
from typing import NamedTuple

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from nlos_models import BLACK_V
from numpy.typing import NDArray

SATURATION = (0.5, 0.9)
VALUE = (0.7, 1.0)
"""Ranges of saturation and value (HSV): no surface is as dark as background."""
TEXTURE_STREAM = 3
"""Seeds a texture's random numbers apart from those of the object's shape, noise and rig."""

Generator = np.random.Generator


class Coat(NamedTuple):
    """Texture of an object."""

    texture: str
    albedo: Float32
    """(64, 64, 3), RGB; defined for background cells too."""


def paint(seed: int, depth_m: Float32, textures: Sequence[str]) -> Coat:
    """Return one of the textures in random colors over an object's depth map (64, 64), by the seed
    alone.
    """
    generator = np.random.default_rng([seed, TEXTURE_STREAM])
    texture = str(generator.choice(list(textures)))
    return Coat(texture, TEXTURES[texture](generator, depth_m).astype(np.float32))


def image_from_albedo(albedo: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Float32:
    """Return albedo (64, 64, 3) as image v (3, 64, 64): 0 where depth is NaN, else 0.1 (black) to
    1.
    """
    v = np.moveaxis(BLACK_V + (1 - BLACK_V) * np.asarray(albedo), -1, 0)
    return np.where(np.isnan(depth_m), 0.0, v).astype(np.float32)


def _colors(generator: Generator, count: int) -> Float64:
    """Return colors (count, 3) of distinct hues."""
    hues = (
        generator.uniform() + (np.arange(count) + generator.uniform(-0.2, 0.2, count)) / count
    ) % 1.0
    return np.array(
        [hsv_to_rgb(hue, generator.uniform(*SATURATION), generator.uniform(*VALUE)) for hue in hues]
    )


def _grid(n: int) -> tuple[Float64, Float64]:
    """Return x (right) and y (up) of the cells of an image, from -1 to 1."""
    x, y = np.meshgrid(
        np.linspace(-1, 1, n),
        np.linspace(1, -1, n),
    )
    return x, y


def _along(generator: Generator, n: int) -> Float64:
    """Return the position of each cell along a random direction, from about -1 to 1."""
    (x, y) = _grid(n)
    angle = generator.uniform(0, np.pi)
    return x * np.cos(angle) + y * np.sin(angle)


def _patches(generator: Generator, depth_m: Float32) -> Float64:
    """Return a Voronoi pattern of 2 to 4 colors: a cell has the color of its nearest point."""
    count = int(generator.integers(2, 5))
    (x, y) = _grid(len(depth_m))
    points = generator.uniform(-0.7, 0.7, (count, 2))
    nearest = np.argmin(
        [(x - a) ** 2 + (y - b) ** 2 for a, b in points],
        axis=0,
    )
    return _colors(generator, count)[nearest]


def _layers(generator: Generator, depth_m: Float32) -> Float64:
    """Return two colors, split at a depth: nearer to the wall, and farther."""
    split = (
        np.nanquantile(depth_m, generator.uniform(0.3, 0.7))
        if (~np.isnan(depth_m)).any()
        else np.inf
    )
    return _colors(generator, 2)[(depth_m > split).astype(int)]


def _stripes(generator: Generator, depth_m: Float32) -> Float64:
    """Return stripes of two colors, with a period of 3 to 8 cm in the paper's box."""
    period = generator.uniform(0.25, 0.65)
    phase = _along(generator, len(depth_m)) / period + generator.uniform()
    return _colors(generator, 2)[(phase % 1.0 < 0.5).astype(int)]


def _gradient(generator: Generator, depth_m: Float32) -> Float64:
    share = np.clip(0.5 + 0.7 * _along(generator, len(depth_m)), 0.0, 1.0)[..., None]
    start, end = _colors(generator, 2)
    return start + share * (end - start)


TEXTURES: dict[str, Callable[[Generator, Float32], Float64]] = {
    "plain": lambda generator, depth_m: np.broadcast_to(
        _colors(generator, 1)[0], (*depth_m.shape, 3)
    ),
    "patches": _patches,
    "layers": _layers,
    "stripes": _stripes,
    "gradient": _gradient,
}
