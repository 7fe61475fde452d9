"""Commands killed at random moments, and pairs of them started at once on one output: docs/kill_commands.json.

`kill_commands.py [--kills N] [--races N] [--seed S] [--only NAME] [--out FILE]`. After each kill the same command runs
again: it has to end well, nothing half-written may be accepted, and nothing may be left over. Of two commands on one
output one has to win, and the other to name the reason in a line. A second call resumes. Exits with 1 after a finding.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from noise_recordings import record
from processes import PROGRAM

from nlos_cam.dataset import open_dataset
from nlos_cam.evaluate import machine
from nlos_cam.recording import load_sidecar, verify
from nlos_cam.view import RecordedView

DOCS = Path(__file__).parents[2] / "docs"
TIMEOUT_S = 900.0
REASONS = "being written", "exists", "in use"
"""Words of the line in which the second of two commands says why it does not run."""


@dataclass(frozen=True)
class Command:
    """Command line, its output, and the check of that.

    {folder} stands for an empty folder, {bag} for a recording, and {recipe} for a small recipe.
    """

    arguments: str
    output: str
    is_whole: Callable[[Path], object]
    again: str = "--overwrite"
    """Option of the run after the kill."""


def _folder(*names: str) -> Callable[[Path], object]:
    return lambda path: [(path / name).read_bytes()[0] for name in names]


def _capture(path: Path) -> object:
    return verify(path), load_sidecar(path.with_suffix(".json"))


def _session(path: Path) -> object:
    with RecordedView(path) as view:
        return view.address


RECIPE = """task = "vae"
objects = 8
held_out = 4
epochs = 3
batch = 4
learning_rate = 1e-3
"""
COMMANDS = {
    "capture": Command("capture sim:bare-wall --frames 30 --out {folder}/a.bag", "a.bag", _capture),
    "export": Command("export {bag} --out {folder}/out", "out", _folder("export.json", "depth.csv")),
    "repair": Command("repair {bag} --out {folder}/a.bag", "a.bag", verify),
    "replay": Command("replay {bag} --out {folder}/out", "out", _folder("report.md")),
    "save session": Command("live sim:bare-wall --no-view --seconds 2 --save-view {folder}/a.html", "a.html", _session),
    "train": Command(
        "train vae --recipe {recipe} --out {folder}/run", "run", _folder("checkpoint.json", "SHA256SUMS"), again=""
    ),
    "port": Command("live sim:bare-wall --view-port 18765 --seconds 8", ".", Path.exists, again=""),
    "render": Command("render cup --out {folder}/a.npz", "a.npz", lambda path: path.read_bytes()[0]),
    "dataset build": Command(
        "dataset build --count 4 --workers 1 --accuracy draft --out {folder}/data",
        "data",
        lambda path: open_dataset(path).column("seed"),
        again="",
    ),
}


def line_of(command: Command, folder: Path, bag: Path, *options: str) -> list[str]:
    """Return a command's process arguments."""
    return [
        *PROGRAM,
        *command.arguments.format(folder=folder, bag=bag, recipe=bag.with_name("small.toml")).split(),
        *options,
    ]


def leftovers(folder: Path) -> list[str]:
    """Return what no finished command leaves."""
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.endswith(".part")]


def kill_once(command: Command, bag: Path, after_s: float) -> dict[str, Any]:
    """Kill a command after a time, run it again, and return what is wrong."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process = subprocess.Popen(line_of(command, folder, bag), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            process.kill()
        was_killed, output = process.wait() < 0, folder / command.output
        wrong = ""
        if output.exists() and not command.arguments.startswith(("capture", "dataset", "train")):
            wrong = problem_of(command, output)  # under its final name it has to be whole
        options = [command.again] if output.exists() and command.again else []
        again = subprocess.run(
            line_of(command, folder, bag, *options), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
        wrong = wrong or (
            f"the next run ends with {again.returncode}: {again.stderr[-200:]}" if again.returncode else ""
        )
        wrong = wrong or problem_of(command, output) or ", ".join(leftovers(folder))
    return {"after_s": round(after_s, 2), "killed": was_killed, "wrong": wrong}


def problem_of(command: Command, output: Path) -> str:
    """Return why an output is not whole; empty if it is."""
    try:
        command.is_whole(output)
    except Exception as error:  # noqa: BLE001  whatever reading it raises is the finding
        return f"{output.name} is not whole: {error}"[:300]
    return ""


def race_once(command: Command, bag: Path, apart_s: float) -> dict[str, Any]:
    """Start a command twice on one output, and return the exit codes and what is wrong."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        first = subprocess.Popen(line_of(command, folder, bag), **pipes)
        time.sleep(apart_s)
        second = subprocess.Popen(line_of(command, folder, bag), **pipes)
        said = [process.communicate(timeout=TIMEOUT_S)[1] for process in (first, second)]
        codes = sorted((first.returncode, second.returncode))
        lines = [text for process, text in zip((first, second), said, strict=True) if process.returncode]
        wrong = problem_of(command, folder / command.output) or ", ".join(leftovers(folder))
        is_build = command.again == ""
        if codes not in ([0, 1], *([[0, 0]] if is_build else [])):
            wrong = wrong or f"exit codes {codes}: {said}"
        if any("Traceback" in text or not any(reason in text for reason in REASONS) for text in lines):
            wrong = wrong or f"no line that says so: {lines}"
    return {"apart_s": round(apart_s, 2), "codes": codes, "wrong": wrong}


def duration_s(command: Command, bag: Path) -> float:
    """Return how long the command takes here."""
    with tempfile.TemporaryDirectory() as name:
        start_s = time.monotonic()
        subprocess.run(line_of(command, Path(name), bag), check=True, capture_output=True, timeout=TIMEOUT_S)
        return time.monotonic() - start_s


def main() -> int:
    """Kill, race, write after each command; return 1 after a finding."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--races", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="only commands with this in their name")
    parser.add_argument("--out", type=Path, default=DOCS / "kill_commands.json")
    chosen = parser.parse_args()
    result = json.loads(chosen.out.read_text(encoding="utf-8")) if chosen.out.exists() else {"machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        bag = record(Path(folder) / "noise.bag", packed=True, frames=8)
        bag.with_name("small.toml").write_text(RECIPE, encoding="utf-8")
        for name, command in COMMANDS.items():
            if chosen.only not in name:
                continue
            done = result.setdefault(name, {"kills": [], "races": []})
            takes_s = duration_s(command, bag)
            for kind, count, act in (("kills", chosen.kills, kill_once), ("races", chosen.races, race_once)):
                for number in range(len(done[kind]), count):
                    moment = random.Random(f"{chosen.seed} {name} {number}").uniform(0, takes_s)  # noqa: S311
                    done[kind].append(act(command, bag, moment if kind == "kills" else 0.3 * moment))
                    print(name, kind, number, done[kind][-1], flush=True)
                    chosen.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    rows = [row for name in COMMANDS for kind in ("kills", "races") for row in result.get(name, {}).get(kind, [])]
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
