"""Commands on a full disk, in little memory, without /dev/shm: docs/figures/starved.json.

`starve_commands.py [--count N] [--seed S] [--only NAME] [--out FILE]`, as root on Linux. Each
command runs N times on a tmpfs of a random size up to a little more than its output needs, N times
under a random limit of address space, and once without /dev/shm. It has to end well or in a line
with a documented exit code, and leave nothing half-written. A second call resumes. Exits with 1
after a finding.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from random import Random

import trials
from trials import Command, Row

EXIT_CODES = {0, 1, 2, 3, 4}
MAX_LINES = 3
MOUNT = "/bin/mount"
UNMOUNT = "/bin/umount"
MIN_KIB = 16
MAX_SHARE = 1.2
AS_MIB = 300, 4000
PAIRS = {"cache", "port"}
"""Commands for races alone."""
PROGRAM = [sys.executable, "-P", "-c", "from nlos_cam.cli import run; run()"]
NO_SHM = [
    "unshare",
    "--mount",
    "sh",
    "-c",
    'mount -t tmpfs -o ro,size=4k none /dev/shm && exec "$@"',
    "sh",
]
ROOT = Path(__file__).parents[2]


@contextmanager
def small_disk(kib: int) -> Generator[Path]:
    """Yield a folder on a file system of its own of `kib` KiB."""
    with tempfile.TemporaryDirectory() as name:
        subprocess.run([MOUNT, "-t", "tmpfs", "-o", f"size={kib}k", "none", name], check=True)
        try:
            yield Path(name)
        finally:
            subprocess.run([UNMOUNT, name], check=True)


def wrong_with(
    command: Command, folder: Path, inputs: Path, ended: subprocess.CompletedProcess[str]
) -> str:
    """Return the finding about an end of a command; empty if there is none."""
    said = [line for line in ended.stderr.splitlines() if line.strip()]
    lines = said[
        next((at for at, line in enumerate(said) if line.startswith("error:")), 0) :
    ]  # notes come before
    output = folder / command.output
    if ended.returncode not in EXIT_CODES:
        return f"exit code {ended.returncode}: {ended.stderr}"
    if "Traceback" in ended.stderr or (ended.returncode and len(lines) > MAX_LINES):
        return f"{len(lines)} lines: {ended.stderr}"
    must_be_whole = ended.returncode == 0 or (command.is_atomic and output.exists())
    if must_be_whole and (problem := trials.problem_of(command, folder, inputs)):
        return problem
    return ", ".join(trials.leftovers(folder))


def starve(command: Command, inputs: Path, way: str, random: Random) -> Row:
    """Run a command with little of something; return its exit code, its last line and the
    finding.
    """
    low, high = {
        "disk_kib": (MIN_KIB, MAX_SHARE * need_kib(command, inputs)),
        "memory_mib": AS_MIB,
    }.get(way, (0, 0))
    amount = random.randint(low, int(high))
    with small_disk(amount if way == "disk_kib" else 1 << 20) as folder:
        line = [*PROGRAM, *trials.line_of(command.arguments, folder, inputs)]
        if way == "memory_mib":
            line = ["prlimit", f"--as={amount << 20}", *line]
        line = [*NO_SHM, *line] if way == "no_shm" else line
        ended = run_in(folder, line)
        said = ended.stderr.strip().splitlines()[-1:] if ended.returncode else []
        row = {"said": "".join(said), "wrong": wrong_with(command, folder, inputs, ended)}
    for place in (folder, inputs, ROOT):  # their names say nothing about the trial
        row = {
            key: text.replace(f"{place}/", "").replace(str(place), "") for key, text in row.items()
        }
    return {
        "amount": amount,
        "code": ended.returncode,
        **{key: text[-300:] for key, text in row.items()},
    }


def run_in(folder: Path, line: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command line whose current folder and cache are a trial's, not the owner's."""
    return subprocess.run(
        line,
        cwd=folder,
        env=os.environ | {"NLOS_CAM_CACHE": str(folder / "cache")},
        capture_output=True,
        text=True,
        timeout=trials.TIMEOUT_S,
        check=False,
    )


@cache
def need_kib(command: Command, inputs: Path) -> int:
    """Return the size of everything that a command writes, in KiB."""
    with tempfile.TemporaryDirectory() as name:
        line = [*PROGRAM, *trials.line_of(command.arguments, Path(name), inputs)]
        run_in(Path(name), line).check_returncode()
        return (
            sum(path.stat().st_size for path in Path(name).rglob("*") if path.is_file()) // 1024
            + MIN_KIB
        )


def main() -> int:
    """Starve each command, write after each run; return 1 after a finding."""
    chosen = trials.options(__doc__, "starved.json", count=10).parse_args()
    trials.load_program()
    results = trials.Results(chosen.out, chosen.seed)
    with trials.inputs_of(chosen) as inputs:
        for name, command in trials.COMMANDS.items():
            for way, count in {
                "disk_kib": chosen.count,
                "memory_mib": chosen.count,
                "no_shm": 1,
            }.items():
                if chosen.only in name and name not in PAIRS:
                    results.repeat(name, way, count, partial(starve, command, inputs, way))
    return int(bool(results.findings))


if __name__ == "__main__":
    sys.exit(main())
