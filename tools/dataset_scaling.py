"""Objects per second of `dataset build` by workers, with the CPU's time: docs/dataset_scaling.json.

Arguments: objects, most workers. Wall time is taken between the workers' first pieces and their last, so that it is the
rate of a long build, not the start of processes.
Run it on a machine that does nothing else.
"""

import json
import resource
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from nlos_calibration.rig import load_rig

from nlos_cam.dataset import build
from nlos_cam.dataset.build import PIECE, DatasetPlan
from nlos_cam.evaluate.render_tradeoff import machine

DOCS = Path(__file__).parents[1] / "docs"


@dataclass(frozen=True)
class Speed:
    """A build by so many workers."""

    workers: int
    objects: int
    wall_s: float
    """While all workers worked."""
    objects_per_s: float
    cpu_s_per_object: float
    """Of all processes, their start with it."""
    scaling: float
    """The rate of each worker over that of one alone; 1 is perfect."""


def measure(count: int, workers: int, alone: float | None = None) -> Speed:
    """Build and time; `alone` is the rate of one worker."""
    moments: list[tuple[float, int]] = []
    before = _cpu_s()
    with tempfile.TemporaryDirectory() as folder:

        def on_progress(done: int, _: int) -> None:
            moments.append((time.perf_counter(), done))

        build(DatasetPlan(load_rig("paper-rig"), 0), count, Path(folder), workers=workers, on_progress=on_progress)
    wall_s, objects = warm(moments, workers)
    rate = objects / wall_s
    return Speed(workers, count, wall_s, rate, (_cpu_s() - before) / count, rate / (alone or rate) / workers)


def warm(moments: list[tuple[float, int]], workers: int) -> tuple[float, int]:
    """Seconds and objects from when every worker has made a piece to when the first runs out of pieces.

    As many pieces for each worker: those of workers in step come at once, and half of them would not tell their rate.
    """
    rounds = (len(moments) - 2 * workers) // workers
    (first_s, first), (last_s, last) = moments[workers], moments[workers + rounds * workers]
    return last_s - first_s, last - first


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def main() -> None:
    """Measure, write, print."""
    count, most = (int(sys.argv[i]) if len(sys.argv) > i else default for i, default in ((1, 400), (2, 2)))
    speeds = list[Speed]()
    for workers in range(1, most + 1):
        speeds.append(measure(max(count, 6 * PIECE * workers), workers, speeds[0].objects_per_s if speeds else None))
    result = {"machine": machine(), "speeds": [asdict(speed) for speed in speeds]}
    (DOCS / "dataset_scaling.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print("workers   objects/s   scaling   CPU s per object")
    for speed in speeds:
        print(f"{speed.workers:7}   {speed.objects_per_s:9.2f}   {speed.scaling:7.2f}   {speed.cpu_s_per_object:16.3f}")


if __name__ == "__main__":
    main()
