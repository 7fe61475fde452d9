"""Dataset builds killed at random moments, compared with an undisturbed one: docs/dataset_kills.json.

Arguments: objects, kills, seed, objects in a shard. Each kill is a SIGKILL to the builder alone, and the next run
resumes in the same folder. Exits with 1 where any array differs by a bit, a finished shard was lost, a worker outlived
its builder, or a build finished before its kill.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from processes import children_of, runs

from nlos_cam.dataset import PART_PATTERN, REQUIRED_ARRAYS, SHARD_PATTERN, open_dataset
from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
DEFAULTS = (300, 10, 0, 10)
GRACE_S = 10.0
"""Time for workers to notice that their builder has ended."""


@dataclass(frozen=True)
class Kill:
    """State of a build after one kill: shards, unfinished files, shards lost or changed, workers left running."""

    after_s: float
    shards_before: int
    shards_after: int
    parts: int
    lost: int
    left_running: int
    killed: bool
    """False where the build had finished."""


def build_command(folder: Path, count: int, shard: int) -> list[str]:
    """Return the command that builds `count` objects in shards of another size."""
    program = f"from nlos_cam import dataset; from nlos_cam.cli import run; dataset.SHARD = {shard}; run()"
    options = ["--out", str(folder), "--count", str(count), "--workers", "2"]
    return [sys.executable, "-c", program, "dataset", "build", *options]


def finish(command: list[str]) -> float:
    """Run a build to its end; return its seconds."""
    started_s = time.monotonic()
    subprocess.run(command, check=True, capture_output=True)
    return time.monotonic() - started_s


def plan_kills(count: int, shard: int, whole_s: float, times: int, seed: int) -> list[tuple[int, float]]:
    """Return for each kill the shards to wait for and the seconds after them, evenly over all but the last."""
    generator, shards = np.random.default_rng(seed), -(-count // shard)
    done = np.sort(generator.uniform(0, shards - 1, times))
    return [(int(moment), moment % 1 * whole_s / shards) for moment in done.tolist()]


def kill(command: list[str], folder: Path, shards: int, then_s: float) -> Kill:
    """Start a build, kill it `then_s` seconds after `shards` shards are there, and return the state of the folder."""
    killed = False
    before, started_s, workers = _shards(folder), time.monotonic(), list[int]()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and len(list(folder.glob(SHARD_PATTERN))) < shards:
            time.sleep(0.005)
        try:
            process.wait(then_s)
        except subprocess.TimeoutExpired:
            workers = children_of(process.pid)
            process.kill()
            killed = True
    after_s, parts = time.monotonic() - started_s, len(list(folder.glob(PART_PATTERN)))
    left, after = _still_running(workers), _shards(folder)
    lost = sum(after.get(name) != content for name, content in before.items())
    return Kill(after_s, len(before), len(after), parts, lost, left, killed)


def _shards(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob(SHARD_PATTERN)}


def _still_running(processes: list[int]) -> int:
    deadline_s = time.monotonic() + GRACE_S
    while (left := sum(runs(process) for process in processes)) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return left


def differing(one: Path, other: Path) -> list[str]:
    """Return the arrays of two datasets that differ in any bit."""
    left, right = open_dataset(one), open_dataset(other)
    return [name for name in REQUIRED_ARRAYS if not _same(left.column(name), right.column(name))]


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    if one.dtype == object:
        return one.tolist() == other.tolist()
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def main() -> None:
    """Build once undisturbed and once with kills; compare, write, print."""
    given = [int(argument) for argument in sys.argv[1:]]
    count, times, seed, shard = (*given, *DEFAULTS[len(given) :])
    with tempfile.TemporaryDirectory() as name:
        whole, killed = Path(name) / "whole", Path(name) / "killed"
        whole_s = finish(build_command(whole, count, shard))
        command = build_command(killed, count, shard)
        kills = [kill(command, killed, *when) for when in plan_kills(count, shard, whole_s, times, seed)]
        finish(command)
        wrong = differing(whole, killed)
    good = not wrong and all(each.killed and not each.lost and not each.left_running for each in kills)
    result = {"machine": machine(), "objects": count, "objects_in_a_shard": shard, "seed": seed}
    result |= {"seconds_undisturbed": whole_s, "good": good}
    result |= {"arrays_that_differ": wrong, "kills": [asdict(each) for each in kills]}
    (DOCS / "dataset_kills.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print("after s   shards before   after   half written   lost   workers left")
    for each in kills:
        print(
            f"{each.after_s:7.2f}   {each.shards_before:13}   {each.shards_after:5}   {each.parts:12}   "
            f"{each.lost:4}   {each.left_running:12}"
        )
    verdict = "equal bit for bit" if good else f"NOT good, arrays that differ: {wrong}"
    print(f"{sum(each.killed for each in kills)} kills, {count} objects: {verdict}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
