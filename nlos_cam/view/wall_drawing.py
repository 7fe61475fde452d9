"""Rerun drawings and text of a measured wall: points, footprint, distance and angle in 3D, maps, Markdown summary.

Red is nearer to the lidar than the plane, blue is behind it, as everywhere in the view.
"""

from collections.abc import Iterator, Sequence
from math import ceil, sqrt
from typing import Any

import cv2
import numpy as np
import rerun as rr
from nlos_calibration import (
    BareWall,
    Extent,
    MeasuredWall,
    Verdict,
    WallRecord,
    footprint,
    on_plane,
    wall_points_m,
    wall_summary,
)
from nlos_calibration.arrays import Float64, Mask
from numpy.typing import NDArray

from nlos_cam.view.images import PICTURE_WIDTH, SATURATED_RGB, difference_rgb, noise_rgb, round_span, saturated_rgb
from nlos_cam.view.layout import WallNames

RESIDUAL_SPAN_M, USUAL_NOISE_M = 0.002, 0.001
MAX_POINTS, MAX_SATURATED = 6000, 1500
OFF_WALL_M = 0.05
"""Pixels farther than this from the plane are in the picture only: in 3D they would hide the bench."""
OUTLIER_RGB = (70, 70, 70)
FOOTPRINT_RGB = (240, 240, 240)
AXES_RGB = ((255, 90, 90), (110, 220, 110), (110, 150, 255))
VERDICT_RGB: dict[Verdict, tuple[int, int, int]] = {
    "good": (80, 220, 120),
    "out of range": (255, 170, 60),
    "doubtful": (255, 170, 60),
}
AXIS_M = 0.05
"""Drawn length of the wall frame's axes."""


def every_nth(shape: tuple[int, ...], max_pixels: int) -> tuple[slice, slice]:
    """Return slices of rows and columns that thin an image evenly to at most `max_pixels` pixels."""
    step = max(ceil(sqrt(shape[0] * shape[1] / max_pixels)), 1)
    while ceil(shape[0] / step) * ceil(shape[1] / step) > max_pixels:
        step += 1
    return slice(None, None, step), slice(None, None, step)


def outline_m(measured: MeasuredWall) -> Float64:
    """Return the footprint (n, 2) of the map on the wall as a closed polygon; empty where no beam meets the wall.

    The field of view cuts a convex region out of a plane, and the wall is convex: their intersection is convex too,
    so the convex hull of the cells on the wall is exact.
    """
    record = measured.record
    visible = footprint(np.array(record.wall_from_lidar), record.rig.pinhole, record.rig.wall)
    corners_m = visible.corners_m[_within(visible.corners_m, record.rig.wall)]
    points_m = np.concatenate([visible.cells_m[visible.on_wall], corners_m])
    if len(points_m) == 0:
        return points_m
    hull_m = cv2.convexHull(points_m.astype(np.float32))[:, 0].astype(np.float64)
    return np.concatenate([hull_m, hull_m[:1]])


def _within(points_m: Float64, wall: Extent) -> Mask:
    x_m, y_m = points_m[..., 0], points_m[..., 1]
    return (x_m >= wall.x_min_m) & (x_m <= wall.x_max_m) & (y_m >= wall.y_min_m) & (y_m <= wall.y_max_m)


def bench_drawings(measured: MeasuredWall) -> Iterator[tuple[str, Any]]:
    """Yield the calibration's static drawings in the bench, each with its entity path."""
    record = measured.record
    pose, verdict_rgb = np.array(record.wall_from_lidar), VERDICT_RGB[record.verdict]
    if len(outline := outline_m(measured)):
        strip = np.column_stack([outline, np.zeros(len(outline))])
        yield "bench/measured/footprint", rr.LineStrips3D([strip], colors=[FOOTPRINT_RGB], radii=0.0015)
    lidar_m, foot_m = pose[:3, 3], np.array([*pose[:2, 3], 0.0])
    axis_m = np.array([*on_plane(pose, np.array([0.0, 0.0, 1.0])), 0.0])
    ends = {"distance": (foot_m, f"{1e3 * record.distance_m:.1f} mm"), "axis": (axis_m, f"{record.facing_deg:.1f}°")}
    for name, (end_m, label) in ends.items():
        yield f"bench/measured/{name}", rr.LineStrips3D([[lidar_m, end_m]], colors=[verdict_rgb], radii=0.002)
        yield f"bench/measured/{name}/end", rr.Points3D([end_m], colors=[verdict_rgb], radii=0.005, labels=[label])
    yield "bench/measured/frame", rr.Arrows3D(vectors=np.eye(3) * AXIS_M, colors=AXES_RGB, radii=0.002)
    if measured.reference is not None:
        yield from _points(record, measured.reference)


def _points(record: WallRecord, reference: BareWall) -> Iterator[tuple[str, Any]]:
    points_m = wall_points_m(record, reference)
    near = np.abs(points_m[..., 2]) <= OFF_WALL_M  # False for NaN
    rgb = difference_rgb(-points_m[..., 2], RESIDUAL_SPAN_M)
    rgb[~reference.inliers] = OUTLIER_RGB
    thinned = every_nth(near.shape, MAX_POINTS)
    if near[thinned].any():
        shown, radii = near[thinned], rr.Radius.ui_points(1.5)
        yield "bench/measured/points", rr.Points3D(points_m[thinned][shown], colors=rgb[thinned][shown], radii=radii)
    blinded_m = points_m[near & (reference.saturated > 0.0)]
    if len(blinded_m):
        blinded_m = blinded_m[:: ceil(len(blinded_m) / MAX_SATURATED)]
        yield "bench/measured/saturated", rr.Points3D(blinded_m, colors=[SATURATED_RGB], radii=0.003)


def wall_pictures(measured: MeasuredWall) -> dict[str, NDArray[np.uint8]]:
    """Return the reference's pictures by the names of the views' fields; none without a reference."""
    reference = measured.reference
    if reference is None:
        return {}
    step = max(1, reference.depth_m.shape[1] // PICTURE_WIDTH)
    residual_m = wall_points_m(measured.record, reference)[::step, ::step, 2]
    return {
        "residual": difference_rgb(-residual_m, RESIDUAL_SPAN_M),
        "noise": noise_rgb(reference.depth_std_m[::step, ::step], _noise_span_m(reference)),
        "saturated": saturated_rgb(reference.ir[::step, ::step], _block_max(reference.saturated, step)),
    }


def wall_names(measured: MeasuredWall, difference_span_m: float | None) -> WallNames:
    """Return the titles of this wall's views; `difference_span_m` is None where no difference is shown."""
    span_cm = 100 * (difference_span_m or 0.0)
    difference = f"Change (red: {span_cm:g} cm nearer)" if difference_span_m else ""
    if measured.reference is None:
        return WallNames(difference)
    residual = f"Residual (±{RESIDUAL_SPAN_M * 1e3:g} mm)"
    noise = f"Noise (to {_noise_span_m(measured.reference) * 1e3:g} mm)"
    return WallNames(difference, residual, noise, "Saturated")


def _noise_span_m(reference: BareWall) -> float:
    return round_span(reference.depth_std_m, otherwise=USUAL_NOISE_M)


def _block_max(values: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Return the maximum of each block of `step` pixels, so that thinning keeps a single saturated pixel."""
    height, width = (-(-size // step) * step for size in values.shape)
    padded = np.zeros((height, width), np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(height // step, step, width // step, step).max(axis=(1, 3))


ALL_IS_WELL = "nothing has drifted since the calibration"
NOT_WATCHED = "drift is not watched: the record has no reference of the bare wall; calibrate the wall again"


def calibration_text(record: WallRecord, warnings: Sequence[str] = ()) -> str:
    """Return the calibration's page as Markdown; `warnings` are those of now."""
    status = f"**Now**: {ALL_IS_WELL if record.reference else NOT_WATCHED}"
    if warnings:
        status = "\n".join(["> [!WARNING]", *(f"> - {warning}" for warning in warnings)])
    return wall_summary(record, status)
