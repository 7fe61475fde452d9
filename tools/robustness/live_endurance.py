"""Ten minutes of `live --camera sim`, alone and watched, and the pace of a replay: docs/live.json.

`python tools/robustness/live_endurance.py [--seconds S] [--runs alone,watched,chromium] [--out FILE]`. Each run is a
process of its own, sampled every second; "watched" has a client that reads the view's stream, "chromium" a headless
browser that draws it. Results are written after each part. Exits with 1 where a run misses a limit; `chromium` has
none, since it draws on the same processors.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

from live_process import LiveProcess
from processes import PROGRAM, Look, memory, memory_mib

from nlos_cam.evaluate import machine

DOCS = Path(__file__).parents[2] / "docs"
START_TIMEOUT_S, END_TIMEOUT_S = 300.0, 60.0
MAX_DROPPED_SHARE, MIN_FPS, MAX_MIB_PER_MINUTE, MIN_TIMES_REAL = 0.001, 29.9, 0.5, 3.0
MAX_P99_MS, MAX_P99_OVER_P50 = {"alone": 15.0, "watched": 18.0, "chromium": 18.0}, 1.5
REPLAYED_S = 60.0
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]

Watch = Callable[[str], Any]
"""Context that watches the view at an address, and yields counts that grow."""


@contextmanager
def unwatched(_: str) -> Generator[dict[str, Any]]:
    """Watch nothing."""
    yield {}


@contextmanager
def client(address: str) -> Generator[dict[str, Any]]:
    """Read the view's stream as fast as it comes, until it ends."""
    counts = {"stream_bytes": 0}

    def read() -> None:
        connection = HTTPConnection(urlsplit(address).netloc, timeout=END_TIMEOUT_S)
        with suppress(HTTPException, OSError):
            connection.request("GET", "/stream")
            answer = connection.getresponse()
            while content := answer.read1(1 << 16):
                counts["stream_bytes"] += len(content)
        connection.close()

    reader = Thread(target=read)
    reader.start()
    yield counts
    reader.join()


@contextmanager
def chromium(address: str) -> Generator[dict[str, Any]]:
    """Draw the view in a headless browser, in software."""
    with tempfile.TemporaryDirectory() as profile:
        command = [CHROMIUM, "--headless", f"--user-data-dir={profile}", "--window-size=1280,800", *SOFTWARE_GL]
        devnull = subprocess.DEVNULL
        with subprocess.Popen([*command, address], stdout=devnull, stderr=devnull) as browser:
            yield {}
            browser.terminate()


RUNS: dict[str, tuple[list[str], Watch]] = {
    "alone": (["--no-view"], unwatched),
    "watched": ([], client),
    "chromium": ([], chromium),
}


def live(name: str, seconds: float) -> dict[str, Any]:
    """Return the report of one run, its memory, and the counts of its watcher."""
    options, watch = RUNS[name]
    looks: list[Look] = []
    with LiveProcess(["--camera", "sim", "--seconds", str(seconds), "--json", *options]) as run:
        address = "" if "--no-view" in options else run.wait_for_address(START_TIMEOUT_S)
        start_s = time.monotonic()
        with watch(address) as counts:
            while run.process.poll() is None and time.monotonic() < start_s + START_TIMEOUT_S + seconds:
                time.sleep(1.0)
                if mib := memory_mib(run.process.pid):
                    looks.append(Look(time.monotonic() - start_s, mib))
        run.ended_within(END_TIMEOUT_S)
        if run.process.returncode != 0:
            raise SystemExit(f"{name}: exit code {run.process.returncode}: {' '.join(run.said[-3:])}")
        report = json.loads(run.stdout.splitlines()[-1])
    return {"name": name, "seconds": seconds, **report, "memory": asdict(memory(looks)), **counts}


def pace_line(run: Mapping[str, Any]) -> str:
    """Return a run's pace in one line; the simulated camera computes in a thread of its own, beside the latency."""
    latency, camera = run["latency_ms"], run["camera_ms"]
    ratio = latency["p99"] / latency["p50"]
    return (
        f"{run['name']}: p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms, p99/p50 {ratio:.2f}, "
        f"{run['dropped']} of {run['frames']} dropped; simulating the camera p50 "
        f"{camera['p50']:.1f} ms, p99 {camera['p99']:.1f} ms"
    )


def misses(run: Mapping[str, Any]) -> list[str]:
    """Return the limits that a run misses, with the measured values."""
    latency_ms = run["latency_ms"]
    share = run["dropped"] / max(run["frames"] + run["dropped"], 1)
    found = {
        f"{share:.2%} dropped": share > MAX_DROPPED_SHARE,
        f"{run['fps']:.2f} frames/s": run["fps"] < MIN_FPS,
        f"p99 {latency_ms['p99']:.1f} ms": latency_ms["p99"] > MAX_P99_MS[run["name"]],
        f"p99 {latency_ms['p99'] / latency_ms['p50']:.2f} p50": latency_ms["p99"]
        > MAX_P99_OVER_P50 * latency_ms["p50"],
        f"{run['memory']['mib_per_minute']:+.2f} MiB a minute": run["memory"]["mib_per_minute"] > MAX_MIB_PER_MINUTE,
    }
    return [value for value, missed in found.items() if missed]


def replayed(seconds: float) -> dict[str, Any]:
    """Return the pace of `replay` on a recording of the simulated camera."""
    with tempfile.TemporaryDirectory() as folder:
        bag, out = f"{folder}/run.bag", f"{folder}/out"
        capture = [*PROGRAM, "capture", "--camera", "sim", "--seconds", str(seconds), "--out", bag]
        subprocess.run(capture, check=True, capture_output=True)
        ended = subprocess.run([*PROGRAM, "replay", bag, "--out", out, "--json"], check=True, capture_output=True)
    report = json.loads(ended.stdout.splitlines()[-1])
    times = report["frames"] / 30 / report["seconds"]
    return {"frames": report["frames"], "seconds": report["seconds"], "times_real_time": times}


def main() -> int:
    """Run, write after each part, print; return 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="length of each run (default: 600)")
    parser.add_argument("--runs", default="alone,watched", help=f"some of {', '.join(RUNS)}")
    parser.add_argument("--out", type=Path, default=DOCS / "live.json")
    chosen = parser.parse_args()
    load = os.getloadavg()[0]  # above 0.5 before the first run: other programs delay the frames
    result: dict[str, Any] = {"machine": machine(), "load_before": load, "runs": [], "missed": []}
    for name in chosen.runs.split(","):
        print(f"{name}: {chosen.seconds:.0f} s", file=sys.stderr)
        run = live(name, chosen.seconds)
        result["runs"].append(run)
        print(pace_line(run), file=sys.stderr)
        result["missed"] += [f"{name}: {value}" for value in misses(run) if name != "chromium"]
        chosen.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    result["replay"] = replayed(min(REPLAYED_S, chosen.seconds))
    if result["replay"]["times_real_time"] < MIN_TIMES_REAL:
        result["missed"].append(f"replay at {result['replay']['times_real_time']:.1f} times real time")
    chosen.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))
    return int(bool(result["missed"]))


if __name__ == "__main__":
    sys.exit(main())
