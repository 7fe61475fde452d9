"""What each radiometry predicts for a bench: docs/radiometry.json and docs/images/radiometry.png (no arguments).

Both modes side by side on the paper's rig and random objects: how strong three bounces are against the direct return,
how often they win, by how much the maps of two objects differ; and what is left for long averaging where the direct
return wins everywhere, but a pulse of 1 ns lets the two overlap.
"""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.rig import load_rig

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.geometry import cast
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor.model import SensorModel

DOCS = Path(__file__).parents[1] / "docs"
RIG = load_rig("paper-rig")
FIRST_SEED, OBJECTS = 20_000_000, 24
PULSE_NS = 1.0
PIXELS_PER_CELL = 60
SIGMAS = 3.0


def maps(radiometry: Radiometry, pulse_ns: float = 0.0) -> tuple[Rendering, list[Rendering]]:
    """The bench with nothing hidden, and with each object."""
    empty = Scene(RIG, radiometry=radiometry, pulse_ns=pulse_ns)
    objects = [object_depth(FIRST_SEED + k, empty.box)[1] for k in range(OBJECTS)]
    return render(empty), [render(replace(empty, object_depth_m=depth)) for depth in objects]


def strength(radiometry: Radiometry) -> dict[str, float]:
    """Three bounces against the direct return, on beams that light the wall."""
    _, found = maps(radiometry)
    beams = cast(RIG, Scene(RIG).cell_intrinsics, lambertian=radiometry == "lambertian")
    lit = beams.on_wall.reshape(beams.shape)
    direct = beams.direct.reshape(beams.shape)[lit]
    ratio = np.stack([r.multi.peak[lit] / direct for r in found])
    pairs = list(combinations(found, 2))
    return {
        "ratio_median": float(np.median(ratio)),
        "ratio_p99": float(np.quantile(ratio, 0.99)),
        "ratio_max": float(ratio.max()),
        "share_of_beams_won": float((ratio > 1).mean()),
        "depth_differs_share": float(np.mean([(np.abs(a.depth_m - b.depth_m) > 1e-3).mean() for a, b in pairs])),
        "intensity_differs_mean": float(np.mean([np.abs(a.intensity - b.intensity).mean() for a, b in pairs])),
    }


def averaging(radiometry: Radiometry) -> dict[str, float | None]:
    """Difference maps with a pulse of some width: how much brighter a cell gets, and for how many frames to look."""
    empty, found = maps(radiometry, PULSE_NS)
    model = SensorModel()
    counts = model.bare_wall_counts * empty.intensity / empty.intensity.max()
    noise = np.sqrt((model.read_noise_counts**2 + model.shot_noise**2 * counts + 1 / 12) / PIXELS_PER_CELL)
    change = np.stack([np.abs(r.intensity - empty.intensity) / np.maximum(empty.intensity, 1e-30) for r in found])
    signal = (change * counts)[:, counts > 0]
    seen = np.maximum(signal, 1e-12) / noise[counts > 0]
    frames = np.sort(2 * (SIGMAS / seen) ** 2, axis=None)  # of the object, and as many of the bare wall

    def needed(share: float) -> float | None:
        """Frames for so large a share of cells and objects; None where that share does not change at all."""
        return None if (signal > 0).mean() < share else float(max(frames[int(share * frames.size)], 1.0))

    return {
        "cells_that_change": float((signal > 0).mean()),
        "relative_change_p99": float(np.quantile(change, 0.99)),
        "frames_for_1_percent_of_cells": needed(0.01),
        "frames_for_10_percent_of_cells": needed(0.1),
        "frames_for_half_of_the_cells": needed(0.5),
    }


def draw(path: Path) -> None:
    """One object in both radiometries: depth, intensity, and the difference to the empty bench with a pulse."""
    figure = Figure(figsize=(12, 5.6), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, radiometry in zip(axes, ("paper", "lambertian"), strict=True):
        _, sharp = maps(radiometry)
        empty, wide = maps(radiometry, PULSE_NS)
        change = (wide[3].intensity - empty.intensity) / empty.intensity.max()
        pictures = sharp[3].depth_m, sharp[3].intensity / sharp[3].intensity.max(), change
        titles = "depth (m)", "intensity (of its brightest)", f"difference to nothing hidden, {PULSE_NS:g} ns pulse"
        for axis, picture, title in zip(row, pictures, titles, strict=True):
            figure.colorbar(axis.imshow(picture, cmap="magma"), ax=axis, shrink=0.8)
            axis.set_title(f"{radiometry}: {title}", fontsize=9)
            axis.axis("off")
    figure.savefig(path, dpi=80)


def main() -> None:
    """Measure, write, draw, print."""
    result = {
        radiometry: {**strength(radiometry), "with_pulse": averaging(radiometry)}
        for radiometry in ("paper", "lambertian")
    }
    whole = {"objects": OBJECTS, "pulse_ns": PULSE_NS, **result}
    text = json.dumps(whole, indent=2)
    (DOCS / "radiometry.json").write_text(text + "\n", encoding="utf-8")
    draw(DOCS / "images" / "radiometry.png")
    print(text)


if __name__ == "__main__":
    main()
