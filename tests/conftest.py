import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeSdk
from fake_lidar import FakeLidar, NapClock
from nlos_calibration import Rig, load_rig
from noise_bags import make_all
from program_state import program_digest

from nlos_cam.camera import Recording, SimulatedCamera
from nlos_cam.camera.l515 import L515Camera
from nlos_cam.render import SensedImages


def pytest_configure(config: pytest.Config) -> None:
    """Keep what tests cache apart from the user's own cache, and from what another state of the
    program has cached: a result that no longer follows from the code must not pass.
    """
    if "NLOS_CAM_CACHE" in os.environ:  # also in the processes of xdist, which inherit it
        return
    caches = config.rootpath / ".pytest_cache" / "nlos-cam"
    own = caches / program_digest()
    for other in caches.glob("*"):
        if other != own:
            shutil.rmtree(other, ignore_errors=True)
    os.environ["NLOS_CAM_CACHE"] = str(own)


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Fail a test that leaves a Python thread behind."""
    before = set(threading.enumerate())
    yield
    left = [thread for thread in threading.enumerate() if thread not in before]
    for thread in left:
        thread.join(timeout=5.0)
    assert not [thread.name for thread in left if thread.is_alive()]


class NoiseWorld:
    """Small world of noise, in which a frame's number determines its bits; it ends with an error at
    one of them.
    """

    width = 64
    height = 48
    fails_at: int | None = None
    error: Exception = ZeroDivisionError("the world ended")

    def __init__(self) -> None:
        rig = load_rig("paper-rig")
        small = rig.pinhole.scaled(self.width, self.height)
        self.rig: Rig = rig.model_copy(
            update={"intrinsics": rig.intrinsics.model_copy(update=vars(small))}
        )

    def images(self, number: int) -> SensedImages:
        if number == self.fails_at:
            raise self.error
        noise = np.random.default_rng(number)
        shape = (self.height, self.width)
        depth = noise.integers(0, 65536, shape, np.uint16)
        ir = noise.integers(0, 256, shape, np.uint8)
        depth[0, :8] = 0
        return SensedImages(depth, ir, noise.integers(0, 16, shape, np.uint8))

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)

    def celsius(self, number: int) -> dict[str, float]:
        return {"ldd_temperature": 20.0 + number}


class HurriedClock:
    """Clock that moves only by waiting, without delay."""

    def __init__(self, start_s: float = 1e9) -> None:
        self.time_s = start_s

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: threading.Event, seconds: float) -> bool:
        self.time_s += max(seconds, 0.0)
        return stop.wait(0.0005)


@pytest.fixture
def noise_world() -> type[NoiseWorld]:
    return NoiseWorld


@pytest.fixture
def hurried_clock() -> type[HurriedClock]:
    return HurriedClock


def record_noise(path: Path, frames: int, world: Any = None) -> Path:
    """Record the first frames of a world, a NoiseWorld if none is given, without waiting for real
    time.
    """
    recording = Recording(path, frames=frames)
    with SimulatedCamera(
        "sim:noise", world or NoiseWorld(), clock=HurriedClock(), recording=recording
    ) as camera:
        for _ in camera:
            pass
    return path


@pytest.fixture(scope="session")
def recorded() -> Callable[..., Path]:
    return record_noise


@pytest.fixture(scope="session")
def noise_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record twenty frames of a NoiseWorld."""
    return record_noise(tmp_path_factory.mktemp("bags") / "noise.bag", 20)


@pytest.fixture
def fake_camera() -> Callable[..., L515Camera]:
    """Make an L515Camera on a fake SDK with these lidars and a clock that moves only by waiting."""

    def make(
        *lidars: FakeLidar,
        serial: str = "",
        clock: NapClock | None = None,
        recording: Recording | None = None,
    ) -> L515Camera:
        uri = f"l515:{serial}".rstrip(":")
        sdk = FakeSdk(*lidars)
        return L515Camera(uri, serial, sdk=sdk, clock=clock or NapClock(), recording=recording)

    return make


@pytest.fixture(scope="session")
def noise_bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Forty frames of noise, recorded "packed" and "plain", and each of them "-unindexed" as a kill
    leaves it.
    """
    return make_all(tmp_path_factory.mktemp("noise"))
