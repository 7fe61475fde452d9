"""Captures of the simulated camera, killed at random moments and repaired: docs/kills.json.

`kill_captures.py [--kills N] [--seed S] [--out FILE]`. Chunks and frames on disk are counted by a reader of its own,
which knows only the framing of the format. A second call resumes. Exits with 1 where a chunk was lost, or a frame
differs from the camera's.
"""

import hashlib
import re
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Protocol

import lz4.frame
import numpy as np
from trials import Forked, Results, Row, empty_folder, in_fork, load_program, options

from nlos_cam.camera import open_world
from nlos_cam.errors import RecordingError
from nlos_cam.recording import BagReader, SdkReplayCamera, repair_recording
from nlos_cam.render import SensedImages

CAMERA, LONGEST_S = "sim:bare-wall", 3.0
START_TIMEOUT_S = 1800.0
FIRST_CHUNK_AT = 4117
STREAM = re.compile(rb"(?s)conn=(.{4})\x04\x00\x00\x00op=\x07.{4}topic=[^\n]{0,80}?/(\w+)_0/image/data")
MESSAGE = re.compile(rb"(?s)conn=(.{4})\x04\x00\x00\x00op=\x02")
STREAMS = ("depth", "infrared", "confidence")


class World(Protocol):
    """Source of the camera's true images by frame number."""

    def images(self, number: int) -> SensedImages: ...


@dataclass(frozen=True)
class Kill:
    """State of a killed capture, and of its repair; frames are counted by stream."""

    after_s: float
    """Time from the first byte of the recording."""
    file_bytes: int
    chunks_on_disk: int
    frames_on_disk: dict[str, int]
    chunks_recovered: int
    frames_recovered: dict[str, int]
    frames_played: dict[str, int]
    """By librealsense from the repaired recording; by our reader where a stream has no frame."""
    frames_wrong: int
    """Played sets that differ from the camera's in any bit."""
    repair_s: float

    @property
    def good(self) -> bool:
        """Return whether all was recovered, and nothing else claimed."""
        kept = all(self.frames_recovered[stream] >= count for stream, count in self.frames_on_disk.items())
        whole = self.chunks_recovered == self.chunks_on_disk and self.frames_played == self.frames_recovered
        return kept and whole and self.frames_wrong == 0


def kill(process: "subprocess.Popen[bytes] | Forked", path: Path, after_s: float) -> None:
    """Kill a capture `after_s` after its recording begins. Raises RuntimeError if it ended before."""
    try:
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not (path.exists() and path.stat().st_size) and time.monotonic() < deadline_s:
            if process.poll() is not None:
                break
            time.sleep(0.01)
        else:
            time.sleep(after_s)
        if (code := process.poll()) is not None:
            raise RuntimeError(f"the capture ended by itself, with exit code {code}")
    finally:
        process.kill()
        process.wait()


def chunks_in(path: Path) -> Iterator[bytes]:
    """Yield the whole chunks of a recording, decompressed and in order."""
    with path.open("rb") as file:
        file.seek(FIRST_CHUNK_AT)
        while len(head := file.read(4)) == 4:
            header = file.read(*struct.unpack("<I", head))
            (data_bytes,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            data = file.read(data_bytes)
            if len(data) < data_bytes or (b"op=\x05" in header and not data):
                return
            if b"op=\x05" in header:
                yield lz4.frame.decompress(data) if b"compression=lz4" in header else data


def frames_in(chunks: list[bytes]) -> dict[str, int]:
    """Count the frames of each stream."""
    streams = {number: name.decode().lower() for chunk in chunks for number, name in STREAM.findall(chunk)}
    counts = Counter(number for chunk in chunks for number in MESSAGE.findall(chunk))
    return {name: counts[number] for number, name in streams.items()}


def played(path: Path, world: World) -> tuple[dict[str, int], int]:
    """Count the frames that librealsense plays, and the sets that differ from the world's images."""
    in_file = {name: info.frames for name, info in BagReader(path).streams.items()}
    if missing := set(STREAMS) - set(in_file):  # killed before the first set was whole: there is nothing to pair
        return in_file | dict.fromkeys(missing, 0), 0
    wrong = 0
    with SdkReplayCamera(path) as camera:
        for frame in camera:
            images = world.images(frame.frame_number)
            depth_z16 = np.nan_to_num(frame.depth_m / np.float32(frame.settings["depth_units"])).round()
            same = np.array_equal(depth_z16, images.depth_z16) and np.array_equal(frame.ir, images.ir)
            wrong += not (same and np.array_equal(frame.confidence, images.confidence))
        return {stream: camera.arrived[stream] for stream in STREAMS}, wrong


def examine(path: Path, after_s: float, world: World) -> Kill:
    """Repair a killed recording, and compare with the chunks on disk."""
    on_disk = list(chunks_in(path))
    frames = dict.fromkeys(STREAMS, 0) | frames_in(on_disk)
    size, out = path.stat().st_size, path.with_suffix(".repaired.bag")
    started_s = time.monotonic()
    try:
        recovered = repair_recording(path, out).recovered_frames
    except RecordingError as error:
        print(f"after {after_s:.2f} s: {error}")
        none = dict.fromkeys(STREAMS, 0)
        return Kill(after_s, size, len(on_disk), frames, 0, none, none, 0, 0.0)
    repair_s = time.monotonic() - started_s
    kept = {hashlib.sha256(chunk).digest() for chunk in chunks_in(out)}
    recovered_chunks = sum(hashlib.sha256(chunk).digest() in kept for chunk in on_disk)
    shown, wrong = played(out, world)
    return Kill(after_s, size, len(on_disk), frames, recovered_chunks, recovered, shown, wrong, repair_s)


def trial(random: Random) -> Row:
    """Kill a capture at a random moment, repair and examine its recording."""
    after_s = random.uniform(0, LONGEST_S)
    with empty_folder() as folder:
        path = folder / "killed.bag"
        command = ["capture", "--camera", CAMERA, "--seconds", str(100 * LONGEST_S), "--out", str(path)]
        kill(Forked(command, folder, folder.with_name("said")), path, after_s)
        found = in_fork(partial(_examined, path, after_s))
    if not found.good:
        return {**asdict(found), "wrong": "not every chunk, or another frame"}
    frames = sum(found.frames_played.values())
    return {
        "after_s": round(after_s, 2),
        "file_bytes": found.file_bytes,
        "chunks": found.chunks_on_disk,
        "frames": frames,
    }


def _examined(path: Path, after_s: float) -> Kill:
    return examine(path, after_s, open_world(CAMERA.removeprefix("sim:")))


def main() -> int:
    """Kill, and write after each; return 1 after a finding."""
    chosen = options(__doc__, "kills.json", kills=100).parse_args()
    load_program()
    results = Results(chosen.out, chosen.seed)
    results.repeat("capture", "kills", chosen.kills, trial)
    return int(bool(results.findings))


if __name__ == "__main__":
    sys.exit(main())
