"""Playback of a recording as a camera, without librealsense; and verification of recordings."""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from nlos_calibration import Intrinsics, Rig

from nlos_cam.camera import FORMATS, OPTIONAL, FrameSynchronizer, frame_in_si
from nlos_cam.errors import CameraError, RecordingError, StreamMissingError
from nlos_cam.frames import Frame
from nlos_cam.recording.bag_reader import BagReader
from nlos_cam.recording.device_clock import unwrapped_samples
from nlos_cam.recording.formats import open_recording
from nlos_cam.recording.renumbering import renumbered

if TYPE_CHECKING:
    from nlos_cam.recording.ros_reader import RosReader

log = logging.getLogger(__name__)

IDENTITY = {
    "name": "name",
    "serial": "serial_number",
    "firmware": "firmware_version",
    "usb_type": "usb_type_descriptor",
}
"""The SDK's names of the device's properties, by ours."""


class ReplayCamera:
    """Camera that plays a .bag as fast as it is read, from the first frame at each iteration,
    without drops.

    No thread and no open file, so leaving the context only ends iterations. A frame's settings are
    those in force when it was recorded. Raises RecordingError for a file that cannot be read, or at
    the damage; StreamMissingError without depth or infrared. Confidence may be missing: its levels
    are 0 then.
    """

    def __init__(self, path: Path) -> None:
        self.uri = f"bag:{path}"
        self.rig: Rig | None = None
        self._bag = open_lidar_bag(path)
        self._streams = streams_of(self._bag)
        self._unit_m = self._bag.depth_unit_m()
        self._gravity_m_s2 = self._bag.gravity()
        self.identity: Mapping[str, str] = identity_of(self._bag)
        self.intrinsics: Intrinsics = self._bag.streams["depth"].intrinsics
        self.incomplete = self.dropped = 0
        self.counts: Counter[str] = Counter()
        self.arrived: Counter[str] = Counter()
        """Frames of each stream in the last iteration."""
        self._settings: Mapping[str, float] = {}
        self._entered = False
        self._iterations = 0
        """Started so far; all but the last have ended."""

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
        shape = self.intrinsics.height, self.intrinsics.width
        pairing = FrameSynchronizer(shape, self._streams)
        try:
            yield from self._frames(pairing, self._iterations)
        except RecordingError:
            self._end(pairing)
            raise

    def _frames(self, pairing: FrameSynchronizer, iteration: int) -> Iterator[Frame]:
        samples = unwrapped_samples(self._bag, self._streams)
        for time_ns, sample in renumbered(samples, self._streams):
            self.arrived[sample.stream] += 1
            found = pairing.add(sample)
            if found:
                self._count(pairing)
                self._settings = self._bag.settings(time_ns)
                yield frame_in_si(
                    found,
                    self._unit_m,
                    self.intrinsics,
                    self._settings,
                    gravity_m_s2=self._gravity_m_s2,
                )
            if iteration != self._iterations:  # the context was left, or another iteration started
                return
        self._end(pairing)

    def _end(self, pairing: FrameSynchronizer) -> None:
        pairing.finish()
        self._count(pairing)

    def _count(self, pairing: FrameSynchronizer) -> None:
        self.incomplete = pairing.incomplete
        self.dropped = pairing.dropped
        self.counts = pairing.counts

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return {name: value for name, value in self._settings.items() if name.endswith(ending)}


def open_lidar_bag(path: Path) -> "BagReader | RosReader":
    """Open a recording of an L515, by librealsense or a ROS driver. Raises StreamMissingError without depth or infrared,
    RecordingError. Logs a warning for one without confidence.
    """
    bag = open_recording(path)
    present = {name: info.format for name, info in bag.streams.items()}
    missing = [stream for stream, wanted in FORMATS.items() if present.get(stream) != wanted]
    if set(missing) <= OPTIONAL:
        for stream in missing:
            log.warning("%s has no %s stream: no result depends on it", path, stream)
    else:
        raise StreamMissingError(
            f"{path} has no {' and no '.join(missing)} stream (it has"
            f" {', '.join(sorted(present))}): record depth and infrared with an L515,"
            " e.g. `nlos-cam capture --camera l515`"
        )
    pinhole = bag.streams["depth"].intrinsics
    if min(pinhole.fx, pinhole.fy) <= 0:
        raise RecordingError(
            f"{path} is damaged (a focal length of {pinhole.fx:g} x {pinhole.fy:g}): record it"
            " again"
        )
    return bag


def streams_of(bag: "BagReader | RosReader") -> list[str]:
    """Return the lidar's streams that a recording has, in the lidar's formats."""
    return [
        stream
        for stream, wanted in FORMATS.items()
        if stream in bag.streams and bag.streams[stream].format == wanted
    ]


def identity_of(bag: "BagReader | RosReader") -> dict[str, str]:
    """Return name, serial, firmware and usb_type of the recorded device, as far as recorded."""
    return {ours: bag.device[theirs] for ours, theirs in IDENTITY.items() if theirs in bag.device}


@dataclass(frozen=True)
class VerifyResult:
    """Contents of a recording that was read from end to end."""

    frames: int
    """Complete sets of the three streams."""
    dropped: int
    """Frame numbers between the first and the last set that are missing, or lack a stream."""
    seconds: float
    """From the first set to the last."""
    streams: dict[str, int]
    """Frames of each stream."""


def verify(path: Path, on_frame: Callable[[], None] = lambda: None) -> VerifyResult:
    """Read a recording from end to end and return its contents. Raises RecordingError at damage."""
    frames = 0
    first_s = 0.0
    last_s = 0.0
    with ReplayCamera(path) as camera:
        for frame in camera:
            if frames == 0:
                first_s = frame.timestamp_s
            last_s = frame.timestamp_s
            frames += 1
            on_frame()
        return VerifyResult(
            frames,
            camera.dropped + camera.incomplete,
            max(last_s - first_s, 0.0),
            dict(camera.arrived),
        )
