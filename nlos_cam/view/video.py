"""Viewer that writes a video for browsers (VP8 in WebM), and stills; both drawn without a
browser.
"""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import UInt8
from PIL import Image, ImageDraw

from nlos_cam.errors import NlosCamError
from nlos_cam.objects import object_box
from nlos_cam.view import images
from nlos_cam.view.assessment import assess
from nlos_cam.view.viewer import Moment

WIDTH = 1280
HEIGHT = 720
"""720p: what every projector and player takes."""
MARGIN = 20
TITLE = 26
BAR = 14
LARGE = 512
SMALL = 232
LARGE_AT = (20, 158)
MIDDLE_AT = (640, 158)
RIGHT_AT = (966, 158)
LOWER = SMALL + TITLE + 22
"""From one row of small pictures to the next."""
LIDAR_WIDTH = 294
PANEL_RGB = (22, 27, 30)
QUIET_RGB = (140, 152, 160)
BAR_STEPS = 64


class Still:
    """Pictures of one run's moments; the first one's color ranges hold for all."""

    def __init__(self, rig: Rig, first: Moment) -> None:
        self._box = object_box(rig)
        self._begun_s = first.published_s
        self._span_m = images.depth_span_m(first.frame.depth_m)
        self._seen = first

    def rgb(self, moment: Moment, *, with_lidar: bool = True) -> UInt8:
        """Return the picture (720, 1280, 3); the lidar's pictures, hard to compress, stay unless
        renewed.
        """
        self._seen = moment if with_lidar else self._seen
        page = _Page()
        page.banner(moment)
        self._draw_hidden(page, moment)
        self._draw_lidar(page, self._seen)
        page.footer(_footer(moment, moment.published_s - self._begun_s))
        return np.asarray(page.image)

    def save(self, path: Path, moment: Moment) -> None:
        """Write the picture as a PNG."""
        Image.fromarray(self.rgb(moment)).save(path, optimize=True)

    def _draw_hidden(self, page: "_Page", moment: Moment) -> None:
        depth_m = moment.reconstruction.depth_m
        box = self._box
        rgb = images.hidden_rgb(depth_m, box)
        assessment = assess(moment)
        if not assessment.trusted:
            rgb = images.dim_untrusted(
                rgb, assessment.headline, assessment.rgb, hatched=assessment.tone == "warning"
            )
        page.picture(LARGE_AT, "Hidden around the corner: reconstruction", rgb, (LARGE, LARGE))
        scale = np.linspace(box.z_near_m, box.z_far_m, BAR_STEPS, dtype=np.float32)[:, np.newaxis]
        page.bar(
            LARGE_AT,
            LARGE,
            images.hidden_rgb(scale, box),
            f"{1e2 * box.z_near_m:.0f} cm",
            f"{1e2 * box.z_far_m:.0f} cm",
        )
        x, y = MIDDLE_AT
        if (uncertainty_m := moment.reconstruction.uncertainty_m) is not None:
            page.picture(
                MIDDLE_AT,
                "Uncertainty",
                images.uncertainty_rgb(uncertainty_m, depth_m),
                (SMALL, SMALL),
            )
            scale = np.linspace(images.MAX_UNCERTAINTY_M, 0.0, BAR_STEPS, dtype=np.float32)[
                :, np.newaxis
            ]
            page.bar(
                MIDDLE_AT,
                SMALL,
                images.uncertainty_rgb(scale, scale),
                f"{1e3 * images.MAX_UNCERTAINTY_M:.0f} mm",
                "0",
            )
        else:
            page.picture(MIDDLE_AT, "Relief", images.relief_rgb(depth_m, box), (SMALL, SMALL))
        below = (x, y + LOWER)
        if (truth_m := moment.frame.truth_depth_m) is not None:
            page.picture(
                below, "Truth (simulated)", images.hidden_rgb(truth_m, box), (SMALL, SMALL)
            )
        elif uncertainty_m is not None:
            page.picture(below, "Relief", images.relief_rgb(depth_m, box), (SMALL, SMALL))

    def _draw_lidar(self, page: "_Page", moment: Moment) -> None:
        x, y = RIGHT_AT
        size = LIDAR_WIDTH, SMALL
        page.picture(
            (x, y),
            "What the lidar sees: depth",
            images.lidar_rgb(moment.frame.depth_m, *self._span_m),
            size,
        )
        infrared = np.repeat(images.infrared_grey(moment.frame.ir)[..., np.newaxis], 3, axis=-1)
        page.picture((x, y + LOWER), "Infrared", infrared, size)


def _footer(moment: Moment, since_s: float) -> str:
    live = (
        moment.published_s != moment.frame.timestamp_s
    )  # a replay's latency would be the pace of its machine
    latency = [f"latency {1e3 * moment.latency_s:.0f} ms"] if live else []
    score = [f"physics score {moment.check.score:.2f}"] if moment.check else []
    return "     ".join(
        [f"frame {moment.frame.frame_number}", f"{since_s:.2f} s", *latency, *score]
    )


class _Page:
    """Canvas of one picture."""

    def __init__(self) -> None:
        self.image = Image.new("RGB", (WIDTH, HEIGHT), images.BACKGROUND_RGB)
        self._pen = ImageDraw.Draw(self.image)

    def banner(self, moment: Moment) -> None:
        assessment = assess(moment)
        self.image.paste(
            Image.fromarray(
                images.banner_rgb(assessment.headline, assessment.detail, assessment.rgb)
            ),
            (MARGIN, MARGIN),
        )
        x = WIDTH - MARGIN
        y = MARGIN
        self._pen.text(
            (x, y + 34), "nlos-cam", fill=images.PALE_RGB, font=images.font(40), anchor="rm"
        )
        self._pen.text(
            (x, y + 74), "seeing around a corner", fill=QUIET_RGB, font=images.font(21), anchor="rm"
        )

    def picture(self, at: tuple[int, int], title: str, rgb: UInt8, size: tuple[int, int]) -> None:
        """Draw an image below its title, scaled to its panel."""
        x, y = at
        width, height = size
        self._pen.rectangle((x, y, x + width - 1, y + height - 1), fill=PANEL_RGB)
        self._pen.text(
            (x, y - TITLE / 2), title, fill=images.PALE_RGB, font=images.font(18), anchor="lm"
        )
        fitted = _fitted(rgb, width, height)
        down = (height - fitted.shape[0]) // 2
        right = (width - fitted.shape[1]) // 2
        self.image.paste(Image.fromarray(fitted), (x + right, y + down))

    def bar(self, at: tuple[int, int], size: int, rgb: UInt8, top: str, bottom: str) -> None:
        """Draw a color bar to the right of a square picture."""
        x = at[0] + size + 10
        y = at[1]
        self.image.paste(
            Image.fromarray(rgb).resize((BAR, size), Image.Resampling.BILINEAR), (x, y)
        )
        for text, height, anchor in ((top, y, "lt"), (bottom, y + size, "lb")):
            self._pen.text(
                (x + BAR + 6, height), text, fill=QUIET_RGB, font=images.font(16), anchor=anchor
            )

    def footer(self, text: str) -> None:
        self._pen.text(
            (MARGIN, HEIGHT - MARGIN), text, fill=QUIET_RGB, font=images.font(18), anchor="lm"
        )


def _fitted(rgb: UInt8, width: int, height: int) -> UInt8:
    """Return an image scaled to fit: cells stay sharp, photographs are smoothed."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = max(round(rgb.shape[1] * scale), 1), max(round(rgb.shape[0] * scale), 1)
    return cv2.resize(
        rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    ).astype(np.uint8)


FRAMES_PER_S = 15.0
SLACK_S = 0.01
"""Frames come at 30 per second: every second is filmed, and not every third because of a
thousandth.
"""
LIDAR_EVERY = 5
CODEC = "VP80"


class VideoFile:
    """Video of moments, 15 per second of their own clock, while entered; drawn in the thread of
    `show`.
    """

    address: str | None = None

    def __init__(self, path: Path, rig: Rig) -> None:
        self.filmed = 0
        """Pictures."""
        self._path = path
        self._rig = rig
        self._still: Still | None = None
        self._due_s = float("-inf")

    def __enter__(self) -> Self:
        self._writer = _writer(self._path)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.release()

    def show(self, moment: Moment) -> None:
        """Add a moment if one is due."""
        if moment.published_s < self._due_s:
            return
        self._due_s = moment.published_s + 1.0 / FRAMES_PER_S - SLACK_S
        self._still = self._still or Still(self._rig, moment)
        self._writer.write(
            self._still.rgb(moment, with_lidar=self.filmed % LIDAR_EVERY == 0)[..., ::-1].copy()
        )
        self.filmed += 1


def _writer(path: Path) -> Any:
    """Open the video writer. Raises NlosCamError if this OpenCV lacks the codec."""
    import cv2

    with _without_native_warnings():
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*CODEC), FRAMES_PER_S, (WIDTH, HEIGHT)
        )
    if not writer.isOpened():
        raise NlosCamError(
            f"{path} cannot be filmed: this OpenCV has no {CODEC} codec; reinstall it, or leave out"
            " --video"
        )
    return writer


@contextmanager
def _without_native_warnings() -> Generator[None]:
    """Silence OpenCV's warning that WebM has no tag for VP8, which it then sets."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
