"""Viewer that writes a video for browsers (VP8 in WebM), and stills; both drawn without a
browser.
"""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from nlos_calibration.arrays import UInt8
from PIL import Image, ImageDraw

from nlos_cam.errors import NlosCamError
from nlos_cam.reconstruct import FrameResult
from nlos_cam.view import images
from nlos_cam.view.assessment import Assessment, assess
from nlos_cam.view.viewer import Moment, Schedule

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
    """Pictures of one run's moments; the first color ranges that are known hold for all."""

    def __init__(self, first: Moment) -> None:
        self._start_s = first.time_s
        self._span = images.LastingSpan(images.depth_span_m)
        self._lidar_frame = first.result.frame
        self._span.of(self._lidar_frame.depth_m)

    def rgb(self, moment: Moment, *, with_lidar: bool = True) -> UInt8:
        """Return the picture (720, 1280, 3); the lidar's pictures, hard to compress, stay unless
        renewed.
        """
        if with_lidar:
            self._lidar_frame = moment.result.frame
        page = _Page()
        page.banner(assess(moment))
        _draw_reconstruction(page, moment)
        _draw_beside(page, moment.result)
        self._draw_lidar(page)
        page.footer(_footer(moment, moment.time_s - self._start_s))
        return np.asarray(page.image)

    def save(self, path: Path, moment: Moment) -> None:
        """Write the picture as a PNG."""
        Image.fromarray(self.rgb(moment)).save(path, optimize=True)

    def _draw_lidar(self, page: "_Page") -> None:
        x, y = RIGHT_AT
        size = LIDAR_WIDTH, SMALL
        frame = self._lidar_frame
        depth = images.lidar_rgb(frame.depth_m, *self._span.of(frame.depth_m))
        page.picture((x, y), "What the lidar sees: depth", depth, size)
        infrared = np.repeat(images.infrared_grey(frame.ir)[..., np.newaxis], 3, axis=-1)
        page.picture((x, y + LOWER), "Infrared", infrared, size)


def _draw_reconstruction(page: "_Page", moment: Moment) -> None:
    box = moment.result.reconstruction.box
    rgb = images.hidden_rgb(moment.result.depth_m, box)
    assessment = assess(moment)
    if not assessment.trusted:
        hatched = assessment.tone == "warning"
        rgb = images.dim_untrusted(rgb, assessment.headline, assessment.rgb, hatched=hatched)
    page.picture(LARGE_AT, "Hidden around the corner: reconstruction", rgb, (LARGE, LARGE))

    scale_m = np.linspace(box.z_near_m, box.z_far_m, BAR_STEPS, dtype=np.float32)[:, np.newaxis]
    labels = f"{1e2 * box.z_near_m:.0f} cm", f"{1e2 * box.z_far_m:.0f} cm"
    page.bar(LARGE_AT, LARGE, images.hidden_rgb(scale_m, box), *labels)


def _draw_beside(page: "_Page", result: FrameResult) -> None:
    """Draw uncertainty and truth beside the reconstruction, where they are known, else its
    relief.
    """
    box = result.reconstruction.box
    size = SMALL, SMALL
    below = MIDDLE_AT[0], MIDDLE_AT[1] + LOWER
    relief = images.relief_rgb(result.depth_m, box)
    if result.uncertainty_m is None:
        page.picture(MIDDLE_AT, "Relief", relief, size)
    else:
        rgb = images.uncertainty_rgb(result.uncertainty_m, result.depth_m)
        page.picture(MIDDLE_AT, "Uncertainty", rgb, size)
        most_m = images.MAX_UNCERTAINTY_M
        scale_m = np.linspace(most_m, 0.0, BAR_STEPS, dtype=np.float32)[:, np.newaxis]
        bar = images.uncertainty_rgb(scale_m, scale_m)
        page.bar(MIDDLE_AT, SMALL, bar, f"{1e3 * most_m:.0f} mm", "0")

    if result.truth_depth_m is not None:
        truth = images.hidden_rgb(result.truth_depth_m, box)
        page.picture(below, "Truth (simulated)", truth, size)
    elif result.uncertainty_m is not None:
        page.picture(below, "Relief", relief, size)


def _footer(moment: Moment, since_s: float) -> str:
    result = moment.result
    parts = [f"frame {result.frame_number}", f"{since_s:.2f} s"]
    # A recorded frame's latency would be the pace of this machine.
    if moment.time_s != result.timestamp_s:
        parts.append(f"latency {1e3 * moment.latency_s:.0f} ms")
    if result.check:
        parts.append(f"physics score {result.check.score:.2f}")
    return "     ".join(parts)


class _Page:
    """Canvas of one picture."""

    def __init__(self) -> None:
        self.image = Image.new("RGB", (WIDTH, HEIGHT), images.BACKGROUND_RGB)
        self._pen = ImageDraw.Draw(self.image)

    def banner(self, assessment: Assessment) -> None:
        banner = images.banner_rgb(assessment.headline, assessment.detail, assessment.rgb)
        self.image.paste(Image.fromarray(banner), (MARGIN, MARGIN))
        right = WIDTH - MARGIN
        self._write((right, MARGIN + 34), "nlos-cam", 40, anchor="rm", rgb=images.PALE_RGB)
        self._write((right, MARGIN + 74), "seeing around a corner", 21, anchor="rm")

    def picture(self, at: tuple[int, int], title: str, rgb: UInt8, size: tuple[int, int]) -> None:
        """Draw an image below its title, scaled to its panel."""
        x, y = at
        width, height = size
        self._pen.rectangle((x, y, x + width - 1, y + height - 1), fill=PANEL_RGB)
        self._write((x, y - TITLE / 2), title, 18, anchor="lm", rgb=images.PALE_RGB)
        fitted = _fitted(rgb, width, height)
        down = (height - fitted.shape[0]) // 2
        right = (width - fitted.shape[1]) // 2
        self.image.paste(Image.fromarray(fitted), (x + right, y + down))

    def bar(self, at: tuple[int, int], size: int, rgb: UInt8, top: str, bottom: str) -> None:
        """Draw a color bar to the right of a square picture."""
        x = at[0] + size + 10
        y = at[1]
        bar = Image.fromarray(rgb).resize((BAR, size), Image.Resampling.BILINEAR)
        self.image.paste(bar, (x, y))
        self._write((x + BAR + 6, y), top, 16, anchor="lt")
        self._write((x + BAR + 6, y + size), bottom, 16, anchor="lb")

    def footer(self, text: str) -> None:
        self._write((MARGIN, HEIGHT - MARGIN), text, 18, anchor="lm")

    def _write(
        self,
        at: tuple[float, float],
        text: str,
        pixels: int,
        *,
        anchor: str,
        rgb: tuple[int, int, int] = QUIET_RGB,
    ) -> None:
        self._pen.text(at, text, fill=rgb, font=images.font(pixels), anchor=anchor)


def _fitted(rgb: UInt8, width: int, height: int) -> UInt8:
    """Return an image scaled to fit: cells stay sharp, photographs are smoothed."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = max(round(rgb.shape[1] * scale), 1), max(round(rgb.shape[0] * scale), 1)
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    return cv2.resize(rgb, size, interpolation=interpolation).astype(np.uint8)


FRAMES_PER_S = 15.0
LIDAR_EVERY = 5
CODEC = "VP80"


class VideoFile:
    """Video of moments, 15 per second of their own clock, while entered; drawn in the thread of
    `show`.
    """

    address: str | None = None

    def __init__(self, path: Path) -> None:
        self.filmed = 0
        """Pictures."""
        self._path = path
        self._still: Still | None = None
        self._schedule = Schedule(1.0 / FRAMES_PER_S)

    def __enter__(self) -> Self:
        self._writer = _writer(self._path)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.release()

    def show(self, moment: Moment) -> None:
        """Add a moment if one is due."""
        if not self._schedule.is_due(moment.time_s):
            return
        self._still = self._still or Still(moment)
        rgb = self._still.rgb(moment, with_lidar=self.filmed % LIDAR_EVERY == 0)
        self._writer.write(rgb[..., ::-1].copy())
        self.filmed += 1


def _writer(path: Path) -> cv2.VideoWriter:
    """Open the video writer. Raises NlosCamError if this OpenCV lacks the codec."""
    codec = cv2.VideoWriter.fourcc(*CODEC)
    with _without_native_warnings():
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, FRAMES_PER_S, (WIDTH, HEIGHT))
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
