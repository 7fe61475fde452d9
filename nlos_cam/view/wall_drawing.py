"""A measured wall as Rerun data: points, footprint, distance and angle in 3D; residual, noise, saturation as pictures.

Red is nearer to the lidar than the plane, blue is behind it, as everywhere in the view.

The calibration in words, as Markdown: the verdict, what was measured and how surely, and what has changed since.
"""

from collections.abc import Iterator, Sequence
from math import ceil, sqrt
from typing import Any

import cv2
import numpy as np
import rerun as rr
from nlos_calibration import (
    INTERVAL_STDS,
    BareWall,
    BoardRecord,
    Extent,
    MeasuredWall,
    Verdict,
    WallRecord,
    footprint,
    on_plane,
    wall_points_m,
)
from nlos_calibration.arrays import Float64, Mask
from numpy.typing import NDArray

from nlos_cam.view.images import PICTURE_WIDTH, SATURATED_RGB, difference_rgb, noise_rgb, round_span, saturated_rgb
from nlos_cam.view.layout import WallNames

RESIDUAL_SPAN_M, USUAL_NOISE_M = 0.002, 0.001
MAX_POINTS, MAX_SATURATED = 6000, 1500
OFF_WALL_M = 0.05
"""What strays farther from the plane is in the picture only: in 3D it would hide the bench."""
OUTLIER_RGB = (70, 70, 70)
FOOTPRINT_RGB = (240, 240, 240)
AXES_RGB = ((255, 90, 90), (110, 220, 110), (110, 150, 255))
VERDICT_RGB: dict[Verdict, tuple[int, int, int]] = {
    "good": (80, 220, 120),
    "out of range": (255, 170, 60),
    "doubtful": (255, 170, 60),
}
AXIS_M = 0.05
"""How long the wall frame's axes are drawn."""


def every_nth(shape: tuple[int, ...], most: int) -> tuple[slice, slice]:
    """Rows and columns to keep of an image so that at most `most` pixels remain, evenly."""
    step = max(ceil(sqrt(shape[0] * shape[1] / most)), 1)
    while ceil(shape[0] / step) * ceil(shape[1] / step) > most:
        step += 1
    return slice(None, None, step), slice(None, None, step)


def outline_m(measured: MeasuredWall) -> Float64:
    """The footprint (n, 2) of the map on the wall as a polygon, closed; empty where no beam meets the wall.

    What is seen of a flat wall is convex, and so is the wall: the hull of the cells that are on it loses nothing.
    """
    record = measured.record
    seen = footprint(np.array(record.wall_from_lidar), record.rig.pinhole, record.rig.wall)
    corners_m = seen.corners_m[_within(seen.corners_m, record.rig.wall)]
    points_m = np.concatenate([seen.cells_m[seen.on_wall], corners_m])
    if len(points_m) == 0:
        return points_m
    hull_m = cv2.convexHull(points_m.astype(np.float32))[:, 0].astype(np.float64)
    return np.concatenate([hull_m, hull_m[:1]])


def _within(points_m: Float64, wall: Extent) -> Mask:
    x_m, y_m = points_m[..., 0], points_m[..., 1]
    return (x_m >= wall.x_min_m) & (x_m <= wall.x_max_m) & (y_m >= wall.y_min_m) & (y_m <= wall.y_max_m)


def bench_drawings(measured: MeasuredWall) -> Iterator[tuple[str, Any]]:
    """What the calibration adds to the bench, by path; none of it moves."""
    record = measured.record
    pose, verdict_rgb = np.array(record.wall_from_lidar), VERDICT_RGB[record.verdict]
    if len(outline := outline_m(measured)):
        strip = np.column_stack([outline, np.zeros(len(outline))])
        yield "bench/measured/footprint", rr.LineStrips3D([strip], colors=[FOOTPRINT_RGB], radii=0.0015)
    lidar_m, foot_m = pose[:3, 3], np.array([*pose[:2, 3], 0.0])
    axis_m = np.array([*on_plane(pose, np.array([0.0, 0.0, 1.0])), 0.0])
    told = {"distance": (foot_m, f"{record.distance_m:.4f} m"), "axis": (axis_m, f"{record.facing_deg:.1f} degrees")}
    for name, (end_m, label) in told.items():
        yield f"bench/measured/{name}", rr.LineStrips3D([[lidar_m, end_m]], colors=[verdict_rgb], radii=0.002)
        yield f"bench/measured/{name}/end", rr.Points3D([end_m], colors=[verdict_rgb], radii=0.005, labels=[label])
    frame = rr.Arrows3D(vectors=np.eye(3) * AXIS_M, colors=AXES_RGB, radii=0.002)
    yield "bench/measured/frame", frame
    if measured.reference is not None:
        yield from _points(record, measured.reference)


def _points(record: WallRecord, reference: BareWall) -> Iterator[tuple[str, Any]]:
    points_m = wall_points_m(record, reference)
    near = np.abs(points_m[..., 2]) <= OFF_WALL_M  # False for NaN
    rgb = difference_rgb(-points_m[..., 2], RESIDUAL_SPAN_M)
    rgb[~reference.inliers] = OUTLIER_RGB
    kept = every_nth(near.shape, MAX_POINTS)
    if near[kept].any():
        drawn = rr.Points3D(points_m[kept][near[kept]], colors=rgb[kept][near[kept]], radii=rr.Radius.ui_points(1.5))
        yield "bench/measured/points", drawn
    blinded_m = points_m[near & (reference.saturated > 0.0)]
    if len(blinded_m):
        some_m = blinded_m[:: ceil(len(blinded_m) / MAX_SATURATED)]
        yield "bench/measured/saturated", rr.Points3D(some_m, colors=[SATURATED_RGB], radii=0.003)


def wall_pictures(measured: MeasuredWall) -> dict[str, NDArray[np.uint8]]:
    """The reference as pictures, by the names of the views' fields; none without a reference."""
    reference = measured.reference
    if reference is None:
        return {}
    step = max(1, reference.depth_m.shape[1] // PICTURE_WIDTH)
    residual_m = wall_points_m(measured.record, reference)[::step, ::step, 2]
    return {
        "residual": difference_rgb(-residual_m, RESIDUAL_SPAN_M),
        "noise": noise_rgb(reference.depth_std_m[::step, ::step], _noise_span_m(reference)),
        "saturated": saturated_rgb(reference.ir[::step, ::step], _most(reference.saturated, step)),
    }


def wall_names(measured: MeasuredWall, difference_span_m: float | None) -> WallNames:
    """What the views of this wall are called; `difference_span_m` is None where no difference is shown."""
    span_cm = 100 * (difference_span_m or 0.0)
    difference = f"Change (red: {span_cm:g} cm nearer)" if difference_span_m else ""
    if measured.reference is None:
        return WallNames(difference)
    residual = f"Residual (±{RESIDUAL_SPAN_M * 1e3:g} mm)"
    noise = f"Noise (to {_noise_span_m(measured.reference) * 1e3:g} mm)"
    return WallNames(difference, residual, noise, "Saturated")


def _noise_span_m(reference: BareWall) -> float:
    return round_span(reference.depth_std_m, otherwise=USUAL_NOISE_M)


def _most(values: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """The largest of each block of `step` pixels: a single one is not thinned away."""
    height, width = (-(-size // step) * step for size in values.shape)
    padded = np.zeros((height, width), np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(height // step, step, width // step, step).max(axis=(1, 3))


ALL_IS_WELL = "nothing has drifted since the calibration"
NOT_WATCHED = "not watched: the record has no reference of the bare wall; calibrate the wall again"


def calibration_text(record: WallRecord, warnings: Sequence[str] = ()) -> str:
    """The calibration's page; `warnings` are those of now."""
    rows = [f"| {what} | {told} |" for what, told in _rows(record)]
    parts = [
        f"**{record.verdict.upper()}**: {record.advice}",
        _now(warnings, watched=bool(record.reference)),
        "\n".join(["| measured | with its 95 % interval |", "|---|---|", *rows]),
        *([f"Board: {_board(record.board)}"] if record.board else []),
        *(f"Note: {note}" for note in record.warnings),
    ]
    return "\n\n".join(parts)


def _now(warnings: Sequence[str], *, watched: bool) -> str:
    if not warnings:
        return f"**Now**: {ALL_IS_WELL if watched else NOT_WATCHED}"
    return "\n".join(["> [!WARNING]", *(f"> - {warning}" for warning in warnings)])


def _rows(record: WallRecord) -> list[tuple[str, str]]:
    """What was measured, by name; what was not is left out."""
    rows = [
        ("distance", f"{record.distance_m:.4f} m{_interval(record.distance_std_m, 'mm', 1e3)}"),
        ("facing", f"{record.facing_deg:.2f}°{_interval(record.facing_std_deg, '°')}"),
        ("yaw", f"{record.yaw_deg:+z.2f}°{_interval(record.yaw_std_deg, '°')}"),
        ("pitch", f"{record.pitch_deg:+z.2f}°{_interval(record.pitch_std_deg, '°')}"),
    ]
    if record.range_offset_std_m is not None:
        told = f"{1e3 * record.range_offset_m:+z.1f} mm{_interval(record.range_offset_std_m, 'mm', 1e3)}"
        rows.append((f"offset of {record.range_offset_cause}", told))
    if record.occluder is not None:
        rows.append(("occluder", f"{record.occluder.x_m:.3f} m, gap {record.occluder.gap_m:.3f} m"))
    rows.append(("date", f"{record.created.isoformat()}, {record.frames} frames"))
    if record.temperatures_c:
        coldest, warmest = min(record.temperatures_c.values()), max(record.temperatures_c.values())
        rows.append(("temperature", f"{coldest:.1f} to {warmest:.1f} °C" if warmest > coldest else f"{warmest:.1f} °C"))
    return rows


def _interval(std: float | None, unit: str, scale: float = 1.0) -> str:
    """Nothing where no uncertainty is known: records of version 1."""
    if std is None:
        return ""
    gap = "" if unit == "°" else " "
    return f" ± {_plain(INTERVAL_STDS * scale * std)}{gap}{unit}"


def _plain(value: float) -> str:
    """Without a power of ten; what is below a thousandth is rounded up to it."""
    return "0.001" if value < 0.001 else f"{value:.3f}" if value < 0.1 else f"{value:.2f}"


def _board(board: BoardRecord) -> str:
    if board.disagreement_m is None or board.disagreement_deg is None:
        return f"{board.corners} corners; the depth was refused"
    apart = f"{1e3 * board.disagreement_m:+z.2f} mm and {board.disagreement_deg:.2f}° from the depth's plane"
    return f"{apart} ({board.disagreement_sigmas:.1f} sigma); used: {board.used}"
