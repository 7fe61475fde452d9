"""Hours of `live` with a watcher that comes and goes: `soak.json` and `soak.png` of the docs.

`soak.py [--minutes M] [--camera URI] [--watcher visits|stays|none] [--out FILE]`. Once a minute it
notes memory, threads and descriptors of the process, and latency and drops of that minute's frames.
The files are written after each minute. A minute should have a p99 of at most 15 ms without a
watcher, 18 ms with one, and no frame dropped.
"""

import argparse
import csv
import json
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from threading import Event, Thread
from urllib.parse import urlsplit

import numpy as np
from live_process import LiveProcess
from matplotlib.figure import Figure

from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
START_TIMEOUT_S = 300.0
END_TIMEOUT_S = 60.0
MINUTE_S = 60.0
WATCH_S = 20.0
PAUSE_S = 10.0
WATCHERS = {"visits": WATCH_S, "stays": float("inf"), "none": 0.0}
"""Length of a visit in seconds."""
LATENCY = "latency_ms"
DROPPED = "dropped"
"""Columns of the frame log, by part of their name."""


@dataclass(frozen=True)
class Minute:
    """State of the process at the end of a minute, and the frames of that minute."""

    minute: int
    rss_mib: float
    threads: int
    descriptors: int
    frames: int
    latency_p50_ms: float
    latency_p99_ms: float
    dropped: float
    """Frames dropped since the start, as the log has it."""
    watchers: int
    """That came and went so far."""


def watch(address: str, stop: Event, visits: list[int], visit_s: float) -> None:
    """Read the view's stream for `visit_s`, leave, and come again, until `stop`; `visits` counts
    those who were shown something.
    """
    while not stop.wait(PAUSE_S):
        until_s = time.monotonic() + visit_s
        shown = False
        connection = HTTPConnection(urlsplit(address).netloc, timeout=WATCH_S)
        with suppress(OSError, HTTPException):
            connection.request("GET", "/stream")
            stream = connection.getresponse()
            while time.monotonic() < until_s and stream.read1(1 << 16) and not stop.is_set():
                shown = stream.status == HTTPStatus.OK
        connection.close()
        if shown:
            visits.append(1)


def state_of(pid: int) -> tuple[float, int, int]:
    """Return memory in MiB, threads and descriptors of a process."""
    status = dict(
        line.split(":", 1)
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    )
    descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"]), descriptors


class FrameLog:
    """Rows of a growing frame log, each read once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names = list[str]()
        self._read = 0

    def rows(self) -> list[dict[str, str]]:
        """Return the whole rows since the last call."""
        with self._path.open("rb") as file:
            file.seek(self._read)
            whole = file.read().rpartition(b"\n")[0]
        if not whole:
            return []
        self._read += len(whole) + 1
        table = csv.DictReader(whole.decode().splitlines(), self._names or None)
        rows = list(table)
        self._names = list(table.fieldnames or ())
        return rows


def _column(rows: list[dict[str, str]], part: str) -> list[float]:
    name = next((name for name in rows[0] if part in name), "") if rows else ""
    return [float(row[name]) for row in rows if name and row[name]]


def summarize(
    number: int, state: tuple[float, int, int], rows: list[dict[str, str]], watchers: int
) -> Minute:
    """Return one minute's line."""
    latency_ms = _column(rows, LATENCY) or [0.0]
    dropped = _column(rows, DROPPED) or [0.0]
    p50, p99 = (float(value) for value in np.percentile(latency_ms, [50, 99]))
    return Minute(number, *state, len(rows), p50, p99, dropped[-1], watchers)


def draw(minutes: list[Minute], path: Path) -> None:
    """Draw every figure over time."""
    names = "rss_mib", "threads", "descriptors", "latency_p99_ms", "frames"
    figure = Figure(figsize=(7, 8), layout="constrained")
    for axis, name in zip(figure.subplots(len(names), 1, sharex=True), names, strict=True):
        values = [float(getattr(each, name)) for each in minutes]
        axis.plot([each.minute for each in minutes], values)
        axis.set(ylabel=name.replace("_", " "), ylim=(0, 1.15 * max(values) or 1))
    axis.set(xlabel="minutes")
    figure.savefig(path, dpi=110)


def main() -> int:
    """Soak; write after each minute; return the exit code of the run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=int, default=120)
    parser.add_argument("--camera", default="sim")
    parser.add_argument("--watcher", choices=WATCHERS, default="visits")
    parser.add_argument("--out", type=Path, default=DOCS / "figures" / "soak.json")
    chosen = parser.parse_args()
    minutes = list[Minute]()
    visits = list[int]()
    stop = Event()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "frames.csv"
        seconds = MINUTE_S * chosen.minutes + MINUTE_S / 2
        visit_s = WATCHERS[chosen.watcher]
        options = ["--seconds", str(seconds), "--log", str(log), "--json"] + ["--no-view"] * (
            not visit_s
        )
        with LiveProcess([chosen.camera, *options]) as run:
            while not log.exists() and run.process.poll() is None:
                time.sleep(1.0)
            if visit_s:
                address = run.wait_for_address(START_TIMEOUT_S)
                Thread(target=watch, args=(address, stop, visits, visit_s), daemon=True).start()
            frames = FrameLog(log)
            start_s = time.monotonic()
            for number in range(1, chosen.minutes + 1):
                time.sleep(max(start_s + MINUTE_S * number - time.monotonic(), 0))
                if run.process.poll() is not None:
                    break
                minutes.append(
                    summarize(number, state_of(run.process.pid), frames.rows(), len(visits))
                )
                facts = {
                    "machine": machine(),
                    "camera": chosen.camera,
                    "minutes": list(map(asdict, minutes)),
                }
                chosen.out.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
                # Beside a file of one's own; the docs' picture is that of the docs' figures.
                in_docs = chosen.out.resolve().parent == (DOCS / "figures").resolve()
                pictures = DOCS / "images" if in_docs else chosen.out.parent
                draw(minutes, pictures / f"{chosen.out.stem}.png")
                print(minutes[-1], file=sys.stderr)
            stop.set()
            if run.ended_within(END_TIMEOUT_S + MINUTE_S) is None:
                print("the run does not end", file=sys.stderr)
                return 1
            return run.process.returncode or 0


if __name__ == "__main__":
    sys.exit(main())
