"""Recognition: the kind of a reconstruction, by the nearest silhouette among training objects of
the 18 kinds.
"""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64
from nlos_models import surface

from nlos_cam.objects import (
    CATEGORIES,
    category_triangles,
    image_from_depth,
    orthographic_depth,
    place,
    random_pose,
)

PER_KIND = 60
"""Silhouettes of each kind to compare with, of training settings in random poses."""
ROOT_AREA = 24.0
"""Square root of a standard silhouette's area, in pixels."""


def recognise(images: Float32, box: ObjectBox) -> list[str]:
    """Return the kind whose silhouette is nearest to that of each image (n, 64, 64); "" where there
    is no surface.

    Silhouettes are moved to the middle and scaled to one area; nearest is the largest correlation.
    """
    names, gallery = _gallery(box)  # pyright: ignore[reportArgumentType] (a frozen model has a hash)
    standard = _standard(images)
    nearest = (standard @ gallery.T).argmax(1)
    return [names[k] if one.any() else "" for k, one in zip(nearest, standard, strict=True)]


def recognised(images: Float32, kinds: Sequence[str], box: ObjectBox) -> Float64:
    """Return 1 for each image (n, 64, 64) that is recognised as its kind, else 0; (n,)."""
    return np.array(
        [found == kind for found, kind in zip(recognise(images, box), kinds, strict=True)],
        np.float64,
    )


@cache  # a thousand objects are drawn, and `evaluate` asks for truth and for reconstructions
def _gallery(box: ObjectBox) -> tuple[list[str], Float32]:
    """Return the kinds and standard silhouettes (18 PER_KIND, pixels) to compare with, the same in
    every run.
    """
    generator = np.random.default_rng(0)
    names = list[str]()
    images = list[Float32]()
    for name in CATEGORIES:
        for seed in range(PER_KIND):
            triangles = place(category_triangles(name, seed), random_pose(generator, box), box)
            images.append(image_from_depth(orthographic_depth(triangles, box), box))
            names.append(name)
    return names, _standard(np.stack(images))


def _standard(images: Float32) -> Float32:
    """Return the silhouettes of images (n, 64, 64), centred, of one area and of unit length: (n,
    4096).
    """
    rows = list[Float32]()
    for mask in surface(images).astype(np.float32):
        area = float(mask.sum())
        shape = mask.shape
        if not area:
            rows.append(np.zeros(mask.size, np.float32))
            continue
        y, x = (float(values.mean()) for values in np.nonzero(mask))
        scale = ROOT_AREA / np.sqrt(area)
        move = np.array(
            [[scale, 0, shape[1] / 2 - scale * x], [0, scale, shape[0] / 2 - scale * y]]
        )
        moved = np.asarray(cv2.warpAffine(mask, move, shape[::-1]), np.float32).ravel()
        rows.append(moved / max(float(np.linalg.norm(moved)), 1e-9))
    return np.stack(rows)
