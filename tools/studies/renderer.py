"""Renderer: accuracy against time, glossy objects, random scenes against the reference, and the
pace on a GPU.

    python tools/studies/renderer.py tradeoff
        accuracy against time: docs/figures/renderer.json, docs/images/tradeoff.png and the table
        of docs/accuracy.md

    python tools/studies/renderer.py glossy
        time and error, time over a Lambertian object's: docs/figures/glossy.json

    python tools/studies/renderer.py soak [--scenes 1000000]
        random scenes against the reference: docs/figures/renderer_soak.json

    python tools/studies/renderer.py cuda [--backend torch] [--objects 64] [--batch 1 4 16 64]
        one line of JSON
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import harness
import numpy as np
import torch
from nlos_calibration import Occluder, load_rig

from nlos_cam import evaluate
from nlos_cam import render as renderer
from nlos_cam.files import cache_folder
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import beam_sums, effects, planning, scene_facts


def tradeoff(_: argparse.Namespace) -> None:
    """Measure accuracy against time on the default scene; most of the time goes to brute force."""
    scene = renderer.paper_scene().scene_at(0)
    size = evaluate.render_facts(scene)
    rows = list(evaluate.measure_renders(scene))
    table = evaluate.as_table(size, rows, len(evaluate.render_settings(scene)))
    harness.write("renderer", table)
    path = harness.DOCS / "images" / "tradeoff.png"
    evaluate.draw_renders(
        path, rows, f"airplane: {size.patches} patches, {size.beams_on_wall} beams"
    )
    print(evaluate.render_document(table, "airplane").as_markdown())


def shortest_s(
    work: renderer.Work, repeats: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the shortest of several times, after one run to warm up."""
    work()
    return renderer.least_seconds(work, repeats, clock)


cpu_s = partial(shortest_s, repeats=3, clock=time.process_time)
"""Shortest processor time, which other programs disturb less than the clock."""


EXPONENTS = 1, 5, 20, 80, 200, 1000


def glossy(_: argparse.Namespace) -> None:
    """Measure glossy objects: time of a rendering over a Lambertian one's, and error of peaks."""
    scene = renderer.paper_scene().scene_at(0)
    kinds = {"Phong": renderer.phong, "retroreflective": renderer.retroreflective}
    rows: list[dict[str, Any]] = []
    for stop in ("draft", "standard", "fine"):
        plain_s = cpu_s(partial(renderer.render, scene, stop))
        for exponent in EXPONENTS:
            for kind, lobe in kinds.items():
                one = replace(scene, surface=renderer.Surface(1.0, lobe(0.5, 0.5, exponent)))
                seconds = cpu_s(partial(renderer.render, one, stop))
                rows.append(
                    {
                        "kind": kind,
                        "exponent": exponent,
                        "stop": stop,
                        "cpu_s": seconds,
                        "times_lambertian": seconds / plain_s,
                        **peak_errors(one, stop),
                    }
                )
                print(rows[-1], flush=True)
    harness.write("glossy", {"machine": evaluate.machine(), "renderings": rows})


def peak_errors(scene: renderer.Scene, stop: renderer.Stop) -> dict[str, float]:
    """Return the relative errors of ten beams' peaks against the reference."""
    job = renderer.prepare(scene, renderer.STOPS[stop]).job
    if job is None:
        raise SystemExit("the default scene has no three-bounce light")

    some = job.select(np.arange(0, len(job.length_m), 400))
    exact = renderer.backend_reference.histograms(some).max(1)
    error = np.abs(renderer.histograms(some).max(1) / exact - 1)
    return {
        "peak_error_median": float(np.median(error)),
        "peak_error_max": float(error.max()),
    }


SOAK_RIGS = [
    load_rig("paper-rig").model_copy(update={"occluder": edge})
    for edge in (
        None,
        *(Occluder(x_m=x, z_min_m=z) for x in (-0.3, 0.0, 0.43) for z in (0.05, 0.2)),
    )
]
SOAK_EFFECTS = "three-bounce", "direct", "line-of-sight", "occluder", "self-occlusion", "tilt"
SOAK_PLAN = tuple(
    effects.Effect(name, name in SOAK_EFFECTS, "soak", 0.0) for name in renderer.EFFECTS
)
"""Named without the verdicts on the scene, which take as long as its rendering."""
SHADE_EDGE = 1e-3
"""Light of a bin, relative to the beam's, that legs on the very edge of a shadow may add or take in
float32.
"""
SHAKES = 60
SHAKE = 1e-7
ROUNDED = "explained by coordinates 1e-7 of themselves elsewhere"
"""Other places of patches and relay cells, about within float32's rounding, whose shadows may
explain a fault.
"""


def random_scene(generator: np.random.Generator) -> renderer.Scene:
    """Return a small scene: rough, smooth, spiked, cut by background or touching the wall, dark or
    white.
    """
    size = int(generator.choice([1, 2, 3, 5, 8]))
    y, x = np.mgrid[0:size, 0:size] / size
    wave = 0.25 + 0.1 * np.sin(generator.uniform(0, 9) * x + 4) * np.cos(
        generator.uniform(0, 9) * y
    )
    depth = (
        generator.uniform(0.05, 0.5, (size, size)),
        wave,
        wave + 0.1 * x,
    )[generator.integers(3)]
    depth = np.where(
        generator.random((size, size)) < generator.choice([0, 0.05]),
        generator.choice([0, 1e-4, 3]),
        depth,
    )
    depth[generator.random((size, size)) < generator.choice([0, 0.4])] = np.nan
    albedo = (
        generator.choice([0, 1, 0.5])
        if generator.random() < 0.5
        else generator.random((size, size))
    )
    rig = SOAK_RIGS[generator.integers(len(SOAK_RIGS))]
    radiometry = ("paper", "lambertian")[generator.integers(2)]
    return renderer.Scene(
        rig,
        depth.astype(np.float32),
        renderer.Surface(albedo),
        radiometry,
        jump_m=generator.choice([0.02, 1]),
    )


def light_bounds(job: renderer.TransportJob, seen: renderer.TransportJob) -> Any:
    """Return the least and most light (2, n, bins + 1) of a job, of each bin and of all, by the
    reference of `seen`.
    """
    # The fast renderer moves a path by at most a sub-bin, and by two more where it joins patches.
    fine = 64
    sub_bins = job.accuracy.sub_bins
    exact = replace(
        seen, accuracy=renderer.STOPS["reference"], bin_m=job.bin_m / fine, bins=job.bins * fine
    )
    below = np.pad(
        np.cumsum(renderer.backend_reference.histograms(exact), 1),
        [(0, 0), (1, 0)],
    )
    at = np.arange(job.bins) * fine
    moved = 3 * fine // sub_bins + 1
    joined = float((1 + beam_sums.JOIN_COSINE) * beam_sums.JOIN_WEIGHT) / max(sub_bins, 4)
    edge = SHADE_EDGE * below[:, -1:]
    starts = np.append(at - moved, 0)
    ends = np.append(at + fine + moved, fine * job.bins)

    def light(start: Any, end: Any) -> Any:
        return (
            below[:, np.clip(end, 0, below.shape[1] - 1)]
            - below[
                :,
                np.clip(
                    start,
                    0,
                    below.shape[1] - 1,
                ),
            ]
        )

    least = (
        np.maximum(
            light(starts + 2 * moved, ends - 2 * moved),
            0,
        )
        * (1 - joined)
        - edge
    )
    return np.stack(
        [
            least,
            light(starts, ends) * (1 + joined) + edge,
        ]
    )


def faults_within(
    least: Any,
    most: Any,
    job: renderer.TransportJob,
) -> list[str]:
    """Return the faults of a job's histograms and echoes. A winner must be the strongest for
    some such light.
    """
    found = renderer.histograms(job).astype(np.float64)
    echo = renderer.backend_numba.echoes(job)
    every = np.column_stack([found, found.sum(1)])
    lit = echo.peak > 0
    winner = (echo.path_m[lit] / job.bin_m).astype(int)
    faults = {
        "a number that is not finite": not np.isfinite(found).all()
        or not np.isfinite(echo.peak).all(),
        "negative light": (found < 0).any() or (echo.peak < 0).any(),
        "a bin, or all, outside its bounds": (every > most).any() or (every < least).any(),
        "an echo other than the histogram's": not np.array_equal(
            echo.peak, found.max(1).astype(np.float32)
        ),
        "a winner outside its margin": (most[lit, winner] < least[lit, :-1].max(1)).any(),
    }
    return [name for name, wrong in faults.items() if wrong]


def soak_faults(seed: int) -> list[str]:
    """Return the faults of a random scene; `ROUNDED` where the reference of the scene barely
    shaken has it too.
    """
    generator = np.random.default_rng([seed, 20])
    # The finer one has more than one tile of relay cells.
    grid = ((8, 6), (24, 20))[int(generator.random() < 0.2)]
    accuracy = renderer.Accuracy(
        "soak",
        *grid,
        sub_bins=int(generator.choice([1, 4, 8, 64])),
    )
    facts = scene_facts.SceneFacts(random_scene(generator), accuracy)
    if (job := planning.RenderProblem.of(facts, SOAK_PLAN).job) is None:
        return []
    beams = generator.integers(len(job.length_m), size=12)
    if generator.random() < 0.5:  # neighbors, whose tile may see all of a patch or nothing
        beams = np.argsort(
            np.linalg.norm(
                job.laser_spot_m - job.laser_spot_m[beams[0]],
                axis=1,
            ),
            kind="stable",
        )[:12]
    job = job.select(beams)
    least, most = light_bounds(job, job)
    faults = faults_within(least, most, job)
    places = job.patches.point_m, job.relay.x_m, job.relay.y_m
    for _ in range(SHAKES if faults else 0):
        point_m, x_m, y_m = (
            one * (1 + SHAKE * generator.standard_normal(one.shape)) for one in places
        )
        patches = replace(job.patches, point_m=point_m)
        relay = replace(job.relay, x_m=x_m, y_m=y_m)
        seen = light_bounds(job, replace(job, patches=patches, relay=relay))
        least = np.minimum(least, seen[0])
        most = np.maximum(most, seen[1])
    return faults and (faults_within(least, most, job) or [ROUNDED])


def soak(options: argparse.Namespace) -> None:
    """Render random small scenes and hold them against the reference; continue where a run of the
    same code stopped.
    """
    name = f"renderer-soak-{harness.fingerprint([], 1)}.json"
    store = cache_folder() / "studies" / name
    store.parent.mkdir(parents=True, exist_ok=True)
    done = (
        json.loads(store.read_text(encoding="utf-8"))
        if store.exists()
        else {"scenes": 0, "faults": {}}
    )
    while done["scenes"] < options.scenes:
        for seed in range(
            done["scenes"],
            min(done["scenes"] + 500, options.scenes),
        ):
            for fault in soak_faults(seed):
                done["faults"].setdefault(fault, []).append(seed)
            done["scenes"] = seed + 1
        part = store.with_suffix(".part")  # replaced whole: an interrupted run leaves the last one
        part.write_text(json.dumps(done), encoding="utf-8")
        part.replace(store)
    harness.write("renderer_soak", {"machine": evaluate.machine(), **done})
    store.unlink()


def jobs_of(
    scenes: Sequence[renderer.Scene],
    accuracy: str,
) -> list[renderer.TransportJob]:
    """Plan scenes for the GPU."""
    return [
        job
        for scene in scenes
        if (job := renderer.prepare(scene, renderer.accuracy_named(accuracy)).job)
    ]


def deviation(jobs: Sequence[renderer.TransportJob], device: torch.device) -> float:
    """Return the relative L1 deviation of some histograms from the numba renderer's."""
    some = [
        job.select(
            np.arange(
                0,
                len(job.laser_spot_m),
                50,
            )
        )
        for job in jobs
    ]
    pairs = zip(
        renderer.histograms_of_all(some, device), map(renderer.histograms, some), strict=True
    )
    return max(float(np.abs(found - other).sum() / other.sum()) for found, other in pairs)


def bench_cuda(options: argparse.Namespace) -> None:
    """Measure objects a second by batch size."""
    device = renderer.device_named(options.backend)
    rig = load_rig("paper-rig")
    scenes = [
        renderer.Scene(rig, object_depth(seed, object_box(rig))[1])
        for seed in range(options.objects)
    ]
    jobs = jobs_of(scenes, options.accuracy)

    def in_batches(size: int) -> None:
        for start in range(0, len(jobs), size):
            renderer.histograms_of_all(jobs[start : start + size], device)

    rates = {
        size: len(jobs) / shortest_s(partial(in_batches, size), options.repeats)
        for size in options.batch
    }
    planning_s = shortest_s(lambda: jobs_of(scenes, options.accuracy), 1) / len(scenes)
    whole_s = shortest_s(
        lambda: list(
            renderer.render_all(
                scenes,
                options.accuracy,
                backend=options.backend,
            )
        ),
        1,
    )
    result = {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "accuracy": options.accuracy,
        "objects": len(jobs),
        "patches_mean": float(np.mean([len(job.patches.beta) for job in jobs])),
        "histograms_per_s": {str(size): rate for size, rate in rates.items()},
        "planning_s": planning_s,
        "renderings_per_s": len(scenes) / whole_s,
        "difference_from_cpu": deviation(jobs, device),
    }
    print(json.dumps(result))


def main() -> None:
    """Run the named measurement."""
    parser = harness.options(__doc__)
    commands = parser.add_subparsers(required=True)
    for work in (tradeoff, glossy):
        commands.add_parser(work.__name__, help=work.__doc__).set_defaults(run=work)
    long = commands.add_parser("soak", help=soak.__doc__)
    long.set_defaults(run=soak)
    long.add_argument("--scenes", type=int, default=1_000_000)
    gpu = commands.add_parser("cuda", help=bench_cuda.__doc__)
    gpu.set_defaults(run=bench_cuda)
    gpu.add_argument("--backend", choices=["torch", "cuda"], default="cuda")
    gpu.add_argument("--accuracy", default="standard")
    gpu.add_argument("--objects", type=int, default=64)
    gpu.add_argument(
        "--batch",
        type=int,
        nargs="+",
        default=[1, 4, 16, 64],
    )
    gpu.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
