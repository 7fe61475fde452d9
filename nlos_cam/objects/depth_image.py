"""Hidden depth in its two forms: metres over the object box, and the image v in [0, 1] that the networks speak."""

import numpy as np
from nlos_calibration.rig import ObjectBox, Rig
from nlos_models.metrics import BACKGROUND_BELOW_V, LEAST_V
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import OBJECT_PIXELS, Float32


def object_box(rig: Rig) -> ObjectBox:
    """The box that hidden objects live in. Raises SceneError where the rig has none."""
    if rig.object_box is None:
        raise SceneError(f"rig {rig.name!r} has no object_box to hide an object in: add [object_box] to its record")
    return rig.object_box


def image_from_depth(depth_m: NDArray[np.floating], box: ObjectBox) -> Float32:
    """Depth (..., 64, 64) in metres, NaN for background, as v: 0 background, else 0.1 (far) to 1 (near the wall)."""
    v = LEAST_V + (1 - LEAST_V) * (box.z_far_m - depth_m) / (box.z_far_m - box.z_near_m)
    return np.where(np.isnan(depth_m), 0.0, np.clip(v, LEAST_V, 1.0)).astype(np.float32)


def depth_from_image(v: NDArray[np.floating], box: ObjectBox) -> Float32:
    """The way back: v (..., 64, 64) as depth in metres, NaN where v < 0.05."""
    share = np.clip((v - LEAST_V) / (1 - LEAST_V), 0.0, 1.0)
    depth_m = box.z_far_m - share * (box.z_far_m - box.z_near_m)
    return np.where(v < BACKGROUND_BELOW_V, np.nan, depth_m).astype(np.float32)


def cell_centres_m(box: ObjectBox, pixels: int = OBJECT_PIXELS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wall x of the columns (pixels,) and wall y of the rows (pixels,): row 0 is at the top, the largest y."""
    steps = (np.arange(pixels) + 0.5) / pixels
    x_m = box.x_min_m + steps * (box.x_max_m - box.x_min_m)
    y_m = box.y_max_m - steps * (box.y_max_m - box.y_min_m)
    return x_m, y_m
