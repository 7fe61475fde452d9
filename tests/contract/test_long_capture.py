"""Thirty seconds of `nlos-cam capture` in a process of its own: its frames, its memory, and both
readers.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sdk_playback import SdkReplay

from nlos_cam.frames import Frame
from nlos_cam.recording import ReplayCamera

SECONDS = 30
FRAMES = 900
pytestmark = pytest.mark.slow
WARM_UP = 0.2
"""Share of a run in which buffers fill; memory is judged after it."""
MAX_GROWTH_MIB = 30.0
Long = tuple[dict[str, Any], list[float], Path]


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Long]:
    """Capture, and return the JSON report, anonymous memory in MiB once a second of recording, and
    the recording.
    """
    path = tmp_path_factory.mktemp("long") / "long.bag"
    memory_mib = list[float]()
    written = -1
    arguments = [
        "capture",
        "sim:bare-wall",
        "--seconds",
        str(SECONDS),
        "--json",
        "--out",
        str(path),
    ]
    command = [sys.executable, "-c", "from nlos_cam.cli import run; run()", *arguments]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        status = Path(f"/proc/{process.pid}/status")
        while process.poll() is None:
            time.sleep(1.0)
            if (
                path.exists() and path.stat().st_size > written and status.exists()
            ):  # it grows until it is read back
                written = path.stat().st_size
                if kib := re.search(r"RssAnon:\s+(\d+)", status.read_text(encoding="ascii")):
                    memory_mib.append(int(kib[1]) / 1024)
        stdout, stderr = process.communicate()
    assert process.returncode == 0, stderr
    yield json.loads(stdout.splitlines()[-1]), memory_mib, path
    path.unlink()  # close to a gigabyte


def digest_of(recorded: Iterable[Frame]) -> tuple[int, str]:
    """Return the number of a recording's frames, and a digest of every bit of them in order."""
    digest = blake2b(digest_size=16)
    frames = 0
    for frame in recorded:
        digest.update(f"{frame.frame_number} {frame.timestamp_s:.6f}".encode())
        for pixels in (frame.depth_m, frame.ir, frame.confidence):
            digest.update(np.ascontiguousarray(pixels).data)
        frames += 1
    return frames, digest.hexdigest()


def test_long_capture_holds_every_frame_and_counts_gaps(long: Long) -> None:
    """On a machine too busy to expose the world in time there are gaps, which are counted."""
    report = long[0]

    assert report["state"] == "complete"
    assert set(report["streams"].values()) == {report["frames"]}

    numbers = report["frames"] + report["dropped"]

    assert numbers >= FRAMES
    assert report["seconds"] == pytest.approx((numbers - 1) / 30, abs=0.01)


@pytest.mark.skipif(
    not Path("/proc/self/status").is_file(), reason="reads memory as Linux reports it"
)
def test_long_capture_keeps_memory_flat(long: Long) -> None:
    memory_mib = long[1]

    assert len(memory_mib) > SECONDS / 2

    warm = memory_mib[round(WARM_UP * len(memory_mib)) :]

    assert max(warm) - warm[0] < MAX_GROWTH_MIB


def test_long_capture_reads_alike_with_both_readers(long: Long) -> None:
    report, _, path = long
    with ReplayCamera(path) as camera:
        ours = digest_of(camera)

    assert ours == digest_of(SdkReplay(path))
    assert ours[0] == report["frames"]
