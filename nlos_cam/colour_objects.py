"""Hidden objects in colour, by seed (simulation only: the L515's laser is infrared), and the image of their albedo."""

from collections.abc import Callable
from colorsys import hsv_to_rgb
from dataclasses import dataclass

import numpy as np
from nlos_calibration.rig import ObjectBox
from nlos_models.data import Half
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.objects.hidden import object_depth

BLACK_V = 0.1
"""v of a surface that reflects nothing in a channel; background is 0."""
SATURATION, VALUE = (0.5, 0.9), (0.7, 1.0)
"""Of colours, as hue, saturation and value have them: no surface is so dark that it passes for background."""
TEXTURE_STREAM = 3
"""Keeps a texture's random numbers apart from those of its object's shape."""

Array = NDArray[np.float64]
Generator = np.random.Generator


@dataclass(frozen=True)
class ColourObject:
    """One hidden object and what it is painted with."""

    category: str
    texture: str
    depth_m: Float32
    """(64, 64); NaN for background."""
    albedo: Float32
    """(64, 64, 3) in red, green and blue; background cells have one too, which nothing sees."""

    @property
    def image(self) -> Float32:
        """The colour image (3, 64, 64)."""
        return image_from_albedo(self.albedo, self.depth_m)


def colour_object(seed: int, box: ObjectBox) -> ColourObject:
    """One random object in random colours; the seed decides all, and the shape is `object_depth`'s of that seed."""
    category, depth_m = object_depth(seed, box)
    generator = np.random.default_rng([seed, TEXTURE_STREAM])
    texture = str(generator.choice(list(TEXTURES)))
    albedo = TEXTURES[texture](generator, depth_m).astype(np.float32)
    return ColourObject(category, texture, depth_m, albedo)


def colour_images(first_seed: int, count: int, box: ObjectBox) -> Half:
    """Images (count, 3, 64, 64) of random objects, without rendering: all that a VAE needs."""
    seeds = range(first_seed, first_seed + count)
    return np.stack([colour_object(seed, box).image.astype(np.float16) for seed in seeds])


def image_from_albedo(albedo: NDArray[np.floating], depth_m: NDArray[np.floating]) -> Float32:
    """Albedo (64, 64, 3) as v (3, 64, 64): 0 where depth (64, 64) is NaN, else 0.1 (black) to 1 in each channel."""
    v = np.moveaxis(BLACK_V + (1 - BLACK_V) * np.asarray(albedo), -1, 0)
    return np.where(np.isnan(depth_m), 0.0, v).astype(np.float32)


def albedo_from_image(v: NDArray[np.floating]) -> Float32:
    """The way back: v (..., 3, 64, 64) as albedo (..., 64, 64, 3), NaN where no channel reaches half of black's v."""
    albedo = np.clip((np.moveaxis(v, -3, -1) - BLACK_V) / (1 - BLACK_V), 0.0, 1.0)
    return np.where(v.max(-3)[..., None] < BLACK_V / 2, np.nan, albedo).astype(np.float32)


def _colours(generator: Generator, count: int) -> Array:
    """Colours (count, 3) whose hues lie apart."""
    hues = (generator.uniform() + (np.arange(count) + generator.uniform(-0.2, 0.2, count)) / count) % 1.0
    return np.array([hsv_to_rgb(hue, generator.uniform(*SATURATION), generator.uniform(*VALUE)) for hue in hues])


def _grid(n: int) -> tuple[Array, Array]:
    """How far right and how far up each cell of an image lies, from -1 to 1."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(1, -1, n))
    return x, y


def _along(generator: Generator, n: int) -> Array:
    """How far each cell lies along a random direction, from about -1 to 1."""
    (x, y), angle = _grid(n), generator.uniform(0, np.pi)
    return x * np.cos(angle) + y * np.sin(angle)


def _plain(generator: Generator, depth_m: Float32) -> Array:
    """One colour all over."""
    return np.broadcast_to(_colours(generator, 1)[0], (*depth_m.shape, 3))


def _patches(generator: Generator, depth_m: Float32) -> Array:
    """Parts side by side, each in its colour: a cell takes that of the nearest of some points."""
    count, (x, y) = int(generator.integers(2, 5)), _grid(len(depth_m))
    points = generator.uniform(-0.7, 0.7, (count, 2))
    nearest = np.argmin([(x - a) ** 2 + (y - b) ** 2 for a, b in points], axis=0)
    return _colours(generator, count)[nearest]


def _layers(generator: Generator, depth_m: Float32) -> Array:
    """Two colours: of what stands out towards the wall, and of the rest."""
    split = np.nanquantile(depth_m, generator.uniform(0.3, 0.7)) if (~np.isnan(depth_m)).any() else np.inf
    return _colours(generator, 2)[(depth_m > split).astype(int)]


def _stripes(generator: Generator, depth_m: Float32) -> Array:
    """Two colours in turn, 3 to 8 cm to the pair in the paper's box."""
    period = generator.uniform(0.25, 0.65)
    phase = _along(generator, len(depth_m)) / period + generator.uniform()
    return _colours(generator, 2)[(phase % 1.0 < 0.5).astype(int)]


def _gradient(generator: Generator, depth_m: Float32) -> Array:
    """One colour that turns into another across the object."""
    share = np.clip(0.5 + 0.7 * _along(generator, len(depth_m)), 0.0, 1.0)[..., None]
    start, end = _colours(generator, 2)
    return start + share * (end - start)


TEXTURES: dict[str, Callable[[Generator, Float32], Array]] = {
    "plain": _plain,
    "patches": _patches,
    "layers": _layers,
    "stripes": _stripes,
    "gradient": _gradient,
}
