"""Figures of a reconstruction that its quality is predicted from: a table of names and formulas."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from nlos_models.arrays import Float32, Mask

PIXELS = 64 * 64


class UncertaintyEstimate(NamedTuple):
    """Calibrated uncertainty of n reconstructions."""

    p_empty: Float32
    """(n,): probability that nothing is hidden."""
    p_out_of_distribution: Float32
    """(n,): probability that the hidden object is unlike the training objects."""
    error_v: Float32
    """(n, 64, 64): expected absolute error in v, given a surface."""
    p_surface: Float32
    """(n, 64, 64): probability that there is a surface."""


@dataclass(frozen=True)
class Outline:
    """Surface of n images, compared with probabilities of a surface."""

    mask: Float32
    """(n, PIXELS): 1 where the image has a surface, else 0."""
    p: Float32
    """(n, PIXELS): probability of a surface."""
    area: Float32
    """(n,): pixels of the image's surface, at least 1."""

    @cached_property
    def inside(self) -> Float32:
        """Sum of p over the image's surface, over its area: (n,)."""
        return _over(self.p * self.mask, self.area)

    @cached_property
    def beside(self) -> Float32:
        """Sum of p over the image's background, over the surface's area: (n,)."""
        return _over(self.p * (1 - self.mask), self.area)

    @cached_property
    def overlap(self) -> Float32:
        """Expected overlap (n,): intersection over union with p in place of the truth."""
        # (sum of p inside) / (area + sum of p outside), all over the area.
        return self.inside / (1 + self.beside)

    @cached_property
    def unsure(self) -> Float32:
        """Variance of each pixel, p (1 - p): (n, PIXELS)."""
        return self.p * (1 - self.p)

    def iou_above(self, level: float) -> Float32:
        """Return the IoU (n,) of the image's surface with the pixels whose p is above a level."""
        above = self._above(level)
        joint = (above * self.mask).sum(1)
        return joint / np.maximum(above.sum(1) + self.mask.sum(1) - joint, 1.0)

    def area_above(self, level: float) -> Float32:
        """Return the area (n,) whose p is above a level, over that of the image's surface."""
        return _over(self._above(level), self.area)

    def _above(self, level: float) -> Float32:
        return (self.p > level).astype(np.float32)


class Place(NamedTuple):
    """Place and extent of the surface of n images, in pixels."""

    off_middle: Float32
    """(n,): distance of the mean row from the rig's plane of symmetry. The row itself would differ
    in the mirrored frame, whose figures must be the same."""
    column: Float32
    """(n,): mean column."""
    height: Float32
    """(n,): standard deviation of the row."""
    width: Float32
    """(n,): standard deviation of the column."""

    @classmethod
    def of(cls, has_surface: Mask, area: Float32) -> Self:
        """Return the place of surfaces (n, 64, 64) with their areas (n,), by their moments."""
        # First and second moments of the sums along rows and columns.
        pixels = np.arange(has_surface.shape[1], dtype=np.float32)
        rows, columns = (has_surface.sum(axis).astype(np.float32) for axis in (2, 1))
        row = (rows @ pixels) / area
        column = (columns @ pixels) / area
        # Var(x) = E(x^2) - E(x)^2
        height = np.sqrt(np.maximum((rows @ pixels**2) / area - row**2, 0.0))
        width = np.sqrt(np.maximum((columns @ pixels**2) / area - column**2, 0.0))
        middle = (has_surface.shape[1] - 1) / 2
        return cls(np.abs(row - middle), column, height, width)


class Frames:
    """Reconstructions of n frames, with the parts that their figures share."""

    def __init__(
        self, image: Float32, estimate: UncertaintyEstimate, own_p: Float32 | None = None
    ) -> None:
        self.image = image
        """(n, 64, 64): v."""
        self.has_surface: Mask = image > 0
        """(n, 64, 64): where the image has a surface."""
        self.estimate = estimate
        self.mask = _flat(self.has_surface.astype(np.float32))
        """(n, PIXELS): 1 where the image has a surface, else 0."""
        self.error = _flat(np.asarray(estimate.error_v, np.float32))
        """(n, PIXELS): expected error of v."""
        self.area: Float32 = np.maximum(self.mask.sum(1), 1.0)
        """(n,): pixels of the image's surface, at least 1."""
        self.place = Place.of(self.has_surface, self.area)

        p = _flat(estimate.p_surface)
        self.outline = Outline(self.mask, p, self.area)
        """Image against the uncertainty network's probability of a surface."""
        self.own = Outline(self.mask, p if own_p is None else _flat(own_p), self.area)
        """Image against the reconstructing network's own probability of a surface."""

    def share(self, values: Float32) -> Float32:
        """Return sums (n,) of values (n, PIXELS) over all pixels, over the surface's area."""
        return _over(values, self.area)

    @cached_property
    def v(self) -> Float32:
        """Image with its pixels in a row: (n, PIXELS)."""
        return _flat(np.asarray(self.image, np.float32))

    @cached_property
    def mean_v(self) -> Float32:
        """Mean of v over the surface: (n,)."""
        return self.share(self.v)

    @cached_property
    def spread_v(self) -> Float32:
        """Standard deviation of v over the surface: (n,)."""
        return np.sqrt(self.share((self.v - self.mean_v[:, None]) ** 2 * self.mask))

    @cached_property
    def rim(self) -> Float32:
        """Number of changes between surface and background along both axes: (n,)."""
        down, across = (
            np.diff(self.has_surface, axis=axis).reshape(len(self.has_surface), -1).sum(1)
            for axis in (1, 2)
        )
        return (down + across).astype(np.float32)

    @cached_property
    def step_down(self) -> Float32:
        """Mean step of v from a pixel to the next row, where both are surface: (n,)."""
        both = self.has_surface[:, 1:] & self.has_surface[:, :-1]
        return self.share(_flat(np.abs(np.diff(self.image, axis=1)) * both))

    @cached_property
    def step_across(self) -> Float32:
        """Mean step of v from a pixel to the next column, where both are surface: (n,)."""
        both = self.has_surface[:, :, 1:] & self.has_surface[:, :, :-1]
        return self.share(_flat(np.abs(np.diff(self.image, axis=2)) * both))

    @cached_property
    def apart(self) -> Float32:
        """Difference of the two networks' probabilities of a surface: (n, PIXELS)."""
        return np.abs(self.own.p - self.outline.p)

    @cached_property
    def own_decided(self) -> Float32:
        """Sum of p^2 over the sum of p, of the reconstructing network's own p: (n,)."""
        # 1 for probabilities of 0 and 1, and p for a constant p.
        total: Float32 = np.maximum(self.share(self.own.p), 1e-4)
        return self.share(self.own.p * self.own.p) / total


Formula = Callable[[Frames], Float32]
"""Figure (n,) of n frames."""

# All sums over pixels are divided by the area of the image's surface, so that a figure does not
# depend on how large the object is; the area itself is a figure. The order of the rows is the
# format of quality.json: means, spreads and the first layer have a number for each.
FIGURES: Mapping[str, Formula] = {
    # Overlap first: the image against the probability of a surface from another network is the
    # best single figure.
    "overlap": lambda f: f.outline.overlap,
    "logit of overlap": lambda f: _logit(f.outline.overlap),
    # Size, which the other sums are free of.
    "area": lambda f: f.area / PIXELS,
    "log of area": lambda f: np.log(f.area),
    "root of area": lambda f: np.sqrt(f.area),
    # The parts of the overlap, and how undecided the other network is.
    "p inside": lambda f: f.outline.inside,
    "p beside": lambda f: f.outline.beside,
    "unsure": lambda f: f.share(f.outline.unsure),
    "unsure inside": lambda f: f.share(f.outline.unsure * f.mask),
    # The image's outline against the outlines at five probabilities of a surface: they lie
    # far apart where that network does not know where the object ends.
    "IoU above 0.1": lambda f: f.outline.iou_above(0.1),
    "area above 0.1": lambda f: f.outline.area_above(0.1),
    "IoU above 0.3": lambda f: f.outline.iou_above(0.3),
    "area above 0.3": lambda f: f.outline.area_above(0.3),
    "IoU above 0.5": lambda f: f.outline.iou_above(0.5),
    "area above 0.5": lambda f: f.outline.area_above(0.5),
    "IoU above 0.7": lambda f: f.outline.iou_above(0.7),
    "area above 0.7": lambda f: f.outline.area_above(0.7),
    "IoU above 0.9": lambda f: f.outline.iou_above(0.9),
    "area above 0.9": lambda f: f.outline.area_above(0.9),
    # Depth.
    "mean error": lambda f: f.share(f.error * f.mask),
    "RMS error": lambda f: np.sqrt(f.share(f.error * f.error * f.mask)),
    "mean v": lambda f: f.mean_v,
    "spread of v": lambda f: f.spread_v,
    # Shape: the rim over the area's root does not depend on the size, over the area it is large
    # for thin parts.
    "roughness": lambda f: f.rim / np.sqrt(f.area),
    "thinness": lambda f: f.rim / f.area,
    "step of v down": lambda f: f.step_down,
    "step of v across": lambda f: f.step_across,
    # Place and extent of the silhouette.
    "rows off the middle": lambda f: f.place.off_middle,
    "column": lambda f: f.place.column,
    "height": lambda f: f.place.height,
    "width": lambda f: f.place.width,
    "height over width": lambda f: f.place.height / np.maximum(f.place.width, 1.0),
    "fill": lambda f: f.area / np.maximum(f.place.height * f.place.width, 1.0),
    # The other network's verdicts.
    "logit of unlike the training": lambda f: _logit(f.estimate.p_out_of_distribution),
    "logit of empty": lambda f: _logit(f.estimate.p_empty),
}
SURFACE_FIGURES: Mapping[str, Formula] = {
    # The rows of the overlap and the outlines once more, for the network's own probability.
    "own overlap": lambda f: f.own.overlap,
    "logit of own overlap": lambda f: _logit(f.own.overlap),
    "own p inside": lambda f: f.own.inside,
    "own p beside": lambda f: f.own.beside,
    "own unsure": lambda f: f.share(f.own.unsure),
    "own unsure inside": lambda f: f.share(f.own.unsure * f.mask),
    "IoU above own 0.1": lambda f: f.own.iou_above(0.1),
    "area above own 0.1": lambda f: f.own.area_above(0.1),
    "IoU above own 0.3": lambda f: f.own.iou_above(0.3),
    "area above own 0.3": lambda f: f.own.area_above(0.3),
    "IoU above own 0.5": lambda f: f.own.iou_above(0.5),
    "area above own 0.5": lambda f: f.own.area_above(0.5),
    "IoU above own 0.7": lambda f: f.own.iou_above(0.7),
    "area above own 0.7": lambda f: f.own.area_above(0.7),
    "IoU above own 0.9": lambda f: f.own.iou_above(0.9),
    "area above own 0.9": lambda f: f.own.area_above(0.9),
    # Where two networks disagree, one of them is wrong.
    "difference of the networks": lambda f: f.share(f.apart),
    "difference of the networks inside": lambda f: f.share(f.apart * f.mask),
    "own decided": lambda f: f.own_decided,
}
"""Further figures where the reconstructing network has its own probability of a surface."""
FEATURES = len(FIGURES)
WITH_SURFACE = FEATURES + len(SURFACE_FIGURES)
"""Figures without and with the reconstructing network's own probability of a surface."""


def quality_features(
    image: Float32, estimate: UncertaintyEstimate, surface: Float32 | None = None
) -> Float32:
    """Return the figures (n, FEATURES or WITH_SURFACE) that the quality of images (n, 64, 64) in v
    is predicted from; all are finite.

    `surface` (n, 64, 64) is the reconstructing network's probability of a surface. Figures are the
    same for the mirrored image.
    """
    frames = Frames(image, estimate, surface)
    table = [FIGURES] if surface is None else [FIGURES, SURFACE_FIGURES]
    figures = [formula(frames) for part in table for formula in part.values()]
    return np.stack(figures, 1).astype(np.float32)


def _over(values: Float32, area: Float32) -> Float32:
    """Return sums (n,) of values (n, PIXELS), over an area (n,)."""
    return values.sum(1) / area


def _flat(images: Float32) -> Float32:
    return images.reshape(len(images), -1)


def _logit(p: Float32) -> Float32:
    # A linear layer sees 0.99 and 0.9999 as the same; their logits differ.
    clipped = p.clip(1e-4, 1 - 1e-4)
    return np.log(clipped / (1 - clipped)).astype(np.float32)
