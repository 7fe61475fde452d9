"""A fake L515 on USB with its typical faults; fake_librealsense.py is the SDK over it."""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Thread
from types import SimpleNamespace
from typing import Self

import numpy as np

from nlos_cam.camera.l515 import NEAR_WALL
from nlos_cam.camera.streams import FORMATS
from nlos_cam.render.sensor.sensor import DEPTH_UNIT_M

COLOUR_FROM_DEPTH = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.8, 0.014], [0.0, -0.8, 0.6, -0.007]]
)
"""Pose of the color camera: far from the L515's, so that no test passes by chance."""
LENS = [0.15, -0.5, -0.001, 0.0006, 0.47]
Named = SimpleNamespace  # a member of one of the SDK's enumerations
PACE_S = 0.002


class NapClock:
    """Clock that moves only by waiting, and records each wait; `hook` is called before, with the
    number of earlier.
    """

    def __init__(self, hook: Callable[[int], object] = lambda _: None) -> None:
        self.time_s = 1e9
        self.naps = list[float]()
        self.hook = hook

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        self.hook(len(self.naps))
        self.naps.append(seconds)
        self.time_s += seconds
        return stop.wait(0.001)


class FakeProfile:
    def __init__(self, stream: str, size: tuple[int, int], lidar: "FakeLidar") -> None:
        self.stream = stream
        self.size = size
        self.lidar = lidar

    def stream_type(self) -> Named:
        return Named(name=self.stream)

    def format(self) -> Named:
        return Named(name="rgb8" if self.stream == "color" else FORMATS[self.stream])

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
        if self.lidar.uncalibrated:
            raise RuntimeError(f"intrinsics for resolution {width},{height} doesn't exist")
        made = SimpleNamespace(
            width=width, height=height, fx=460.0, fy=461.0, ppx=width / 2, ppy=height / 2
        )
        made.model = Named(name="none")
        made.coeffs = [0.0] * 5
        if self.stream == "color":
            made.model = Named(name=self.lidar.lens_model)
            made.coeffs = LENS
        return made

    def get_extrinsics_to(self, other: "FakeProfile") -> SimpleNamespace:
        """Return the extrinsics from color to depth, the only ones in use."""
        assert (self.stream, other.stream) == ("color", "depth")
        turn = COLOUR_FROM_DEPTH[:, :3]
        shift = COLOUR_FROM_DEPTH[:, 3]
        return SimpleNamespace(
            rotation=turn.ravel().tolist(), translation=(-turn.T @ shift).tolist()
        )


@dataclass(frozen=True)
class FakeFrame:
    profile: FakeProfile
    number: int
    timestamp_ms: float
    pixels: np.ndarray
    domain: str = "global_time"

    def get_profile(self) -> FakeProfile:
        return self.profile

    def get_frame_number(self) -> int:
        return self.number

    def get_timestamp(self) -> float:
        return self.timestamp_ms

    def get_frame_timestamp_domain(self) -> Named:
        return Named(name=self.domain)

    def get_data(self) -> np.ndarray:
        return self.pixels


class FakeLidar:
    """L515 on USB. Each start of its sensor uses the next of `runs`: a number of frames, from
    number 0.

    While it `flaps` more than once, it repeats the first run. Without `runs` it delivers one frame
    on starting, and then those of each call of `deliver`.
    """

    def __init__(
        self,
        serial: str = "f0246262",
        usb: str = "3.2",
        streams: tuple[str, ...] = tuple(FORMATS),
        name: str = "Intel RealSense L515",
        runs: tuple[int, ...] | None = None,
        **options: float,
    ) -> None:
        self.info = {"name": name, "serial_number": serial, "usb_type_descriptor": usb}
        self.info["firmware_version"] = "01.05.08.01"
        self.streams = streams
        self.runs = list(runs) if runs is not None else None
        factory = {"depth_units": DEPTH_UNIT_M, "visual_preset": 4.0, "global_time_enabled": 0.0}
        self.factory = factory | dict.fromkeys(NEAR_WALL, 9.0) | options
        self.options = dict(self.factory)
        self.ranges: dict[str, tuple[float, float, float]] = {}
        """Lowest, highest and step of an option that has a range."""
        self.stubborn: set[str] = set()
        self.refused: set[str] = set()
        self.did: list[str] = []
        self.opened: list[FakeProfile] = []
        self.is_open = False
        self.is_streaming = False
        """State of its sensors, of which one runs at a time."""
        self.start_error: Exception | None = None
        self.uncalibrated = False
        self.reset_takes = 2
        """Number of look-ups until it is back after a reset."""
        self.plugged = True
        self.generation = 0
        self.flaps = 0
        """Number of times that it will be unplugged at the end of a run, and plugged in after two
        look-ups.
        """
        self.back_after = 0
        """Number of look-ups after which an unplugged device is plugged in; never, if 0."""
        self.saturated_share: Callable[[float], float] = lambda _: 0.0
        """Share of infrared pixels at 255, by laser power."""
        self.zero_ms = 0.0
        self.period_ms = 1000 / 30
        self.colour: Callable[[int], int] | None = None
        """Gray level of the color image by frame number; None without a color camera. One sensor
        runs at a time.
        """
        self.lens_model = "brown_conrady"
        self._callback: Callable[[FakeFrame], None] | None = None
        self._stopping = Event()
        self._thread = None

    def unplug(self) -> None:
        self.did.append("unplugged")
        self.plugged = False
        self.generation = self.generation + 1
        self._stopping.set()
        self._callback = None
        self.is_open = False
        self.is_streaming = False
        self.options = dict(self.factory)

    def plug_in(self) -> None:
        self.plugged = True

    def look_for(self) -> bool:
        """Look the device up on USB; return True if it is connected."""
        if not self.plugged and self.back_after:
            self.back_after -= 1
            self.plugged = self.back_after == 0
        return self.plugged

    def start(self, callback: Callable[[FakeFrame], None]) -> None:
        if self.start_error:
            raise self.start_error
        self.did.append("start")
        self._callback = callback
        if self.runs is None:
            self.deliver(range(1))
            return
        self._stopping = stopping = Event()
        frames = 0 if not self.runs else self.runs[0] if self.flaps > 1 else self.runs.pop(0)
        self._thread = Thread(
            target=self._run, args=(frames, stopping), name="fake SDK", daemon=True
        )
        self._thread.start()

    def _run(self, frames: int, stopping: Event) -> None:
        for number in range(frames):
            if stopping.wait(PACE_S):
                return
            self.deliver(range(number, number + 1))
        if self.flaps and frames and not stopping.wait(PACE_S):
            self.flaps = self.flaps - 1
            self.back_after = 2
            self.unplug()

    def deliver(self, numbers: range, streams: tuple[str, ...] = (*FORMATS, "color")) -> None:
        for number in numbers:
            for profile in self.opened:
                if self._callback and profile.stream in streams:
                    taken_ms = self.zero_ms + number * self.period_ms
                    self._callback(
                        FakeFrame(profile, number, taken_ms, self._pixels(profile, number))
                    )

    def _pixels(self, profile: FakeProfile, number: int) -> np.ndarray:
        if profile.stream == "color" and self.colour:
            return np.full((*profile.size[::-1], 3), self.colour(number), np.uint8)
        pixels = np.full(
            profile.size[::-1], 240, np.uint16 if profile.stream == "depth" else np.uint8
        )
        if profile.stream == "infrared":
            share = self.saturated_share(self.options.get("laser_power", 0.0))
            pixels.ravel()[: round(share * pixels.size)] = 255
        return pixels

    def stop(self) -> None:
        self.did.append("stop")
        self._callback = None
        self._stopping.set()
        if self._thread:
            self._thread.join(5.0)
            self._thread = None
