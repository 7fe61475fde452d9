"""Small recordings of noise, made with librealsense's recorder: packed or not, closed or without their index."""

import gc
import re
from pathlib import Path

import numpy as np
from nlos_calibration import load_rig

from nlos_cam.camera import SoftwareLidar, load_sdk
from nlos_cam.render import SensedImages

WIDTH, HEIGHT = 160, 120
FRAMES = 40
"""Of 77 kB each: several chunks."""


def noise(number: int) -> SensedImages:
    """Frame `number`, the same each time."""
    generator, shape = np.random.default_rng(number), (HEIGHT, WIDTH)
    depth, ir = generator.integers(0, 65536, shape, np.uint16), generator.integers(0, 256, shape, np.uint8)
    return SensedImages(depth, ir, generator.integers(0, 16, shape, np.uint8))


def record(path: Path, *, packed: bool, frames: int = FRAMES) -> Path:
    """Record noise: lz4, or as it is."""
    sdk = load_sdk()
    lidar = SoftwareLidar(load_rig("paper-rig").pinhole.scaled(WIDTH, HEIGHT), sdk)
    recorder = sdk.recorder(str(path), lidar.device, packed)
    sensor = lidar.device.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles())
    sensor.start(lambda _: None)
    for number in range(frames):
        lidar.push(number, number / 30, noise(number))
    sensor.stop()
    sensor.close()
    del recorder
    gc.collect()
    return path


def without_index(content: bytes) -> bytes:
    """A recording as a kill leaves it: not closed, its last chunk begun and of no length yet."""
    last = content.rindex(b"\x00\x00\x00compression=") - 5
    size = content.index(b"size=", last) + len(b"size=")
    data = size + 8
    end = content.index(b"\x2f\x00\x00\x00\x09\x00\x00\x00conn=", data)  # where its index begins
    unfinished = content[last:size] + bytes(8) + content[data : (data + end) // 2]
    return re.sub(rb"(?s)(index_pos=).{8}", rb"\1" + bytes(8), content[:last], count=1) + unfinished


def make_all(folder: Path) -> dict[str, Path]:
    """One of each kind, by name."""
    made = {name: record(folder / f"{name}.bag", packed=name == "packed") for name in ("packed", "plain")}
    for name, path in list(made.items()):
        unindexed = folder / f"{name}-unindexed.bag"
        unindexed.write_bytes(without_index(path.read_bytes()))
        made[unindexed.stem] = unindexed
    return made
