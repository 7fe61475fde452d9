"""A verdict as large, coloured text: a banner for its panel, and a note to lay over what may not be believed."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from nlos_calibration.arrays import UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.pictures import BACKGROUND_RGB, faded

BANNER_WIDTH, BANNER_HEIGHT = 880, 96
NOTED_PIXELS = 512
HATCH_PIXELS = 32
HATCH_ALPHA, FRAME_ALPHA = 70, 255
DIM = 0.16
"""How much of its colour the banner's ground has."""
PALE_RGB = (214, 224, 230)


@dataclass(frozen=True)
class Look:
    """How a verdict is shown."""

    rgb: tuple[int, int, int]
    advice: str


LOOKS = {
    Verdict.SEEN: Look((80, 220, 120), "the shape may be believed to within the uncertainty beside it"),
    Verdict.NOTHING: Look((150, 175, 190), "the light that comes back is that of an empty box"),
    Verdict.OUTSIDE: Look((255, 180, 60), "unlike all that the networks were trained on: do not believe the shape"),
    Verdict.SATURATED: Look((255, 120, 200), "the sensor is blinded: lower the laser's power or shade the light"),
    Verdict.WALL_MOVED: Look((255, 110, 90), "wall or lidar are not where they were: calibrate the wall again"),
    Verdict.STALLED: Look((255, 110, 90), "no new frame comes: what is shown is old"),
}
UNTOLD = Look(PALE_RGB, "these networks do not tell how far they may be believed")


def look_of(verdict: Verdict | None) -> Look:
    """Colour and advice; of no verdict too."""
    return LOOKS[verdict] if verdict else UNTOLD


def may_be_believed(verdict: Verdict | None) -> bool:
    """Whether what is drawn of a frame is drawn in full colour; networks that do not tell are not doubted for it."""
    return verdict in {None, Verdict.SEEN}


@cache
def banner_rgb(verdict: Verdict | None) -> UInt8:
    """The verdict's panel: its name large, what to do or think below, on a ground of its colour."""
    look = look_of(verdict)
    ground = tuple(int(b + DIM * (c - b)) for b, c in zip(BACKGROUND_RGB, look.rgb, strict=True))
    image = Image.new("RGB", (BANNER_WIDTH, BANNER_HEIGHT), ground)
    pen = ImageDraw.Draw(image)
    pen.rectangle((0, 0, 13, BANNER_HEIGHT), fill=look.rgb)
    pen.text((34, 32), (verdict or "no verdict").upper(), fill=look.rgb, font=font(44), anchor="lm")
    pen.text((35, 74), look.advice, fill=PALE_RGB, font=font(21), anchor="lm")
    return np.asarray(image)


def as_believed(rgb: UInt8, verdict: Verdict | None) -> UInt8:
    """A reconstruction's picture (64, 64, 3) as it is; if it may not be believed (512, 512, 3): faded, framed, named.

    What is doubted is hatched too; what is nothing is not.
    """
    if verdict is None or may_be_believed(verdict):
        return rgb
    large = faded(rgb).repeat(NOTED_PIXELS // len(rgb), axis=0).repeat(NOTED_PIXELS // len(rgb), axis=1)
    note = note_rgba(verdict)
    alpha = note[..., 3:].astype(np.uint16)
    return ((note[..., :3] * alpha + large * (255 - alpha)) // 255).astype(np.uint8)


@cache
def note_rgba(verdict: Verdict) -> NDArray[np.uint8]:
    """What is laid over such a picture (512, 512, 4)."""
    image = Image.new("RGBA", (NOTED_PIXELS, NOTED_PIXELS), (0, 0, 0, 0))
    pen, rgb, end = ImageDraw.Draw(image), look_of(verdict).rgb, NOTED_PIXELS
    if verdict is not Verdict.NOTHING:
        for start in range(-end, end, HATCH_PIXELS):
            pen.line((start, end, start + end, 0), fill=(*rgb, HATCH_ALPHA), width=3)
    pen.rectangle((0, 0, end - 1, end - 1), outline=(*rgb, FRAME_ALPHA), width=6)
    middle = (end / 2, end / 2 if verdict is Verdict.NOTHING else end - 44)
    left, top, right, bottom = pen.textbbox(middle, verdict, font=font(36), anchor="mm")
    pen.rounded_rectangle((left - 16, top - 12, right + 16, bottom + 12), 10, fill=(*BACKGROUND_RGB, 235))
    pen.text(middle, verdict, fill=rgb, font=font(36), anchor="mm")
    return np.asarray(image)


@cache
def font(pixels: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of everything that we write into pictures; it comes with Pillow."""
    return ImageFont.load_default(pixels)
