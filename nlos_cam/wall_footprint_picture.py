"""The report's drawing of the wall from the front: the cells that the lidar sees, the relay, what is hidden."""

from typing import TYPE_CHECKING, Any

import numpy as np
from nlos_calibration.footprint import MAP_SHAPE, footprint, on_plane
from nlos_calibration.rig import Extent, Rig
from nlos_calibration.wall_record import WallRecord

from nlos_cam.wall_bench_picture import LIDAR, NAMES, OBJECT, OCCLUDER, WALL, X, Y, drawn_limits
from nlos_cam.wall_pictures import Picture, figure_of, png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RELAY, SEEN, SEEN_EDGE = "#1b9e77", "#c6dbef", "#6baed6"
CELLS_PER_LINE = 8
WIDTH_IN = 8.6
FARTHEST_M = 100.0


def footprint_picture(record: WallRecord) -> Picture:
    """The wall from the front: what the lidar sees of it, what the object is seen by, what is hidden."""
    rig = record.rig
    x, y, _ = drawn_limits(rig)
    figure = figure_of(WIDTH_IN, min(WIDTH_IN * (y[1] - y[0]) / (x[1] - x[0]) + 1.0, 9.0))
    axis = figure.add_subplot()
    axis.set(xlim=x, ylim=y, aspect="equal", xlabel=NAMES[X], ylabel=NAMES[Y], facecolor="0.93")
    _cells(axis, rig)
    shown = Extent(x_min_m=x[0], x_max_m=x[1], y_min_m=y[0], y_max_m=y[1])
    if not _holds(rig.wall, shown):
        _rectangle(axis, rig.wall, WALL, "-", "edge of the wall")
    _rectangle(axis, rig.relay, RELAY, "-", "relay: the part of the wall that the object is seen by")
    if rig.object_box is not None:
        _rectangle(axis, rig.object_box, OBJECT, "--", "hidden object's box, behind the occluder")
    if rig.occluder is not None:
        style = "-" if record.occluder is not None else "--"
        axis.axvline(rig.occluder.x_m, color=OCCLUDER, linewidth=1.5, linestyle=style, label="occluder's edge")
    marked: dict[str, Any] = {"color": LIDAR, "linestyle": "none"}
    axis.plot(0.0, 0.0, marker="+", markersize=14, label="foot of the perpendicular from the lidar", **marked)
    meets = on_plane(rig.wall_from_lidar, np.array([0.0, 0.0, 1.0]))
    axis.plot(*meets, marker="x", markersize=10, label="where the optical axis meets the wall", **marked)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    share = footprint(rig.wall_from_lidar, rig.pinhole, rig.wall).share
    caption = (
        f"The wall from the front. Blue is what the lidar sees, with a line for every {CELLS_PER_LINE}th of the map's "
        f"64 x 80 cells; {100.0 * share:.0f} % of the cells meet the wall. Light comes back only from where blue and "
        "relay (green) overlap: the more, the better."
    )
    return Picture("What the lidar sees of the wall", caption, png(figure))


def _holds(outer: Extent, inner: Extent) -> bool:
    across = outer.x_min_m <= inner.x_min_m and inner.x_max_m <= outer.x_max_m
    return across and outer.y_min_m <= inner.y_min_m and inner.y_max_m <= outer.y_max_m


def _cells(axis: "Axes", rig: Rig) -> None:
    """The edges of every eighth cell, where they meet the wall's plane."""
    from matplotlib.collections import PolyCollection

    rows, columns = MAP_SHAPE
    cells = rig.pinhole.scaled(columns, rows)
    x = (np.arange(0, columns + 1, CELLS_PER_LINE) - 0.5 - cells.ppx) / cells.fx
    y = (np.arange(0, rows + 1, CELLS_PER_LINE) - 0.5 - cells.ppy) / cells.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1, dtype=np.float64)
    at_m = on_plane(rig.wall_from_lidar, rays)
    quads = np.stack([at_m[:-1, :-1], at_m[:-1, 1:], at_m[1:, 1:], at_m[1:, :-1]], axis=2).reshape(-1, 4, 2)
    seen = quads[np.abs(quads).max(axis=(1, 2)) < FARTHEST_M]  # False for NaN
    axis.add_collection(PolyCollection(list(seen), facecolor=SEEN, edgecolor=SEEN_EDGE, linewidth=0.6, alpha=0.8))


def _rectangle(axis: "Axes", extent: Extent, colour: str, line: str, label: str) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Rectangle

    size = extent.x_max_m - extent.x_min_m, extent.y_max_m - extent.y_min_m
    fill = to_rgba(colour, 0.15 if line == "--" else 0.0)
    style: dict[str, Any] = {
        "edgecolor": colour,
        "facecolor": fill,
        "linestyle": line,
        "linewidth": 1.8,
        "label": label,
    }
    axis.add_patch(Rectangle((extent.x_min_m, extent.y_min_m), *size, **style))
