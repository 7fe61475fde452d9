"""SIGKILL in the middle of a capture: `repair` takes everything that a naive reader of the format finds on disk."""

import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest

from nlos_cam.recording import SdkReplayCamera, repair_recording

CAPTURE = """
import sys
from pathlib import Path
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/fakes"]
from conftest import record_noise
record_noise(Path(sys.argv[2]), 10**9)
"""
FIRST_CHUNK_AT = 4117


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


@pytest.mark.slow
def test_repair_recovers_every_chunk_of_a_killed_capture(noise_world: Any, tmp_path: Path) -> None:
    path, out, world = tmp_path / "killed.bag", tmp_path / "repaired.bag", noise_world()
    command = [sys.executable, "-c", CAPTURE, str(Path(__file__).parents[2]), str(path)]
    with subprocess.Popen(command) as capture:
        while not (path.exists() and path.stat().st_size) and capture.poll() is None:
            time.sleep(0.01)
        time.sleep(1.0)
        assert capture.poll() is None
        capture.kill()
    on_disk = list(chunks_in(path))
    found = repair_recording(path, out)
    assert on_disk
    assert set(on_disk) <= set(chunks_in(out))
    assert min(found.recovered_frames.values()) > 40
    with SdkReplayCamera(out) as camera:
        for frame in camera:
            images = world.images(frame.frame_number)
            depth_z16 = np.nan_to_num(frame.depth_m / np.float32(frame.settings["depth_units"])).round()
            np.testing.assert_array_equal(depth_z16, images.depth_z16)
            np.testing.assert_array_equal(frame.ir, images.ir)
            np.testing.assert_array_equal(frame.confidence, images.confidence)
        assert {stream: camera.arrived[stream] for stream in found.recovered_frames} == found.recovered_frames


def test_naive_reader_finds_the_chunks_of_an_unfinished_recording(noise_bags: dict[str, Path]) -> None:
    for name in ("packed", "plain"):
        assert list(chunks_in(noise_bags[f"{name}-unindexed"])) == [*chunks_in(noise_bags[name])][:-1] != []
