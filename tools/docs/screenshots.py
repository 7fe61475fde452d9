"""Screenshots of the view's page in a headless Chromium, one for each situation.

    python tools/docs/screenshots.py [SITUATION ...]
        docs/images/page-*.webp: object, calibrated, phone
    python tools/docs/screenshots.py --look FOLDER [SITUATION ...]
        each situation at three sizes, as it is and as a person with deuteranopia sees it

The program runs on simulated scenes. Prints the seconds from opening each page to its first drawn
moment, and every text that lies over a picture. Needs Chromium and the dev extra.
"""

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlos_calibration import dump_toml, load_rig
from PIL import Image
from playwright.sync_api import sync_playwright

from nlos_cam.recording import SAMPLE

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
TIMEOUT_S = 240.0
SETTLE_MS = 3000
SIZES = (1280, 720), (1400, 900), (390, 844)
PHONE_WIDTH = 600
"""A page narrower than this is photographed in its whole length."""
CUP = 'rig = "paper-rig"\n[object]\ncategory = "cup"\n'
NEVER_SEEN = f"{CUP}seed = {int(time.time()) % 1_000_000}\n[motion]\nposes = 120\nsway_x_m = 0.02\n"
"""Scene that no cache holds, so that the page waits for its rendering."""
UNPLUG = '[[faults]]\nkind = "unplug"\nat_frame = 300\nframes = 9000\n'
SHOWN = "!!window.nlos && nlos.state().shown > 0"


def _headline(words: str) -> str:
    return f"nlos.state().headline === '{words}'"


@dataclass(frozen=True)
class Situation:
    """A run of the program, and what its page shows when the picture is taken."""

    arguments: tuple[str, ...]
    """Of the program; {folder} is a temporary folder."""
    until: str
    """Condition in the page's JavaScript."""
    scene: str = ""
    """Content of {folder}/scene.toml."""
    wall_yaw_deg: float | None = None
    """Angle at which the lidar faced the wall when it was measured; it faces it at 45 degrees."""
    key: str = ""
    """Pressed once a moment is drawn."""
    has_moments: bool = True


OWN_SCENE = "sim:{folder}/scene.toml"
MEASURED = ("live", "--wall", "{folder}/wall.toml", "--camera", "sim")
SITUATIONS = {
    "waiting": Situation(
        ("live", OWN_SCENE),
        "!!window.nlos && nlos.state().status.message",
        f'name = "waiting"\n{NEVER_SEEN}',
        has_moments=False,
    ),
    "object": Situation(("live", "sim"), _headline("Object seen")),
    "nothing": Situation(
        ("live", OWN_SCENE), _headline("Nothing there"), 'name = "empty"\nrig = "paper-rig"\n'
    ),
    "outside": Situation(
        ("live", OWN_SCENE),
        _headline("Outside the trained range"),
        f'name = "outside"\n{CUP}size_m = 0.06\nx_m = 0.08\n',
    ),
    "stalled": Situation(
        ("live", OWN_SCENE), _headline("Camera stalled"), f'name = "stalled"\n{CUP}{UNPLUG}'
    ),
    "recording": Situation(("live", "sim"), "nlos.state().statusText.includes('REC')", key="r"),
    "ended": Situation(("live", "sim", "--seconds", "30"), _headline("The run has ended")),
    "playback": Situation(
        ("view", str(SAMPLE.resolve())),
        "nlos.state().status.state === 'playback' && !nlos.state().status.message",
    ),
    "calibrated": Situation(MEASURED, _headline("Object seen"), wall_yaw_deg=45.0),
    "moved": Situation(MEASURED, _headline("Wall moved"), wall_yaw_deg=43.0),
}
IN_DOCS = {"object": "object", "calibrated": "calibrated", "phone": "object"}
"""Situation of each picture that the docs show."""
UNDER_TEXT = """() => {
  const box = (element) => element.getBoundingClientRect();
  const texts = [...document.querySelectorAll("#status, #verdict, #player, figcaption, figure small, #readout, #tabbed")];
  const pictures = [...document.querySelectorAll("figure div, #bench")];
  const meet = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
  return pictures.flatMap((picture) => texts.filter((text) => meet(box(picture), box(text))).map((text) => text.textContent));
}"""
"""JavaScript that returns every text that lies over a picture."""


def main() -> None:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "situations", nargs="*", help=f"some of {', '.join(SITUATIONS)} (default: all)"
    )
    parser.add_argument("--look", type=Path, help="folder for every size and kind of sight")
    options = parser.parse_args()
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS) as browser,
    ):
        if options.look:
            options.look.mkdir(parents=True, exist_ok=True)
            for name in options.situations or SITUATIONS:
                look(browser, name, options.look)
        else:
            for picture in options.situations or IN_DOCS:
                size = SIZES[2] if picture == "phone" else SIZES[0]
                take(browser, SITUATIONS[IN_DOCS[picture]], IMAGES / f"page-{picture}.webp", size)


def look(browser: Any, name: str, folder: Path) -> None:
    """Take a situation at every size, as it is and with simulated deuteranopia."""
    situation = SITUATIONS[name]
    with _running(situation) as address:
        page = _open(browser, situation, address, SIZES[0])
        sight = page.context.new_cdp_session(page)
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            _settle(page, situation)
            for over in page.evaluate(UNDER_TEXT):
                print(f"{name} at {width} x {height}: over a picture: {over!r}")
            for kind in ("none", "deuteranopia"):
                sight.send("Emulation.setEmulatedVisionDeficiency", {"type": kind})
                end = "" if kind == "none" else f"-{kind}"
                path = folder / f"{name}-{width}x{height}{end}.png"
                _photograph(page, path, full_page=width < PHONE_WIDTH)
        page.close()


def take(browser: Any, situation: Situation, out: Path, size: tuple[int, int]) -> None:
    """Take a picture for the docs, and print when the page's first moment was drawn."""
    with _running(situation) as address:
        page = _open(browser, situation, address, size)
        _wait(page, SHOWN)
        opened_s = time.monotonic()
        page.goto("about:blank")
        page.goto(address, wait_until="commit")
        _wait(page, SHOWN)
        first_s = time.monotonic() - opened_s
        _settle(page, situation)
        png = out.with_suffix(".png")
        _photograph(page, png, full_page=size[0] < PHONE_WIDTH)
        page.close()
    with Image.open(png) as image:
        image.save(out, quality=70, method=6)
    png.unlink()
    print(f"{out}: first page after {first_s:.2f} s, {out.stat().st_size / 1e3:.0f} kB")


def _open(browser: Any, situation: Situation, address: str, size: tuple[int, int]) -> Any:
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(address, wait_until="commit")
    if situation.has_moments:
        _wait(page, SHOWN)
    return page


def _photograph(page: Any, path: Path, *, full_page: bool) -> None:
    page.screenshot(path=path, full_page=full_page, timeout=1e3 * TIMEOUT_S)


def _settle(page: Any, situation: Situation) -> None:
    """Wait until a page shows its situation, after the key that leads to it."""
    if situation.key and not page.evaluate(situation.until):
        page.keyboard.press(situation.key)
    _wait(page, situation.until)
    page.wait_for_timeout(SETTLE_MS if situation.has_moments else 0)


@contextmanager
def _running(situation: Situation) -> Generator[str]:
    """Run the program in a folder of its own, and yield its view's address."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "scene.toml").write_text(situation.scene)
        if situation.wall_yaw_deg is not None:
            _measure_wall(Path(folder), situation.wall_yaw_deg)
        arguments = [each.format(folder=folder) for each in situation.arguments]
        with _program(arguments, Path(folder)) as address:
            yield address


def _measure_wall(folder: Path, yaw_deg: float) -> None:
    """Write the record of a bare wall that the simulated lidar faces at this angle."""
    rig = load_rig("bare-wall")
    turned = rig.model_copy(
        update={"name": "turned", "lidar": rig.lidar.model_copy(update={"yaw_deg": yaw_deg})}
    )
    (folder / "rig.toml").write_text(dump_toml(turned))
    scene = folder / "turned.toml"
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
def _program(arguments: Sequence[str], folder: Path) -> Generator[str]:
    """Run the program, and yield its view's address."""
    command = [*PROGRAM, *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder) as program:
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


def _wait(page: Any, condition: str) -> None:
    """Wait for a condition of the page."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while not page.evaluate(condition):
        if time.monotonic() > deadline_s:
            raise SystemExit(f"not within {TIMEOUT_S:.0f} s: {page.evaluate('nlos.state()')}")
        page.wait_for_timeout(50)


if __name__ == "__main__":
    main()
