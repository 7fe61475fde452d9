"""Fast renderer against the brute-force reference on the default scene, in one run (no arguments).

Writes docs/renderer.json and prints the table of docs/accuracy.md. Takes some minutes: the reference sums every path.
"""

import json
import os
import platform
import time
from pathlib import Path

import numpy as np

from nlos_cam.render.beams import cast
from nlos_cam.render.renderer import Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import paper_scene

REPEATS = 5
OUT = Path(__file__).parents[1] / "docs" / "renderer.json"


def timed(scene: Scene, stop: str, repeats: int) -> tuple[float, Rendering]:
    """Median seconds of several renderings, after one to compile, and the last of them."""
    rendering, seconds = render(scene, stop), []
    for _ in range(repeats):
        started = time.perf_counter()
        rendering = render(scene, stop)
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds)), rendering


def compare(fast: Rendering, slow: Rendering, on_wall: np.ndarray, bin_m: float) -> dict[str, float]:
    """Errors over the beams that light the wall."""
    peak, truth = fast.multi.peak.ravel()[on_wall], slow.multi.peak.ravel()[on_wall]
    error = np.abs(peak - truth) / truth
    bins = np.abs(fast.multi.path_m - slow.multi.path_m).ravel()[on_wall] / bin_m
    depth = np.abs(fast.depth_m - slow.depth_m).ravel()[on_wall]
    return {
        "peak_error_median": float(np.median(error)),
        "peak_error_p99": float(np.quantile(error, 0.99)),
        "peak_error_max": float(error.max()),
        "bin_exact": float((bins < 0.5).mean()),
        "bin_within_1": float((bins < 1.5).mean()),
        "depth_error_median_mm": float(1000 * np.median(depth)),
        "depth_error_mean_mm": float(1000 * depth.mean()),
    }


def main() -> None:
    """Measure, write, print."""
    scene = paper_scene().scene_at(0)
    on_wall = cast(scene.rig, scene.cell_intrinsics).on_wall
    fast = {stop: timed(scene, stop, REPEATS) for stop in ("draft", "standard", "fine")}
    started = time.perf_counter()
    slow = render(scene, "reference")
    slow_s = time.perf_counter() - started
    rows = [
        {"name": stop, "seconds": s, "speedup": slow_s / s, **compare(r, slow, on_wall, scene.rig.device.bin_m)}
        for stop, (s, r) in fast.items()
    ]
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    patches, lit = int(np.isfinite(scene.object_depth_m).sum()), int(on_wall.sum())
    result = {"machine": machine, "patches": patches, "beams_on_wall": lit, "reference_seconds": slow_s, "stops": rows}
    OUT.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(f"{machine}; {patches} patches, {lit} beams on the wall; reference {slow_s:.1f} s")
    print("| stop | seconds | times faster | peak error median / p99 / max | same bin | within one | depth, mean |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for row in rows:
        peak = " / ".join(f"{100 * row[f'peak_error_{k}']:.2f}" for k in ("median", "p99", "max"))
        bins = f"{100 * row['bin_exact']:.1f} % | {100 * row['bin_within_1']:.1f} %"
        depth = f"{row['depth_error_mean_mm']:.2f} mm"
        print(f"| {row['name']} | {row['seconds']:.3f} | {row['speedup']:.0f} | {peak} % | {bins} | {depth} |")


if __name__ == "__main__":
    main()
