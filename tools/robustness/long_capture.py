"""Long capture of the simulated camera, its memory and both readers: docs/long_capture.json and a picture.

`python tools/robustness/long_capture.py [--minutes M] [--camera URI] [--folder DIR]`: ten minutes need 20 GB in DIR
(default: a temporary folder), which are given back. The capture is a process of its own, as a person would start it.
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
from processes import PROGRAM, WARM_UP, Look, memory, memory_mib

from nlos_cam.camera import Reader, open_camera
from nlos_cam.cli.common import tracked
from nlos_cam.evaluate import machine

__all__ = ["READERS", "WARM_UP", "Look", "capture", "memory", "read"]

DOCS = Path(__file__).parents[2] / "docs"
READERS: tuple[Reader, Reader] = ("plain", "sdk")


@dataclass(frozen=True)
class Reading:
    """Frames of a recording as one reader gives them, with the time it took and a digest of every bit in order."""

    frames: int
    seconds: float
    digest: str


def capture(path: Path, seconds: float, camera: str, on_look: Callable[[Look], None]) -> tuple[Any, list[Look]]:
    """Capture in a process of its own; return its report, and a look at it for every second that it recorded."""
    arguments = ["capture", "--camera", camera, "--seconds", str(seconds), "--json", "--out", str(path)]
    looks, zero_s = list[Look](), time.monotonic()
    pipe = subprocess.PIPE
    with subprocess.Popen([*PROGRAM, *arguments], stdout=pipe, stderr=pipe, text=True) as process:
        try:
            while process.poll() is None:
                time.sleep(1.0)
                if path.exists() and (mib := memory_mib(process.pid)):
                    looks.append(Look(time.monotonic() - zero_s, mib, path.stat().st_size))
                    on_look(looks[-1])
            stdout, stderr = process.communicate()
        finally:
            process.kill()
    if process.returncode != 0:
        raise SystemExit(f"the capture ended with exit code {process.returncode}: {stderr.strip()}")
    return json.loads(stdout.splitlines()[-1]), while_recording(looks)


def while_recording(looks: list[Look]) -> list[Look]:
    """Return the looks until the file stopped growing, which is when it is read back; times start at 0."""
    last = max((k for k in range(1, len(looks)) if looks[k].written_bytes > looks[k - 1].written_bytes), default=1)
    return [replace(look, time_s=look.time_s - looks[0].time_s) for look in looks[:last]]


def read(path: Path, reader: Reader, on_frame: Callable[[], None]) -> Reading:
    """Read every frame of a recording, in order."""
    digest, frames, start_s = blake2b(digest_size=16), 0, time.monotonic()
    with open_camera(f"bag:{path}", reader=reader) as camera:
        for frame in camera:
            digest.update(f"{frame.frame_number} {frame.timestamp_s:.6f}".encode())
            for pixels in (frame.depth_m, frame.ir, frame.confidence):
                digest.update(np.ascontiguousarray(pixels).data)
            frames += 1
            on_frame()
    return Reading(frames, time.monotonic() - start_s, digest.hexdigest())


def draw(looks: list[Look], target: Path) -> None:
    """Draw memory and recorded bytes over time."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    minutes = [look.time_s / 60 for look in looks]
    above.plot(minutes, [look.memory_mib for look in looks])
    above.set(ylabel="memory in MiB", ylim=(0, None), title="nlos-cam capture, 640 x 480, three streams, 30 frames/s")
    below.plot(minutes, [look.written_bytes / 1e9 for look in looks])
    below.set(xlabel="minutes", ylabel="recorded GB", ylim=(0, None))
    figure.savefig(target, dpi=110)


def measure(folder: Path, seconds: float, camera: str) -> tuple[dict[str, Any], list[Look]]:
    """Capture, read with both readers, and compare."""
    path = folder / "long.bag"
    with tracked("capturing") as update:
        report, looks = capture(path, seconds, camera, lambda look: update(round(look.time_s), round(seconds)))
    with tracked("reading") as update:
        done = count(1)
        plain, sdk = (read(path, reader, lambda: update(next(done), 2 * report["frames"])) for reader in READERS)
    return {
        "machine": machine(),
        "camera": camera,
        "capture": {key: report[key] for key in ("frames", "dropped", "seconds", "streams", "temporal_noise_mm")},
        "bytes": path.stat().st_size,
        "memory": asdict(memory(looks)),
        "readers": {"plain": asdict(plain), "sdk": asdict(sdk)},
        "identical": plain.digest == sdk.digest,
    }, looks


def main() -> int:
    """Measure, write, print; return 1 where the readers differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--camera", default="sim")
    parser.add_argument("--folder", type=Path, help="folder of the temporary recording")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        result, looks = measure(Path(folder), 60 * chosen.minutes, chosen.camera)
    (DOCS / "long_capture.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    draw(looks, DOCS / "images" / "long_capture.png")
    print(json.dumps(result, indent=2))
    return int(not result["identical"])


if __name__ == "__main__":
    sys.exit(main())
