"""Forecasts of rigs: the prior they start from, and how far trained networks bear them out.

    python tools/studies/forecast.py prior [--objects N]
        nlos_cam/forecast/prior.npz

    python tools/studies/forecast.py rigs [--measured FILE.json ...]
        docs/figures/forecast.json and docs/images/forecast.png

`prior` fits mean and covariance of outline and depth to objects of the training generators, half of
them generic. `rigs` forecasts every rig with a network's figure, fits the line from the linear
estimate's IoU to the network's, and leaves each rig out in turn; put the line's two numbers and the
scatter into nlos_cam/forecast/curve.py. The figures are those of docs/figures/figures.json, of the
trials below (the wide rig's weights had 0.834 when the line was fitted), those of the map of rigs
(docs/figures/rig_map.json: maps aligned with the training rig), and of files with rows of
{"name", "rig" (a file), "silhouette_iou", "foreground_rmse_mm"}, as `adapt` measures a bench. The
five benches of docs/figures/benches.json, forecast before they were adapted, are not in the fit.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import Rig, load_rig, rig_named
from nlos_calibration.arrays import Float32, Float64

from nlos_cam import evaluate
from nlos_cam.cli.common import tracked
from nlos_cam.forecast import Forecast, fit_prior, forecast
from nlos_cam.objects import generic_depth, object_box, object_depth

PRIOR = harness.ROOT / "nlos_cam" / "forecast" / "prior.npz"
FIRST_SEED = 5_000_000
"""Between the seeds of training and of the held-out objects."""
MAX_OUTSIDE = 0.1
REACH_M = 0.0101
REACH_DEG = 15.0
"""Limits within which aligned weights stand for weights of the rig's own: share of frames outside
the trained range, and distance and yaw from the home rig (the loss there is 0.01 to 0.07).
"""


@dataclass(frozen=True)
class Measured:
    """A network's figure on a rig."""

    name: str
    rig: Rig
    network_iou: float
    network_rmse_mm: float
    trained: str
    """"home", "for the rig", or "aligned": trained for the home rig, maps aligned with it."""
    outside: float = 0.0
    """Share of the frames that the network's uncertainty calls outside its range."""


def figures_at_home() -> dict[str, Any]:
    """Return the figures of `nlos-cam evaluate` with the shipped weights on their own rig."""
    return json.loads((harness.DOCS / "figures" / "figures.json").read_text(encoding="utf-8"))


def measured_by_hand(home: Rig) -> list[Measured]:
    """Return figures of weights that were trained for their rig: the home rig's, and those of trials
    that are in no other file.
    """
    own = figures_at_home()
    iou = own["silhouette_iou"]["value"]
    rmse_mm = own["foreground_rmse_mm"]["value"]
    return [
        Measured("home", home, iou, rmse_mm, "home"),
        Measured("0.25 m, 30 degrees", moved(home, 0.25, 30), 0.598, 24.6, "for the rig"),
        Measured(
            "0.16 m, 55 degrees, occluder at 0.18 m, gap 0.08 m",
            moved(home, 0.16, 55, occluder={"x_m": 0.18, "z_min_m": 0.08}),
            0.638,
            19.0,
            "for the rig",
        ),
        Measured("gap 0.14 m", load_rig("wide-rig"), 0.834, 11.7, "for the rig"),
    ]


def moved(
    home: Rig,
    distance_m: float,
    yaw_deg: float,
    pitch_deg: float = 0.0,
    occluder: dict[str, float] | None = None,
) -> Rig:
    """Return the home rig with its lidar elsewhere."""
    pose = {"distance_m": distance_m, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg}
    update: dict[str, Any] = {"lidar": home.lidar.model_copy(update=pose)}
    if occluder and home.occluder:
        update["occluder"] = home.occluder.model_copy(update=occluder)
    return home.model_copy(update=update)


def measured_on_the_map(home: Rig) -> Iterator[Measured]:
    """Yield the direct weights' figures over distance and angle, but those moved aside."""
    rig_map = json.loads((harness.DOCS / "figures" / "rig_map.json").read_text())
    for cell in rig_map["cells"] + rig_map["benches"]:
        if cell["aside_m"] or cell["up_m"]:
            continue
        place = cell["distance_m"], cell["yaw_deg"], cell["pitch_deg"]
        figures = cell["weights"]["direct"]
        yield Measured(
            f"{place[0]:.3f} m, {place[1]:g} degrees, pitch {place[2]:g}",
            moved(home, *place),
            figures["silhouette_iou"]["value"],
            figures["foreground_rmse_mm"]["value"],
            "aligned",
            figures["outside"],
        )


def after_an_hour() -> list[dict[str, Any]]:
    """Return what was forecast for the five benches before they were adapted, and what they have
    after an hour. Pictures of objects that change no cell count 0 there.
    """
    found = json.loads((harness.DOCS / "figures" / "benches.json").read_text(encoding="utf-8"))
    return [
        {
            "name": bench["name"],
            "expected_iou": bench["expected_iou"],
            "hidden_share": bench["hidden_share"],
            "network_iou": bench["minutes"]["60"]["silhouette_iou"]["value"],
        }
        for bench in found["benches"]
    ]


def measured_in(path: Path) -> Iterator[Measured]:
    """Yield the figures of a file."""
    for row in json.loads(path.read_text(encoding="utf-8")):
        yield Measured(
            row["name"],
            rig_named(str(path.parent / row["rig"])),
            row["silhouette_iou"],
            row["foreground_rmse_mm"],
            "for the rig",
        )


def serves(one: Measured, home: Rig) -> bool:
    """Return whether a network's figure is about that of one trained for the rig."""
    if one.trained != "aligned":
        return True
    off_m = abs(one.rig.lidar.distance_m - home.lidar.distance_m)
    off_deg = abs(one.rig.lidar.yaw_deg - home.lidar.yaw_deg)
    return one.outside <= MAX_OUTSIDE and off_m <= REACH_M and off_deg <= REACH_DEG


def line(linear: Float64, network: Float64) -> tuple[float, float]:
    """Return slope (at least 0: monotone) and offset of network = offset + slope * linear."""
    slope = max(float(np.polyfit(linear, network, 1)[0]), 0.0)
    return slope, float(network.mean() - slope * linear.mean())


def left_out(linear: Float64, network: Float64, guess: tuple[float, float]) -> Float64:
    """Return each rig's error of the line through the guess and all others."""
    errors: list[float] = []
    for i in range(len(linear)):
        others = np.arange(len(linear)) != i
        slope, offset = line(
            np.append(linear[others], guess[0]), np.append(network[others], guess[1])
        )
        errors.append(float(offset + slope * linear[i] - network[i]))
    return np.array(errors)


def fit(
    rows: list[Measured], forecasts: list[Forecast], guess: tuple[float, float]
) -> dict[str, Any]:
    """Return the line through guess and rigs, and its errors with each rig left out."""
    linear = np.array([found.at().linear_iou for found in forecasts])
    network = np.array([row.network_iou for row in rows])
    errors = left_out(linear, network, guess)
    both = np.append(linear, guess[0]), np.append(network, guess[1])
    slope, offset = line(*both)
    rmse = [
        row.network_rmse_mm / 1e3 / f.at().depth_rmse_m
        for row, f in zip(rows, forecasts, strict=False)
    ]
    return {
        "rigs": len(rows),
        "slope": slope,
        "offset": offset,
        "scatter_left_out": float(np.sqrt(np.mean(errors**2))),
        "largest_error_left_out": float(np.abs(errors).max()),
        "rank_correlation": evaluate.spearman(linear, network),
        "network_rmse_over_linear": [float(v) for v in np.percentile(rmse, (10, 50, 90))],
    }


def draw(
    rows: list[Measured],
    forecasts: list[Forecast],
    found: dict[str, Any],
    benches: list[dict[str, Any]],
) -> Figure:
    """Return a figure of network over linear IoU with the line, and of the benches."""
    figure = Figure(figsize=(6, 5), layout="constrained")
    axis = figure.subplots()
    for kind, marker in (("home", "*"), ("for the rig", "o"), ("aligned", "x")):
        pairs = [
            (f.at().linear_iou, row.network_iou)
            for row, f in zip(rows, forecasts, strict=True)
            if row.trained == kind
        ]
        if pairs:
            axis.scatter(*np.array(pairs).T, marker=marker, label=f"network: {kind}")
    linear = [(bench["expected_iou"] - found["offset"]) / found["slope"] for bench in benches]
    reached = [bench["network_iou"] for bench in benches]
    axis.scatter(linear, reached, marker="s", label="five benches after an hour")
    ends = np.array([0.4, 0.85])
    axis.plot(ends, found["offset"] + found["slope"] * ends, "k-", lw=0.8, label="line")
    axis.set(xlabel="IoU of the linear estimate", ylabel="IoU of the network")
    axis.legend()
    return figure


def training_objects(count: int) -> Iterator[Float32]:
    """Yield objects of the training generators, every other one generic."""
    box = object_box(load_rig("paper-rig"))
    with tracked("objects") as on_progress:
        for i in range(count):
            seed = FIRST_SEED + i
            yield object_depth(seed, box)[1] if i % 2 else generic_depth(seed, box)[1]
            on_progress(i + 1, count)


def main() -> None:
    """Fit the prior, or hold forecasts against networks."""
    parser = harness.options(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    prior = commands.add_parser("prior")
    prior.add_argument("--objects", type=int, default=6000)
    rigs = commands.add_parser("rigs")
    rigs.add_argument("--measured", type=Path, nargs="*", default=[])
    options: argparse.Namespace = parser.parse_args()
    if options.command == "prior":
        found = fit_prior(training_objects(options.objects), object_box(load_rig("paper-rig")))
        PRIOR.write_bytes(found.dump())
        return

    home = load_rig("paper-rig")
    measured = measured_by_hand(home) + list(measured_on_the_map(home))
    for path in options.measured:
        measured += measured_in(path)
    forecasts: list[Forecast] = []
    for row in measured:
        forecasts.append(forecast(row.rig, quick=True))
        now = forecasts[-1].at()
        text = f"{now.linear_iou:.3f}, network {row.network_iou:.3f}, outside {row.outside:.2f}"
        print(f"{row.name} ({row.trained}): linear {text}", flush=True)
    used = [i for i, row in enumerate(measured) if serves(row, home)]
    guessed = figures_at_home()["baselines"]["mean_object"]["silhouette_iou"]["value"]
    guess = forecasts[0].guess_iou, guessed
    chosen = [measured[i] for i in used]
    fitted = fit(chosen, [forecasts[i] for i in used], guess)
    rows = [
        {
            "name": row.name,
            "trained": row.trained,
            "outside": row.outside,
            "in_fit": serves(row, home),
            "network_iou": row.network_iou,
            "network_rmse_mm": row.network_rmse_mm,
            "linear_iou": found.at().linear_iou,
            "linear_rmse_mm": 1e3 * found.at().depth_rmse_m,
            "outline_numbers": found.at().outline_numbers,
            "depth_numbers": found.at().depth_numbers,
            "cells": found.at().cells,
        }
        for row, found in zip(measured, forecasts, strict=True)
    ]
    benches = after_an_hour()
    facts = {"machine": evaluate.machine(), "guess": guess, "fit": fitted, "rows": rows}
    harness.write("forecast", facts | {"benches": benches})
    harness.save("forecast", draw(measured, forecasts, fitted, benches))
    print(json.dumps(fitted, indent=2))


if __name__ == "__main__":
    with harness.one_line_errors():
        main()
