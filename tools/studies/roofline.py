"""Roofline of the transport: rates of the memory, of the inner loop alone, and of a whole rendering.

python tools/studies/roofline.py  docs/roofline.json: memory bandwidth, multiply-adds a second, legs a second
"""

import json
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import harness
import numba
import numpy as np

from nlos_cam.evaluate import machine
from nlos_cam.render import accuracy_named, histograms, legs, paper_scene, prepare, render

ROWS, ROW_BINS, SUMS = 16, 96, 2000
"""Rows of one sum, their length (6 KiB of rows: the first cache), and sums of one timing for each thread."""
MEMORY_FLOATS = 1 << 25
REPEATS = 7


@numba.njit(parallel=True)
def sum_rows(threads: int, table: Any, base: Any, offset: Any, weight: Any) -> float:
    """Add rows from the first cache, as the transport does once its legs are known."""
    total = np.zeros(threads)
    for thread in numba.prange(threads):
        bins = np.zeros(legs.WINDOW, np.float32)
        for _ in range(SUMS):
            legs.add_rows(bins, 0, table, base, offset, weight, 0, 1, ROWS)
        total[thread] = bins.sum()
    return total.sum()


@numba.njit(parallel=True)
def triad(out: Any, one: Any, other: Any) -> None:
    """Read two arrays from memory and write a third (STREAM triad, McCalpin 1995)."""
    for i in numba.prange(out.size):
        out[i] = one[i] + np.float32(3) * other[i]


def least_cpu_s(work: Callable[[], object], threads: int) -> float:
    """Return the shortest of several processor times a thread, which other programs disturb less than the clock."""
    numba.set_num_threads(threads)
    work()
    seconds = list[float]()
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds) / threads


def measure(threads: int) -> dict[str, float]:
    """Measure with a number of threads; rates are sums over the threads."""
    generator = np.random.default_rng(0)
    table, weight = generator.random(ROWS * ROW_BINS, np.float32), generator.random(ROWS, np.float32)
    base = np.arange(ROWS) * ROW_BINS
    offset = generator.integers(0, ROW_BINS - legs.WINDOW, ROWS).astype(np.int32)
    arrays = [np.ones(MEMORY_FLOATS, np.float32) for _ in range(3)]
    adds = (
        threads
        * SUMS
        * ROWS
        * legs.WINDOW
        / least_cpu_s(lambda: sum_rows(threads, table, base, offset, weight), threads)
    )
    bandwidth = 3 * arrays[0].nbytes / least_cpu_s(lambda: triad(*arrays), threads)
    found = {"row_sum_multiply_adds_per_s": adds, "memory_bytes_per_s": bandwidth}
    scene = paper_scene().scene_at(0)
    for stop in ("draft", "standard"):
        if (job := prepare(scene, accuracy_named(stop)).job) is None:
            raise SystemExit("the default scene has no three-bounce light")
        pairs = len(job.laser_spot_m) * len(job.patches.beta)
        winner_s = least_cpu_s(partial(render, scene, stop), threads)
        whole_s = least_cpu_s(partial(histograms, job), threads)
        found[f"{stop}_render_s"], found[f"{stop}_histograms_s"] = winner_s, whole_s
        found[f"{stop}_render_multiply_adds_per_s"] = pairs * legs.WINDOW / winner_s
        found[f"{stop}_share_of_row_sum"] = pairs * legs.WINDOW / winner_s / adds
    return found


def main() -> None:
    """Measure one thread, then all."""
    harness.options(__doc__).parse_args()
    counts = sorted({1, os.cpu_count() or 1})
    result = {"machine": machine(), "bytes_a_leg": 4 * legs.WINDOW, "multiply_adds_a_leg": legs.WINDOW}
    result["threads"] = {str(count): measure(count) for count in counts}
    harness.write("roofline", result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
