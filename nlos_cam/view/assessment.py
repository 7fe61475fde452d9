"""Assessment of a moment in words: graded by the uncertainty model's numbers, never a promise."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nlos_cam.reconstruct import Reconstruction, Verdict
from nlos_cam.view.viewer import Moment

Tone = Literal["good", "estimate", "quiet", "warning", "alarm"]
RGB: dict[Tone, tuple[int, int, int]] = {
    "good": (90, 210, 130),
    "estimate": (110, 180, 255),
    "quiet": (150, 175, 190),
    "warning": (255, 180, 60),
    "alarm": (255, 110, 90),
}
"""Color by tone. Only "good" is green: at least 90 % of such frames have an outline that is 75 %
right.
"""


@dataclass(frozen=True)
class Assessment:
    """Headline and detail of a moment, with their tone."""

    headline: str
    detail: str
    tone: Tone
    trusted: bool = False
    """True if the surface is drawn in full color; it is an estimate all the same."""

    @property
    def rgb(self) -> tuple[int, int, int]:
        return RGB[self.tone]


WORDS: dict[Verdict | None, tuple[str, Tone]] = {
    Verdict.NOTHING: ("the returning light is that of an empty box", "quiet"),
    Verdict.OUTSIDE: ("shape not reliable: unlike the training data, or not explained", "warning"),
    Verdict.SATURATED: ("lower the laser power or shade the light", "alarm"),
    Verdict.WALL_MOVED: ("the wall or the lidar: calibrate the wall again", "alarm"),
    Verdict.STALLED: ("no new frame: the pictures are old", "alarm"),
    None: ("error unknown: these weights have no uncertainty model", "quiet"),
}
"""Detail and tone by verdict; the headline is the verdict itself, as everywhere."""


def assess(moment: Moment) -> Assessment:
    """Return a moment's assessment; for a detected object, the share of its outline expected right
    and the depth error.

    Both come from the quality model, with the interval that holds 80 % of like frames; it was
    fitted to known objects, of which none of the shown kind may have been (docs/uncertainty.md).
    Without one they are the uncertainty model's own.
    """
    verdict = moment.result.verdict
    found = moment.result.reconstruction
    if verdict is not Verdict.SEEN:
        detail, tone = WORDS[verdict]
        headline = verdict.capitalize() if verdict else "No verdict"
        return Assessment(headline, detail, tone, trusted=verdict is None)

    tone = "estimate"
    overlap = expected_overlap(found)
    error_m = expected_error_m(found)
    if quality := found.quality:
        low, typical, high = (f"{share:.0%}" for share in quality.iou)
        tone = "good" if quality.trusted else "estimate"
        detail = (
            f"outline typically {typical} right ({low} to {high}), depth to"
            f" {1e3 * quality.error_m:.0f} mm"
        )
    elif overlap is None or error_m is None:
        detail = "no estimate of the shape's error"
    else:
        detail = (
            f"outline about {overlap:.0%} right, depth to about {1e3 * error_m:.0f} mm (the"
            " model's own estimate)"
        )
    return Assessment(verdict.capitalize(), detail, tone, trusted=True)


def expected_overlap(found: Reconstruction) -> float | None:
    """Return the expected silhouette IoU from the probability p of a surface per pixel; None
    without p or a surface.

    With the reconstructed mask M: intersection = sum of p over M, union = |M| + sum of p outside M.
    """
    mask = np.isfinite(found.depth_m)
    if found.uncertainty is None or not mask.any():
        return None
    p = found.uncertainty.p_surface
    return float(p[mask].sum() / (mask.sum() + p[~mask].sum()))


def expected_error_m(found: Reconstruction) -> float | None:
    """Return the median expected depth error in metres over the reconstructed surface; None without
    one.
    """
    mask = np.isfinite(found.depth_m)
    if found.uncertainty_m is None or not mask.any():
        return None
    return float(np.median(found.uncertainty_m[mask]))
