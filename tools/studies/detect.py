"""Study of `nlos-cam detect`: false alarms on an empty bench, the paper's radiometry, and the time
that the Lambertian one takes.

Maps are drawn by the simulated sensor's own noise (mean of F frames: its standard deviation over
the square root of F), with drift of range, patches and infrared gain as a device that warms up.
Writes docs/figures/detect.json. Without a camera and without librealsense.
"""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp
from statistics import NormalDist

import numpy as np
from harness import DOCS, options
from nlos_calibration.arrays import Float64

from nlos_cam.cli.common import tracked
from nlos_cam.dataset import STENCIL, STEPS, interpolated_peak
from nlos_cam.detect import Plan, Turn, analyze
from nlos_cam.render import (
    Radiometry,
    Scene,
    SceneFile,
    Sensor,
    cast,
    paper_scene,
    render,
    smooth_patches,
    transient,
)

TURN_S = 20.0
"""From one turn to the next, hands included."""
CELSIUS = 25.0, 45.0
WARM_UP_S = 600.0
DRIFT_M_PER_CELSIUS = 1e-4
PATCHES_M = 5e-4
"""As in examples/warming.toml: sizes that the data sheet and owners report, and chosen."""
RANGE_GAIN_PER_CELSIUS = 1e-5
INFRARED_GAIN_PER_CELSIUS = -3e-3
"""Assumed: no figures are published."""
NOISE_DRAWS = 60
ALPHA = 0.01


@dataclass(frozen=True)
class Bench:
    """Expected maps with and without the object, and the noise of one frame: depth and infrared."""

    empty: Float64
    """(2, 64, 80); m and counts."""
    effect: Float64
    """(2, 64, 80)."""
    std: Float64
    """(2, 64, 80)."""
    patches: Float64
    """(64, 80); pattern of standard deviation 1."""
    scene: SceneFile


def make_bench(radiometry: Radiometry, pulse_ns: float) -> Bench:
    """Return the bench of the packaged scene's first pose."""
    scene = paper_scene()
    sensor = scene.sensor.model_copy(update={"pulse_ns": pulse_ns})
    scene = scene.model_copy(update={"radiometry": radiometry, "sensor": sensor})
    bare = render(scene.bare)
    full = render(scene.scene_at(0))
    device = Sensor(scene.rig, scene.sensor, radiometry)
    generator = np.random.default_rng(0)
    drawn = [device.maps(bare.multi, generator) for _ in range(NOISE_DRAWS)]
    depth = np.stack([each.depth_m for each in drawn]).astype(np.float64)
    counts = np.stack([each.intensity for each in drawn]).astype(np.float64)
    empty = np.stack([depth.mean(axis=0), counts.mean(axis=0)])

    # The renderer's own difference: the sensor's expected maps are rounded to the device's steps.
    brighter = np.divide(
        full.intensity, bare.intensity, out=np.ones_like(bare.intensity), where=bare.intensity > 0
    )
    farther = full.depth_m - bare.depth_m
    if pulse_ns:
        farther = peak_shift_m(scene.bare, scene.scene_at(0))
    effect = np.stack([farther, empty[1] * (brighter - 1.0)])
    return Bench(
        empty,
        np.nan_to_num(effect.astype(np.float64)),
        np.stack([depth.std(axis=0, ddof=1), counts.std(axis=0, ddof=1)]),
        smooth_patches((64, 80), generator),
        scene,
    )


def peak_shift_m(bare: Scene, full: Scene) -> Float64:
    """Return how much the waveform's peak moves by the object, as depth (64, 80), for a receiver
    that interpolates between its samples; the renderer reports the middle of a bin.
    """
    waves = [transient(scene).astype(np.float64) for scene in (bare, full)]
    top = np.clip(waves[0].argmax(axis=-1), STENCIL, waves[0].shape[-1] - STENCIL - 1)
    near = top[..., None] + STEPS
    places = [interpolated_peak(np.take_along_axis(wave, near, -1))[0] for wave in waves]
    # There and back: half of the path; bins of path along the beam, depth along the axis.
    beams = cast(bare.rig, bare.cell_intrinsics, lambertian=bare.radiometry == "lambertian")
    along = beams.cos_axis.reshape(top.shape)
    shift_m = (places[1] - places[0]) * bare.rig.device.bin_m / 2.0 * along
    return np.where(beams.direct.reshape(top.shape) > 0, shift_m, 0.0)


def made_turns(bench: Bench, plan: Plan, generator: np.random.Generator) -> list[Turn]:
    """Return the turns of a session on a device that warms up."""
    cold, warm = CELSIUS
    turns: list[Turn] = []
    for number, object_in in enumerate(plan.order()):
        seconds = number * TURN_S
        colder = -(warm - cold) * exp(-seconds / WARM_UP_S)
        clean = bench.empty + bench.effect * object_in
        depth = clean[0] * (1.0 + RANGE_GAIN_PER_CELSIUS * colder) + DRIFT_M_PER_CELSIUS * colder
        depth = depth + PATCHES_M * (1.0 + colder / (warm - cold)) * bench.patches
        infrared = clean[1] * (1.0 + INFRARED_GAIN_PER_CELSIUS * colder)
        noise = bench.std / np.sqrt(plan.frames) * generator.standard_normal(bench.std.shape)
        mean = np.full((1, 3, 64, 80), np.nan)  # confidence: the simulation has no noise of it
        mean[0, :2] = np.stack([depth, infrared]) + noise
        std = np.full((1, 3, 64, 80), np.nan)
        std[0, :2] = bench.std
        turns.append(
            Turn(
                bool(object_in),
                np.array([seconds]),
                mean.astype(np.float32),
                std.astype(np.float32),
                plan.frames,
            )
        )
    return turns


def made_plan(bench: Bench, turns: int, frames: int, seed: int) -> Plan:
    """Return the plan of a simulated session."""
    return Plan(
        created="2026-11-25T12:00:00+00:00",
        camera="sim",
        rig=bench.scene.rig,
        turns=turns,
        frames=frames,
        alpha=ALPHA,
        seed=seed,
    )


def naive_alarm(turns: list[Turn]) -> bool:
    """Return whether the bare wall first and the object afterwards, subtracted without turns, stand
    out of the frames' noise (Bonferroni over the cells), on readings without any effect.
    """
    half = len(turns) // 2
    mean = np.stack([each.mean[0, :2] for each in turns]).astype(np.float64)
    difference = mean[half:].mean(axis=0) - mean[:half].mean(axis=0)
    difference -= np.median(difference, axis=(1, 2), keepdims=True)
    std = turns[0].std[0, :2] * np.sqrt(4.0 / (turns[0].frames * len(turns)))
    limit = NormalDist().inv_cdf(1.0 - ALPHA / (2.0 * difference.size))
    return bool(np.nanmax(np.abs(difference) / std) > limit)


def found(bench: Bench, turns: int, frames: int, runs: int, first: int = 0) -> Mapping[str, float]:
    """Return the number of runs with a detection, and of the naive difference's."""
    hits = 0
    naive = 0
    with tracked(f"{bench.scene.radiometry}, {frames} frames") as update:
        for run in range(runs):
            seed = first + run
            plan = made_plan(bench, turns, frames, seed)
            drawn = made_turns(bench, plan, np.random.default_rng([seed, frames]))
            hits += analyze(plan, drawn, with_power=False).detected
            naive += naive_alarm(drawn)
            update(run + 1, runs)
    return {"turns": turns, "frames": frames, "runs": runs, "found": hits, "naive": naive}


def main() -> None:
    """Run the study."""
    parser = options(__doc__)
    parser.add_argument("--runs", type=int, default=200, help="Runs on the empty bench.")
    parser.add_argument(
        "--power-runs", type=int, default=20, help="Runs for each number of frames."
    )
    given = parser.parse_args()

    paper = make_bench("paper", 0.0)
    lambertian = make_bench("lambertian", 1.0)
    empty = replace(lambertian, effect=np.zeros_like(lambertian.effect))
    alone = analyze(
        made_plan(empty, 32, 30, 0),
        made_turns(empty, made_plan(empty, 32, 30, 0), np.random.default_rng(0)),
    )
    result = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, numpy {np.__version__}",
        "alpha": ALPHA,
        "empty": found(empty, 32, 30, given.runs),
        "paper": found(paper, 32, 2, given.power_runs),
        "lambertian": [
            found(lambertian, 32, frames, given.power_runs)
            for frames in (30, 60, 100, 150, 200, 300)
        ],
        "lambertian_more_turns": [found(lambertian, 96, 50, given.power_runs)],
        "lambertian_effect_mm": {
            str(share): float(np.quantile(np.abs(lambertian.effect[0]), share)) * 1e3
            for share in (0.5, 0.95, 0.99, 1.0)
        },
        "smallest_at_32_turns_of_30": [
            {"channel": each.channel, "patch": each.patch, "smallest": each.smallest}
            for each in alone.findings
        ],
    }
    text = json.dumps(result, indent=1) + "\n"
    (DOCS / "figures" / "detect.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
