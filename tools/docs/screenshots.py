"""Screenshots of the view's page in a headless Chromium, one for each situation:
docs/images/page-*.webp.

`python tools/docs/screenshots.py [SITUATION ...]`, from the repository, runs the program on
simulated scenes: object, nothing, outside (out of distribution), calibrated, moved (the wall),
stalled, ended, phone. Prints the seconds from opening each page to its first drawn moment. Needs
Chromium and the dev extra.
"""

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nlos_calibration import dump_toml, load_rig
from PIL import Image
from playwright.sync_api import sync_playwright

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
FLAGS = [
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-sync",
    ),
    *("--disable-background-networking", "--disable-component-update"),
]
IMAGES = Path("docs/images")
PROGRAM = [sys.executable, "-P", "-c", "from nlos_cam.cli import run; run()"]
TIMEOUT_S = 180.0
CUP = 'rig = "paper-rig"\n[object]\ncategory = "cup"\n'
ASIDE = f"{CUP}size_m = 0.06\nx_m = 0.08\n"
UNPLUG = '[[faults]]\nkind = "unplug"\nat_frame = 300\nframes = 900\n'
SITUATIONS: dict[str, tuple[list[str], str, str]] = {
    "object": (["live", "sim"], "", "Object seen"),
    "nothing": (
        ["live", "sim:{folder}/nothing.toml"],
        'name = "empty"\nrig = "paper-rig"\n',
        "Nothing there",
    ),
    "outside": (
        ["live", "sim:{folder}/outside.toml"],
        f'name = "outside"\n{ASIDE}',
        "Outside the trained range",
    ),
    "calibrated": (["live", "sim", "--wall", "{folder}/wall.toml"], "", "Object seen"),
    "moved": (["live", "sim", "--wall", "{folder}/wall.toml"], "", "Wall moved"),
    "stalled": (
        ["live", "sim:{folder}/stalled.toml"],
        f'name = "stalled"\n{CUP}{UNPLUG}',
        "Camera stalled",
    ),
    "ended": (["live", "sim", "--seconds", "12"], "", "The run has ended"),
    "phone": (["live", "sim"], "", "Object seen"),
}
"""Arguments of the program, its scene, and the headline to wait for."""
SIZES = {"phone": (390, 844)}
WALL_YAW_DEG = {"calibrated": 45.0, "moved": 43.0}
"""Angle at which the lidar faced the wall when it was measured; it faces it at 45 degrees."""


def main() -> None:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "situations", nargs="*", help=f"some of {', '.join(SITUATIONS)} (default: all)"
    )
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    options = parser.parse_args()
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS) as browser,
        tempfile.TemporaryDirectory() as folder,
    ):
        for name in options.situations or SITUATIONS:
            arguments, scene, headline = SITUATIONS[name]
            (Path(folder) / f"{name}.toml").write_text(scene)
            if name in WALL_YAW_DEG:
                _measure_wall(Path(folder), WALL_YAW_DEG[name])
            with _program([each.format(folder=folder) for each in arguments]) as address:
                _take(
                    browser,
                    address,
                    headline,
                    options.out / f"page-{name}.webp",
                    SIZES.get(name, (1280, 800)),
                )


def _measure_wall(folder: Path, yaw_deg: float) -> None:
    """Write the record of a bare wall that the simulated lidar faces at this angle."""
    rig = load_rig("bare-wall")
    turned = rig.model_copy(
        update={"name": "turned", "lidar": rig.lidar.model_copy(update={"yaw_deg": yaw_deg})}
    )
    (folder / "rig.toml").write_text(dump_toml(turned))
    scene = folder / "scene.toml"
    scene.write_text('name = "turned"\nrig = "rig.toml"\n')
    command = [
        *PROGRAM,
        "calibrate",
        "--wall",
        "--camera",
        f"sim:{scene}",
        "--out",
        str(folder / "wall.toml"),
    ]
    subprocess.run([*command, "--overwrite"], check=True, capture_output=True)


@contextmanager
def _program(arguments: list[str]) -> Generator[str]:
    """Run the program, and yield its view's address."""
    with subprocess.Popen([*PROGRAM, *arguments], stderr=subprocess.PIPE, text=True) as program:
        try:
            for line in program.stderr or ():
                if found := re.search(r"http://\S+", line):
                    yield found[0]
                    break
            else:
                raise SystemExit(f"{arguments}: no view")
        finally:
            program.send_signal(signal.SIGINT)
            program.communicate(timeout=TIMEOUT_S)


def _take(browser: Any, address: str, headline: str, out: Path, size: tuple[int, int]) -> None:
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(address, wait_until="commit")
    _wait(page, lambda: page.evaluate("!!window.nlos && nlos.state().shown > 0"))
    opened_s = time.monotonic()
    page.goto("about:blank")
    page.goto(address, wait_until="commit")
    _wait(page, lambda: page.evaluate("!!window.nlos && nlos.state().shown > 0"))
    first_s = time.monotonic() - opened_s
    _wait(page, lambda: page.evaluate("nlos.state().headline") == headline)
    page.wait_for_timeout(4000)
    png = out.with_suffix(".png")
    page.screenshot(path=png, full_page=size[0] < 600)
    with Image.open(png) as image:
        image.save(out, quality=82, method=6)
    png.unlink()
    print(f"{out}: first page after {first_s:.2f} s, {out.stat().st_size / 1e3:.0f} kB")
    page.close()


def _wait(page: Any, holds: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not holds():
        if time.monotonic() > deadline_s:
            raise SystemExit(f"not within {TIMEOUT_S:.0f} s: {page.evaluate('nlos.state()')}")
        page.wait_for_timeout(50)


if __name__ == "__main__":
    main()
