"""Someone runs the live view, and the bench or the disk is not as it was."""

import json
import re
import signal
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from live_process import LiveProcess

from nlos_cam.camera import SimulatedCamera
from nlos_cam.recording import repair_recording, verify

Run = Callable[..., Any]
RESOURCE = pytest.importorskip("resource")
SIZE_LIMIT = 8 << 20
DISK_BYTES = 225 << 20
"""25 MB more than a recording leaves free."""
START_S = 240.0
WITHIN_S = 120.0


class Page:
    """Page of a live run, as a browser sees it."""

    def __init__(self, run: LiveProcess) -> None:
        run.wait_for_address(START_S)
        found = re.search(r"(http://\S+/)#(\S+)", " ".join(run.said))
        assert found
        self._url, self._token = found.groups()

    def command(self, name: str, **arguments: object) -> tuple[int, str]:
        """Run a command; return the HTTP status and the answer."""
        request = urllib.request.Request(  # noqa: S310  its own page
            f"{self._url}command",
            json.dumps({"command": name, **arguments}).encode(),
            {"Content-Type": "application/json", "X-Token": self._token},
        )
        try:
            with urllib.request.urlopen(request, timeout=WITHIN_S) as answer:  # noqa: S310
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as refused:
            with refused:
                return refused.code, refused.read().decode()

    def begin_recording(self) -> None:
        """Record from the first frame on."""
        end_s = time.monotonic() + START_S
        while (answer := self.command("record", label="cup"))[0] != 200:
            assert "wait for the first frame" in answer[1]
            assert time.monotonic() < end_s
            time.sleep(0.2)


def wait_until(said: LiveProcess, text: str) -> None:
    end_s = time.monotonic() + WITHIN_S
    while not any(text in line for line in said.said):
        assert time.monotonic() < end_s, said.said
        time.sleep(0.1)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a small file system, which only root may."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["/bin/mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "none", str(folder)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only root can mount a small disk")
    yield folder
    subprocess.run(["/bin/umount", "-l", str(folder)], check=True)


@pytest.mark.slow
def test_recording_of_the_page_fills_the_disk(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(small_disk)
    with LiveProcess(["sim:bare-wall"]) as run:
        page = Page(run)
        page.begin_recording()
        wait_until(run, "disk full, the recording ends")
        status, answer = page.command("stop_recording")
        goes_on = page.command("average", frames=2)
        run.process.send_signal(signal.SIGINT)
        assert run.ended_within(WITHIN_S) is not None

    assert status == goes_on[0] == 200
    assert "the disk is full" in answer
    assert run.process.returncode == 130
    assert verify(next(small_disk.glob("*.bag"))).frames > 30


@pytest.mark.slow
def test_recording_of_the_page_reaches_a_size_limit(tmp_path: Path) -> None:
    with LiveProcess(["sim:bare-wall"]) as run:
        page = Page(run)
        RESOURCE.prlimit(run.process.pid, RESOURCE.RLIMIT_FSIZE, (SIZE_LIMIT, SIZE_LIMIT))
        page.begin_recording()
        wait_until(run, "MB, the recording ends")
        status, answer = page.command("stop_recording")
        goes_on = page.command("average", frames=2)
        run.process.send_signal(signal.SIGINT)
        assert run.ended_within(WITHIN_S) is not None

    bag = next(tmp_path.glob("*.bag"))
    repaired = repair_recording(bag, tmp_path / "repaired.bag")

    assert status != 200
    assert "limit on a file's size" in answer
    assert "nlos-cam repair" in answer
    assert goes_on[0] == 200
    assert run.process.returncode == 130
    assert min(repaired.recovered_frames.values()) > 0


def test_camera_turned_over_since_its_calibration_is_said(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("calibrate", "--wall", "--camera", "sim:bare-wall", "--out", "wall.toml")
    monkeypatch.setattr(SimulatedCamera, "roll_deg", 180.0)
    run("capture", "--camera", "sim:bare-wall", "--frames", 20, "--out", "over.bag")
    found = run("replay", "over.bag", "--wall", "wall.toml", "--out", "out")

    assert found["verdicts"] == {"wall moved": 20}
    assert any("turned by 180°" in warning for warning in found["warnings"])


@pytest.mark.slow
def test_camera_rolled_a_little_is_no_other_camera(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("calibrate", "--wall", "--camera", "sim:bare-wall", "--out", "wall.toml")
    monkeypatch.setattr(SimulatedCamera, "roll_deg", 2.0)
    run("capture", "--camera", "sim:bare-wall", "--frames", 20, "--out", "same.bag")
    found = run("replay", "same.bag", "--wall", "wall.toml", "--out", "out")

    assert not any("turned" in warning for warning in found["warnings"])


@pytest.mark.slow
def test_camera_upside_down_without_a_record_is_said(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatedCamera, "roll_deg", 180.0)
    found = run("live", "sim:bare-wall", "--seconds", 2, "--no-view")

    assert any("upside down" in warning for warning in found["warnings"])
    assert "object seen" not in found["verdicts"]
    assert found["verdicts"].get("wall moved", 0) > 0
