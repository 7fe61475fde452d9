"""`nlos-cam live --camera sim` and `nlos-cam view run.bag` in a headless Chromium, every control
with its effect.
"""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser_page import DEADLINE_S, Page, needs_browser
from nlos_calibration import load_measured

from nlos_cam.recording import load_sidecar, sidecar_path, verify

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(6 * DEADLINE_S)]


class Program:
    """The program, running in a folder and serving its view."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        program = [sys.executable, "-c", "from nlos_cam.cli import run; run()", *arguments]
        self.process = subprocess.Popen(
            program,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
            cwd=folder,
        )
        self.address = self._address()

    def _address(self) -> str:
        lines = []
        for line in self.process.stderr or ():
            lines.append(line)
            if found := re.search(r"http://127\.0\.0\.1:\d+/\S*", line):
                return found[0]
        pytest.fail(f"the program printed no address: {''.join(lines)}")

    def interrupt(self) -> int:
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode

    def kill(self) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
            self.process.communicate(timeout=DEADLINE_S)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    needs_browser()
    programs: list[Program] = []

    def begin(*arguments: str) -> Program:
        programs.append(Program(tmp_path, *arguments))
        return programs[-1]

    yield begin
    for program in programs:
        program.kill()


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


def test_controls_of_a_live_run_do_what_they_say(
    start: Callable[..., Program], browser: Any, tmp_path: Path
) -> None:
    program = start("live", "--camera", "sim")
    page = Page(browser, program.address).drawn()  # printed before networks and camera are there
    Page(browser, program.address).drawn().close()
    page.wait_until(lambda: page.state()["status"].get("fps", 0) > 1, "the status")
    for part in ("sim", "frames/s", "latency", "newest frame", "dropped", "°C", "disk for"):
        assert part in page.state()["statusText"]

    record_cup(page, tmp_path)
    save_snapshot(page, tmp_path)
    change_run(page)
    save_session(page, browser, tmp_path)
    assert page.page.is_disabled("#reference"), "this bench has an occluder and no wall record"
    assert "--wall" in page.page.inner_text("#reason")
    assert page.hosts == {"127.0.0.1"}, "the page fetched from elsewhere"
    assert page.errors == []
    assert program.interrupt() == 130
    page.wait_until(lambda: page.state()["headline"] == "The run has ended", "the end")
    parts = urlsplit(program.address)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((parts.hostname, parts.port), timeout=60.0)


def record_cup(page: Page, folder: Path) -> None:
    """Record with a label, and find the recording verified."""
    page.page.fill("#label", "cup")
    assert "recording" in page.click("#record")
    page.wait_until(lambda: "REC" in page.state()["statusText"], "the recording's time")
    page.wait_until(lambda: page.page.inner_text("#record") == "Stop recording", "the button")
    page.page.wait_for_timeout(1500)
    assert "verified" in page.click("#record")

    bag = only(folder, "cup-*.bag")
    assert verify(bag).frames > 10
    assert load_sidecar(sidecar_path(bag)).label == "cup"


def save_snapshot(page: Page, folder: Path) -> None:
    """Save what is shown, as arrays and as a picture."""
    assert "wrote" in page.click("#snapshot")
    with np.load(only(folder, "snapshot-*.npz")) as arrays:
        assert arrays["depth_m"].shape == (64, 64)
    assert only(folder, "snapshot-*.png").stat().st_size > 10_000


def change_run(page: Page) -> None:
    """Pause, go on, and average."""
    page.click("#pause")
    page.wait_until(lambda: page.state()["headline"] == "Paused", "the pause")
    frame = page.state()["frame"]
    page.page.wait_for_timeout(1000)
    assert page.state()["frame"] == frame
    page.click("#pause")
    page.wait_until(lambda: page.state()["frame"] > frame, "later frames")

    page.page.fill("#average", "4")
    assert "4 frames" in page.answer(lambda: page.page.press("#average", "Enter"))
    page.wait_until(lambda: page.state()["status"]["control"]["average"] == 4, "the average")


def save_session(page: Page, browser: Any, folder: Path) -> None:
    """Save a second of the session, and play it from its file."""
    page.wait_until(lambda: page.page.inner_text("#session") == "Save session", "the button")
    page.click("#session")
    page.wait_until(lambda: page.page.inner_text("#session") == "End session", "the button")
    page.page.wait_for_timeout(1500)
    assert "any browser" in page.click("#session")
    Page(browser, only(folder, "session-*.html").as_uri()).drawn().close()


def test_keys_record_pause_save_and_replay_without_a_pointer(
    start: Callable[..., Program], browser: Any, tmp_path: Path
) -> None:
    program = start("live", "--camera", "sim")
    page = Page(browser, program.address).drawn()
    page.wait_until(lambda: page.page.query_selector("#record") is not None, "the controls")
    keys = page.page.keyboard
    assert "recording" in page.answer(lambda: keys.press("r"))
    page.wait_until(lambda: page.page.inner_text("#record") == "Stop recording", "the button")
    page.page.wait_for_timeout(1500)
    assert str(tmp_path) in page.answer(lambda: keys.press("r")), "the folder is named"

    page.answer(lambda: keys.press("Space"))
    page.wait_until(lambda: page.state()["headline"] == "Paused", "the pause")
    page.answer(lambda: keys.press("Space"))
    assert "wrote" in page.answer(lambda: keys.press("s"))
    page.wait_until(lambda: page.page.query_selector("[data-file$='.npz']") is not None, "the file")
    with page.page.expect_download() as download:
        page.page.focus("[data-file$='.npz']")
        keys.press("Enter")
    assert Path(download.value.path()).read_bytes() == only(tmp_path, "*.npz").read_bytes()
    assert program.interrupt() == 130

    replay = Page(browser, start("view", only(tmp_path, "live-*.bag").name).address).drawn()
    replay.wait_until(lambda: not replay.state()["status"].get("message"), "the whole recording")
    frame = replay.state()["frame"]
    replay.page.keyboard.press("ArrowRight")
    replay.wait_until(lambda: replay.state()["frame"] > frame, "the next frame")
    replay.page.keyboard.press("Space")
    assert replay.state()["playing"]


def test_page_without_the_token_is_read_only(start: Callable[..., Program], browser: Any) -> None:
    program = start("live", "--camera", "sim:bare-wall")
    page = Page(browser, program.address.partition("#")[0]).drawn()
    page.wait_until(lambda: page.page.query_selector("#record") is not None, "the controls")
    assert page.page.is_disabled("#record")
    assert "Read-only" in page.page.inner_text("#answer")


def test_empty_bench_is_taken_as_reference(
    start: Callable[..., Program], browser: Any, tmp_path: Path
) -> None:
    program = start("live", "--camera", "sim:bare-wall")
    page = Page(browser, program.address).drawn()
    assert "change" not in page.state()["arrays"]
    page.wait_until(lambda: page.page.query_selector("#reference") is not None, "the controls")
    assert "reference of 60 frames" in page.click("#reference")
    page.wait_until(lambda: "change" in page.state()["arrays"], "difference maps")
    assert load_measured(only(tmp_path, "bench-*.toml")).reference is not None


def test_recording_opens_plays_and_exports_in_the_page(
    start: Callable[..., Program], browser: Any, tmp_path: Path
) -> None:
    capture = [
        sys.executable,
        "-c",
        "from nlos_cam.cli import run; run()",
        "capture",
        "--camera",
        "sim",
    ]
    subprocess.run(
        [*capture, "--seconds", "2", "--out", "run.bag"],
        check=True,
        cwd=tmp_path,
        capture_output=True,
    )
    page = Page(browser, start("view", "run.bag").address).drawn()
    page.wait_until(lambda: not page.state()["status"].get("message"), "the whole recording")
    assert page.state()["end"] == pytest.approx(2.0, abs=0.3)
    page.page.evaluate(
        "(t => { t.value = 1; t.dispatchEvent(new Event('input'));"
        " })(document.querySelector('#time'))"
    )
    page.wait_until(
        lambda: page.state()["time_s"] == pytest.approx(1.0, abs=0.1), "the frame at 1 s"
    )
    frame = page.state()["frame"]
    page.page.click("#play")
    page.wait_until(lambda: page.state()["frame"] > frame, "it plays")
    page.page.click("#play")
    assert "wrote" in page.click("#save")
    with np.load(only(tmp_path, "run-*.npz")) as arrays:
        assert arrays["frame_number"] == page.state()["frame"]
