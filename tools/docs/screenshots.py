"""Screenshots of the view in a headless Chromium: docs/images/live.png, live_calibrated.png, replay_view.png.

`python tools/docs/screenshots.py`, from the repository, is the live view of the simulated camera. `--wall bench.toml`
is that of a bench calibrated on sim:bare-wall and sim:examples/empty.toml; `--view F.rrd` is a saved one. Needs
Chromium and the dev extra.
"""

import argparse
import io
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Error, sync_playwright

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
IMAGES = Path("docs/images")
LOOK_MS, SETTLE_MS = 60_000, 25_000
"""Drawn in software, the page takes half a minute to load; then its plots fill."""
LOAD_TIMEOUT_S = 300.0
MIN_COLORED = 0.05
"""The share of the page that is in colour once it is drawn."""


def main() -> None:
    """Start the program, take a picture of its page, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--wall", help="the record of a calibrated bench")
    parser.add_argument("--view", help="a saved view")
    parser.add_argument("--size", default="1280x800", help="of the page")
    parser.add_argument("--out", type=Path, help="the picture; else its place in the docs")
    options = parser.parse_args()
    named = "replay_view" if options.view else "live_calibrated" if options.wall else "live"
    out = options.out or IMAGES / f"{named}.png"
    with subprocess.Popen(_command(options.view, options.wall), stderr=subprocess.PIPE, text=True) as program:
        try:
            _take(_address(program), out, [int(pixels) for pixels in options.size.split("x")])
        finally:
            program.send_signal(signal.SIGINT)
            program.communicate(timeout=60)
    print(f"wrote {out}")


def _command(view: str | None, wall: str | None) -> list[str]:
    program = [sys.executable, "-c", "from nlos_cam.cli.main import run; run()"]
    return program + (["view", view] if view else ["live", "--camera", "sim", *(["--wall", wall] if wall else [])])


def _address(program: subprocess.Popen[str]) -> str:
    for line in program.stderr or ():
        print(line, end="", file=sys.stderr)
        if found := re.search(r"http://\S+", line):
            return found[0]
    raise SystemExit("the view did not start: see above")


def _take(address: str, out: Path, size: list[int]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL) as browser,
    ):
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(address, wait_until="commit")
        _wait_until_drawn(page)
        page.wait_for_timeout(SETTLE_MS)
        page.screenshot(path=out, timeout=LOOK_MS)


def _wait_until_drawn(page: Any) -> None:
    deadline_s = time.monotonic() + LOAD_TIMEOUT_S
    while time.monotonic() < deadline_s:
        try:
            seen = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=LOOK_MS))).convert("RGB")).astype(int)
        except Error:  # a browser too busy drawing to hand out a picture
            continue
        if (np.ptp(seen, axis=-1) > 40).mean() > MIN_COLORED:
            return
        page.wait_for_timeout(1000)
    raise SystemExit(f"the page was not drawn within {LOAD_TIMEOUT_S:.0f} s")


if __name__ == "__main__":
    main()
