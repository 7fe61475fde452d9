"""Renderer: accuracy against time, scaling, convergence, and the pace on a GPU.

python tools/studies/renderer.py tradeoff     docs/renderer.json, docs/images/tradeoff.png, table of docs/accuracy.md
python tools/studies/renderer.py scaling      docs/scaling.json and .png: time by patches and beams, peak memory
python tools/studies/renderer.py glossy       docs/glossy.json: rank against error, time over a Lambertian object's
python tools/studies/renderer.py convergence  docs/convergence.json and .png: each grid against its finest setting
python tools/studies/renderer.py soak [--scenes 1000000]  docs/soak.json: random scenes against the reference
python tools/studies/renderer.py cuda [--backend torch] [--objects 64] [--batch 1 4 16 64]: one line of JSON
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
from matplotlib.figure import Figure
from nlos_calibration import Occluder, load_rig

from nlos_cam.evaluate import (
    as_table,
    draw_renders,
    machine,
    measure_renders,
    render_document,
    render_facts,
    render_settings,
)
from nlos_cam.files import cache_folder
from nlos_cam.objects import Pose, category_triangles, object_box, object_depth, orthographic_depth, place
from nlos_cam.render import (
    STOPS,
    Accuracy,
    EchoMaps,
    Effects,
    Rendering,
    Scene,
    Surface,
    TransportJob,
    Work,
    accuracy_named,
    agreement,
    backend_numba,
    backend_reference,
    device_named,
    glossy_basis,
    histograms,
    histograms_of_all,
    included,
    least_seconds,
    paper_scene,
    phong,
    prepare,
    render,
    render_all,
    retroreflective,
    sample_beams,
    three_bounce,
)

STANDARD, FINE = STOPS["standard"], STOPS["fine"]
DENSE = replace(STANDARD, beams_per_cell=2)
FOUR_TIMES = replace(DENSE, relay_columns=160, relay_rows=128)
REPEATS = 15


def tradeoff(_: argparse.Namespace) -> None:
    """Measure accuracy against time on the default scene; most of the time goes to brute force."""
    scene = paper_scene().scene_at(0)
    size, rows = render_facts(scene), list(measure_renders(scene))
    table = as_table(size, rows, len(render_settings(scene)))
    harness.write("renderer", table)
    path = harness.DOCS / "images" / "tradeoff.png"
    draw_renders(path, rows, f"airplane: {size.patches} patches, {size.beams_on_wall} beams")
    print(render_document(table, "airplane").as_markdown())


@dataclass(frozen=True)
class Line:
    """Times by count, and the straight line fitted to them; the deviation is a share of the time."""

    count: list[int]
    seconds: list[float]
    seconds_each: float
    seconds_fixed: float
    r_squared: float
    largest_deviation: float


def sheet(cells: int, rows: int) -> Scene:
    """Return a wavy, self-occluding sheet over the first rows of an object grid (cells, cells)."""
    y, x = np.mgrid[0:cells, 0:cells] / cells
    depth = 0.2 + 0.03 * np.sin(12 * x) * np.cos(9 * y)
    depth[rows:] = np.nan
    return Scene(load_rig("paper-rig"), depth.astype(np.float32))


def lit_beams(scene: Scene, accuracy: Accuracy) -> Any:
    """Return the indices of the beams on the wall."""
    return np.flatnonzero(prepare(scene, accuracy).beams.on_wall)


def histograms_of(scene: Scene, accuracy: Accuracy, beams: int | None = None) -> Work:
    """Return the work of rendering all beams on the wall, or some."""
    lit = lit_beams(scene, accuracy)
    chosen = sample_beams(lit, beams or len(lit))
    return lambda: three_bounce(scene, accuracy, chosen=chosen)


def in_turns(works: Sequence[Work]) -> list[float]:
    """Return the shortest time of each piece of work, done in turns so that disturbances affect all alike."""
    for work in works:
        work()  # compiles
    rounds = [[least_seconds(work, 1) for work in works] for _ in range(REPEATS)]
    return np.min(rounds, axis=0).tolist()


def fitted(count: list[int], seconds: list[float]) -> Line:
    """Fit a straight line by least squares."""
    each, fixed = np.polyfit(count, seconds, 1)
    off = np.array(seconds) - (fixed + each * np.array(count))
    r_squared = 1 - float((off**2).sum() / np.square(np.array(seconds) - np.mean(seconds)).sum())
    return Line(count, seconds, float(each), float(fixed), r_squared, float((np.abs(off) / seconds).max()))


def against_patches(rows: Sequence[int] = (4, 8, 16, 24, 32, 48, 64)) -> Line:
    """Time a sheet of growing height."""
    return fitted([64 * n for n in rows], in_turns([histograms_of(sheet(64, n), STANDARD) for n in rows]))


def against_beams(twelfths: Sequence[int] = (1, 2, 4, 6, 8, 10, 12)) -> Line:
    """Time a growing part of the beams of the default scene, two to a cell's side."""
    scene = paper_scene().scene_at(0)
    count = [len(lit_beams(scene, DENSE)) * n // 12 for n in twelfths]
    return fitted(count, in_turns([histograms_of(scene, DENSE, n) for n in count]))


def self_occlusion(scene: Scene) -> dict[str, float | bool]:
    """Time a rendering as planned, with self-occlusion forced in, and without it."""
    plan = render(scene).plan
    others = {effect.name for effect in plan if effect.included} - {"self-occlusion"}
    asked: list[Effects] = ["auto", {*others, "self-occlusion"}, others]
    planned, forced, without = in_turns([partial(render, scene, effects=effects) for effects in asked])
    return {
        "called_for": included(plan, "self-occlusion"),
        "seconds_planned": planned,
        "seconds_with": forced,
        "seconds_without": without,
        "times_as_long": forced / without,
    }


def peak_mib() -> float:
    """Return the peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def memory(_: argparse.Namespace) -> None:
    """Print the peak memory after and before a rendering at four times the default grids."""
    before = peak_mib()
    render(sheet(128, 128), FOUR_TIMES)
    print(peak_mib(), before)


def scaling(_: argparse.Namespace) -> None:
    """Measure the growth of time and memory."""
    run = [sys.executable, str(Path(__file__).resolve()), "memory"]
    # first: a process starts with the peak of the one that started it
    peak, before = map(float, subprocess.run(run, check=True, capture_output=True, text=True).stdout.split())
    grids = "160 x 128 beams, 128 x 128 object cells, 160 x 128 relay cells"
    box, airplane = paper_scene().scene_at(0).box, paper_scene().scene_at(0)
    level = Scene(load_rig("paper-rig"), np.full((64, 64), (box.z_near_m + box.z_far_m) / 2, np.float32))
    scenes = {"airplane": airplane, "wavy sheet": sheet(64, 64), "level plate": level}
    patches, beams = against_patches(), against_beams()
    result = {
        "machine": machine(),
        "memory": {"grids": grids, "peak_mib": peak, "before_rendering_mib": before},
        "patches": asdict(patches),
        "beams": asdict(beams),
        "self_occlusion": {name: self_occlusion(scene) for name, scene in scenes.items()},
    }
    harness.write("scaling", result)
    harness.save("scaling", draw_lines({"active patches": patches, "beams on the wall": beams}), dpi=110)
    print(json.dumps(result, indent=2))


def draw_lines(lines: dict[str, Line]) -> Figure:
    """Draw times and fitted lines side by side."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    for axis, (name, line) in zip(figure.subplots(1, len(lines)), lines.items(), strict=True):
        ends = np.array([0, max(line.count)])
        axis.plot(ends, 1000 * (line.seconds_fixed + line.seconds_each * ends), color="0.6", label="straight line")
        axis.plot(line.count, 1000 * np.array(line.seconds), "o", label="measured")
        axis.set(xlabel=name, ylabel="milliseconds", title=f"R² = {line.r_squared:.4f}", ylim=(0, None))
        axis.legend()
    return figure


def cpu_s(work: Work) -> float:
    """Return the shortest of three processor times, which other programs disturb less than the clock."""
    work()
    return least_seconds(work, 3, time.process_time)


def glossy(_: argparse.Namespace) -> None:
    """Measure glossy objects: rank against error, and the time of a rendering over that of a Lambertian one."""
    scene = paper_scene().scene_at(0)
    kinds = {
        "Phong, exponent 20": phong(0.5, 0.5, 20),
        "Phong, exponent 80": phong(0.1, 0.9, 80),
        "retroreflective, exponent 200": retroreflective(0.5, 0.5, 200),
    }
    scenes = {name: replace(scene, surface=Surface(1.0, brdf)) for name, brdf in kinds.items()}
    rows: list[dict[str, Any]] = []
    for stop in ("draft", "standard"):
        plain_s = cpu_s(partial(render, scene, stop))
        for name, one in scenes.items():
            if (job := prepare(one, STOPS[stop]).job) is None or job.brdf is None:
                raise SystemExit("the default scene has no three-bounce light")
            functions, some = glossy_basis(job, job.brdf), job.select(np.arange(0, len(job.length_m), 400))
            error = np.abs(histograms(some).max(1) / backend_reference.histograms(some).max(1) - 1)
            seconds = cpu_s(partial(render, one, stop))
            row = {"kind": name, "stop": stop, "rank": len(functions.sign) if functions else None, "cpu_s": seconds}
            row |= {"times_lambertian": seconds / plain_s, "peak_error_median": float(np.median(error))}
            rows.append(row | {"peak_error_max": float(error.max())})
            print(rows[-1], flush=True)
    job = prepare(scenes["Phong, exponent 20"], STANDARD).job
    ranks = [
        {"kind": name, "error": error, "rank": len(functions.sign) if functions else None}
        for name, brdf in kinds.items()
        for error in (0.1, 0.03, 0.01, 5e-3, 1e-3)
        if job
        for functions in [glossy_basis(replace(job, accuracy=replace(STANDARD, scatter_error=error)), brdf)]
    ]
    harness.write("glossy", {"machine": machine(), "renderings": rows, "ranks": ranks})


def airplane_scene(cells: int) -> Scene:
    """Return the same airplane on an object grid (cells, cells)."""
    empty = Scene(load_rig("paper-rig"))
    triangles = place(category_triangles("airplane", 20_000_003), Pose(), empty.box)
    return replace(empty, object_depth_m=orthographic_depth(triangles, empty.box, cells))


def series() -> dict[str, tuple[list[int], Callable[[int], Rendering]]]:
    """Return for each grid its numbers, the finest last, and the rendering with one of them."""
    scene = airplane_scene(64)

    def at(**change: int) -> Rendering:
        return render(scene, replace(FINE, **change))

    relay = "relay cells along x (80 : 64)"
    return {
        relay: ([10, 20, 40, 80, 160, 320], lambda n: at(relay_columns=n, relay_rows=n * 4 // 5)),
        "object cells along a side": ([16, 32, 64, 128, 256], lambda n: render(airplane_scene(n), FINE)),
        "sub-bins of path length": ([1, 2, 4, 8, 16, 32, 64], lambda n: at(sub_bins=n)),
        "beams along a side of a cell": ([1, 2, 3, 4, 6], lambda n: at(beams_per_cell=n)),
    }


def refined(numbers: list[int], rendered: Callable[[int], Rendering]) -> list[dict[str, Any]]:
    """Compare each number of a grid with the last: errors of the peak, and the share of beams three bounces win."""
    scene = airplane_scene(64)
    lit, found = lit_beams(scene, FINE), [rendered(number) for number in numbers]
    per_cell = len({rendering.multi.peak.shape for rendering in found}) > 1
    echoes = [EchoMaps.of_cells(one, scene) if per_cell else EchoMaps.of_beams(one) for one in found]
    rows: list[dict[str, Any]] = []
    for number, rendering, echo in zip(numbers, found, echoes, strict=True):
        agreed = agreement(echo.select(lit), echoes[-1].select(lit), scene.rig.device.bin_m)
        won = None if per_cell else float((rendering.intensity == rendering.multi.peak).ravel()[lit].mean())
        keys = "intensity_error_median", "intensity_error_p99", "bin_within_1"
        rows.append({"setting": number, **{key: getattr(agreed, key) for key in keys}, "three_bounce_wins": won})
    return rows


def convergence(_: argparse.Namespace) -> None:
    """Refine one grid at a time; the share of beams won must not drift with a grid."""
    found = {name: refined(*how) for name, how in series().items()}
    harness.write("convergence", {"machine": machine(), "series": found})
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axis, (name, rows) in zip(figure.subplots(1, len(found), sharey=True), found.items(), strict=True):
        numbers = [row["setting"] for row in rows[:-1]]
        for percentile, style in (("p99", "o--"), ("median", "o-")):
            errors = [100 * row[f"intensity_error_{percentile}"] for row in rows[:-1]]
            axis.plot(numbers, errors, style, color="tab:blue", label=percentile)
        axis.set(xscale="log", yscale="log", xlabel=name, title=f"against {rows[-1]['setting']}")
        axis.set_xticks(numbers, [str(number) for number in numbers])
        axis.minorticks_off()
        axis.grid(visible=True, alpha=0.3)
        axis.legend()
        axis.set_ylabel("relative error of the peak, %")
    harness.save("convergence", figure, dpi=110)
    for name, rows in found.items():
        print(name, *rows, sep="\n   ")


SOAK_RIGS = [
    load_rig("paper-rig").model_copy(update={"occluder": edge})
    for edge in (None, *(Occluder(x_m=x, z_min_m=z) for x in (-0.3, 0.0, 0.43) for z in (0.05, 0.2)))
]
SHADE_EDGE = 1e-3
"""Light of a bin, relative to the beam's, that legs on the very edge of a shadow may add or take in float32."""


def random_scene(generator: np.random.Generator) -> Scene:
    """Return a small scene: rough, smooth, spiked, cut by background or touching the wall, dark or white."""
    size = int(generator.choice([1, 2, 3, 5, 8]))
    y, x = np.mgrid[0:size, 0:size] / size
    wave = 0.25 + 0.1 * np.sin(generator.uniform(0, 9) * x + 4) * np.cos(generator.uniform(0, 9) * y)
    depth = (generator.uniform(0.05, 0.5, (size, size)), wave, wave + 0.1 * x)[generator.integers(3)]
    depth = np.where(
        generator.random((size, size)) < generator.choice([0, 0.05]), generator.choice([0, 1e-4, 3]), depth
    )
    depth[generator.random((size, size)) < generator.choice([0, 0.4])] = np.nan
    albedo = generator.choice([0, 1, 0.5]) if generator.random() < 0.5 else generator.random((size, size))
    rig = SOAK_RIGS[generator.integers(len(SOAK_RIGS))]
    radiometry = ("paper", "lambertian")[generator.integers(2)]
    return Scene(rig, depth.astype(np.float32), Surface(albedo), radiometry, jump_m=generator.choice([0.02, 1]))


def soak_faults(seed: int) -> list[str]:
    """Return what is wrong with the histograms and echoes of a random scene; nothing if they keep every bound.

    The fast renderer moves a path by at most a sub-bin, so a bin holds at least the reference's light that is a sub-bin
    or more within it, and at most the light to a sub-bin outside. A winner must be the strongest for some such light.
    """
    generator = np.random.default_rng([seed, 20])
    accuracy = Accuracy("soak", 8, 6, sub_bins=int(generator.choice([1, 4, 8, 64])))
    effects = "three-bounce", "direct", "line-of-sight", "occluder", "self-occlusion", "tilt"
    job = prepare(random_scene(generator), accuracy, effects).job
    if job is None:
        return []
    job, fine = job.select(generator.integers(len(job.length_m), size=12)), 64
    found, echo = histograms(job).astype(np.float64), backend_numba.echoes(job)
    exact = replace(job, accuracy=STOPS["reference"], bin_m=job.bin_m / fine, bins=job.bins * fine)
    below = np.pad(np.cumsum(backend_reference.histograms(exact), 1), [(0, 0), (1, 0)])
    at, moved = np.arange(job.bins) * fine, fine // accuracy.sub_bins + 1

    def light(start: Any, end: Any) -> Any:
        return below[:, np.clip(end, 0, below.shape[1] - 1)] - below[:, np.clip(start, 0, below.shape[1] - 1)]

    whole = below[:, -1:]
    most = light(at - moved, at + fine + moved) + SHADE_EDGE * whole
    least = np.maximum(light(at + moved, at + fine - moved), 0) - SHADE_EDGE * whole
    faults = {
        "a number that is not finite": not np.isfinite(found).all() or not np.isfinite(echo.peak).all(),
        "negative light": (found < 0).any() or (echo.peak < 0).any(),
        "more light than the reference": (found.sum(1) > whole[:, 0] * (1 + SHADE_EDGE)).any(),
        "a bin outside its bounds": (found > most).any() or (found < least).any(),
        "an echo other than the histogram's": not np.array_equal(echo.peak, found.max(1).astype(np.float32)),
    }
    lit = echo.peak > 0
    winner = (echo.path_m[lit] / job.bin_m).astype(int)
    faults["a winner outside its margin"] = (most[lit, winner] < least[lit].max(1)).any()
    return [name for name, wrong in faults.items() if wrong]


def soak(options: argparse.Namespace) -> None:
    """Render random small scenes and hold them against the reference; continue where a run stopped."""
    store = cache_folder() / "studies" / "renderer-soak.json"
    store.parent.mkdir(parents=True, exist_ok=True)
    done: dict[str, Any] = {"scenes": 0, "faults": {}}
    if store.exists():
        done = json.loads(store.read_text(encoding="utf-8"))
    while done["scenes"] < options.scenes:
        for seed in range(done["scenes"], min(done["scenes"] + 500, options.scenes)):
            for fault in soak_faults(seed):
                done["faults"].setdefault(fault, []).append(seed)
            done["scenes"] = seed + 1
        part = store.with_suffix(".part")  # replaced whole: an interrupted run leaves the last one
        part.write_text(json.dumps(done), encoding="utf-8")
        part.replace(store)
    harness.write("soak", {"machine": machine(), **done})
    print(json.dumps(done))


def jobs_of(scenes: Sequence[Scene], accuracy: str) -> Iterator[TransportJob]:
    """Plan scenes for the GPU."""
    for scene in scenes:
        if (job := prepare(scene, accuracy_named(accuracy)).job) is not None:
            yield job


def deviation(jobs: Sequence[TransportJob], device: torch.device) -> float:
    """Return the relative L1 deviation of some histograms from the numba renderer's."""
    some = [job.select(np.arange(0, len(job.laser_spot_m), 50)) for job in jobs]
    pairs = zip(histograms_of_all(some, device), map(histograms, some), strict=True)
    return max(float(np.abs(found - other).sum() / other.sum()) for found, other in pairs)


def shortest(work: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several times, after one run to warm up."""
    times = list[float]()
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def bench_cuda(options: argparse.Namespace) -> None:
    """Measure objects a second by batch size."""
    device, rig = device_named(options.backend), load_rig("paper-rig")
    scenes = [Scene(rig, object_depth(seed, object_box(rig))[1]) for seed in range(options.objects)]
    jobs = list(jobs_of(scenes, options.accuracy))

    def in_batches(size: int) -> None:
        for start in range(0, len(jobs), size):
            histograms_of_all(jobs[start : start + size], device)

    rates = {size: len(jobs) / shortest(partial(in_batches, size), options.repeats) for size in options.batch}
    planning_s = shortest(lambda: list(jobs_of(scenes, options.accuracy)), 1) / len(scenes)
    whole_s = shortest(lambda: list(render_all(scenes, options.accuracy, backend=options.backend)), 1)
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
    for work in (tradeoff, scaling, memory, glossy, convergence):
        commands.add_parser(work.__name__, help=work.__doc__).set_defaults(run=work)
    long = commands.add_parser("soak", help=soak.__doc__)
    long.set_defaults(run=soak)
    long.add_argument("--scenes", type=int, default=1_000_000)
    gpu = commands.add_parser("cuda", help=bench_cuda.__doc__)
    gpu.set_defaults(run=bench_cuda)
    gpu.add_argument("--backend", choices=["torch", "cuda"], default="cuda")
    gpu.add_argument("--accuracy", default="standard")
    gpu.add_argument("--objects", type=int, default=64)
    gpu.add_argument("--batch", type=int, nargs="+", default=[1, 4, 16, 64])
    gpu.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    asked.run(asked)


if __name__ == "__main__":
    main()
