import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest
from nlos_calibration.rig import Rig, load_rig

from nlos_cam.camera import Recording
from nlos_cam.camera.l515 import NEAR_WALL, L515Camera
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.camera.streams import FORMATS
from nlos_cam.render.sensor import DEPTH_UNIT_M, SensedImages


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
    """A world of noise, small and quick to make: every bit of every frame is known from its number."""

    width, height = 64, 48

    def __init__(self, fails_at: int | None = None) -> None:
        rig = load_rig("paper-rig")
        small = rig.pinhole.scaled(self.width, self.height)
        self.rig: Rig = rig.model_copy(update={"intrinsics": rig.intrinsics.model_copy(update=vars(small))})
        self.fails_at = fails_at

    def images(self, number: int) -> SensedImages:
        if number == self.fails_at:
            raise ZeroDivisionError("the world ended")
        noise, shape = np.random.default_rng(number), (self.height, self.width)
        depth, ir = noise.integers(0, 65536, shape, np.uint16), noise.integers(0, 256, shape, np.uint8)
        depth[0, :8] = 0
        return SensedImages(depth, ir, noise.integers(0, 16, shape, np.uint8))

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)


class HurriedClock:
    """A clock by which everything is due as soon as it is asked for: it moves only by waiting."""

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


def record_noise(path: Path, frames: int) -> Path:
    """A recording of a NoiseWorld's first frames, made in no time."""
    recording = Recording(path, frames=frames)
    with SimulatedCamera("sim:noise", NoiseWorld(), clock=HurriedClock(), recording=recording) as camera:
        for _ in camera:
            pass
    return path


@pytest.fixture(scope="session")
def recorded() -> Callable[..., Path]:
    return record_noise


@pytest.fixture(scope="session")
def noise_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty frames of a NoiseWorld, recorded."""
    return record_noise(tmp_path_factory.mktemp("bags") / "noise.bag", 20)


Named = SimpleNamespace  # a member of one of the SDK's enumerations


class FakeProfile:
    def __init__(self, stream: str, width: int, height: int) -> None:
        self.stream, self.size = stream, (width, height)

    def stream_type(self) -> Named:
        return Named(name=self.stream)

    def format(self) -> Named:
        return Named(name=FORMATS[self.stream])

    def fps(self) -> int:
        return 30

    def width(self) -> int:
        return self.size[0]

    def height(self) -> int:
        return self.size[1]

    def as_video_stream_profile(self) -> Self:
        return self

    def get_intrinsics(self) -> SimpleNamespace:
        width, height = self.size
        return SimpleNamespace(width=width, height=height, fx=460.0, fy=461.0, ppx=width / 2, ppy=height / 2)


class FakeFrame:
    def __init__(self, profile: FakeProfile, number: int) -> None:
        self.profile, self.number = profile, number

    def get_profile(self) -> FakeProfile:
        return self.profile

    def get_frame_number(self) -> int:
        return self.number

    def get_timestamp(self) -> float:
        return self.number * 1000 / 30

    def get_data(self) -> np.ndarray:
        return np.full(self.profile.size[::-1], 240, np.uint16 if self.profile.stream == "depth" else np.uint8)


class FakeSensor:
    """A sensor that keeps what it is told, but for what it is `stubborn` about, and delivers a frame on starting."""

    def __init__(self, sizes: list[tuple[int, int]], streams: tuple[str, ...]) -> None:
        self.profiles = [FakeProfile(stream, *size) for size in sizes for stream in streams]
        self.options = {"depth_units": DEPTH_UNIT_M, "visual_preset": 4.0, "global_time_enabled": 0.0}
        self.options |= dict.fromkeys(NEAR_WALL, 9.0)
        self.stubborn: set[str] = set()
        self.refused: set[str] = set()
        self.did: list[Any] = []
        self.opened: list[FakeProfile] = []
        self.start_error: Exception | None = None
        self.callback: Callable[[FakeFrame], None] = lambda _: None

    def get_stream_profiles(self) -> list[FakeProfile]:
        return self.profiles

    def open(self, profiles: list[FakeProfile]) -> None:
        self.opened = profiles

    def start(self, callback: Callable[[FakeFrame], None]) -> None:
        if self.start_error:
            raise self.start_error
        self.did.append("start")
        self.callback = callback
        self.deliver(range(1))

    def deliver(self, numbers: range) -> None:
        for number in numbers:
            for profile in self.opened:
                self.callback(FakeFrame(profile, number))

    def stop(self) -> None:
        self.did.append("stop")

    def close(self) -> None:
        self.did.append("close")

    def get_supported_options(self) -> list[Named]:
        return [Named(name=name) for name in self.options]

    def supports(self, option: Named) -> bool:
        return option.name in self.options

    def get_option(self, option: Named) -> float:
        return self.options[option.name]

    def set_option(self, option: Named, value: float) -> None:
        self.did.append(option.name)
        if option.name in self.refused:
            raise RuntimeError("out of range")
        if option.name not in self.stubborn:
            self.options[option.name] = value


class FakeDevice:
    def __init__(self, sensor: FakeSensor, **info: str) -> None:
        self.sensor, self.info = sensor, info

    def supports(self, key: str) -> bool:
        return key in self.info

    def get_info(self, key: str) -> str:
        return self.info[key]

    def query_sensors(self) -> list[FakeSensor]:
        return [self.sensor]


class Names:
    """Stands for an enumeration: any member is its own name."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self.make = make

    def __getattr__(self, name: str) -> Any:
        return self.make(name)


def sdk_with(*devices: FakeDevice) -> SimpleNamespace:
    context = SimpleNamespace(query_devices=lambda: list(devices))
    return SimpleNamespace(context=lambda: context, camera_info=Names(str), option=Names(lambda name: Named(name=name)))


def l515(
    serial: str = "f0246262",
    usb: str = "3.2",
    streams: tuple[str, ...] = tuple(FORMATS),
    name: str = "Intel RealSense L515",
) -> FakeDevice:
    sensor = FakeSensor([(1024, 768), (640, 480), (320, 240)], streams)
    return FakeDevice(sensor, name=name, serial_number=serial, usb_type_descriptor=usb, firmware_version="01.05.08.01")


@pytest.fixture
def fake_l515() -> Callable[..., FakeDevice]:
    return l515


@pytest.fixture
def fake_camera() -> Callable[..., L515Camera]:
    """An L515Camera on a fake SDK that sees these devices; `naps` takes what it would have slept."""

    def make(*devices: FakeDevice, serial: str = "", naps: list[float] | None = None) -> L515Camera:
        uri, sleeps = f"l515:{serial}".rstrip(":"), naps if naps is not None else []
        return L515Camera(uri, serial, sdk=sdk_with(*devices), sleep=sleeps.append)

    return make
