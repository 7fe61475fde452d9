"""Picture and report of a transient: a slice over time, the sum over all points, and its plain
back-projection from three sides.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from nlos_calibration.arrays import Float32

from nlos_cam.report import Document, Facts, Picture, Section, figure_of, png
from nlos_cam.transients.back_projection import Volume, back_projection, outward, peak_m
from nlos_cam.transients.transient import Transient

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIDES = (("x", "y", 2), ("x", "z", 1), ("z", "y", 0))
"""Horizontal axis, vertical axis, and number of the axis over which the maximum is taken."""


def transient_figure(transient: Transient, title: str = "") -> "Figure":
    """Return the picture of a transient."""
    volume = Volume.of(transient)
    return _figure(transient, title, volume, back_projection(transient, volume))


def _figure(transient: Transient, title: str, volume: Volume, light: Float32) -> "Figure":
    """Return the picture of a transient with the light (x, y, z) of its back-projection."""
    figure = figure_of(13, 3.4)
    slice_axis, curve_axis, *sides = figure.subplots(1, 5)
    ends = (transient.start_m, transient.end_m)
    image, label = _slice(transient)
    shown = np.flatnonzero(transient.curve)
    window = ends
    if shown.size:
        window = tuple(transient.start_m + transient.bin_m * (shown[[0, -1]] + [0, 1]))
    slice_axis.imshow(
        image,
        aspect="auto",
        cmap="magma",
        origin="lower",
        extent=(-0.5, image.shape[1] - 0.5, *ends),
    )
    slice_axis.set(title="slice", xlabel=label, ylabel="path length (m)", ylim=window)
    path_m = transient.start_m + transient.bin_m * (np.arange(transient.bins) + 0.5)
    curve_axis.plot(path_m, transient.curve, lw=0.9)
    curve_axis.set(title="sum over all points", xlabel="path length (m)", xlim=window, yticks=[])
    extent = dict(zip("xyz", zip(volume.low_m, volume.high_m, strict=True), strict=True))
    peak = dict(zip("xyz", peak_m(light, volume), strict=True))
    for axis, (across, up, over) in zip(sides, SIDES, strict=True):
        # Two axes are left, in the order x, y, z; rows of a picture are the one that points up.
        face = light.max(over) if up < across else light.max(over).T
        axis.imshow(face, cmap="magma", origin="lower", extent=(*extent[across], *extent[up]))
        if light.any():
            axis.plot(peak[across], peak[up], "+", color="cyan", ms=8)
        axis.set(title=f"back-projection, {across}{up}", xlabel=f"{across} (m)", ylabel=f"{up} (m)")
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _slice(transient: Transient) -> tuple[Float32, str]:
    """Return histograms (T, points) along a line through the strongest one, and its name."""
    place = transient.histograms.reshape(transient.bins, -1).sum(0).argmax()
    at = np.unravel_index(int(place), transient.histograms.shape[1:])
    # The longest axis of points is run along; the others stay where the light is strongest.
    along = int(np.argmax(transient.histograms.shape[1:]))
    chosen = tuple(slice(None) if k == along else int(i) for k, i in enumerate(at))
    return transient.histograms[(slice(None), *chosen)], f"{transient.layout.axes[1 + along]}"


def transient_document(title: str, transient: Transient, facts: Mapping[str, str]) -> Document:
    """Return a report: facts, and the picture of a transient."""
    volume = Volume.of(transient)
    light = back_projection(transient, volume)
    caption = (
        "A line of histograms through the strongest one; their sum; and the largest values of a"
        " plain back-projection (no filter, no weights) seen along z, y and x."
    )
    if light.any():
        x, y, z = peak_m(light, volume)
        from_wall_m = np.array([x, y, z]) - np.concatenate(transient.points).mean(0)
        caption += (
            f" It is brightest at ({x:.3f}, {y:.3f}, {z:.3f}) m,"
            f" {from_wall_m @ outward(transient):.3f} m from the wall."
        )
    else:
        caption += " No light has a path length that fits a point of its volume."
    if transient.laser_normals is None and transient.detector_normals is None:
        caption += " The file has no normals: the wall is taken to face along +z."
    figure = _figure(transient, "", volume, light)
    picture = Picture("Slice and back-projection", caption, png(figure))
    return Document(title, transient.kind, [Section("Content", [Facts(dict(facts))]), picture])
