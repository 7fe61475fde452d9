"""Small recordings of noise, made with librealsense's recorder."""

import gc
from pathlib import Path

import numpy as np
from nlos_calibration import load_rig

from nlos_cam.camera import SoftwareLidar, load_sdk
from nlos_cam.render import SensedImages

WIDTH = 160
HEIGHT = 120
FRAMES = 40
"""Of 77 kB each: several chunks."""


def noise(number: int) -> SensedImages:
    """Frame `number`, the same each time."""
    generator = np.random.default_rng(number)
    shape = (HEIGHT, WIDTH)
    depth = generator.integers(0, 65536, shape, np.uint16)
    ir = generator.integers(0, 256, shape, np.uint8)
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
