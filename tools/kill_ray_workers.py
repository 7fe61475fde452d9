"""A dataset built by a local Ray cluster of two workers, one of them killed midway, against one built without Ray.

Argument: how many objects. Exits with 1 where any bit differs.
"""

import os
import signal
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import build
from nlos_cam.dataset import build as dataset
from nlos_cam.dataset.build import DatasetPlan, open_dataset
from nlos_cam.dataset.ray_backend import RayFarm
from nlos_cam.dataset.samples import Samples, make_samples

PLAN = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
LONGEST_S = 20.0


class KillsOne:
    """A farm on a cluster that kills one of its workers when the first piece is there."""

    def __init__(self, ray: Any, address: str) -> None:
        self._ray, self._farm, self.killed = ray, RayFarm(ray, address), 0

    def __call__(self, plan: DatasetPlan, pieces: Sequence[range]) -> Generator[tuple[range, Samples]]:
        """As the farm does it, one worker less after the first piece."""
        for made in self._farm(plan, pieces):
            if not self.killed:
                self.killed = _kill_one_of(os.getpid())
            yield made


def _kill_one_of(parent: int) -> int:
    """Kill a process that works on a piece, among those that the cluster started; its id, or 0 where none works."""
    deadline_s = time.monotonic() + LONGEST_S
    while time.monotonic() < deadline_s:
        for process in _descendants(parent):
            if _command_of(process).startswith("ray::make_piece"):
                os.kill(process, signal.SIGKILL)
                return process
        time.sleep(0.01)
    return 0


def _descendants(parent: int) -> list[int]:
    """Processes below one, as /proc has them."""
    parents = {int(path.name): _parent_of(path) for path in Path("/proc").iterdir() if path.name.isdigit()}
    below, found = {parent}, list[int]()
    while more := [process for process, above in parents.items() if above in below and process not in found]:
        found += more
        below = set(more)
    return found


def _parent_of(process: Path) -> int:
    try:
        return int((process / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
    except OSError:  # it ended meanwhile
        return -1


def _command_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def main() -> None:
    """Build, kill, compare, print."""
    import ray
    from ray.cluster_utils import Cluster

    count = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    dataset.PIECE = 2
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 10**8})
    nodes.add_node(num_cpus=1, object_store_memory=10**8)
    farm = KillsOne(ray, nodes.address)
    try:
        with tempfile.TemporaryDirectory() as folder:
            build(PLAN, count, Path(folder), workers=2, on_progress=print, farm=farm)
            found, wanted = open_dataset(Path(folder)), make_samples(PLAN, range(count))
            equal = all(
                np.array_equal(found.column(name), wanted[name], equal_nan=name != "category") for name in wanted
            )
    finally:
        nodes.shutdown()
    print(f"{int(farm.killed > 0)} worker killed, {count} objects {'equal' if equal else 'DIFFERENT'}")
    sys.exit(0 if equal and farm.killed else 1)


if __name__ == "__main__":
    main()
