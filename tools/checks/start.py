"""Starting times of the command line, beside those of a bare interpreter and of NumPy: a table, and
docs/figures/start.json.

`python tools/checks/start.py [--runs N] [--only WORD] [--out FILE]`. Each program runs N times; the
runs of different programs alternate, so that a busy machine slows all alike, and medians are
compared. Wall-clock times mean something on an idle machine only; the processor's time and the
ratios in one run stand more.
"""

import argparse
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple
from urllib.parse import urlsplit

from typer.main import get_command

from nlos_cam.cli.main import COMMANDS, build_app
from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
NLOS_CAM = "from nlos_cam.cli import run; run()"
BARE = "python -c pass"
NUMPY = "import numpy"
ADDRESS = re.compile(rb"http://127\.0\.0\.1:\d+/")
MOMENT = b'"kind":"moment"'
"""In the head of each message with a reconstruction."""
TIMEOUT_S = 600.0
POLL_S = 0.005


class Times(NamedTuple):
    """Seconds from a program's start to its end or first result, and the processor's seconds until
    its end.
    """

    wall_s: float
    cpu_s: float


Await = Callable[["subprocess.Popen[bytes]", Path], None]
"""Returns when a program, whose folder is given, has shown its first result."""


def ended(process: "subprocess.Popen[bytes]", _folder: Path) -> None:
    """Read the output of a program to its end."""
    process.communicate(timeout=TIMEOUT_S)


def first_line(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    """Wait until the log of a live run has a line; the first one is flushed at once."""
    log = folder / "first.jsonl"
    while not (log.is_file() and log.stat().st_size):
        if process.poll() is not None:
            raise RuntimeError("the live run ended without a line in its log")
        time.sleep(POLL_S)


def first_picture(process: "subprocess.Popen[bytes]", _folder: Path) -> None:
    """Read the live page's stream as a browser does, until it has a reconstruction."""
    address = next(
        (found[0].decode() for line in process.stderr or () if (found := ADDRESS.search(line))), ""
    )
    connection = HTTPConnection(urlsplit(address).netloc, timeout=TIMEOUT_S)
    connection.request("GET", "/stream")
    answer = connection.getresponse()
    received = b""
    while MOMENT not in received:
        received += (part := answer.read1(1 << 16))
        if not part:
            raise RuntimeError("the stream ended without a reconstruction")
    connection.close()


def children_s() -> float:
    """Return the processor's time of all ended children, in seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(words: list[str], until: Await = ended, *, cold: bool = False) -> Times:
    """Start Python with arguments in an empty folder; `cold`: with empty caches, as after the
    installation.
    """
    with TemporaryDirectory() as name:
        folder = Path(name)
        caches = (
            {"NLOS_CAM_CACHE": str(folder / "cache"), "NUMBA_CACHE_DIR": str(folder / "numba")}
            if cold
            else {}
        )
        pipe = subprocess.PIPE
        before_s = children_s()
        start_s = time.perf_counter()
        command = [sys.executable, "-P", *words]
        with subprocess.Popen(
            command, cwd=folder, env={**os.environ, **caches}, stdout=pipe, stderr=pipe
        ) as process:
            until(process, folder)
            wall_s = time.perf_counter() - start_s
            if until is not ended:
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=TIMEOUT_S)
        # doctor ends with 1 where it misses something, such as a camera
        wanted = {0, 1} if words[-1] == "doctor" else {0} if until is ended else {130}
        if process.returncode not in wanted:
            raise RuntimeError(f"{' '.join(words)}: exit code {process.returncode}")
    return Times(wall_s, children_s() - before_s)


def programs() -> dict[str, Callable[[], Times]]:
    """Return the measurements, by name."""
    tree = get_command(build_app()).commands  # type: ignore[attr-defined]
    parts = {
        name: [[], *([part] for part in getattr(tree[name], "commands", ()))] for name in COMMANDS
    }
    helps = [[name, *part, "--help"] for name in COMMANDS for part in parts[name]]
    calls = {" ".join(line): line for line in [["--version"], ["--help"], *helps, ["doctor"]]}
    live = ["-c", NLOS_CAM, "live", "sim", "--no-view", "--log", "first.jsonl"]
    demo = ["-c", NLOS_CAM, "demo"]
    return {
        BARE: partial(timed, ["-c", "pass"]),
        NUMPY: partial(timed, ["-c", "import numpy"]),
        **{name: partial(timed, ["-c", NLOS_CAM, *line]) for name, line in calls.items()},
        "live --no-view, to its first result": partial(timed, live, first_line),
        "demo with empty caches, to its first picture": partial(
            timed, demo, first_picture, cold=True
        ),
    }


def table(medians: dict[str, Times]) -> str:
    """Return the medians in Markdown, with their ratios to a bare interpreter and to NumPy's
    import.
    """
    head = "| program | wall s | processor s | x bare | x numpy |\n| --- | --- | --- | --- | --- |"
    bare = medians[BARE]
    numpy = medians[NUMPY]
    rows = [
        f"| `{name}` | {each.wall_s:.2f} | {each.cpu_s:.2f} | {each.wall_s / bare.wall_s:.1f} |"
        f" {each.wall_s / numpy.wall_s:.1f} |"
        for name, each in medians.items()
    ]
    return "\n".join([head, *rows])


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=9, metavar="N")
    parser.add_argument(
        "--only",
        default="",
        metavar="WORD",
        help="measure only the programs whose name has this word",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="default with --only: none")
    asked = parser.parse_args()
    # Some of the programs alone must not replace the figures of all.
    out = asked.out or (None if asked.only else DOCS / "figures" / "start.json")
    chosen = {
        name: run for name, run in programs().items() if name in {BARE, NUMPY} or asked.only in name
    }
    measured: dict[str, list[Times]] = {name: [] for name in chosen}
    load_before = os.getloadavg()[0]
    for _ in range(asked.runs):
        for name, run in chosen.items():
            measured[name].append(run())
    medians = {
        n: Times(median(t.wall_s for t in many), median(t.cpu_s for t in many))
        for n, many in measured.items()
    }
    load = {"before": load_before, "after": os.getloadavg()[0]}
    rows = {name: times._asdict() for name, times in medians.items()}
    facts = {"machine": machine(), "load": load, "runs": asked.runs, "medians": rows}
    if out:
        out.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(
        f"{facts['machine']}; load {load['before']:.1f} before, {load['after']:.1f} after;"
        f" {asked.runs} runs\n"
    )
    print(table(medians))
    return 0


if __name__ == "__main__":
    sys.exit(main())
