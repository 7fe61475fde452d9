"""Drawings of the bench for the report: to scale from above and from the side; the wall from the
front.
"""

from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, radians, sin
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from nlos_calibration import (
    MAP_SHAPE,
    Extent,
    ObjectBox,
    Occluder,
    Rig,
    WallRecord,
    corner_rays,
    footprint,
    on_plane,
)
from nlos_calibration.arrays import Float64

from nlos_cam.report import Picture, figure_of, png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Limits = tuple[float, float]
Style = dict[str, Any]

WALL = "0.35"
LIDAR = "#08306b"
EDGE = "#4292c6"
VIEW = "#9ecae1"
OCCLUDER = "#000000"
OBJECT = "#d95f02"
FAR_M = 2.5
MARGIN_M = 0.12
MAX_X_DRAWN_M = 0.9
MAX_Y_DRAWN_M = 0.35
"""Limits from the foot: an optical axis that meets the wall beyond them leaves the picture."""
BENCH_WIDTH_IN = 11.0
X = 0
Y = 1
Z = 2
NAMES = {X: "x along the wall (m)", Y: "y up (m)", Z: "z from the wall (m)"}


@dataclass(frozen=True)
class _Side:
    """View along one axis of the wall frame: the axes drawn across and up the page."""

    across: int
    up: int
    turned: bool
    """True if the axis that goes up the page points down."""


ABOVE = _Side(X, Z, turned=True)
BESIDE = _Side(Z, Y, turned=False)


def bench_picture(record: WallRecord) -> Picture:
    """Return the bench from above and from the side, both to one scale."""
    limits = drawn_limits(record.rig)
    wide, tall, deep = (high - low for low, high in limits)
    # both drawings side by side at one scale, with 14 % of the width and 0.9 inches for labels
    height_in = 0.86 * BENCH_WIDTH_IN * max(tall, deep) / (wide + deep) + 0.9
    figure = figure_of(BENCH_WIDTH_IN, height_in)
    above, beside = figure.subplots(1, 2, width_ratios=(wide, deep))
    for axis, side in ((above, ABOVE), (beside, BESIDE)):
        _draw(axis, side, record, limits)
    _dimension(above, record)
    above.set_title(
        f"from above: {record.distance_m:.3f} m away, facing {record.facing_deg:.1f}°", fontsize=11
    )
    beside.set_title(f"from the side: pitch {record.pitch_deg:+z.1f}°", fontsize=11)
    caption = (
        "Both to the same scale. The dash-dotted line is the lidar's optical axis; the blue area"
        " is its field of view without the occluder. Its dashed edges never meet the wall. From"
        " the side the hidden object (dashed) overlaps the lidar: it stands beside it, behind the"
        " occluder. Light goes from the lidar to the wall, past the occluder's edge to the hidden"
        f" object, and back the same way. {_occluder_source(record)}"
    )
    return Picture("The bench", caption, png(figure))


def _occluder_source(record: WallRecord) -> str:
    if record.rig.occluder is None:
        return "This rig has no occluder."
    if record.occluder is None:
        return "The dashed occluder has the paper's place: it was not measured here."
    return f"The occluder was {record.occluder.source}."


def drawn_limits(rig: Rig) -> tuple[Limits, Limits, Limits]:
    """Return the drawn ranges of x, y and z: the whole bench, and the optical axis as far as it
    fits.
    """
    axis_end = _axis_end(rig)
    highest = float(np.clip(axis_end[Y], -MAX_Y_DRAWN_M, MAX_Y_DRAWN_M))
    x = [0.0, axis_end[X]]
    y = [highest, -0.15, 0.15]
    z = [rig.lidar.distance_m + 0.05]
    for extent in (rig.object_box, rig.relay):
        if extent is not None:
            x += [extent.x_min_m, extent.x_max_m]
            y += [extent.y_min_m, extent.y_max_m]
    if rig.object_box is not None:
        z.append(rig.object_box.z_far_m)
    if rig.occluder is not None:
        x.append(rig.occluder.x_m)
        z.append(rig.occluder.z_min_m + 0.1)
    return (
        (min(x) - MARGIN_M, max(x) + MARGIN_M),
        (min(y) - 0.05, max(y) + 0.05),
        (-0.04, max(z) + 0.04),
    )


def _axis_end(rig: Rig) -> Float64:
    """Return the point where the optical axis meets the wall, or where it leaves the picture."""
    along = rig.wall_from_lidar[:3, 2]
    distance_m = rig.lidar.distance_m
    aside = hypot(along[X], along[Y])
    reach_m = min(distance_m / -along[Z], MAX_X_DRAWN_M / aside if aside > 0.0 else FAR_M)
    return np.array([0.0, 0.0, distance_m]) + reach_m * along


def _draw(
    axis: "Axes", side: _Side, record: WallRecord, limits: tuple[Limits, Limits, Limits]
) -> None:
    rig = record.rig
    low, high = limits[side.up]
    axis.set(xlim=limits[side.across], ylim=(high, low) if side.turned else (low, high))
    axis.set(xlabel=NAMES[side.across], ylabel=NAMES[side.up], aspect="equal")
    _view(axis, side, rig)
    _wall(axis, side)
    if rig.occluder is not None and side is ABOVE:
        _occluder_from_above(axis, record, rig.occluder, high)
    elif rig.occluder is not None:
        _occluder_from_the_side(axis, record, rig.occluder, high)
    if rig.object_box is not None:
        _object(axis, side, rig.object_box)
    place = rig.wall_from_lidar[:3, 3][[side.across, side.up]]
    axis.plot(*place, marker="s", markersize=9, color=LIDAR, zorder=5)
    style: Style = {"ha": "center", "va": "center", "color": LIDAR, "fontsize": 10}
    axis.annotate("lidar", tuple(place), xytext=(0, -15), textcoords="offset points", **style)


def _wall(axis: "Axes", side: _Side) -> None:
    from matplotlib.patches import Rectangle

    style: Style = {"facecolor": "0.85", "edgecolor": WALL, "hatch": "///", "linewidth": 1.5}
    if side is ABOVE:
        axis.add_patch(Rectangle((-FAR_M, -1.0), 2.0 * FAR_M, 1.0, **style))
    else:
        axis.add_patch(Rectangle((-1.0, -FAR_M), 1.0, 2.0 * FAR_M, **style))


def _view(axis: "Axes", side: _Side, rig: Rig) -> None:
    """Draw the field of view: corner rays, the area between them, the optical axis."""
    pose = rig.wall_from_lidar
    drawn = [side.across, side.up]
    start = pose[:3, 3]
    corners = [start]
    for edge in corner_rays(rig.pinhole) @ pose[:3, :3].T:
        meets_wall = edge[Z] < 0.0
        length = min(start[Z] / -edge[Z], FAR_M) if meets_wall else FAR_M
        end = start + edge * length
        # with its foot on the wall: rays that end over the wall cover what is below them
        corners += [end, end * np.array([1.0, 1.0, 0.0])]
        line = "-" if meets_wall else "--"
        axis.plot(*np.stack([start, end])[:, drawn].T, color=EDGE, linewidth=1.0, linestyle=line)
    outline = cv2.convexHull(np.array(corners, np.float32)[:, drawn])[:, 0]
    axis.fill(*outline.T, color=VIEW, alpha=0.3, linewidth=0.0, zorder=0)
    path = np.stack([start, _axis_end(rig)])
    axis.plot(*path[:, drawn].T, color=LIDAR, linewidth=1.3, linestyle="-.")


def _occluder_style(record: WallRecord) -> tuple[str, str]:
    """Return line style and label: dashed if its place is assumed."""
    return ("-", "occluder") if record.occluder is not None else ("--", "occluder (paper's)")


def _occluder_from_above(
    axis: "Axes", record: WallRecord, occluder: Occluder, low_m: float
) -> None:
    line, label = _occluder_style(record)
    lean = radians((record.occluder.tilt_deg if record.occluder else None) or 0.0)
    top = np.array([occluder.x_m, occluder.z_min_m])
    end = top + FAR_M * np.array([sin(lean), cos(lean)])
    width = 4.0 if record.occluder else 2.0
    axis.plot(*np.stack([top, end]).T, color=OCCLUDER, linewidth=width, linestyle=line)
    arrow: Style = {"arrowstyle": "<->", "color": OCCLUDER, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", (occluder.x_m, 0.0), xytext=tuple(top), arrowprops=arrow)
    gap = f"gap {occluder.z_min_m:.3f} m"
    axis.text(occluder.x_m + 0.01, 0.5 * occluder.z_min_m, gap, fontsize=9, va="center")
    style: Style = {"fontsize": 9, "rotation": 90, "ha": "left", "va": "bottom"}
    axis.text(occluder.x_m + 0.02, low_m - 0.01, label, **style)


def _occluder_from_the_side(
    axis: "Axes", record: WallRecord, occluder: Occluder, high_m: float
) -> None:
    line, label = _occluder_style(record)
    if record.occluder is not None:
        axis.axvspan(occluder.z_min_m, FAR_M, color=OCCLUDER, alpha=0.12, linewidth=0.0)
    axis.axvline(occluder.z_min_m, color=OCCLUDER, linewidth=1.5, linestyle=line)
    axis.text(occluder.z_min_m + 0.01, high_m - 0.01, label, fontsize=9, va="top")


def _object(axis: "Axes", side: _Side, box: ObjectBox) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Rectangle

    spans = {
        X: (box.x_min_m, box.x_max_m),
        Y: (box.y_min_m, box.y_max_m),
        Z: (box.z_near_m, box.z_far_m),
    }
    left, right = spans[side.across]
    low, high = spans[side.up]
    size = right - left, high - low
    words = "hidden object"
    line = "-"
    opacity = 0.2
    if side is BESIDE:
        # the box lies behind the lidar and the occluder, at some distance from the lidar's plane
        words += f",\n{box.x_min_m:.2f} m to the\nside of the lidar"
        line = "--"
        opacity = 0.07
    fill = to_rgba(OBJECT, opacity)
    outline: Style = {"facecolor": fill, "edgecolor": OBJECT, "linewidth": 1.5, "linestyle": line}
    axis.add_patch(Rectangle((left, low), *size, **outline))
    text: Style = {"ha": "right", "va": "bottom" if side.turned else "top", "fontsize": 9}
    axis.text(right - 0.008, high - 0.008, words, color="#8c3b00", **text)


def _dimension(axis: "Axes", record: WallRecord) -> None:
    """Draw the perpendicular with its length, and its angle to the optical axis, in the view from
    above.
    """
    from matplotlib.patches import Arc

    distance_m = record.rig.lidar.distance_m
    along = record.rig.wall_from_lidar[:3, 2]
    to_right = along[X] >= 0.0
    arrow: Style = {"arrowstyle": "<->", "color": LIDAR, "shrinkA": 0, "shrinkB": 5}
    axis.annotate("", (0.0, 0.0), xytext=(0.0, distance_m), arrowprops=arrow)
    axis.plot(0.0, 0.0, marker="o", markersize=5, color=LIDAR)
    inner, outer = ("left", "right") if to_right else ("right", "left")
    box = {"facecolor": "white", "alpha": 0.8, "pad": 1.0}
    style: Style = {"fontsize": 10, "color": LIDAR, "va": "center", "bbox": box}
    aside_m = -0.012 if to_right else 0.012
    axis.text(aside_m, 0.4 * distance_m, f"{distance_m:.3f} m", ha=outer, **style)
    drawn_deg = degrees(atan2(along[X], -along[Z]))
    radius_m = 0.45 * distance_m
    first_deg, last_deg = sorted((-90.0, drawn_deg - 90.0))
    size_m = 2.0 * radius_m, 2.0 * radius_m
    axis.add_patch(Arc((0.0, distance_m), *size_m, theta1=first_deg, theta2=last_deg, color=LIDAR))
    middle = radians(0.5 * drawn_deg - 90.0)
    place = 1.15 * radius_m * cos(middle), distance_m + 1.15 * radius_m * sin(middle)
    axis.text(*place, _facing(record), ha=inner, **style)


def _facing(record: WallRecord) -> str:
    """Return the facing angle, and the yaw, which the view from above shows, if it differs."""
    facing = f"{record.facing_deg:.1f}°"
    if abs(record.facing_deg - abs(record.yaw_deg)) <= 0.3:
        return facing
    return f"{facing}\n(yaw {record.yaw_deg:+z.1f}°)"


RELAY = "#1b9e77"
VISIBLE = "#c6dbef"
VISIBLE_EDGE = "#6baed6"
CELLS_PER_LINE = 8
FOOTPRINT_WIDTH_IN = 8.6
MAX_CELL_M = 100.0


def footprint_picture(record: WallRecord) -> Picture:
    """Return the wall from the front: the lidar's field of view, the relay, the hidden object's
    box.
    """
    rig = record.rig
    x, y, _ = drawn_limits(rig)
    height_in = FOOTPRINT_WIDTH_IN * (y[1] - y[0]) / (x[1] - x[0]) + 1.0
    figure = figure_of(FOOTPRINT_WIDTH_IN, min(height_in, 9.0))
    axis = figure.add_subplot()
    axis.set(xlim=x, ylim=y, aspect="equal", xlabel=NAMES[X], ylabel=NAMES[Y], facecolor="0.93")
    _cells(axis, rig)
    if not rig.wall.contains(np.column_stack([x, y])).all():
        _rectangle(axis, rig.wall, WALL, "-", "edge of the wall")
    relay = "relay: the part of the wall that reflects light to and from the object"
    _rectangle(axis, rig.relay, RELAY, "-", relay)
    if rig.object_box is not None:
        _rectangle(axis, rig.object_box, OBJECT, "--", "hidden object's box, behind the occluder")
    if rig.occluder is not None:
        edge: Style = {"color": OCCLUDER, "linewidth": 1.5, "label": "occluder's edge"}
        axis.axvline(rig.occluder.x_m, linestyle=_occluder_style(record)[0], **edge)
    marked: Style = {"color": LIDAR, "linestyle": "none"}
    foot = "foot of the perpendicular from the lidar"
    axis.plot(0.0, 0.0, marker="+", markersize=14, label=foot, **marked)
    meets = on_plane(rig.wall_from_lidar, np.array([0.0, 0.0, 1.0]))
    spot = "where the optical axis meets the wall"
    axis.plot(*meets, marker="x", markersize=10, label=spot, **marked)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    share = footprint(rig.wall_from_lidar, rig.pinhole, rig.wall).share
    caption = (
        "The wall from the front. Blue is the lidar's field of view, with a line for every"
        f" {CELLS_PER_LINE}th of the map's 64 x 80 cells; {100.0 * share:.0f} % of the cells meet"
        " the wall. Light returns only from where blue and relay (green) overlap: the larger the"
        " overlap, the better."
    )
    return Picture("What the lidar sees of the wall", caption, png(figure))


def _cells(axis: "Axes", rig: Rig) -> None:
    from matplotlib.collections import PolyCollection

    rows, columns = MAP_SHAPE
    cells = rig.pinhole.scaled(columns, rows)
    x = (np.arange(0, columns + 1, CELLS_PER_LINE) - 0.5 - cells.ppx) / cells.fx
    y = (np.arange(0, rows + 1, CELLS_PER_LINE) - 0.5 - cells.ppy) / cells.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1, dtype=np.float64)
    at_m = on_plane(rig.wall_from_lidar, rays)
    quads = np.stack([at_m[:-1, :-1], at_m[:-1, 1:], at_m[1:, 1:], at_m[1:, :-1]], axis=2)
    quads = quads.reshape(-1, 4, 2)
    visible = quads[np.abs(quads).max(axis=(1, 2)) < MAX_CELL_M]  # False for NaN
    style: Style = {"facecolor": VISIBLE, "edgecolor": VISIBLE_EDGE, "linewidth": 0.6}
    axis.add_collection(PolyCollection(list(visible), alpha=0.8, **style))


def _rectangle(axis: "Axes", extent: Extent, color: str, line: str, label: str) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Rectangle

    size = extent.x_max_m - extent.x_min_m, extent.y_max_m - extent.y_min_m
    fill = to_rgba(color, 0.15 if line == "--" else 0.0)
    style: Style = {"edgecolor": color, "facecolor": fill, "linestyle": line, "linewidth": 1.8}
    axis.add_patch(Rectangle((extent.x_min_m, extent.y_min_m), *size, label=label, **style))
