"""Latency of the loop while a browser's pointer moves over the maps, against a pointer that rests.

    python tools/robustness/pointer.py [--rounds 4]      docs/figures/pointer.json

A run of the simulated camera, its page in a headless Chromium on the same machine; rests and moves
take turns, so that other work on the machine falls on both. A turn's figures are the page's own, of
the loop's last 10 s. p99 with a moving pointer should be at most 1.2 times that without.
"""

import argparse
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from playwright.sync_api import sync_playwright

from nlos_cam.evaluate import machine

PROGRAM = [sys.executable, "-P", "-c", "from nlos_cam.cli import run; run()", "live", "sim"]
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu"]
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
OUT = Path(__file__).parents[2] / "docs/figures/pointer.json"
WARM_UP_S = 15.0
TURN_S = 12.0
"""Longer than the 10 s over which the page's figures are."""
BOXES = """[...document.querySelectorAll("figure.map div")].slice(0, 4).map((each) => {
  const box = each.getBoundingClientRect();
  return [box.left, box.top, box.width, box.height];
})"""


def move(page: Any) -> None:
    """Move the pointer over the maps, back and forth, for a turn."""
    boxes = page.evaluate(BOXES)
    end_s = time.monotonic() + TURN_S
    step = 0
    while time.monotonic() < end_s:
        left, top, width, height = boxes[step // 40 % len(boxes)]
        page.mouse.move(left + step % 40 / 40 * width, top + 0.5 * height)
        page.wait_for_timeout(30)
        step += 1


def rest(page: Any) -> None:
    """Leave the pointer beside the maps for a turn."""
    page.mouse.move(1, 1)
    page.wait_for_timeout(1e3 * TURN_S)


def turns(page: Any, rounds: int) -> dict[str, list[dict[str, float]]]:
    """Return the loop's latency in each turn."""
    while not page.evaluate("!!window.nlos && nlos.state().shown > 0"):
        page.wait_for_timeout(100)
    page.wait_for_timeout(1e3 * WARM_UP_S)
    found: dict[str, list[dict[str, float]]] = {"rests": [], "moves": []}
    for _ in range(rounds):
        for name, act in (("rests", rest), ("moves", move)):
            act(page)
            status = page.evaluate("nlos.state().status")
            found[name].append({each: status[each] for each in ("p50_ms", "p99_ms", "fps")})
    return found


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=4, help="turns of each kind")
    rounds = parser.parse_args().rounds
    with (
        tempfile.TemporaryDirectory() as folder,
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS) as browser,
        subprocess.Popen(PROGRAM, stderr=subprocess.PIPE, text=True, cwd=folder) as program,
    ):
        try:
            address = next(
                found[0] for line in program.stderr or () if (found := re.search(r"http\S+", line))
            )
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.goto(address, wait_until="commit", timeout=240e3)
            found = turns(page, rounds)
        finally:
            program.send_signal(signal.SIGINT)
            program.communicate(timeout=120)
    p99_ms = {name: median(one["p99_ms"] for one in ones) for name, ones in found.items()}
    ratio = p99_ms["moves"] / p99_ms["rests"]
    facts = {"machine": machine(), "p99_ms": p99_ms, "ratio": round(ratio, 3), "turns": found}
    OUT.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(facts))


if __name__ == "__main__":
    main()
