"""Live runs interrupted at random moments, and the files and processes they leave: docs/interruptions.json.

`python tools/robustness/interrupt_live.py [--count N] [--seed S] [--out FILE]`. Each run records, logs and serves its
view (mostly); it is ended by Ctrl-C, by a request to terminate, by the camera being unplugged for good, or by its
--seconds after its watcher was killed or the camera was unplugged for a while. A second call resumes.
Exits with 1 where a process is left, a file is half written, or an exit code is not the documented one.
"""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from live_process import LiveProcess

from nlos_cam.cli.common import tracked
from nlos_cam.errors import RecordingError
from nlos_cam.evaluate import machine
from nlos_cam.recording import BagReader, repair_recording

DOCS = Path(__file__).parents[2] / "docs"
KINDS = "ctrl-c", "terminate", "viewer killed", "unplugged a while", "unplugged, then ctrl-c", "unplugged for good"
EXIT_CODES = {"viewer killed": 0, "unplugged a while": 0, "unplugged for good": 3}
INTERRUPTED = 130
"""Exit code of the other kinds."""
SHARES = 0.3, 0.2, 0.2, 0.1, 0.15, 0.05
"""Probability of each kind; a run of the last waits a minute for the camera to return."""
LATEST_S, RUN_S = 12.0, 12.0
START_TIMEOUT_S, END_TIMEOUT_S = 300.0, 180.0
SCENE = 'name = "a wall"\nrig = "bare-wall"\n'
UNPLUG = '[[faults]]\nkind = "unplug"\nat_frame = {at_frame}\nframes = {frames}\n'
WATCHER = """
import sys, urllib.request
with urllib.request.urlopen(sys.argv[1].partition("#")[0] + "stream") as stream:
    print("watching", flush=True)
    while stream.read(1 << 16):
        pass
"""


@dataclass(frozen=True)
class Plan:
    """Interruption of one run: time after its start (of a viewer: after it watches), frame of the unplugging."""

    number: int
    kind: str
    after_s: float
    at_frame: int
    view: bool


@dataclass(frozen=True)
class Outcome:
    """State after a run: exit code (None: did not end), processes, half-written files, missing output."""

    plan: Plan
    exit_code: int | None
    seconds_to_end: float | None
    processes_left: int
    half_written: list[str]
    frames_recorded: int
    lines_logged: int
    missing: str

    @property
    def good(self) -> bool:
        expected = EXIT_CODES.get(self.plan.kind, INTERRUPTED)
        return self.exit_code == expected and not (self.processes_left or self.half_written or self.missing)


def plan_of(number: int, seed: int) -> Plan:
    """Draw the plan of a run from its number and the seed."""
    generator = np.random.default_rng([seed, number])
    kind = str(generator.choice(KINDS, p=SHARES))
    after_s, at_frame = float(generator.uniform(0.0, LATEST_S)), int(generator.integers(1, 90))
    return Plan(number, kind, after_s, at_frame, kind == "viewer killed" or bool(generator.random() < 0.6))


def scene_of(plan: Plan) -> str:
    """Return the scene file of a run."""
    if not plan.kind.startswith("unplugged"):
        return SCENE
    frames = 60 if plan.kind == "unplugged a while" else 1_000_000
    return SCENE + UNPLUG.format(at_frame=plan.at_frame, frames=frames)


def arguments_of(plan: Plan, folder: Path) -> list[str]:
    """Return the arguments of `live`."""
    endless = EXIT_CODES.get(plan.kind) != 0
    paths = ["--record", str(folder / "run.bag"), "--log", str(folder / "run.csv")]
    options = [*([] if plan.view else ["--no-view"]), *([] if endless else ["--seconds", str(RUN_S)])]
    return ["--camera", f"sim:{folder / 'scene.toml'}", "--json", *paths, *options]


def interrupt(plan: Plan, folder: Path) -> Outcome:
    """Start a run, interrupt it as planned, and return the state of its folder and processes."""
    (folder / "scene.toml").write_text(scene_of(plan), encoding="utf-8")
    with LiveProcess(arguments_of(plan, folder)) as run:
        run.wait_until_begun(START_TIMEOUT_S)
        if plan.kind == "viewer killed":
            _watch_and_be_killed(run.wait_for_address(START_TIMEOUT_S), plan.after_s)
        elif plan.kind not in EXIT_CODES:
            time.sleep(plan.after_s)
            run.process.send_signal(signal.SIGTERM if plan.kind == "terminate" else signal.SIGINT)
        seconds = run.ended_within(END_TIMEOUT_S + START_TIMEOUT_S * (plan.kind in EXIT_CODES))
        left, code = len(run.left()), run.process.poll()
        frames, half_written = files_of(folder)
        log = folder / "run.csv"
        lines = len(log.read_text(encoding="utf-8").splitlines()) - 1 if log.exists() else 0
        return Outcome(plan, code, seconds, left, half_written, frames, max(lines, 0), _missing(run, log))


def _watch_and_be_killed(address: str, after_s: float) -> None:
    command = [sys.executable, "-c", WATCHER, address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as watcher:
        if watcher.stdout:
            watcher.stdout.readline()
        time.sleep(after_s / 4)
        watcher.kill()


def _missing(run: LiveProcess, log: Path) -> str:
    """Return the missing output of a run that had begun: its last line is a JSON object."""
    if not log.exists():
        return ""
    try:
        report = json.loads(run.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        return "no object ends stdout"
    return "" if "frames" in report or "error" in report else "neither frames nor an error are reported"


def files_of(folder: Path) -> tuple[int, list[str]]:
    """Return the frames in the recording, and the files that are neither whole nor can be repaired."""
    half = [f"{path.name}: left over" for path in folder.rglob("*") if ".part" in path.name]
    log, bag, frames = folder / "run.csv", folder / "run.bag", 0
    if log.exists() and not (text := log.read_text(encoding="utf-8")).endswith("\n") and text:
        half.append("run.csv: its last line is cut")
    if bag.exists():
        try:
            frames = _frames_in(bag)
        except RecordingError as error:
            half.append(f"run.bag: {error}")
    return frames, half


def _frames_in(bag: Path) -> int:
    """Count the frames of the shortest stream. Raises RecordingError where it can be neither read nor repaired."""
    try:
        streams = BagReader(bag).streams
    except RecordingError:
        fixed = bag.with_name("repaired.bag")
        recovered = repair_recording(bag, fixed).recovered_frames
        return min(recovered.values(), default=0)
    return min((info.frames for info in streams.values()), default=0)


def facts(outcomes: list[dict[str, Any]], count: int, seed: int) -> dict[str, Any]:
    """Return the results for JSON."""
    good = sum(outcome["good"] for outcome in outcomes)
    return {"machine": machine(), "seed": seed, "count": count, "good": good, "runs": outcomes}


def so_far(path: Path, seed: int) -> list[dict[str, Any]]:
    """Return the finished runs of an earlier call with the same seed."""
    if not path.exists():
        return []
    written = json.loads(path.read_text(encoding="utf-8"))
    return written["runs"] if written["seed"] == seed else []


def main() -> None:
    """Interrupt, write after each, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=DOCS / "interruptions.json")
    chosen = parser.parse_args()
    outcomes = so_far(chosen.out, chosen.seed)[: chosen.count]
    with tracked("interrupting") as on_progress:
        for number in range(len(outcomes), chosen.count):
            on_progress(number, chosen.count)
            folder = Path(tempfile.mkdtemp())
            outcome = interrupt(plan_of(number, chosen.seed), folder)
            shutil.rmtree(folder)
            outcomes.append({**asdict(outcome), "good": outcome.good})
            written = json.dumps(facts(outcomes, chosen.count, chosen.seed), indent=2)
            chosen.out.write_text(written + "\n", encoding="utf-8")
    bad = [outcome for outcome in outcomes if not outcome["good"]]
    print(json.dumps(bad, indent=2) if bad else f"{len(outcomes)} runs interrupted: nothing left, nothing half written")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
