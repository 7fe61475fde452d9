"""Accuracy of the wall fit, and wrong walls called good: docs/wall_study.json and docs/images/wall_study.png.

Simulated recordings over the paper's distances and angles: noise, outliers, flicker, walls that are partly missing,
ripples of the lidar, the simulated camera's own sensor, and scenes that are not one flat wall. Prints the tables of
docs/calibration-measured.md. `--runs` sets the trials of each setting (default: 60).
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import hypot
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import (
    INTERVAL_STDS,
    TOLERANCE_DEG,
    TOLERANCE_M,
    DepthMean,
    LidarPose,
    PinholeRecord,
    Rig,
    WallFit,
    fit_wall,
    load_rig,
)
from nlos_calibration.arrays import Float64
from nlos_calibration.errors import WallRefusedError
from numpy.typing import NDArray

from nlos_cam.calibrate import (
    View,
    bent,
    curved,
    depth_statistics,
    patch,
    patchy,
    rippled,
    stepped,
    view,
    window,
    with_outliers,
)
from nlos_cam.render import MultiBounce, Sensor, SensorModel

Generator = np.random.Generator
Scene = Callable[[View, Generator], tuple[Float64, View]]
"""Returns a depth map and the view that it is to be measured as."""

DISTANCES_M, FACING_DEG, PITCHES_DEG = (0.15, 0.20, 0.25, 0.30), (15.0, 30.0, 45.0, 60.0, 75.0), (-12.0, 0.0, 8.0)
NOISES, OUTLIERS, FRAMES, MAX_OUTLIERS = (0.5, 1.0, 2.0, 4.0), (0.0, 0.2, 0.4, 0.5, 0.6), (1, 8, 30), 0.4
BARE = load_rig("bare-wall")
SIZE, SENSOR_SIZE = (160, 120), (320, 240)
EMPTY = np.zeros((64, 80), np.float32)
NO_ECHO = MultiBounce(EMPTY, EMPTY, np.full((64, 80), np.nan, np.float32))
QUANTITIES = "distance", "facing", "yaw", "pitch"


@dataclass(frozen=True)
class Setting:
    """Scene (a key of SCENES, or `sensor`), noise over the nominal, shares of outliers and flicker, and frames."""

    scene: str = "bare"
    noise: float = 1.0
    outliers: float = 0.0
    flicker: float = 0.0
    frames: int = 8


def beyond(seen: View, generator: Generator, low: float, high: float) -> NDArray[np.bool_]:
    """Mask a random share of the image, between two limits, on one side of a line in a random direction."""
    rows, columns = np.indices(seen.depth_m.shape) / seen.depth_m.shape[1]
    way, share = generator.uniform(0.0, 2.0 * np.pi), generator.uniform(low, high)
    along = columns * np.cos(way) + rows * np.sin(way)
    return along > np.quantile(along, 1.0 - share)


def other_surface(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Put a surface square to the lidar in front of part of the wall."""
    mask = beyond(seen, generator, 0.02, 0.5)
    return np.where(mask, generator.uniform(0.08, 0.5), seen.depth_m), seen


def fold(seen: View, generator: Generator, bend_deg: float) -> tuple[Float64, View]:
    """Bend the wall either way; draw again where the second half would pass behind the lidar."""
    share, way, sign = generator.uniform(0.05, 0.95), generator.uniform(0.0, 2.0 * np.pi), generator.choice([-1, 1])
    try:
        return bent(seen, float(sign * bend_deg), float(share), float(way))
    except ValueError:
        return fold(seen, generator, bend_deg)


def mirror(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Lengthen the depth of a patch, as a mirror does."""
    mask = patch(seen, generator.uniform(0.02, 0.45))
    return np.where(mask, seen.depth_m * generator.uniform(1.5, 5.0), seen.depth_m), seen


def saturated(seen: View, generator: Generator) -> tuple[Float64, View]:
    """Shorten the depth of a patch in the middle, as saturation does."""
    mask = patch(seen, generator.uniform(0.02, 0.45))
    return np.where(mask, seen.depth_m - 10.0 ** generator.uniform(-3.3, -1.0), seen.depth_m), seen


HARD: dict[str, Scene] = {
    "another surface": other_surface,
    "bent": lambda seen, g: fold(seen, g, 10.0 ** g.uniform(-0.7, 0.9)),
    "corner": lambda seen, g: fold(seen, g, g.uniform(8.0, 110.0)),
    "curved": lambda seen, g: (
        curved(seen, 10.0 ** g.uniform(0.0, 2.2) * g.choice([-1, 1]), g.uniform(0.0, np.pi)),
        seen,
    ),
    "mirror": mirror,
    "saturated": saturated,
    "stepped": lambda seen, g: (
        stepped(
            seen, 10.0 ** g.uniform(-3.3, -1.3) * g.choice([-1, 1]), g.uniform(0.05, 0.5), g.uniform(0.0, 2.0 * np.pi)
        ),
        seen,
    ),
    "stuck": lambda seen, g: (np.full(seen.depth_m.shape, g.uniform(0.1, 1.0)), seen),
    "window": lambda seen, g: (window(seen, 10.0 ** g.uniform(-3.3, -1.0), int(g.choice([4, 12, 30]))), seen),
}
SCENES: dict[str, Scene] = {
    "bare": lambda seen, _: (seen.depth_m, seen),
    "no return": lambda seen, g: (np.where(beyond(seen, g, 0.2, 0.7), np.nan, seen.depth_m), seen),
    "rippled": lambda seen, g: (rippled(seen, g.uniform(0.0002, 0.002), g.uniform(2.5, 12.0), g), seen),
    "patchy": lambda seen, g: (patchy(seen, g.uniform(0.0002, 0.001), g), seen),
    **HARD,
}


def settings() -> list[Setting]:
    """Return every setting of the study."""
    bare = [Setting("bare", noise, share, 0.0, n) for noise, share, n in product(NOISES, OUTLIERS, FRAMES)]
    partial = [Setting("no return", noise, share, 0.0, 8) for noise, share in product((1.0, 4.0), (0.0, 0.2, 0.4))]
    flicker = [Setting("bare", 1.0, 0.0, share, 30) for share in (0.02, 0.1, 0.4)]
    uneven = product(("rippled", "patchy"), (1.0, 4.0), (1, 8, 30))
    ripples = [Setting(scene, noise, 0.0, 0.0, n) for scene, noise, n in uneven]
    sensor = [Setting("sensor", 1.0, 0.0, share, n) for share, n in ((0.0, 1), (0.0, 8), (0.02, 8))]
    grid = product(HARD, (1.0, 4.0), (0.0, 0.2), (1, 8))
    return (
        bare + partial + flicker + ripples + sensor + [Setting(s, noise, share, 0.0, n) for s, noise, share, n in grid]
    )


def random_view(generator: Generator, size: tuple[int, int]) -> View:
    """Return a view of a wall on the grid of distances and angles, turned to either side."""
    distance_m, facing_deg = generator.choice(DISTANCES_M), generator.choice(FACING_DEG)
    pitch_deg = generator.choice([pitch for pitch in PITCHES_DEG if abs(pitch) < facing_deg])
    # cos(facing) = cos(yaw) cos(pitch)
    yaw_deg = np.degrees(np.arccos(np.cos(np.radians(facing_deg)) / np.cos(np.radians(pitch_deg))))
    yaw_deg *= generator.choice([-1, 1])
    return view(float(distance_m), float(yaw_deg), float(pitch_deg), BARE.pinhole.scaled(*size))


def trial(setting: Setting, generator: Generator) -> harness.Record:
    """Draw a wall, measure it, and compare the fit with the truth."""
    seen = random_view(generator, SENSOR_SIZE if setting.scene == "sensor" else SIZE)
    if setting.scene == "sensor":
        truth, mean = seen, sensor_mean(rig_of(seen), setting, generator)
    else:
        depth_m, truth = SCENES[setting.scene](seen, generator)
        depth_m = with_outliers(depth_m, setting.outliers, generator)
        noise = 0.0 if setting.scene == "stuck" else setting.noise
        mean = depth_statistics(depth_m, generator, frames=setting.frames, noise=noise, flicker=setting.flicker)
    drawn = {"distance_m": float(seen.pose[2, 3]), "facing_deg": float(seen.facing_deg)}
    try:
        fit = fit_wall(mean.mean_m(), seen.pinhole, generator, mean.noise())
    except WallRefusedError as error:
        return drawn | {"refused": str(error)}
    return drawn | {"refused": ""} | errors_of(fit, truth)


def rig_of(seen: View) -> Rig:
    """Return the bare-wall rig with the pose and intrinsics of a view."""
    yaw, pitch = np.degrees(np.arctan2(seen.pose[2, 0], -seen.pose[2, 2])), np.degrees(np.arcsin(-seen.pose[2, 1]))
    lidar = LidarPose(distance_m=seen.pose[2, 3], yaw_deg=yaw, pitch_deg=pitch)
    return BARE.model_copy(update={"lidar": lidar, "intrinsics": PinholeRecord.model_validate(vars(seen.pinhole))})


def sensor_mean(rig: Rig, setting: Any, generator: Generator) -> DepthMean:
    """Average frames of the simulated camera's sensor, whose confidence decides about depth."""
    model, pinhole = SensorModel(), rig.pinhole
    noisier = {name: setting.noise * getattr(model, name) for name in ("range_noise_m", "range_noise_per_m")}
    sensor, mean = Sensor(rig, model.model_copy(update=noisier)), DepthMean(pinhole.height, pinhole.width)
    for _ in range(setting.frames):
        frame_m = sensor.expose(NO_ECHO, generator).frame(pinhole).depth_m
        mean.add(with_outliers(frame_m.astype(np.float64), getattr(setting, "flicker", 0.0), generator))
    return mean


def errors_of(fit: WallFit, truth: View) -> harness.Record:
    """Return verdict, errors, the angle between normals, and the quantities inside their 95 % interval."""
    normal = truth.pose[2, :3]
    yaw_deg, pitch_deg = np.degrees(np.arctan2(normal[0], -normal[2])), np.degrees(np.arcsin(-normal[1]))
    errors = (
        (fit.distance_m - truth.pose[2, 3], fit.distance_std_m),
        (fit.facing_deg - truth.facing_deg, fit.facing_std_deg),
        (fit.yaw_deg - yaw_deg, fit.yaw_std_deg),
        (fit.pitch_deg - pitch_deg, fit.pitch_std_deg),
    )
    across = np.cross(fit.wall_from_lidar[2, :3], normal)
    turn_deg = float(np.degrees(np.arcsin(min(hypot(*across), 1.0))))
    return {
        "verdict": fit.verdict,
        "distance_error_m": float(errors[0][0]),
        "facing_error_deg": float(errors[1][0]),
        "turn_deg": turn_deg,
        "inside": [bool(abs(error) <= INTERVAL_STDS * std) for error, std in errors],
        "wrong": bool(abs(errors[0][0]) > TOLERANCE_M or turn_deg > TOLERANCE_DEG),
    }


def row(name: str, records: list[harness.Record]) -> harness.Record:
    """Summarize records; errors and coverage are of those that were measured."""
    measured, runs = [one for one in records if not one["refused"]], max(len(records), 1)
    return {
        "name": name,
        "runs": len(records),
        "refused": 1.0 - len(measured) / runs,
        "doubtful": Counter(one["verdict"] for one in measured)["doubtful"] / runs,
        "wrong": sum(one["wrong"] for one in measured),
        "wrong_and_good": sum(one["wrong"] and one["verdict"] == "good" for one in measured),
        "distance_mm": harness.percentiles(1e3 * abs(one["distance_error_m"]) for one in measured),
        "facing_deg": harness.percentiles(abs(one["facing_error_deg"]) for one in measured),
        "inside_95": harness.coverage((one["inside"] for one in measured), QUANTITIES),
    }


def tables(records: list[harness.Record]) -> dict[str, list[harness.Record]]:
    """Return every table of the study."""
    plain = [one for one in records if one["scene"] == "bare" and not one["flicker"]]
    flicker = [one for one in records if one["scene"] == "bare" and one["flicker"]]
    noisy = [*plain, *(one for one in records if one["scene"] == "no return")]
    noisy = [one for one in noisy if one["outliers"] <= MAX_OUTLIERS]
    others = {
        "no return": "20 to 70 % without return",
        "rippled": "ripples up to 2 mm",
        "patchy": "drift up to 1 mm, in patches",
        "sensor": "the simulated camera's sensor",
    }

    def rows(of: list[harness.Record], field: str, levels: Any, form: str, near: float = 1e-6) -> list[harness.Record]:
        return [row(form.format(at), [one for one in of if abs(one[field] - at) < near]) for at in levels]

    def scene(name: str) -> list[harness.Record]:
        return [one for one in records if one["scene"] == name]

    return {
        "all": [row("noise only, up to 40 % outliers", noisy)],
        "outliers": rows(plain, "outliers", OUTLIERS, "{:.0%} outliers"),
        "noise": rows(noisy, "noise", NOISES, "noise x {:g}"),
        "frames": rows(noisy, "frames", FRAMES, "{} frames"),
        "distance": rows(noisy, "distance_m", DISTANCES_M, "{:.2f} m"),
        "facing": rows(noisy, "facing_deg", FACING_DEG, "{:.0f} degrees", 1e-3),
        "others": rows(flicker, "flicker", sorted({one["flicker"] for one in flicker}), "{:.0%} of samples flicker")
        + [row(title, scene(name)) for name, title in others.items()],
        "hard": [row(name, scene(name)) for name in HARD],
    }


def as_markdown(found: dict[str, list[harness.Record]]) -> str:
    """Return the tables of docs/calibration-measured.md."""
    head = ("runs", "refused", "doubtful", "distance p50 / p95 / max, mm", "facing p50 / p95 / max, degrees")
    head = (*head, "inside 95 %: distance, facing, yaw, pitch", "wrong", "wrong and good")
    return "\n\n".join(harness.table([name, *head], map(cells, rows)) for name, rows in found.items())


def cells(one: harness.Record) -> list[str]:
    """Return a row's cells."""
    shares = [f"{one['refused']:.0%}", f"{one['doubtful']:.0%}"]
    errors = [harness.joined(one["distance_mm"]), harness.joined(one["facing_deg"])]
    inside = harness.joined(one["inside_95"], "{:.1%}", ", ")
    return [one["name"], str(one["runs"]), *shares, *errors, inside, str(one["wrong"]), str(one["wrong_and_good"])]


def fit_milliseconds() -> float:
    """Return the shortest time of one fit of a 640 x 480 mean map."""
    pinhole, generator, times = BARE.pinhole, np.random.default_rng(0), list[float]()
    mean = depth_statistics(view(0.2, 45.0, 0.0, pinhole).depth_m, generator, frames=8)
    for _ in range(10):
        start = time.perf_counter()
        fit_wall(mean.mean_m(), pinhole, generator, mean.noise())
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


def draw(records: list[harness.Record], found: dict[str, list[harness.Record]]) -> Figure:
    """Draw errors against outliers, coverage, and the verdicts on hard scenes."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    plain = [one for one in records if one["scene"] == "bare" and not one["flicker"]]
    for axis, name, limit, unit in ((axes[0], "distance_mm", 1.0, "mm"), (axes[1], "facing_deg", 0.2, "degrees")):
        for noise in NOISES:
            of = {a: row("", [o for o in plain if (o["noise"], o["outliers"]) == (noise, a)])[name] for a in OUTLIERS}
            errors = [v["p95"] if v else np.nan for v in of.values()]
            axis.plot(100 * np.array(OUTLIERS), errors, "o-", label=f"x {noise:g}")
        axis.axhline(limit, color="0.4", ls="--", label="limit")
        axis.set(yscale="log", xlabel="outliers, %", ylabel=f"95th percentile, {unit}", title=name.split("_")[0])
        axis.legend(fontsize=8, title="noise")
    harness.draw_coverage(
        axes[2], [one for part in ("all", "noise", "frames", "facing") for one in found[part]], QUANTITIES
    )
    draw_verdicts(axes[3], found["hard"] + found["others"])
    return figure


def draw_verdicts(axis: Any, rows: list[harness.Record]) -> None:
    """Draw the shares refused, doubtful, rightly good and wrongly good."""
    left = np.zeros(len(rows))
    wrong = np.array([one["wrong_and_good"] / max(one["runs"], 1) for one in rows])
    refused, doubtful = (np.array([one[key] for one in rows]) for key in ("refused", "doubtful"))
    right = 1 - refused - doubtful - wrong
    parts = {"refused": refused, "doubtful": doubtful, "good, and right": right, "good, and wrong": wrong}
    for (name, shares), color in zip(parts.items(), ("0.7", "tab:orange", "tab:green", "tab:red"), strict=True):
        axis.barh(range(len(rows)), 100 * shares, left=100 * left, label=name, color=color)
        left = left + shares
    axis.set_yticks(range(len(rows)), [one["name"] for one in rows], fontsize=8)
    axis.set(xlabel="share of walls, %", xlim=(0, 100))
    axis.invert_yaxis()
    axis.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def main() -> None:
    """Measure, write, draw, print."""
    parser = harness.options(__doc__)
    parser.add_argument("--runs", type=int, default=60, help="trials of each setting (default: 60)")
    runs, start = parser.parse_args().runs, time.perf_counter()
    records = harness.collect("wall", settings(), trial, runs)
    found = tables(records)
    facts = {"runs_of_each_setting": runs, "minutes": (time.perf_counter() - start) / 60}
    facts["fit_640x480_ms"] = fit_milliseconds()
    harness.write("wall_study", facts | found)
    harness.save("wall_study", draw(records, found), dpi=110)
    print(as_markdown(found), facts, sep="\n\n")


if __name__ == "__main__":
    main()
