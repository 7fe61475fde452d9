"""Pictures from maps, and the banner of stills and videos: pure functions from arrays to arrays."""

from collections.abc import Callable
from functools import cache
from math import floor, log10
from typing import Generic, TypeVar

import cv2
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Mask, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nlos_cam.objects import MAX_UNCERTAINTY_M, image_from_depth

Span = TypeVar("Span")

BACKGROUND_RGB = (13, 16, 17)
"""Color of the page's background, for pixels without surface."""
PICTURE_WIDTH = 320
"""Columns to which lidar pictures are thinned."""
DARKEST = 60
"""Count at which the farthest surface starts in a color map, to stand out from the background."""
DIVERGING_RGB = (255, 150, 60), (70, 155, 130), (50, 160, 255)
"""Red, green and blue, each for nearer, expected and farther depth."""
SATURATED_RGB = (255, 0, 200)
ROUND_STEPS = 1.0, 2.0, 3.0, 5.0, 10.0
CHANGED_M = 0.01
FEW_CHANGED = 0.02
QUIET_SPAN_M = 0.02
"""Differences below are noise and ripples; if few cells differ by more, the span shows these."""
FADED = 0.35
"""Share of color left in an untrusted picture."""


def hidden_rgb(depth_m: Float32, box: ObjectBox) -> UInt8:
    """Return hidden depth (64, 64) as a picture (64, 64, 3): bright near the wall, dark
    background.
    """
    v = image_from_depth(depth_m, box)
    return _in_color_map(_from_darkest(v), cv2.COLORMAP_INFERNO, np.isnan(depth_m))


def lidar_rgb(depth_m: Float32, near_m: float, far_m: float) -> UInt8:
    """Return lidar depth (height, width) as a picture, bright (near) to dark (far), in the colors of
    hidden depth; the background's without a return.
    """
    share = np.clip((depth_m - near_m) / max(far_m - near_m, 1e-6), 0.0, 1.0)
    nearness = np.nan_to_num(1.0 - 0.9 * share)
    return _in_color_map(_from_darkest(nearness), cv2.COLORMAP_INFERNO, np.isnan(depth_m))


def infrared_grey(ir: UInt8) -> UInt8:
    """Return IR counts (height, width) as grey under a square root, so that weak returns are
    visible too.
    """
    return np.sqrt(ir * np.float32(255.0)).astype(np.uint8)


def uncertainty_rgb(uncertainty_m: Float32, depth_m: Float32) -> UInt8:
    """Return the uncertainty of hidden depth (64, 64) as a picture, bright where large, dark
    without surface.
    """
    share = np.clip(np.nan_to_num(uncertainty_m, nan=np.inf) / MAX_UNCERTAINTY_M, 0.0, 1.0)
    return _in_color_map(_from_darkest(share), cv2.COLORMAP_VIRIDIS, np.isnan(depth_m))


def relief_rgb(depth_m: Float32, box: ObjectBox) -> UInt8:
    """Return hidden depth (64, 64) as a relief lit from the top left."""
    pitch_m = (box.x_max_m - box.x_min_m) / depth_m.shape[1]
    down, right = np.gradient(np.nan_to_num(depth_m, nan=box.z_far_m), pitch_m)
    # Cosine between the normal (-right, -down, 1) and the light's direction (0.7, 0.7, 1).
    lengths = np.sqrt((1.0 + right**2 + down**2) * (1.0 + 2 * 0.7**2))
    facing = (1.0 - 0.7 * right - 0.7 * down) / lengths
    shade = 0.25 + 0.75 * np.clip(facing, 0.0, 1.0)[..., np.newaxis]
    rgb = (hidden_rgb(depth_m, box) * shade).astype(np.uint8)
    rgb[np.isnan(depth_m)] = BACKGROUND_RGB
    return rgb


def faded(rgb: UInt8) -> UInt8:
    """Return a picture (..., 3) with little color left, for an unreliable reconstruction."""
    grey = rgb.mean(axis=-1, keepdims=True)
    return np.rint(grey + FADED * (rgb - grey)).astype(np.uint8)


class LastingSpan(Generic[Span]):
    """Range of the values of a run's first frame that has any, which holds for all later ones."""

    def __init__(self, span_of: Callable[[Float32], Span]) -> None:
        self._span_of = span_of
        self._span: Span | None = None

    def of(self, values: Float32) -> Span:
        """Return the run's range; until there is one, what `span_of` says of no value."""
        if self._span is not None:
            return self._span
        span = self._span_of(values)
        if np.isfinite(values).any():
            self._span = span
        return span


def depth_span_m(depth_m: Float32) -> tuple[float, float]:
    """Return the range of most of a depth map; (0, 1) without a return."""
    seen = depth_m[np.isfinite(depth_m)]
    if seen.size == 0:
        return 0.0, 1.0
    near_m, far_m = np.percentile(seen, [1, 99])
    return float(near_m), float(far_m)


def difference_rgb(further: NDArray[np.floating], span: float) -> UInt8:
    """Return a depth difference as a picture: blue farther, red nearer, grey as expected, dark for
    NaN.
    """
    share = np.clip(np.nan_to_num(further) / span, -1.0, 1.0)
    channels = [np.interp(share, (-1.0, 0.0, 1.0), stops) for stops in DIVERGING_RGB]
    rgb = np.stack(channels, axis=-1).astype(np.uint8)
    rgb[np.isnan(further)] = BACKGROUND_RGB
    return rgb


def noise_rgb(noise: NDArray[np.floating], span: float) -> UInt8:
    """Return a spread as a picture, bright where large, dark for NaN."""
    share = np.clip(np.nan_to_num(noise) / span, 0.0, 1.0)
    return _in_color_map(_from_darkest(share), cv2.COLORMAP_INFERNO, np.isnan(noise))


def saturated_rgb(ir: NDArray[np.floating], saturated: NDArray[np.floating]) -> UInt8:
    """Return mean IR counts in grey, with pixels that ever saturated in a color."""
    rgb = np.repeat(infrared_grey(np.nan_to_num(ir).astype(np.uint8))[..., np.newaxis], 3, axis=-1)
    rgb[saturated > 0.0] = SATURATED_RGB
    return rgb


def round_span(
    values: NDArray[np.floating], percent: float = 95.0, otherwise: float = 1.0
) -> float:
    """Return 1, 2, 3, 5 or 10 times a power of ten above most magnitudes; `otherwise` if all are
    zero or NaN.
    """
    known = np.abs(values[np.isfinite(values)])
    most = float(np.percentile(known, percent)) if known.size else 0.0
    if most <= 0.0:
        return otherwise
    power = 10.0 ** floor(log10(most))
    above = [step * power for step in ROUND_STEPS if most <= step * power * (1 + 1e-6)]
    return float(f"{above[0]:g}")


def change_span_m(difference_m: Float32) -> float:
    """Return a round span for most changes; an occluder far in front of the wall may lie beyond."""
    changed_m = difference_m[np.abs(difference_m) > CHANGED_M]  # without NaN
    few = changed_m.size < FEW_CHANGED * difference_m.size
    return QUIET_SPAN_M if few else round_span(changed_m, percent=75.0)


def _from_darkest(share: NDArray[np.floating]) -> NDArray[np.floating]:
    return DARKEST + share * (255 - DARKEST)


def _in_color_map(values: NDArray[np.floating], color_map: int, absent: Mask) -> UInt8:
    """Return values of 0 to 255 in a map's colors, and the background's where they are absent."""
    bgr = cv2.applyColorMap(values.astype(np.uint8), color_map)
    rgb = np.ascontiguousarray(bgr[..., ::-1], dtype=np.uint8)
    rgb[absent] = BACKGROUND_RGB
    return rgb


BANNER_WIDTH = 880
BANNER_HEIGHT = 96
NOTED_PIXELS = 512
HATCH_PIXELS = 32
HATCH_ALPHA = 70
FRAME_ALPHA = 255
DIM = 0.16
"""Share of the verdict's color in the banner's background."""
PALE_RGB = (214, 224, 230)


def banner_rgb(headline: str, detail: str, rgb: tuple[int, int, int]) -> UInt8:
    """Return the verdict's panel: headline in its color, the detail below."""
    ground = tuple(int(b + DIM * (c - b)) for b, c in zip(BACKGROUND_RGB, rgb, strict=True))
    image = Image.new("RGB", (BANNER_WIDTH, BANNER_HEIGHT), ground)
    pen = ImageDraw.Draw(image)
    pen.rectangle((0, 0, 13, BANNER_HEIGHT), fill=rgb)
    pen.text((34, 32), headline, fill=rgb, font=font(40), anchor="lm")
    pen.text((35, 74), detail, fill=PALE_RGB, font=font(21), anchor="lm")
    return np.asarray(image)


def dim_untrusted(rgb: UInt8, note: str, note_rgb: tuple[int, int, int], *, hatched: bool) -> UInt8:
    """Return an untrusted reconstruction (512, 512, 3) of (64, 64, 3): faded, framed and
    labelled.
    """
    times = NOTED_PIXELS // len(rgb)
    large = faded(rgb).repeat(times, axis=0).repeat(times, axis=1)
    over = note_rgba(note, note_rgb, hatched=hatched)
    alpha = over[..., 3:].astype(np.uint16)
    return ((over[..., :3] * alpha + large * (255 - alpha)) // 255).astype(np.uint8)


@cache
def note_rgba(note: str, rgb: tuple[int, int, int], *, hatched: bool) -> UInt8:
    """Return the overlay of an untrusted picture (512, 512, 4)."""
    image = Image.new("RGBA", (NOTED_PIXELS, NOTED_PIXELS), (0, 0, 0, 0))
    pen = ImageDraw.Draw(image)
    end = NOTED_PIXELS
    if hatched:
        for start in range(-end, end, HATCH_PIXELS):
            pen.line((start, end, start + end, 0), fill=(*rgb, HATCH_ALPHA), width=3)
    pen.rectangle((0, 0, end - 1, end - 1), outline=(*rgb, FRAME_ALPHA), width=6)
    middle = (end / 2, end - 44 if hatched else end / 2)
    left, top, right, bottom = pen.textbbox(middle, note, font=font(36), anchor="mm")
    pen.rounded_rectangle(
        (left - 16, top - 12, right + 16, bottom + 12), 10, fill=(*BACKGROUND_RGB, 235)
    )
    pen.text(middle, note, fill=rgb, font=font(36), anchor="mm")
    return np.asarray(image)


@cache
def font(pixels: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of all texts in pictures; it comes with Pillow."""
    return ImageFont.load_default(pixels)
