"""A long capture of the simulated camera, its memory and both readers of it: docs/long_capture.json and a picture.

`python tools/long_capture.py [--minutes M] [--camera URI] [--folder DIR]`: ten minutes need 20 GB in DIR (default: a
temporary folder), which are given back. The capture is a process of its own, as a person would start it.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from nlos_cam.camera import open_camera
from nlos_cam.camera.registry import Reader
from nlos_cam.cli.common import tracked
from nlos_cam.evaluate.render_tradeoff import machine

DOCS = Path(__file__).parents[1] / "docs"
COMMAND = "from nlos_cam.cli.main import run; run()"
WARM_UP = 0.2
"""Share of a recording in which buffers fill; memory is judged after it."""
READERS: tuple[Reader, Reader] = ("plain", "sdk")


@dataclass(frozen=True)
class Look:
    """One look at the capture's process, from when its file is there."""

    time_s: float
    memory_mib: float
    """Its own: without files that it has mapped."""
    written_bytes: int


@dataclass(frozen=True)
class Memory:
    """How a process's memory went while it recorded, after warming up."""

    median_mib: float
    most_mib: float
    mib_per_minute: float
    """Slope of the straight line nearest to it."""


@dataclass(frozen=True)
class Reading:
    """A recording as one reader gives it."""

    frames: int
    seconds: float
    """That reading took."""
    digest: str
    """Of every bit of every frame, in order."""


def memory_mib(pid: int) -> float | None:
    """Anonymous memory of a process, as Linux tells it; None when it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon:")]
    return kib[0] / 1024 if kib else None


def capture(path: Path, seconds: float, camera: str, on_look: Callable[[Look], None]) -> tuple[Any, list[Look]]:
    """Capture in a process of its own, looked at every second; what it told, and the looks while it recorded."""
    arguments = ["capture", "--camera", camera, "--seconds", str(seconds), "--json", "--out", str(path)]
    command, looks, zero_s = [sys.executable, "-c", COMMAND, *arguments], list[Look](), time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            while process.poll() is None:
                time.sleep(1.0)
                if path.exists() and (memory := memory_mib(process.pid)):
                    looks.append(Look(time.monotonic() - zero_s, memory, path.stat().st_size))
                    on_look(looks[-1])
            stdout, stderr = process.communicate()
        finally:
            process.kill()
    if process.returncode != 0:
        raise SystemExit(f"the capture ended with exit code {process.returncode}: {stderr.strip()}")
    return json.loads(stdout.splitlines()[-1]), while_recording(looks)


def while_recording(looks: list[Look]) -> list[Look]:
    """Those up to when the file no longer grew: then it is read back. Times from the first."""
    growing = [
        number for number in range(1, len(looks)) if looks[number].written_bytes > looks[number - 1].written_bytes
    ]
    return [replace(look, time_s=look.time_s - looks[0].time_s) for look in looks[: growing[-1] if growing else 1]]


def memory(looks: list[Look]) -> Memory:
    """Of the looks after warming up."""
    warm = [look for look in looks if look.time_s >= WARM_UP * looks[-1].time_s]
    mib, minutes = np.array([look.memory_mib for look in warm]), np.array([look.time_s / 60 for look in warm])
    return Memory(float(np.median(mib)), float(mib.max()), float(np.polyfit(minutes, mib, 1)[0]))


def read(path: Path, reader: Reader, on_frame: Callable[[], None]) -> Reading:
    """Every frame of a recording, in order."""
    digest, frames, begun_s = blake2b(digest_size=16), 0, time.monotonic()
    with open_camera(f"bag:{path}", reader=reader) as camera:
        for frame in camera:
            digest.update(f"{frame.frame_number} {frame.timestamp_s:.6f}".encode())
            for pixels in (frame.depth_m, frame.ir, frame.confidence):
                digest.update(np.ascontiguousarray(pixels).data)
            frames += 1
            on_frame()
    return Reading(frames, time.monotonic() - begun_s, digest.hexdigest())


def draw(looks: list[Look], target: Path) -> None:
    """Memory and what was written over time, one above the other."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    minutes = [look.time_s / 60 for look in looks]
    above.plot(minutes, [look.memory_mib for look in looks])
    above.set(ylabel="memory in MiB", ylim=(0, None), title="nlos-cam capture, 640 x 480, three streams, 30 frames/s")
    below.plot(minutes, [look.written_bytes / 1e9 for look in looks])
    below.set(xlabel="minutes", ylabel="recorded GB", ylim=(0, None))
    figure.savefig(target, dpi=110)


def measure(folder: Path, seconds: float, camera: str) -> tuple[dict[str, Any], list[Look]]:
    """Capture, read with both readers, and say how they compare."""
    path = folder / "long.bag"
    with tracked("capturing") as update:
        told, looks = capture(path, seconds, camera, lambda look: update(round(look.time_s), round(seconds)))
    with tracked("reading") as update:
        done = count(1)
        plain, sdk = (read(path, reader, lambda: update(next(done), 2 * told["frames"])) for reader in READERS)
    return {
        "machine": machine(),
        "camera": camera,
        "capture": {key: told[key] for key in ("frames", "dropped", "seconds", "streams", "temporal_noise_mm")},
        "bytes": path.stat().st_size,
        "memory": asdict(memory(looks)),
        "readers": {"plain": asdict(plain), "sdk": asdict(sdk)},
        "identical": plain.digest == sdk.digest,
    }, looks


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description="A long capture: see the top of the file.")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--camera", default="sim")
    parser.add_argument("--folder", type=Path, help="where the recording goes meanwhile")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        result, looks = measure(Path(folder), 60 * chosen.minutes, chosen.camera)
    (DOCS / "long_capture.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    draw(looks, DOCS / "images" / "long_capture.png")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
