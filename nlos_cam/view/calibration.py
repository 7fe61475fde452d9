"""Pictures and facts of a measured wall: footprint of the view, residual, noise, saturated pixels,
quantities.

Red is nearer to the lidar than the plane, blue is behind it, as everywhere in the view.
"""

import cv2
import numpy as np
from nlos_calibration import MeasuredWall, WallRecord, footprint, wall_facts, wall_points_m
from nlos_calibration.arrays import Float64, UInt8
from numpy.typing import NDArray

from nlos_cam.view.images import PICTURE_WIDTH, difference_rgb, noise_rgb, round_span, saturated_rgb

RESIDUAL_SPAN_M = 0.002
USUAL_NOISE_M = 0.001


def outline_m(measured: MeasuredWall) -> Float64:
    """Return the footprint (n, 2) of the map on the wall as a closed polygon; empty where no beam
    meets the wall.

    The field of view cuts a convex region out of a plane, and the wall is convex: their
    intersection is convex too, so the convex hull of the cells on the wall is exact.
    """
    record = measured.record
    visible = footprint(np.array(record.wall_from_lidar), record.rig.pinhole, record.rig.wall)
    corners_m = visible.corners_m[record.rig.wall.contains(visible.corners_m)]
    points_m = np.concatenate([visible.cells_m[visible.on_wall], corners_m])
    if len(points_m) == 0:
        return points_m
    hull_m = cv2.convexHull(points_m.astype(np.float32))[:, 0].astype(np.float64)
    return np.concatenate([hull_m, hull_m[:1]])


def wall_pictures(measured: MeasuredWall) -> dict[str, tuple[str, UInt8]]:
    """Return title with scale, and picture (height, width, 3), of each map of the reference; none
    without one.
    """
    reference = measured.reference
    if reference is None:
        return {}
    step = max(1, reference.depth_m.shape[1] // PICTURE_WIDTH)
    residual_m = wall_points_m(measured.record, reference)[::step, ::step, 2]
    noise_m = reference.depth_std_m
    span_m = round_span(reference.depth_std_m, otherwise=USUAL_NOISE_M)
    saturated = saturated_rgb(reference.ir[::step, ::step], _block_max(reference.saturated, step))
    return {
        "wall_residual": (
            f"Bare wall: residual (±{1e3 * RESIDUAL_SPAN_M:g} mm)",
            difference_rgb(-residual_m, RESIDUAL_SPAN_M),
        ),
        "wall_noise": (
            f"Bare wall: noise (0 to {1e3 * span_m:g} mm)",
            noise_rgb(noise_m[::step, ::step], span_m),
        ),
        "wall_saturated": ("Bare wall: infrared, saturated pixels in pink", saturated),
    }


def _block_max(values: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Return the maximum of each block of `step` pixels, so that thinning keeps a single saturated
    pixel.
    """
    rows, columns = (np.arange(0, size, step) for size in values.shape)
    return np.maximum.reduceat(np.maximum.reduceat(values, rows, axis=0), columns, axis=1)


def calibration_facts(record: WallRecord) -> list[list[str]]:
    """Return rows of quantity, value (± 95 %) and meaning, with the verdict first and warnings
    last.
    """
    notes = list(record.warnings)
    if not record.reference:
        notes.append(
            "drift is not watched: no reference of the bare wall; calibrate the wall again"
        )
    return [
        ["verdict", record.verdict, record.advice],
        *(list(fact) for fact in wall_facts(record)),
        *(["note", text, ""] for text in notes),
    ]
