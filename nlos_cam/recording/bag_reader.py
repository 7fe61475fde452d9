"""A librealsense recording, read without librealsense: streams, frames in order or by index, options, metadata.

The options of a recorded sensor: which values were in force when.
"""

import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from heapq import merge
from itertools import count, repeat
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Intrinsics
from numpy.typing import NDArray

from nlos_cam.camera import Sample
from nlos_cam.errors import RecordingError
from nlos_cam.recording import bag_container
from nlos_cam.recording.bag_container import ENCODINGS, BagContainer, Entry, FrameMetadata, sdk_name


class RecordedOptions:
    """The options of one sensor, from the messages that told of them."""

    def __init__(self, container: BagContainer, topics: Mapping[str, str]) -> None:
        """`topics`: of each option's value, with the option's name."""
        self._container = container
        self._names = {topic: sdk_name(name) for topic, name in topics.items()}
        self._changes: list[tuple[Entry, str]] = sorted(
            (entry, topic) for topic in topics for entry in container.entries[topic]
        )
        self._done = 0
        """Changes that are in `_values`."""
        self._values: dict[str, float] = {}

    def at(self, time_ns: int) -> Mapping[str, float]:
        """The values in force, by the SDK's names; the same object until one changes."""
        done = bisect_right(self._changes, time_ns, key=lambda change: change[0].time_ns)
        if done != self._done:
            ahead = done > self._done
            latest = {topic: entry for entry, topic in self._changes[self._done if ahead else 0 : done]}
            read = {self._names[topic]: self._value(topic, entry) for topic, entry in latest.items()}
            self._values, self._done = self._values | read if ahead else read, done
        return self._values

    def _value(self, topic: str, entry: Entry) -> float:
        return float(self._container.read(topic, entry).data)


DEVICE = "/device_0"
STREAM = re.compile(DEVICE + r"/sensor_(\d+)/(\w+)_(\d+)(?=/image/data$)")
OPTION = re.compile(DEVICE + r"/sensor_(\d+)/option/(.+)/value")
STATIC_NS = 1
"""When librealsense says that what was so from the beginning was recorded."""


@dataclass(frozen=True)
class StreamInfo:
    """One stream of a recording."""

    name: str
    """The SDK's, with the index where that is not 0: depth, infrared, confidence, color, infrared_1."""
    topic: str
    sensor: int
    encoding: str
    """As the file has it: mono16, 8UC1, mono8, rgb8, ..."""
    frames_per_s: int
    intrinsics: Intrinsics
    frames: int
    """How many the index lists."""

    @property
    def format(self) -> str:
        """The SDK's name of the encoding: z16, y8, raw8, rgb8, ...; empty where we cannot read it."""
        return ENCODINGS[self.encoding].sdk_format if self.encoding in ENCODINGS else ""


@dataclass(frozen=True, slots=True)
class Place:
    """A frame's place among all frames of a recording."""

    stream: str
    index: int
    """Among the frames of its stream."""
    time_ns: int
    """When it was recorded, on the recorder's clock, which starts at 0."""


class BagFile:
    """A recording. Opening reads its index; frames are read when asked for, and no file stays open in between.

    Numbers and timestamps are as librealsense's playback gives them. Raises RecordingError, on opening and from every
    method, with the place of the damage.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._container = BagContainer(path)
        self._entries = self._container.entries
        self._options: dict[int, RecordedOptions] = {}
        self.device: Mapping[str, str] = self._key_values(f"{DEVICE}/info")
        """By the SDK's names: name, serial_number, firmware_version, product_line, ..."""
        found = [match for topic, entries in self._entries.items() if entries and (match := STREAM.match(topic))]
        infos = [self._stream_info(*match.groups(), topic=match[0]) for match in found]
        self.streams: Mapping[str, StreamInfo] = {info.name: info for info in infos}
        """Those that have frames, by name."""

    def _stream_info(self, sensor: str, kind: str, index: str, topic: str) -> StreamInfo:
        info, camera = self._first(f"{topic}/info"), self._first(f"{topic}/info/camera_info")
        name = sdk_name(kind if index == "0" else f"{kind}_{index}")
        frames = len(self._entries[f"{topic}/image/data"])
        return StreamInfo(
            name, topic, int(sensor), info.encoding, info.fps, bag_container.intrinsics_of(camera), frames
        )

    def _first(self, topic: str) -> Any:
        entries = self._entries.get(topic)
        if not entries:
            raise self._container.damage(f"it has no {topic}")
        return self._container.read(topic, entries[0])

    def _key_values(self, topic: str) -> dict[str, str]:
        pairs = [self._container.read(topic, entry) for entry in self._entries.get(topic, ())]
        return {sdk_name(pair.key): pair.value for pair in pairs}

    @property
    def end_ns(self) -> int:
        """When the last message was recorded, on the recorder's clock."""
        return self._container.end_ns

    def check(self) -> None:
        """Read everything, also what there is no method for. Raises RecordingError at the first damage."""
        images = {f"{info.topic}/image/data": info for info in self.streams.values() if info.format}
        for topic, entry, message in self._container.everything():
            if topic in images:
                self._pixels(message, images[topic], entry)

    def _pixels(self, image: Any, info: StreamInfo, entry: Entry) -> NDArray[Any]:
        with self._container.told_at(entry):
            return bag_container.pixels(image, info.encoding, info.intrinsics)

    def sensor_name(self, stream: str) -> str:
        """What the sensor of a stream is called; empty where that is not recorded."""
        return self._key_values(f"{DEVICE}/sensor_{self.streams[stream].sensor}/info").get("name", "")

    def order(self, streams: Iterable[str]) -> Iterator[Place]:
        """Where the frames of these streams are, in the order in which they were recorded."""
        each = [zip(self._frames(stream), repeat(stream), count()) for stream in streams]
        return (Place(stream, index, entry.time_ns) for entry, stream, index in merge(*each))

    def _frames(self, stream: str) -> list[Entry]:
        return self._entries[f"{self.streams[stream].topic}/image/data"]

    def samples(self, streams: Iterable[str]) -> Iterator[Sample]:
        """The frames of these streams, in the order in which they were recorded."""
        return (self.sample(place.stream, place.index) for place in self.order(streams))

    def sample(self, stream: str, index: int) -> Sample:
        """A frame by its place in its stream. Raises IndexError where there is none."""
        info, entry = self.streams[stream], self._frames(stream)[index]
        if not info.format:
            raise RecordingError(
                f"{self.path}: its {stream} stream is encoded as {info.encoding}, which we cannot read"
            )
        image = self._container.read(f"{info.topic}/image/data", entry)
        return Sample(stream, image.header.seq, bag_container.timestamp_s(image), self._pixels(image, info, entry))

    def metadata(self, stream: str, index: int) -> FrameMetadata:
        """What is told of that frame besides its image."""
        time_ns, topic = self._frames(stream)[index].time_ns, f"{self.streams[stream].topic}/image/metadata"
        entries = self._entries.get(topic, [])
        first, end = (side(entries, time_ns, key=_time_ns) for side in (bisect_left, bisect_right))
        pairs = [self._container.read(topic, entry) for entry in entries[first:end]]
        with self._container.told_at(self._frames(stream)[index]):
            return bag_container.metadata(pairs)

    def settings(self, time_ns: int = STATIC_NS, stream: str = "depth") -> Mapping[str, float]:
        """The options of the stream's sensor in force at a time, by the SDK's names: from the first to `end_ns`.

        The same object is given until one of them changes.
        """
        sensor = self.streams[stream].sensor
        if sensor not in self._options:
            found = [match for topic in self._entries if (match := OPTION.fullmatch(topic))]
            names = {match[0]: match[2] for match in found if int(match[1]) == sensor}
            self._options[sensor] = RecordedOptions(self._container, names)
        return self._options[sensor].at(time_ns)

    def lens(self, stream: str) -> tuple[str, NDArray[np.float64]]:
        """The distortion model of a stream, by the SDK's name, and its coefficients."""
        return bag_container.lens_of(self._first(f"{self.streams[stream].topic}/info/camera_info"))

    def pose(self, stream: str, other: str) -> NDArray[np.float64]:
        """Where another stream's camera is in the frame of a stream's: stream_from_other (4, 4).

        Raises RecordingError where the recording does not tell.
        """
        mine, others = self._poses(stream), self._poses(other)
        if not (groups := mine.keys() & others.keys()):
            raise RecordingError(f"{self.path} does not tell where {other} is seen from, against {stream}")
        group = min(groups)
        return mine[group] @ np.linalg.inv(others[group])

    def _poses(self, stream: str) -> dict[str, NDArray[np.float64]]:
        """stream_from_reference (4, 4) by group: streams of one group have one reference."""
        start, poses = f"{self.streams[stream].topic}/tf/", dict[str, NDArray[np.float64]]()
        for topic, entries in self._entries.items():
            if topic.startswith(start) and entries:
                with self._container.told_at(entries[0]):
                    poses[topic.removeprefix(start)] = bag_container.pose_of(self._container.read(topic, entries[0]))
        return poses

    def depth_unit_m(self) -> float:
        """Metres per depth count. Raises RecordingError where the recording does not tell."""
        info, entry = self.streams["depth"], self._frames("depth")[0]
        with self._container.told_at(entry):
            tail = bag_container.depth_unit_m(self._container.raw(entry))
        unit_m = self.settings().get("depth_units", tail)
        if unit_m is None or not 0 < unit_m < inf:
            raise RecordingError(f"{self.path}: {info.topic} does not tell its depth unit ({unit_m}): record it again")
        return unit_m


def _time_ns(entry: Entry) -> int:
    return entry.time_ns
