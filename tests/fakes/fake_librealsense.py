"""Fake of the parts of pyrealsense2 that the camera package uses, over fake lidars.

Devices and sensors are handles on a `FakeLidar` that fail once it was unplugged, as librealsense's
do. tests/unit/camera/test_fake_librealsense.py holds the names against the real module.
"""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fake_lidar import FakeFrame, FakeLidar, FakeProfile, Named

from nlos_cam.camera.l515 import ADJUSTABLE

SIZES = [(1024, 768), (640, 480), (320, 240)]
COLOUR_SIZES = [(1920, 1080), (1280, 720), (960, 540), (640, 480)]
GONE = "failed to set power state"
DEPENDENT = ADJUSTABLE
"""Options that a preset sets; firmware 1.5.8.1 and librealsense 2.54 have some more."""
CUSTOM = 0.0


class FakeSensor:
    """Handle on the lidar's depth or color sensor."""

    def __init__(self, lidar: FakeLidar, generation: int, *, colour: bool = False) -> None:
        self.lidar = lidar
        self.generation = generation
        smallest = (
            slice(-1, None)
            if lidar.info.get("usb_type_descriptor", "").startswith("2")
            else slice(None)
        )
        sizes, streams = (COLOUR_SIZES, ("color",)) if colour else (SIZES, lidar.streams)
        self.profiles = [
            FakeProfile(stream, size, lidar) for size in sizes[smallest] for stream in streams
        ]

    def _check(self) -> None:
        if not self.lidar.plugged or self.generation != self.lidar.generation:
            raise RuntimeError(GONE)

    def get_stream_profiles(self) -> list[FakeProfile]:
        return self.profiles

    def _need_state(self, *, is_open: bool, is_streaming: bool) -> None:
        """Refuse a call out of turn, as librealsense does."""
        self._check()
        if (self.lidar.is_open, self.lidar.is_streaming) != (is_open, is_streaming):
            raise RuntimeError("the sensor is in another state")

    def open(self, profiles: list[FakeProfile]) -> None:
        self._need_state(is_open=False, is_streaming=False)
        self.lidar.opened = list(profiles)
        self.lidar.is_open = True

    def start(self, callback: Callable[[FakeFrame], None]) -> None:
        self._need_state(is_open=True, is_streaming=False)
        self.lidar.is_streaming = True
        try:
            self.lidar.start(callback)
        except RuntimeError:
            self.lidar.is_streaming = False
            raise

    def stop(self) -> None:
        self.lidar.stop()
        self._need_state(is_open=True, is_streaming=True)
        self.lidar.is_streaming = False

    def close(self) -> None:
        self.lidar.did.append("close")
        self._need_state(is_open=True, is_streaming=False)
        self.lidar.is_open = False

    def get_supported_options(self) -> list[Named]:
        return [Named(name=name) for name in self.lidar.options]

    def supports(self, option: Named) -> bool:
        return option.name in self.lidar.options

    def _need(self, option: Named) -> None:
        self._check()
        if not self.supports(option):
            raise RuntimeError(f"object doesn't support option {option.name}")

    def get_option(self, option: Named) -> float:
        self._need(option)
        return self.lidar.options[option.name]

    def get_option_range(self, option: Named) -> SimpleNamespace:
        self._need(option)
        low, high, step = self.lidar.ranges.get(option.name, (0.0, 100.0, 1.0))
        return SimpleNamespace(min=low, max=high, step=step, default=low)

    def set_option(self, option: Named, value: float) -> None:
        self._need(option)
        self.lidar.did.append(option.name)
        low, high, _ = self.lidar.ranges.get(option.name, (0.0, 100.0, 1.0))
        if option.name in self.lidar.refused or not low <= value <= high:
            raise RuntimeError("out of range")
        if option.name in self.lidar.stubborn:
            return
        options = self.lidar.options
        options[option.name] = value
        # As in librealsense: a preset sets the options that depend on it anew, and an option that
        # is set by hand makes the preset a custom one.
        if option.name == "visual_preset":
            factory = self.lidar.factory
            offered = [name for name in DEPENDENT if name in options and name in factory]
            options |= {name: factory[name] for name in offered}
        elif option.name in DEPENDENT and "visual_preset" in options:
            options["visual_preset"] = CUSTOM


class FakeDevice:
    """Handle on the lidar, valid until it is unplugged."""

    def __init__(self, lidar: FakeLidar, generation: int) -> None:
        self.lidar = lidar
        self.generation = generation

    def supports(self, key: str) -> bool:
        return key in self.lidar.info

    def get_info(self, key: str) -> str:
        return self.lidar.info[key]

    def query_sensors(self) -> list[FakeSensor]:
        if self.generation != self.lidar.generation:
            raise RuntimeError(GONE)
        depth = FakeSensor(self.lidar, self.generation)
        return (
            [depth, FakeSensor(self.lidar, self.generation, colour=True)]
            if self.lidar.colour
            else [depth]
        )

    def hardware_reset(self) -> None:
        """Leave the bus and come back with a calibration."""
        if self.generation != self.lidar.generation:
            raise RuntimeError("hwmon command 0x20 failed. Error type: no device")
        self.lidar.did.append("reset")
        self.lidar.unplug()
        self.lidar.uncalibrated = False
        self.lidar.back_after = self.lidar.reset_takes


class FakeRecorder:
    """Recorder that creates an empty file and notes its start."""

    def __init__(self, path: str, device: FakeDevice) -> None:
        device.lidar.did.append("record")
        Path(path).write_bytes(b"")

    def query_sensors(self) -> list[FakeSensor]:
        return []

    def pause(self) -> None:
        pass


class FakeContext:
    def __init__(self, lidars: list[FakeLidar]) -> None:
        self.lidars = lidars

    def query_devices(self) -> list[FakeDevice]:
        return [FakeDevice(lidar, lidar.generation) for lidar in self.lidars if lidar.look_for()]


class Names:
    """Enumeration whose members are their own names; records the names in use."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self.make = make
        self.asked = set[str]()

    def __getattr__(self, name: str) -> Any:
        self.asked.add(name)
        return self.make(name)


class FakeSdk:
    """The module."""

    recorder = FakeRecorder

    def __init__(self, *lidars: FakeLidar) -> None:
        self.camera_info = Names(str)
        self.option = Names(lambda name: Named(name=name))
        self.lidars = list(lidars)
        self.contexts = 0

    def context(self) -> FakeContext:
        self.contexts += 1
        return FakeContext(self.lidars)
