"""What refining one grid at a time leads to: docs/convergence.json and docs/images/convergence.png (no arguments).

An airplane at `fine`, one ingredient varied, against its finest setting: relative error of peak intensity, and the
share of beams on the wall in which three bounces win over the direct return, which must not drift with a grid.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.rig import load_rig

from nlos_cam.objects.hidden import Pose, category_triangles, place
from nlos_cam.objects.raster import orthographic_depth
from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.agreement import Echoes, agreement
from nlos_cam.render.prepare import Prepared
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.tradeoff_report import machine

DOCS = Path(__file__).parents[2] / "docs"
FINE = STOPS["fine"]
SEED = 20_000_003


def airplane(cells: int) -> Scene:
    """The same airplane on an object grid (cells, cells)."""
    empty = Scene(load_rig("paper-rig"))
    triangles = place(category_triangles("airplane", SEED), Pose(), empty.box)
    return replace(empty, object_depth_m=orthographic_depth(triangles, empty.box, cells))


SCENE = airplane(64)
SERIES: dict[str, tuple[list[int], Callable[[int], Rendering]]] = {
    "relay cells along x (80 : 64)": (
        [10, 20, 40, 80, 160, 320],
        lambda n: render(SCENE, replace(FINE, relay_columns=n, relay_rows=n * 4 // 5)),
    ),
    "object cells along a side": ([16, 32, 64, 128, 256], lambda n: render(airplane(n), FINE)),
    "sub-bins of path length": ([1, 2, 4, 8, 16, 32, 64], lambda n: render(SCENE, replace(FINE, sub_bins=n))),
    "beams along a side of a cell": ([1, 2, 3, 4, 6], lambda n: render(SCENE, replace(FINE, beams_per_cell=n))),
}


def convergence(settings: list[int], rendered: Callable[[int], Rendering]) -> list[dict[str, Any]]:
    """Each setting against the finest, which comes last."""
    lit = Prepared.of(SCENE, FINE, "auto").beams.on_wall
    renderings = [rendered(setting) for setting in settings]
    per_cell = len({rendering.multi.peak.shape for rendering in renderings}) > 1
    echoes = [Echoes.of_cells(one, SCENE) if per_cell else Echoes.of_beams(one) for one in renderings]
    rows: list[dict[str, Any]] = []
    for setting, rendering, found in zip(settings, renderings, echoes, strict=True):
        told = agreement(found.some(lit), echoes[-1].some(lit), SCENE.rig.device.bin_m)
        rows.append(
            {
                "setting": setting,
                "intensity_error_median": told.intensity_error_median,
                "intensity_error_p99": told.intensity_error_p99,
                "bin_within_1": told.bin_within_1,
                "three_bounce_wins": _wins(rendering, per_cell=per_cell, lit=lit),
            }
        )
    return rows


def _wins(rendering: Rendering, *, per_cell: bool, lit: np.ndarray) -> float | None:
    """The share of beams whose reported intensity is the three-bounce peak; not told of means over several beams."""
    return None if per_cell else float((rendering.intensity == rendering.multi.peak).ravel()[lit].mean())


def draw(series: dict[str, list[dict[str, Any]]]) -> None:
    """Median and 99th percentile against each grid's number, without the finest, whose error is none."""
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axis, (name, rows) in zip(figure.subplots(1, len(series), sharey=True), series.items(), strict=True):
        settings = [row["setting"] for row in rows[:-1]]
        for percentile, style in (("p99", "o--"), ("median", "o-")):
            errors = [100 * row[f"intensity_error_{percentile}"] for row in rows[:-1]]
            axis.plot(settings, errors, style, color="tab:blue", label=percentile)
        axis.set(xscale="log", yscale="log", xlabel=name, title=f"against {rows[-1]['setting']}")
        axis.set_xticks(settings, [str(setting) for setting in settings])
        axis.minorticks_off()
        axis.grid(visible=True, alpha=0.3)
        axis.legend()
        axis.set_ylabel("relative error of the peak, %")
    figure.savefig(DOCS / "images" / "convergence.png", dpi=110)


def main() -> None:
    """Refine, write, print."""
    series = {name: convergence(*how) for name, how in SERIES.items()}
    result = {"machine": machine(), "series": series}
    (DOCS / "convergence.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    draw(series)
    for name, rows in series.items():
        print(name)
        for row in rows:
            print("  ", row)


if __name__ == "__main__":
    main()
