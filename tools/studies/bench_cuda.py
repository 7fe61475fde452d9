"""Objects a second of the torch renderer at an accuracy, on a GPU or the CPU; the last line printed is JSON.

python tools/bench_cuda.py --backend cuda --objects 64 --batch 1 4 16 64
python tools/bench_cuda.py --backend torch --objects 2 --batch 1 2
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_image import object_box
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render import cpu, cuda
from nlos_cam.render.accuracy import accuracy_named
from nlos_cam.render.job import Job
from nlos_cam.render.prepare import Prepared
from nlos_cam.render.renderer import render_all
from nlos_cam.render.scene import Scene


def seconds(work: Callable[[], object], repeats: int) -> float:
    """The shortest of several runs, after one to warm up."""
    taken: list[float] = []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        work()
        taken.append(time.perf_counter() - started)
    return min(taken[1:])


def prepared(scenes: list[Scene], accuracy: str) -> Iterator[Job]:
    """The jobs of scenes."""
    for scene in scenes:
        job = Prepared.of(scene, accuracy_named(accuracy), "auto").job()
        if job is not None:
            yield job


def difference(jobs: list[Job], device: torch.device) -> float:
    """Relative L1 of some histograms from those of the numba renderer."""
    some = [job.some(np.arange(0, len(job.foot_m), 50)) for job in jobs]
    pairs = zip(cuda.histograms_of_all(some, device), map(cpu.histograms, some), strict=True)
    return max(float(np.abs(found - other).sum() / other.sum()) for found, other in pairs)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=["torch", "cuda"], default="cuda")
    parser.add_argument("--accuracy", default="standard")
    parser.add_argument("--objects", type=int, default=64)
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    device, rig = cuda.device_named(options.backend), load_rig("paper-rig")
    scenes = [Scene(rig, object_depth(seed, object_box(rig))[1]) for seed in range(options.objects)]
    jobs = list(prepared(scenes, options.accuracy))

    def in_batches(size: int) -> None:
        for start in range(0, len(jobs), size):
            cuda.histograms_of_all(jobs[start : start + size], device)

    rates = {size: len(jobs) / seconds(lambda size=size: in_batches(size), options.repeats) for size in options.batch}
    for size, rate in rates.items():
        print(f"histograms, {size} at a time: {rate:.1f} objects/s")
    preparing = seconds(lambda: list(prepared(scenes, options.accuracy)), 1) / len(scenes)
    whole = len(scenes) / seconds(lambda: list(render_all(scenes, options.accuracy, backend=options.backend)), 1)
    print(f"planning on the host: {1000 * preparing:.1f} ms an object; whole renderings: {whole:.1f} objects/s")
    result = {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "accuracy": options.accuracy,
        "objects": len(jobs),
        "patches_mean": float(np.mean([len(job.patches.beta) for job in jobs])),
        "histograms_per_s": {str(size): rate for size, rate in rates.items()},
        "planning_s": preparing,
        "renderings_per_s": whole,
        "difference_from_cpu": difference(jobs, device),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
