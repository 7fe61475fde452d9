"""A recording as a camera: complete, in order, the same each time, as fast as it is read; without librealsense."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from nlos_calibration import Intrinsics, Rig

from nlos_cam.camera import FORMATS, ClockUnwrap, FrameSynchronizer, frame_in_si
from nlos_cam.errors import CameraError, RecordingError, StreamMissingError
from nlos_cam.frames import Frame
from nlos_cam.recording.bag_reader import BagFile

IDENTITY = {
    "name": "name",
    "serial": "serial_number",
    "firmware": "firmware_version",
    "usb_type": "usb_type_descriptor",
}
"""What a camera tells of itself, by our name and by the SDK's."""


class ReplayCamera:
    """The frames of a .bag. Iterating starts at the first frame each time, and never drops one.

    A frame's settings are those in force when it was recorded. Raises RecordingError for a file that cannot be read, or
    where it cannot be read on; StreamMissingError for one that lacks a stream.
    """

    def __init__(self, path: Path) -> None:
        self.uri = f"bag:{path}"
        self.rig: Rig | None = None
        self._bag = open_lidar_bag(path)
        self._unit_m = self._bag.depth_unit_m()
        self.identity: Mapping[str, str] = identity_of(self._bag)
        self.intrinsics: Intrinsics = self._bag.streams["depth"].intrinsics
        self.incomplete = self.dropped = 0
        self.counts: Counter[str] = Counter()
        self.arrived: Counter[str] = Counter()
        """Frames of each stream in the last iteration."""
        self._settings: Mapping[str, float] = {}
        self._entered = False
        self._iterations = 0
        """Begun so far: only the last goes on."""

    def __enter__(self) -> Self:
        self._entered = True
        return self

    def __exit__(self, *_: object) -> None:
        self._entered = False
        self._iterations += 1

    def __iter__(self) -> Iterator[Frame]:
        if not self._entered:
            raise CameraError(f"{self.uri} is not started: iterate inside `with`")
        self._iterations += 1
        self.arrived = Counter()
        pairing = FrameSynchronizer((self.intrinsics.height, self.intrinsics.width))
        try:
            yield from self._frames(pairing, self._iterations)
        except RecordingError:
            self._end(pairing)
            raise

    def _frames(self, pairing: FrameSynchronizer, iteration: int) -> Iterator[Frame]:
        clock = device_clock(self._bag)
        for place in self._bag.order(FORMATS):
            sample = self._bag.sample(place.stream, place.index)
            self.arrived[sample.stream] += 1
            found = pairing.add(replace(sample, timestamp_s=clock(sample.timestamp_s)))
            if found:
                self._count(pairing)
                self._settings = self._bag.settings(place.time_ns)
                yield frame_in_si(found, self._unit_m, self.intrinsics, self._settings)
            if iteration != self._iterations:  # it was left, or begun anew
                return
        self._end(pairing)

    def _end(self, pairing: FrameSynchronizer) -> None:
        pairing.finish()
        self._count(pairing)

    def _count(self, pairing: FrameSynchronizer) -> None:
        self.incomplete, self.dropped, self.counts = pairing.incomplete, pairing.dropped, pairing.counts

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return {name: value for name, value in self._settings.items() if name.endswith(ending)}


def open_lidar_bag(path: Path) -> BagFile:
    """A recording with the three streams that are needed. Raises StreamMissingError for another, RecordingError."""
    bag = BagFile(path)
    if not bag.streams:
        raise RecordingError(f"{path} holds no frames: record it again")
    present = {name: info.format for name, info in bag.streams.items()}
    if missing := [stream for stream, wanted in FORMATS.items() if present.get(stream) != wanted]:
        raise StreamMissingError(
            f"{path} has no {' and no '.join(missing)} stream (it has {', '.join(sorted(present))}): record depth, "
            "infrared and confidence with an L515, e.g. `nlos-cam capture --camera l515`"
        )
    return bag


def identity_of(bag: BagFile) -> dict[str, str]:
    """What a camera tells of itself, from a recording of it."""
    return {ours: bag.device[theirs] for ours, theirs in IDENTITY.items() if theirs in bag.device}


def device_clock(bag: BagFile) -> Callable[[float], float]:
    """What makes one clock of a recording's timestamps, taken in order: a device's own counter wraps."""
    wraps = bag.metadata("depth", 0).domain == "hardware_clock"
    return ClockUnwrap().add if wraps else float


@dataclass(frozen=True)
class Verified:
    """What a recording holds, read back from the file."""

    frames: int
    """Complete sets."""
    dropped: int
    """Numbers between the first and the last set that are not in the file, or lack a stream."""
    seconds: float
    """From the first set to the last."""
    streams: dict[str, int]
    """Frames of each stream."""


def verify(path: Path, on_frame: Callable[[], None] = lambda: None) -> Verified:
    """Read a recording from end to end. Raises RecordingError where it cannot be."""
    frames, first_s, last_s = 0, 0.0, 0.0
    with ReplayCamera(path) as camera:
        for frame in camera:
            first_s, last_s = first_s if frames else frame.timestamp_s, frame.timestamp_s
            frames += 1
            on_frame()
        return Verified(frames, camera.dropped + camera.incomplete, last_s - first_s, dict(camera.arrived))
