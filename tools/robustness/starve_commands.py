"""Commands on a disk that fills up, in little memory, and without /dev/shm: docs/starved.json.

`starve_commands.py [--count N] [--seed S] [--only NAME] [--out FILE]`, as root on Linux. Each command runs N times on a
tmpfs of a random size up to a little more than its output needs, N times under a random limit of address space, and
once without /dev/shm. It has to end well or in a line with a documented exit code, and leave nothing half-written.
A second call resumes. Exits with 1 after a finding.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kill_commands import COMMANDS, RECIPE, TIMEOUT_S, Command, leftovers, line_of, problem_of
from noise_recordings import record

from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
EXIT_CODES, MAX_LINES = {0, 1, 2, 3, 4}, 3
MOUNT, UNMOUNT = "/bin/mount", "/bin/umount"
MIN_KIB, SPARE = 16, 1.2
MIN_AS_MIB, MAX_AS_MIB = 300, 4000
NO_SHM = ["unshare", "--mount", "sh", "-c", 'mount -t tmpfs -o ro,size=4k none /dev/shm && exec "$@"', "sh"]
PROGRESS = "...", " s", "%"
"""Ends of lines that report progress."""


@contextmanager
def small_disk(kib: int) -> Generator[Path]:
    """Yield a folder on a file system of its own with so many KiB."""
    with tempfile.TemporaryDirectory() as name:
        subprocess.run([MOUNT, "-t", "tmpfs", "-o", f"size={kib}k", "none", name], check=True)
        try:
            yield Path(name)
        finally:
            subprocess.run([UNMOUNT, name], check=True)


def wrong_with(command: Command, folder: Path, ended: subprocess.CompletedProcess[str]) -> str:
    """Return what is wrong with an end of a command; empty if nothing is."""
    lines = [line for line in ended.stderr.splitlines() if line.strip() and not line.endswith(PROGRESS)]
    output = folder / command.output
    if ended.returncode not in EXIT_CODES:
        return f"exit code {ended.returncode}: {ended.stderr[-300:]}"
    if "Traceback" in ended.stderr or (ended.returncode and len(lines) > MAX_LINES):
        return f"{len(lines)} lines: {ended.stderr[-600:]}"
    if ended.returncode == 0 and (problem := problem_of(command, output)):
        return problem
    is_atomic = not command.arguments.startswith(("capture", "dataset", "train"))
    if ended.returncode and is_atomic and output.exists() and (problem := problem_of(command, output)):
        return problem
    return ", ".join(leftovers(folder))


def starve(command: Command, bag: Path, way: str, amount: int) -> dict[str, Any]:
    """Run a command with little of something; return its exit code, its last line and what is wrong."""
    with small_disk(amount if way == "disk_kib" else 1 << 20) as folder:
        line = line_of(command, folder, bag)
        if way == "memory_mib":
            line = ["prlimit", f"--as={amount << 20}", *line]
        line = [*NO_SHM, *line] if way == "no_shm" else line
        ended = subprocess.run(line, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        said = ended.stderr.strip().splitlines()[-1:] if ended.returncode else []
        wrong = wrong_with(command, folder, ended)
    return {"amount": amount, "code": ended.returncode, "said": "".join(said)[-200:], "wrong": wrong}


def need_kib(command: Command, bag: Path) -> int:
    """Return the size of everything that a command writes, in KiB."""
    with tempfile.TemporaryDirectory() as name:
        subprocess.run(line_of(command, Path(name), bag), check=True, capture_output=True, timeout=TIMEOUT_S)
        return sum(path.stat().st_size for path in Path(name).rglob("*") if path.is_file()) // 1024 + MIN_KIB


def main() -> int:
    """Starve each command, write after each run; return 1 after a finding."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="only commands with this in their name")
    parser.add_argument("--out", type=Path, default=DOCS / "starved.json")
    chosen = parser.parse_args()
    result = json.loads(chosen.out.read_text(encoding="utf-8")) if chosen.out.exists() else {"machine": machine()}
    with tempfile.TemporaryDirectory() as folder:
        bag = record(Path(folder) / "noise.bag", packed=True, frames=8)
        bag.with_name("small.toml").write_text(RECIPE, encoding="utf-8")
        for name, command in COMMANDS.items():
            if chosen.only not in name or name == "port":
                continue
            done: dict[str, list[dict[str, Any]]] = result.setdefault(name, {})
            most_kib = int(SPARE * need_kib(command, bag))
            bounds = {"disk_kib": (MIN_KIB, most_kib), "memory_mib": (MIN_AS_MIB, MAX_AS_MIB), "no_shm": (0, 0)}
            for way, (low, high) in bounds.items():
                rows = done.setdefault(way, [])
                while len(rows) < (chosen.count if high else 1):
                    draw = random.Random(f"{chosen.seed} {name} {way} {len(rows)}")  # noqa: S311
                    rows.append(starve(command, bag, way, draw.randint(low, high)))
                    print(name, way, rows[-1], flush=True)
                    chosen.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    rows = [row for ways in result.values() if isinstance(ways, dict) for rows in ways.values() for row in rows]
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
