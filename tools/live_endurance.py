"""Ten minutes of `live --camera sim`, alone and watched, and the pace of a replay: docs/live.json.

`python tools/live_endurance.py [--seconds S] [--runs alone,watched,chromium] [--out FILE]`. Each run is a process of
its own, looked at every second; "watched" has a client that reads the view's stream, "chromium" a headless browser that
draws it. What is done is kept after each part. Exits with 1 where a run misses what is promised; `chromium` promises
nothing, since it draws on the same processors.
"""

import argparse
import json
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

from headless_chromium import CHROMIUM, SOFTWARE_GL
from live_process import LiveProcess
from long_capture import Look, memory, memory_mib

from nlos_cam.evaluate.render_tradeoff import machine

DOCS = Path(__file__).parents[1] / "docs"
START_TIMEOUT_S, END_TIMEOUT_S = 300.0, 60.0
MOST_DROPPED_SHARE, LEAST_FPS, MOST_P99_MS, MOST_MIB_PER_MINUTE, LEAST_TIMES_REAL = 0.001, 29.9, 20.0, 0.5, 3.0
"""What is promised."""
REPLAYED_S = 60.0

Watch = Callable[[str], Any]
"""Watches the view at an address while the block lasts; gives what it saw, which grows."""


@contextmanager
def nobody(address: str) -> Generator[dict[str, Any]]:
    """Watches nothing."""
    del address
    yield {}


@contextmanager
def client(address: str) -> Generator[dict[str, Any]]:
    """Reads the stream, as fast as it comes, until it ends."""
    seen = {"stream_bytes": 0}

    def read() -> None:
        connection = HTTPConnection(urlsplit(address).netloc, timeout=END_TIMEOUT_S)
        with suppress(HTTPException, OSError):
            connection.request("GET", "/live.rrd")
            answer = connection.getresponse()
            while content := answer.read1(1 << 16):
                seen["stream_bytes"] += len(content)
        connection.close()

    reader = Thread(target=read)
    reader.start()
    yield seen
    reader.join()


@contextmanager
def chromium(address: str) -> Generator[dict[str, Any]]:
    """A headless browser that draws in software."""
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless", f"--user-data-dir={profile}", "--window-size=1280,800", *SOFTWARE_GL]
        devnull = subprocess.DEVNULL
        with subprocess.Popen([CHROMIUM, *options, address], stdout=devnull, stderr=devnull) as browser:
            yield {}
            browser.terminate()


RUNS: dict[str, tuple[list[str], Watch]] = {
    "alone": (["--no-view"], nobody),
    "watched": ([], client),
    "chromium": ([], chromium),
}


def live(name: str, seconds: float, on_look: Callable[[Look], None]) -> dict[str, Any]:
    """One run; what it told, how its memory went, and what was seen of its view."""
    options, watch = RUNS[name]
    looks: list[Look] = []
    with LiveProcess(["--camera", "sim", "--seconds", str(seconds), "--json", *options]) as run:
        address = "" if "--no-view" in options else run.wait_for_address(START_TIMEOUT_S)
        begun_s = time.monotonic()
        with watch(address) as seen:
            while run.process.poll() is None and time.monotonic() < begun_s + START_TIMEOUT_S + seconds:
                time.sleep(1.0)
                if mib := memory_mib(run.process.pid):
                    looks.append(Look(time.monotonic() - begun_s, mib, 0))
                    on_look(looks[-1])
        run.ended_within(END_TIMEOUT_S)
        if run.process.returncode != 0:
            raise SystemExit(f"{name}: exit code {run.process.returncode}: {' '.join(run.said[-3:])}")
        told = json.loads(run.stdout.splitlines()[-1])
    return {"name": name, "seconds": seconds, **told, "memory": asdict(memory(looks)), **seen}


def misses(run: Mapping[str, Any]) -> list[str]:
    """What a run does not keep of what is promised."""
    share = run["dropped"] / max(run["frames"] + run["dropped"], 1)
    found = {
        f"{share:.2%} dropped": share > MOST_DROPPED_SHARE,
        f"{run['fps']:.2f} frames/s": run["fps"] < LEAST_FPS,
        f"p99 {run['latency_ms']['p99']:.1f} ms": run["latency_ms"]["p99"] > MOST_P99_MS,
        f"{run['memory']['mib_per_minute']:+.2f} MiB a minute": run["memory"]["mib_per_minute"] > MOST_MIB_PER_MINUTE,
    }
    return [what for what, missed in found.items() if missed]


def replayed(seconds: float) -> dict[str, Any]:
    """A recording of so long, replayed; how many times faster than it was recorded."""
    program = [sys.executable, "-c", "from nlos_cam.cli.main import run; run()"]
    with tempfile.TemporaryDirectory() as folder:
        bag, out = f"{folder}/run.bag", f"{folder}/out"
        capture = [*program, "capture", "--camera", "sim", "--seconds", str(seconds), "--out", bag]
        subprocess.run(capture, check=True, capture_output=True)
        ended = subprocess.run([*program, "replay", bag, "--out", out, "--json"], check=True, capture_output=True)
    told = json.loads(ended.stdout.splitlines()[-1])
    times = told["frames"] / 30 / told["seconds"]
    return {"frames": told["frames"], "seconds": told["seconds"], "times_real_time": times}


def main() -> None:
    """Run, write after each part, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=600.0, help="of each run; a few are a try")
    parser.add_argument("--runs", default="alone,watched", help=f"of {', '.join(RUNS)}")
    parser.add_argument("--out", type=Path, default=DOCS / "live.json")
    chosen = parser.parse_args()
    result: dict[str, Any] = {"machine": machine(), "runs": [], "missed": []}
    for name in chosen.runs.split(","):
        print(f"{name}: {chosen.seconds:.0f} s", file=sys.stderr)
        run = live(name, chosen.seconds, lambda _: None)
        result["runs"].append(run)
        result["missed"] += [f"{name}: {what}" for what in misses(run) if name != "chromium"]
        chosen.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    result["replay"] = replayed(min(REPLAYED_S, chosen.seconds))
    if result["replay"]["times_real_time"] < LEAST_TIMES_REAL:
        result["missed"].append(f"replay at {result['replay']['times_real_time']:.1f} times real time")
    chosen.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))
    sys.exit(1 if result["missed"] else 0)


if __name__ == "__main__":
    main()
