"""An adaptation killed at random moments, its children too: docs/figures/kill_adapt.json.

`kill_adapt.py [--kills N] [--seed S] [--work DIR] [--out FILE]`. One adaptation with a plan of a few
steps runs through; another with the same plan is killed (SIGKILL) N times, rendering and training
included, and goes on by the same command each time. Its weights, uncertainty network and quality
model have to be the same bytes, and nothing half-written may be left over. Exits with 1 where they
differ. A second call with the same --work takes over the run that was not killed, unless the
program has changed since.
"""

import argparse
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random

from live_process import children_of
from nlos_calibration import load_rig
from nlos_models import shipped_folder
from program_state import program_digest

from nlos_cam.adapt import Pace, Plan, Stage, calibration_spread
from nlos_cam.render import RENDERING_VERSION, SensorModel

RIG = "paper-rig"
DOCS = Path(__file__).parents[2] / "docs"
COMPARED = "direct.safetensors", "doubt.safetensors", "doubt.json", "quality.json"
TRAINED = "adapt/stage-1/weights"
"""Weights that are compared. A few steps' are worse than the start weights, so that they do not
become the bench's."""
SLICE = 0.2
"""Longest time until a kill, as a share of the whole run's."""


def prepare(folder: Path) -> None:
    """Write the plan of an adaptation of a few steps, unless it is there."""
    work = folder / "adapt"
    if work.exists():
        return
    work.mkdir(parents=True)
    rig = load_rig(RIG)
    network = (shipped_folder() / "direct.safetensors").read_bytes()
    Plan(
        rendering_version=RENDERING_VERSION,
        rig_checksum=rig.checksum,
        start=hashlib.sha256(network).hexdigest(),
        spread=calibration_spread(None),
        sensor=SensorModel(),
        seed=0,
        pace=Pace(objects_per_s=1.0, samples_per_s=1.0),
        stages=(Stage(minutes=1.0, objects=400, epochs=2, steps=3),),
    ).save(work)


def started(folder: Path) -> subprocess.Popen[bytes]:
    """Start the command in a group of its own."""
    program = "from nlos_cam.cli import run; run()"
    words = ["adapt", RIG, "--minutes", "1", "--out", str(folder), "--quiet"]
    return subprocess.Popen(
        [sys.executable, "-P", "-c", program, *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def finish(folder: Path) -> float:
    """Run the command to its end, and return its seconds. Raises RuntimeError where it fails."""
    start_s = time.monotonic()
    process = started(folder)
    _, said = process.communicate()
    if process.returncode:
        raise RuntimeError(f"it ends with {process.returncode}: {said.decode()[-500:]}")
    return time.monotonic() - start_s


def kill_once(folder: Path, after_s: float) -> str:
    """Kill the command after some seconds, and return the step that it had begun last; empty where it was
    done before.
    """
    process = started(folder)
    try:
        _, said = process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        children = children_of(process.pid)
        process.kill()
        process.communicate()
        # workers end with their parent; the test must not depend on how fast
        for child in children:
            try:
                os.kill(child, signal.SIGKILL)
            except ProcessLookupError:
                continue
        newest = max((folder / "adapt").rglob("*"), key=lambda path: path.lstat().st_mtime)
        return newest.relative_to(folder / "adapt").as_posix()
    if process.returncode:
        raise RuntimeError(
            f"after a kill it ends with {process.returncode}: {said.decode()[-500:]}"
        )
    return ""


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that have to be the same."""
    return {
        name: hashlib.sha256((folder / TRAINED / name).read_bytes()).hexdigest()
        for name in COMPARED
    }


def main() -> None:
    """Kill an adaptation, and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/kill-adapt"))
    parser.add_argument("--out", type=Path, default=DOCS / "figures" / "kill_adapt.json")
    asked = parser.parse_args()

    if asked.kills < 1:
        parser.error("--kills: without a kill nothing is compared")

    whole = asked.work / "whole"
    timed = asked.work / "seconds.json"
    mark = asked.work / "program.txt"
    program = program_digest()
    # Another program's weights differ without any fault.
    if not mark.exists() or mark.read_text() != program:
        shutil.rmtree(whole, ignore_errors=True)
        timed.unlink(missing_ok=True)
        asked.work.mkdir(parents=True, exist_ok=True)
        mark.write_text(program)
    prepare(whole)
    if not timed.exists():
        timed.write_text(json.dumps(finish(whole)))
    seconds = json.loads(timed.read_text())

    killed = asked.work / "killed"
    shutil.rmtree(killed, ignore_errors=True)
    prepare(killed)
    random = Random(asked.seed)  # noqa: S311  repeatable moments, no secrets
    kills: list[dict[str, object]] = []
    while len(kills) < asked.kills:
        after_s = random.uniform(0, SLICE * seconds)
        last = kill_once(killed, after_s)
        if not last:
            print(f"done after {len(kills)} kills", flush=True)
            break
        kills.append({"after_s": round(after_s, 1), "newest_file": last})
        print(kills[-1], flush=True)
    finish(killed)

    same = digests(killed) == digests(whole)
    left = [str(path) for path in killed.rglob("*.part")]
    result = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "program": program,
        "seconds_unkilled": round(seconds, 1),
        "kills": kills,
        "same_weights": same,
        "left_over": left,
    }
    asked.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"{len(kills)} kills, the same weights: {same}, left over: {left}")
    if not same or left or not kills:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
