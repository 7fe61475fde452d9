"""The docs' pictures of the live view of the simulated camera, in a headless Chromium: docs/images/live.png.

Run from the repository: `python tools/screenshot.py`. With `--wall bench.toml` it is
docs/images/live_calibrated.png, of a bench that was calibrated on sim:bare-wall and sim:examples/empty.toml.
Needs Chromium and the dev extra.
"""

import argparse
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

IMAGES = Path("docs/images")
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
DRAW_MS = 60_000
"""Drawn in software, the page loads in half of that, and its plot has filled."""


def main() -> None:
    """Start the live view, look at it for a minute, and keep what is seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--wall", help="the record of a calibrated bench")
    wall = parser.parse_args().wall
    out = IMAGES / ("live_calibrated.png" if wall else "live.png")
    program = [sys.executable, "-c", "from nlos_cam.cli.main import run; run()", "live", "--camera", "sim"]
    program += ["--wall", wall] if wall else []
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True) as live:
        try:
            _take(_address(live), out)
        finally:
            live.send_signal(signal.SIGINT)
            live.communicate(timeout=60)
    print(f"wrote {out}")


def _address(live: subprocess.Popen[str]) -> str:
    for line in live.stderr or ():
        print(line, end="", file=sys.stderr)
        if found := re.search(r"http://\S+", line):
            return found[0]
    raise SystemExit("the live view did not start: see above")


def _take(address: str, out: Path) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    chromium = shutil.which("chromium") or "/usr/bin/chromium"
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=chromium, args=SOFTWARE_GL) as browser,
    ):
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(address, wait_until="commit")
        page.wait_for_timeout(DRAW_MS)
        page.screenshot(path=out, timeout=DRAW_MS)


if __name__ == "__main__":
    main()
