"""A moment as one picture that we draw ourselves, for talks and videos: no browser is needed."""

from pathlib import Path

import cv2
import numpy as np
from nlos_calibration.arrays import UInt8
from nlos_calibration.rig import Rig
from PIL import Image, ImageDraw

from nlos_cam.objects.depth_map import object_box
from nlos_cam.view.pictures import (
    BACKGROUND_RGB,
    MOST_UNCERTAIN_M,
    depth_span_m,
    hidden_rgb,
    infrared_grey,
    lidar_rgb,
    relief_rgb,
    uncertainty_rgb,
)
from nlos_cam.view.verdict_picture import PALE_RGB, as_believed, banner_rgb, font
from nlos_cam.view.viewer import Moment

WIDTH, HEIGHT = 1280, 720
"""720p: what every projector and player takes."""
MARGIN, TITLE, BAR = 20, 26, 14
LARGE, SMALL = 512, 232
LARGE_AT, MIDDLE_AT, RIGHT_AT = (20, 158), (640, 158), (966, 158)
LOWER = SMALL + TITLE + 22
"""From one row of small pictures to the next."""
LIDAR_WIDTH = 294
PANEL_RGB, QUIET_RGB = (22, 27, 30), (140, 152, 160)
BAR_STEPS = 64


class Still:
    """Pictures of moments of one run: what its first one spans, all do."""

    def __init__(self, rig: Rig, first: Moment) -> None:
        self._box, self._begun_s = object_box(rig), first.published_s
        self._span_m = depth_span_m(first.frame.depth_m)
        self._seen = first

    def rgb(self, moment: Moment, *, with_lidar: bool = True) -> UInt8:
        """(720, 1280, 3); without new pictures of the lidar's, whose noise is hard to compress, those before stay."""
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
        depth_m, box = moment.reconstruction.depth_m, self._box
        rgb = as_believed(hidden_rgb(depth_m, box), moment.verdict)
        page.picture(LARGE_AT, "Hidden around the corner: reconstruction", rgb, (LARGE, LARGE))
        scale = np.linspace(box.z_near_m, box.z_far_m, BAR_STEPS, dtype=np.float32)[:, np.newaxis]
        page.bar(LARGE_AT, LARGE, hidden_rgb(scale, box), f"{1e2 * box.z_near_m:.0f} cm", f"{1e2 * box.z_far_m:.0f} cm")
        x, y = MIDDLE_AT
        if (uncertainty_m := moment.reconstruction.uncertainty_m) is not None:
            page.picture(MIDDLE_AT, "Uncertainty", uncertainty_rgb(uncertainty_m, depth_m), (SMALL, SMALL))
            scale = np.linspace(MOST_UNCERTAIN_M, 0.0, BAR_STEPS, dtype=np.float32)[:, np.newaxis]
            page.bar(MIDDLE_AT, SMALL, uncertainty_rgb(scale, scale), f"{1e3 * MOST_UNCERTAIN_M:.0f} mm", "0")
        else:
            page.picture(MIDDLE_AT, "Relief", relief_rgb(depth_m, box), (SMALL, SMALL))
        below = (x, y + LOWER)
        if (truth_m := moment.frame.truth_depth_m) is not None:
            page.picture(below, "Truth (simulated)", hidden_rgb(truth_m, box), (SMALL, SMALL))
        elif uncertainty_m is not None:
            page.picture(below, "Relief", relief_rgb(depth_m, box), (SMALL, SMALL))

    def _draw_lidar(self, page: "_Page", moment: Moment) -> None:
        x, y = RIGHT_AT
        size = LIDAR_WIDTH, SMALL
        page.picture((x, y), "What the lidar sees: depth", lidar_rgb(moment.frame.depth_m, *self._span_m), size)
        infrared = np.repeat(infrared_grey(moment.frame.ir)[..., np.newaxis], 3, axis=-1)
        page.picture((x, y + LOWER), "Infrared", infrared, size)


def _footer(moment: Moment, since_s: float) -> str:
    latency = f"latency {1e3 * moment.latency_s:.0f} ms"
    score = [f"physics score {moment.check.score:.2f}"] if moment.check else []
    return "     ".join([f"frame {moment.frame.frame_number}", f"{since_s:.2f} s", latency, *score])


class _Page:
    """The picture as it is drawn."""

    def __init__(self) -> None:
        self.image = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND_RGB)
        self._pen = ImageDraw.Draw(self.image)

    def banner(self, moment: Moment) -> None:
        self.image.paste(Image.fromarray(banner_rgb(moment.verdict)), (MARGIN, MARGIN))
        x, y = WIDTH - MARGIN, MARGIN
        self._pen.text((x, y + 34), "nlos-cam", fill=PALE_RGB, font=font(40), anchor="rm")
        self._pen.text((x, y + 74), "seeing around a corner", fill=QUIET_RGB, font=font(21), anchor="rm")

    def picture(self, at: tuple[int, int], title: str, rgb: UInt8, size: tuple[int, int]) -> None:
        """Below its title, as large as fits, in the middle of its panel."""
        (x, y), (width, height) = at, size
        self._pen.rectangle((x, y, x + width - 1, y + height - 1), fill=PANEL_RGB)
        self._pen.text((x, y - TITLE / 2), title, fill=PALE_RGB, font=font(18), anchor="lm")
        fitted = _fitted(rgb, width, height)
        down, right = (height - fitted.shape[0]) // 2, (width - fitted.shape[1]) // 2
        self.image.paste(Image.fromarray(fitted), (x + right, y + down))

    def bar(self, at: tuple[int, int], size: int, rgb: UInt8, top: str, bottom: str) -> None:
        """The scale of colours to the right of a square picture."""
        x, y = at[0] + size + 10, at[1]
        self.image.paste(Image.fromarray(rgb).resize((BAR, size), Image.Resampling.BILINEAR), (x, y))
        for text, height, anchor in ((top, y, "lt"), (bottom, y + size, "lb")):
            self._pen.text((x + BAR + 6, height), text, fill=QUIET_RGB, font=font(16), anchor=anchor)

    def footer(self, text: str) -> None:
        self._pen.text((MARGIN, HEIGHT - MARGIN), text, fill=QUIET_RGB, font=font(18), anchor="lm")


def _fitted(rgb: UInt8, width: int, height: int) -> UInt8:
    """As large as fits; cells stay cells, and photographs are thinned smoothly."""
    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = max(round(rgb.shape[1] * scale), 1), max(round(rgb.shape[0] * scale), 1)
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST).astype(np.uint8)
