"""Gradients: their cost, how well a bench determines its object, and a pose fitted to echoes.

    python tools/studies/gradients.py [cost] [bound] [pose] [--trials 6]
        docs/figures/gradients.json, docs/images/gradients.png

Each part that is named (default: all) replaces its own part of the JSON, with its machine; the
picture belongs to `bound`.
"""

import json
import os
import time
from dataclasses import replace
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.arrays import Float64

from nlos_cam import render as renderer
from nlos_cam.evaluate import machine


def cost(_: Any) -> dict[str, Any]:
    """Time the gradients of everything against a rendering, in turns in one process."""
    scene = renderer.paper_scene().scene_at(0)
    weights = np.random.default_rng(0).normal(size=(2, 64, 80))
    renderer.render(scene)
    found = renderer.Gradients(scene)
    found.pull(*weights)
    seconds: list[list[float]] = []
    for _round in range(15):
        marks = [time.perf_counter()]
        renderer.render(scene)
        marks.append(time.perf_counter())
        found = renderer.Gradients(scene)
        marks.append(time.perf_counter())
        found.pull(*weights)
        marks.append(time.perf_counter())
        found.push(renderer.SceneVector(lidar=np.ones(6)))
        marks.append(time.perf_counter())
        seconds.append(np.diff(marks).tolist())
    each = np.array(seconds)
    render_s, winners_s, pull_s, push_s = np.median(each, axis=0)
    ratios = {
        "pull": each[:, 2] / each[:, 0],
        "winners and pull": (each[:, 1] + each[:, 2]) / each[:, 0],
    }
    return {
        "load_average_1_min": os.getloadavg()[0],
        "render_s": render_s,
        "winners_s": winners_s,
        "pull_s": pull_s,
        "push_s": push_s,
        "shortest_s": dict(
            zip(("render", "winners", "pull", "push"), each.min(0).tolist(), strict=True)
        ),
        "times_a_render": {
            name: np.percentile(ratio, [10, 50, 90]).tolist() for name, ratio in ratios.items()
        },
        "patches": len(found.echo_job.patches.beta),
        "beams": int(found.three_bounce.sum()),
    }


def bound(_: Any) -> dict[str, Any]:
    """Bound the depth of the default object by its echoes, per cell and per 4 x 4 cells, and draw
    the maps.
    """
    found = renderer.Gradients(renderer.paper_scene().scene_at(0))
    prior_m = 0.05
    blocks = (1, 4)
    frames = (1, 100, 10_000)
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(2, 3)
    rows: list[dict[str, Any]] = []
    for block, line in zip(blocks, axes, strict=True):
        for count, axis in zip(frames, line, strict=True):
            noise = renderer.intensity_noise(found, renderer.SensorModel(), count)
            limit = renderer.depth_bound(found, noise, prior_m, block)
            surface = ~np.isnan(limit.bound_m)
            cells = len(limit.modes_m)
            rows.append(
                {
                    "cells": f"{block} x {block}",
                    "frames": count,
                    "unknowns": cells,
                    "determined": limit.determined,
                    "alone_mm": (
                        1000 * np.percentile(limit.alone_m[surface], [10, 50, 90])
                    ).tolist(),
                    "bound_mm": (
                        1000 * np.percentile(limit.bound_m[surface], [10, 50, 90])
                    ).tolist(),
                    "modes_mm": (1000 * limit.modes_m[:40]).tolist(),
                }
            )
            axis.imshow(1000 * limit.bound_m, vmin=0, vmax=1000 * prior_m, cmap="viridis")
            axis.set_title(f"{block} x {block} cells, {count:,} frames", fontsize=10)
            axis.set(xticks=[], yticks=[])
    figure.colorbar(
        axes[0, 0].images[0],
        ax=axes,
        label="bound on the standard deviation of depth, mm (prior: 50)",
    )
    figure.savefig(harness.DOCS / "images" / "gradients.png", dpi=100)
    return {"prior_m": prior_m, "rows": rows}


def pose(asked: Any) -> dict[str, Any]:
    """Displace lidar and wall by a few mm and 0.3 degrees, and fit the pose to noisy echoes of a
    finer rendering.
    """
    scene = renderer.paper_scene().scene_at(0)
    model = renderer.SensorModel()
    trials = []
    nominal = renderer.prepare(scene, renderer.STOPS["standard"])
    finer = replace(renderer.STOPS["fine"], relay_columns=160, relay_rows=128)
    for body in ("lidar", "wall"):
        for trial in range(asked.trials):
            draw = np.random.default_rng([7, trial])
            truth = np.concatenate(
                [draw.normal(size=3) * 0.003, draw.normal(size=3) * np.radians(0.3)]
            )
            bench = renderer.Gradients(
                renderer.moved(renderer.prepare(scene, finer), **{body: truth})
            )
            noise = renderer.intensity_noise(bench, model, 30)
            seen = bench.intensity + np.where(np.isfinite(noise), noise, 0) * draw.normal(
                size=noise.shape
            )
            start = time.perf_counter()
            fit = renderer.fit_pose(nominal, seen, noise, body)
            off = fit.motion - truth
            trials.append(
                {
                    "body": body,
                    "trial": trial,
                    "truth": truth.tolist(),
                    "error": off.tolist(),
                    "deviation": fit.deviation.tolist(),
                    "cost": fit.cost,
                    "iterations": fit.iterations,
                    "seconds": time.perf_counter() - start,
                }
            )
            print(
                body,
                trial,
                *(np.round(1000 * part, 2) for part in (truth, off, fit.deviation)),
                fit.cost,
                flush=True,
            )
    by_body = {
        body: summary([t for t in trials if t["body"] == body]) for body in ("lidar", "wall")
    }
    return {"frames": 30, "trials": trials, "summary": by_body}


def summary(trials: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the root mean square errors by component before and after, and the error in units of
    the deviation.
    """
    truth, error, deviation = (
        np.array([t[name] for t in trials]) for name in ("truth", "error", "deviation")
    )

    def rms(values: Float64) -> list[float]:
        return np.sqrt((values**2).mean(0)).tolist()

    return {
        "components": ["x_m", "y_m", "z_m", "about_x_rad", "about_y_rad", "about_z_rad"],
        "rms_before": rms(truth),
        "rms_after": rms(error),
        "rms_over_deviation": rms(error / deviation),
        "worst_after": np.abs(error).max(0).tolist(),
    }


PARTS = {part.__name__: part for part in (cost, bound, pose)}


def main() -> None:
    """Run the named parts, or all."""
    parser = harness.options(__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=[])
    parser.add_argument("--trials", type=int, default=6)
    asked = parser.parse_args()
    path = harness.DOCS / "figures" / "gradients.json"
    for name in asked.parts or PARTS:
        result = PARTS[name](asked)
        table: dict[str, Any] = (
            json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        )
        harness.write("gradients", table | {name: result | {"machine": machine()}})


if __name__ == "__main__":
    main()
