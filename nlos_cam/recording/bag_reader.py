"""Reader of librealsense recordings without librealsense: streams, frames by index, options,
metadata.
"""

import re
from bisect import bisect_left, bisect_right
from bz2 import BZ2Decompressor
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from heapq import merge
from io import BufferedReader, BytesIO, FileIO
from itertools import count, pairwise, repeat
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from nlos_calibration import Gravity, Intrinsics
from nlos_calibration.arrays import Float64
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, RecordType, read_uint32

from nlos_cam.camera import WRAP_PERIOD_S, Sample, gravity_of, repair_command
from nlos_cam.errors import RecordingError
from nlos_cam.files import describe, is_claimed
from nlos_cam.recording import bag_messages, rosbag
from nlos_cam.recording.frame_order import AGREED_S, corrected_times_ns

DEVICE = "/device_0"
STREAM = re.compile(DEVICE + r"/sensor_([0-9]{1,3})/([A-Za-z_]{1,40})_([0-9]{1,3})(?=/image/data$)")
OPTION = re.compile(DEVICE + r"/sensor_([0-9]{1,3})/option/(.{1,80})/value")
ACCELERATION = re.compile(f"({DEVICE}/sensor_[0-9]{{1,3}}/Accel_[0-9]{{1,3}})/imu/data")
MAX_ACCELERATIONS = 1000
MAX_STREAMS = 64
MIN_READS = 2_000_000
BYTES_PER_READ = 100
"""Bound on the reads of an index, two for each entry, so that it cannot fill the memory."""
T = TypeVar("T")
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
MAX_NAMED = 4
ENDS = 4
"""Frames at each end among which one has a stamp that agrees with the next."""
MAX_DRIFT_S = 10.0
"""Bound between the durations by the device's clock and by the recorder's, apart from wraps."""
STATIC_NS = 1
"""The time that librealsense gives to values in force when the recording began."""
SAMPLE = Path(__file__).parent / "sample.bag"
"""Recording that comes with the package: eight frames of the simulated airplane; the name "sample"
stands for it.
"""
ROS2_MARKS = {b"SQLite format": "a ROS 2 bag (.db3)", b"\x89MCAP0\r\n": "a ROS 2 bag (.mcap)"}
"""First bytes of other recordings."""
ROS2_ADVICE = (
    "librealsense 2.58 and ROS 2 record to: record to a .bag (ROS 1), with `nlos-cam capture` or an"
    " earlier librealsense"
)
BEING_RECORDED = "{} is being recorded: it can be read once that has ended"
DECOMPRESSORS = {"lz4": LZ4FrameDecompressor, "bz2": BZ2Decompressor}


class Entry(NamedTuple):
    """Position of a message in the file; entries sort by time, then by position."""

    time_ns: int
    """On the recorder's clock, which starts at 0."""
    chunk_pos: int
    offset: int
    connection: int


@dataclass(frozen=True)
class StreamInfo:
    """Stream of a recording."""

    name: str
    """The SDK's, with the index where that is not 0: depth, infrared, confidence, color,
    infrared_1.
    """
    topic: str
    sensor: int
    encoding: str
    """As the file spells it: mono16, 8UC1, mono8, rgb8, ..."""
    frames_per_s: int
    intrinsics: Intrinsics
    frames: int
    """Number of frames in the index."""

    @property
    def format(self) -> str:
        """The SDK's name of the encoding: z16, y8, raw8, rgb8, ...; empty for one that we cannot
        read.
        """
        return (
            bag_messages.ENCODINGS[self.encoding].sdk_format
            if self.encoding in bag_messages.ENCODINGS
            else ""
        )


@dataclass(frozen=True, slots=True)
class Place:
    """Position of a frame in the order of recording."""

    stream: str
    index: int
    """Among the frames of its stream."""
    time_ns: int
    """When it was recorded, on the recorder's clock, which starts at 0."""


def packaged_or_file(path: Path) -> Path:
    """Return the packaged recording for its name, unless a file is called so; else the path."""
    return SAMPLE if str(path) == SAMPLE.stem and not path.is_file() else path


class BagReader:
    """Recording of any RealSense camera; frames are read on request.

    Opening reads the index into memory. One chunk is cached and no file stays open, so there is
    nothing to close; for one thread at a time. Numbers and timestamps equal those of librealsense's
    playback. Opening and every method raise RecordingError, with the place of the damage.
    """

    def __init__(self, path: Path) -> None:
        self.path = path = packaged_or_file(path)
        self.entries: dict[str, list[Entry]] = {}
        """Messages of each topic, in order of time."""
        self.types: dict[str, str] = {}
        """Message type of each topic, in rosbags' spelling."""
        self.end_ns = 0
        """Time of the last message, on the recorder's clock."""
        self._chunk_pos = -1
        self._chunk = b""
        self._options: dict[int, _SensorOptions] = {}
        self._ordered: dict[str, list[Entry]] = {}
        self._times_ns: dict[str, list[int]] = {}
        """Of each frame in that order, on the recorder's clock."""
        _check_start(path)
        with raise_as_recording_error(path, "is cut short or damaged"):
            self._read_index()
        self.device: Mapping[str, str] = bag_messages.texts_of(self._all(f"{DEVICE}/info"))
        """By the SDK's names: name, serial_number, firmware_version, product_line, ..."""
        matches = [
            match
            for topic, entries in self.entries.items()
            if entries and (match := STREAM.match(topic))
        ]
        with raise_as_recording_error(path, "is damaged"):
            if len(matches) > MAX_STREAMS:
                raise ValueError(f"it has {len(matches)} streams")
            infos = [self._stream_info(*match.groups(), topic=match[0]) for match in matches]
            self.streams: Mapping[str, StreamInfo] = {info.name: info for info in infos}
            """Streams with at least one frame, by name."""
            if len(self.streams) < len(infos):
                raise ValueError("two of its streams have one name")

    def _read_index(self) -> None:
        found: dict[str, list[Entry]] = defaultdict(list)
        _check_topics(self.path)
        with Reader(cast("Any", _BoundedPath(self.path))) as indexed:
            for connection in indexed.connections:
                index = indexed.indexes.pop(
                    connection.id
                )  # half a million tuples for ten minutes: keep one copy
                found[connection.topic].extend(Entry(*place, connection.id) for place in index)
                if (
                    self.types.setdefault(connection.topic, connection.msgtype)
                    != connection.msgtype
                ):
                    raise ValueError(
                        f"messages of two types on {connection.topic[: bag_messages.MAX_TEXT]}"
                    )
        if not found:
            raise ValueError("its index is empty")
        self.entries = {topic: sorted(entries) for topic, entries in found.items()}
        if any(
            one[:3] == two[:3]
            for entries in self.entries.values()
            for one, two in pairwise(entries)
        ):
            raise ValueError("its index lists a message twice")
        self.end_ns = max(
            (entries[-1].time_ns for entries in self.entries.values() if entries), default=0
        )

    def _stream_info(self, sensor: str, kind: str, index: str, topic: str) -> StreamInfo:
        encoding, frames_per_s = self._first(
            f"{topic}/info",
            bag_messages.INFO,
            lambda info: (info.encoding[: bag_messages.MAX_TEXT], info.fps),
        )
        pinhole = self._first(
            f"{topic}/info/camera_info", bag_messages.CAMERA, bag_messages.intrinsics_of
        )
        name = bag_messages.sdk_name(kind if index == "0" else f"{kind}_{index}")
        frames = len(self.entries[f"{topic}/image/data"])
        return StreamInfo(name, topic, int(sensor), encoding, frames_per_s, pinhole, frames)

    def _first(self, topic: str, kind: str, convert: Callable[[Any], T]) -> T:
        if entries := self.entries.get(topic):
            return self.read(topic, entries[0], kind, convert)
        raise RecordingError(
            f"{self.path} has no {topic}, which describes a stream: where a recording is split, the"
            " descriptions are in its first part; take them from there with"
            f" `{repair_command(self.path, take_from='FIRST.bag')}`"
        )

    def _all(self, topic: str) -> list[Any]:
        return [self.read(topic, entry, bag_messages.PAIR) for entry in self.entries.get(topic, ())]

    def check(self) -> None:
        """Read every message, in the order of the file. Raises RecordingError at the first
        damage.
        """
        images = {f"{info.topic}/image/data": info for info in self.streams.values() if info.format}
        messages = [(entry, topic) for topic, entries in self.entries.items() for entry in entries]
        for entry, topic in sorted(
            messages, key=lambda message: (message[0].chunk_pos, message[0].offset)
        ):
            with self._locate(entry):
                raw = self.raw(entry)
                if not bag_messages.is_known(self.types[topic]):
                    continue
                message = bag_messages.parse(
                    raw, self.types[topic], bag_messages.IMAGE if topic in images else ""
                )
                if topic in images:
                    bag_messages.pixels(message, images[topic].encoding, images[topic].intrinsics)

    def read(
        self,
        topic: str,
        entry: Entry,
        kind: str = "",
        convert: Callable[[Any], Any] = lambda it: it,
    ) -> Any:
        """Return a message as rosbags deserialises it, converted; it has to be of the type `kind`,
        if given.
        """
        with self._locate(entry):
            return convert(bag_messages.parse(self.raw(entry), self.types[topic], kind))

    def _locate(self, entry: Entry) -> AbstractContextManager[None]:
        """Raise any exception within the block as a RecordingError that names this place in the
        recording.
        """
        place = (
            f"{entry.time_ns / 1e9:.1f} s into its {self.end_ns / 1e9:.1f} s, at byte"
            f" {entry.chunk_pos}"
        )
        return raise_as_recording_error(self.path, f"is damaged {place}")

    def raw(self, entry: Entry) -> memoryview:
        """Return a message's bytes. Damage can raise almost any exception."""
        if entry.chunk_pos != self._chunk_pos:
            self._chunk = self._read_chunk(entry.chunk_pos)
            self._chunk_pos = entry.chunk_pos
        stream = BytesIO(self._chunk)
        stream.seek(entry.offset)
        header = Header.read(stream, RecordType.MSGDATA)
        if (header.get_time("time"), header.get_uint32("conn")) != (
            entry.time_ns,
            entry.connection,
        ):
            raise ValueError("the index leads to another message")
        size = read_uint32(stream)
        data = memoryview(self._chunk)[stream.tell() : stream.tell() + size]
        if len(data) != size:
            raise ValueError(f"a message of {size} bytes has {len(data)}")
        return data

    def _read_chunk(self, position: int) -> bytes:
        with _BoundedFile(self.path) as file:
            file.seek(position)
            header = Header.read(file, RecordType.CHUNK)
            packed = file.read(read_uint32(file))
        return _unpack(packed, header.get_string("compression"), header.get_uint32("size"))

    def order(self, streams: Iterable[str]) -> Iterator[Place]:
        """Yield the places of all frames of these streams, in the order of recording."""
        each = [
            zip(self._times_ns[stream], frames, repeat(stream), count())
            for stream in streams
            if (frames := self._frames(stream))
        ]
        return (Place(stream, index, time_ns) for time_ns, _, stream, index in merge(*each))

    def _frames(self, stream: str) -> list[Entry]:
        """Return the frames of a stream in their order, which is found once."""
        if stream not in self._ordered:
            entries = self.entries[f"{self.streams[stream].topic}/image/data"]
            try:
                times_ns = corrected_times_ns(entries, self._stamp)
            except RecordingError:  # damaged further on: what comes before it can be played
                times_ns = [entry.time_ns for entry in entries]
            pairs = sorted(zip(times_ns, entries, strict=True))
            self._ordered[stream] = [entry for _, entry in pairs]
            self._times_ns[stream] = [time_ns for time_ns, _ in pairs]
        return self._ordered[stream]

    def _stamp(self, entry: Entry) -> tuple[int, float]:
        """Return a frame's number, and its time in s on the device's clock."""
        with self._locate(entry):
            return bag_messages.stamp(self.raw(entry))

    def duration_s(self, stream: str) -> float:
        """Return the time from the first frame of a stream to its last.

        It is that of the device's clock, between the outermost stamps that agree with those beside
        them, and over its wraps; of the recorder's where none do, or the device's clock started
        again.
        """
        frames = self._frames(stream)
        times_ns = self._times_ns[stream]
        recorded_s = (times_ns[-1] - times_ns[0]) / 1e9
        first = self._first_agreed_s(list(zip(frames[:ENDS], times_ns[:ENDS], strict=True)))
        last = self._first_agreed_s(
            list(zip(frames[: -ENDS - 1 : -1], times_ns[: -ENDS - 1 : -1], strict=True))
        )
        if first is None or last is None:
            return max(recorded_s, 0.0)
        device_s = last - first
        wraps = round((recorded_s - device_s) / WRAP_PERIOD_S)
        unwrapped_s = device_s + wraps * WRAP_PERIOD_S
        if wraps > 0 and abs(recorded_s - unwrapped_s) < MAX_DRIFT_S:
            return unwrapped_s
        return max(recorded_s, 0.0) if device_s < 0 else device_s

    def _first_agreed_s(self, frames: list[tuple[Entry, int]]) -> float | None:
        """Return the first stamp, in s, that is as far from the next as the recorder says; of a
        lone frame its own.
        """
        stamps_s = [self._stamp(entry)[1] for entry, _ in frames]
        if len(stamps_s) == 1:
            return stamps_s[0]
        for k, (one_s, next_s) in enumerate(pairwise(stamps_s)):
            recorded_s = (frames[k + 1][1] - frames[k][1]) / 1e9
            if abs(next_s - one_s - recorded_s) < AGREED_S:
                return one_s
        return None

    def samples(self, streams: Iterable[str]) -> Iterator[Sample]:
        """Yield all frames of these streams, in the order of recording."""
        return (sample for _, sample in self.timed_samples(streams))

    def timed_samples(self, streams: Iterable[str]) -> Iterator[tuple[int, Sample]]:
        """Yield the recorder's time in ns of each frame with it, in the order of recording."""
        return (
            (place.time_ns, self.sample(place.stream, place.index)) for place in self.order(streams)
        )

    def sample(self, stream: str, index: int) -> Sample:
        """Return a frame by its index in its stream. Raises IndexError beyond the last."""
        info = self.streams[stream]
        entry = self._frames(stream)[index]
        if not info.format:
            raise RecordingError(
                f"{self.path}: unsupported encoding of the {stream} stream: {info.encoding}"
            )

        def convert(image: Any) -> Sample:
            pixels = bag_messages.pixels(image, info.encoding, info.intrinsics)
            return Sample(stream, image.header.seq, bag_messages.timestamp_s(image), pixels)

        return self.read(f"{info.topic}/image/data", entry, bag_messages.IMAGE, convert)

    def metadata(self, stream: str, index: int) -> bag_messages.FrameMetadata:
        """Return the metadata of a frame by its index in its stream."""
        frame = self._frames(stream)[index]
        topic = f"{self.streams[stream].topic}/image/metadata"
        entries = self.entries.get(topic, [])
        first, end = (
            side(entries, frame.time_ns, key=lambda e: e.time_ns)
            for side in (bisect_left, bisect_right)
        )
        pairs = [self.read(topic, entry, bag_messages.PAIR) for entry in entries[first:end]]
        with self._locate(frame):
            return bag_messages.metadata(pairs)

    def settings(self, time_ns: int = STATIC_NS, stream: str = "depth") -> Mapping[str, float]:
        """Return the options in force at a time, by the SDK's names, of the sensor of a stream.

        Returns the same mapping until one of them changes.
        """
        sensor = self.streams[stream].sensor
        if sensor not in self._options:
            matches = [match for topic in self.entries if (match := OPTION.fullmatch(topic))]
            names = {
                match[0]: bag_messages.sdk_name(match[2])
                for match in matches
                if int(match[1]) == sensor
            }
            self._options[sensor] = _SensorOptions(self, names)
        return self._options[sensor].at(time_ns)

    def lens(self, stream: str) -> tuple[str, Float64]:
        """Return the distortion model of a stream, by the SDK's name, and its coefficients."""
        return self._first(
            f"{self.streams[stream].topic}/info/camera_info",
            bag_messages.CAMERA,
            bag_messages.lens_of,
        )

    def pose(self, stream: str, other: str) -> Float64:
        """Return stream_from_other (4, 4): the pose of another stream's camera in the frame of this
        stream's.

        Raises RecordingError where the recording holds no common reference of the two.
        """
        pose = self._pose_between(self.streams[stream].topic, self.streams[other].topic)
        if pose is None:
            raise RecordingError(f"{self.path} has no extrinsics between {stream} and {other}")
        return pose

    def gravity(self) -> Gravity | None:
        """Return gravity in the frame of the depth stream by the first second of the accelerometer;
        None without one, where it was moved, and where its samples are damaged.
        """
        topic = next(filter(ACCELERATION.fullmatch, self.entries), None)
        if topic is None:
            return None
        entries = self.entries[topic][:MAX_ACCELERATIONS]
        first = [entry for entry in entries if entry.time_ns - entries[0].time_ns < 1e9]
        with suppress(RecordingError):
            samples = [
                self.read(topic, entry, bag_messages.MOTION, bag_messages.acceleration_of)
                for entry in first
            ]
            sensor = topic.removesuffix("/imu/data")
            pose = self._pose_between(self.streams["depth"].topic, sensor)
            if pose is None:
                pose = np.eye(4)  # the SDK aligns the axes of both
            return gravity_of(samples, pose[:3, :3])
        return None

    def _pose_between(self, stream_topic: str, other_topic: str) -> Float64 | None:
        """Return stream_from_other (4, 4); None where the two have no common reference."""
        mine = self._poses(stream_topic)
        others = self._poses(other_topic)
        if not (groups := mine.keys() & others.keys()):
            return None
        group = min(groups)
        return mine[group] @ np.linalg.inv(others[group])

    def _poses(self, stream_topic: str) -> dict[str, Float64]:
        """Return stream_from_reference (4, 4) by group; the streams of a group share one
        reference.
        """
        start = f"{stream_topic}/tf/"
        poses = dict[str, Float64]()
        for topic, entries in self.entries.items():
            if topic.startswith(start) and entries:
                poses[topic.removeprefix(start)] = self.read(
                    topic, entries[0], bag_messages.TRANSFORM, bag_messages.pose_of
                )
        return poses

    def depth_unit_m(self) -> float:
        """Return metres per depth count. Raises RecordingError where no positive unit is
        recorded.
        """
        info = self.streams["depth"]
        entry = self._frames("depth")[0]
        with self._locate(entry):
            after_image = bag_messages.depth_unit_m(self.raw(entry))
        # Tools that count from another zero move the options in force at the start with the frames.
        start_ns = max(STATIC_NS, entry.time_ns)
        settings = self.settings() or self.settings(start_ns)
        unit_m = settings.get("depth_units", after_image)
        if unit_m is None or not 0 < unit_m < inf:
            raise RecordingError(
                f"{self.path}: {info.topic} has no valid depth unit ({unit_m}): record it again"
            )
        return unit_m


class _SensorOptions:
    """Options of one sensor over time, from the messages that record their changes; caches the last
    values.
    """

    def __init__(self, bag: BagReader, names: Mapping[str, str]) -> None:
        """Take the options' names by the topics of their values."""
        self._bag = bag
        self._names = names
        self._changes = sorted((entry, topic) for topic in names for entry in bag.entries[topic])
        self._applied = 0
        """Number of changes in `_values`."""
        self._values: dict[str, float] = {}

    def at(self, time_ns: int) -> Mapping[str, float]:
        """Return the values in force at a time; the same mapping until one of them changes."""
        due = bisect_right(self._changes, time_ns, key=lambda change: change[0].time_ns)
        if due != self._applied:
            ahead = due > self._applied
            latest = {
                topic: entry for entry, topic in self._changes[self._applied if ahead else 0 : due]
            }
            read = {
                self._names[topic]: self._bag.read(
                    topic, entry, bag_messages.NUMBER, lambda found: float(found.data)
                )
                for topic, entry in latest.items()
            }
            self._values = bag_messages.finite(self._values | read if ahead else read)
            self._applied = due
        return self._values


class _BoundedFile(BufferedReader):
    """File that returns at most its own size in total and a chunk at once, so that absurd lengths
    read short.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self._left = path.stat().st_size
        self._reads = MIN_READS + self._left // BYTES_PER_READ

    def read(self, size: int | None = -1, /) -> bytes:
        wanted = self._left if size is None or size < 0 else size
        data = super().read(min(wanted, self._left, rosbag.CHUNK_LIMIT))
        self._left = self._left - len(data)
        self._reads = self._reads - 1
        if self._reads < 0:
            raise ValueError("its index has more entries than a recording of its size")
        return data


class _BoundedPath:
    """Path for rosbags' Reader that opens a `_BoundedFile`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return True

    def open(self, mode: str) -> _BoundedFile:
        del mode
        return _BoundedFile(self._path)


def _unpack(packed: bytes, compression: str, size: int) -> bytes:
    """Return a chunk's content. Raises ValueError where that has another size than declared, or an
    absurd one.
    """
    if size > rosbag.CHUNK_LIMIT:
        raise ValueError(f"a chunk of {size} bytes")
    if compression == "none":
        content = packed
        whole = True
    else:
        decompressor = DECOMPRESSORS[compression]()
        content = cast(
            "bytes", decompressor.decompress(packed, size + 1)
        )  # one more: reach the checksum at the end
        whole = decompressor.eof
    if len(content) != size or not whole:
        raise ValueError(f"a chunk of {size} bytes has {len(content)}")
    return content


def no_frames(bag: BagReader) -> str:
    """Return an error for a recording without streams, with the topics of images that it has
    instead.
    """
    images = [
        f"{topic} ({len(entries)} images)"
        for topic, entries in bag.entries.items()
        if entries
        and bag.types[topic] in {bag_messages.IMAGE, COMPRESSED_IMAGE}
        and not topic.startswith(DEVICE)
    ]
    if not images:
        return f"{bag.path} holds no frames: record it again"
    named = ", ".join(images[:MAX_NAMED]) + (" and others" if len(images) > MAX_NAMED else "")
    return (
        f"{bag.path} is a bag of a ROS driver, not of librealsense's recorder: it has {named}."
        f" Record with `nlos-cam capture` or the SDK's viewer, whose topics begin with {DEVICE}"
    )


def _check_topics(path: Path) -> None:
    """Raise OverflowError for a file header with absurdly many topics; rosbags reports a damaged
    one.
    """
    with path.open("rb") as file, suppress(rosbag.BagFormatError):
        head = rosbag.read_record(
            rosbag.reader(file.read(rosbag.FILE_HEADER_BYTES)), len(rosbag.MAGIC)
        )
        if (topics := rosbag.number(head.fields, "conn_count")) > rosbag.MAX_CONNECTIONS:
            raise OverflowError(f"it declares {topics} topics")


def _check_start(path: Path) -> None:
    """Raise RecordingError for a path that is not a .bag, before rosbags reports it less
    clearly.
    """
    if not path.is_file():  # opening a pipe would wait for a writer
        problem = (
            "is a directory"
            if path.is_dir()
            else "is not a file"
            if path.exists()
            else "does not exist"
        )
        raise RecordingError(f"{path} {problem}: give the path of a .bag recording")
    with raise_as_recording_error(path, "cannot be read"), path.open("rb") as file:
        start = file.read(len(rosbag.MAGIC))
    if not start:
        raise RecordingError(
            BEING_RECORDED.format(path) if is_claimed(path) else f"{path} is empty: record it again"
        )
    if kind := next((kind for mark, kind in ROS2_MARKS.items() if start.startswith(mark)), ""):
        raise RecordingError(f"{path} is {kind}, which {ROS2_ADVICE}")
    if start != rosbag.MAGIC:
        raise RecordingError(
            f"{path} is not a .bag recording (it starts with {start!r}): give one made by `capture`"
        )


@contextmanager
def raise_as_recording_error(path: Path, problem: str) -> Generator[None]:
    """Raise any exception within the block as a RecordingError of one line, with the command that
    repairs.
    """
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:  # damaged bytes make the libraries raise almost anything
        detail = describe(error)
        if isinstance(error, OSError) and error.strerror:
            raise RecordingError(f"{path} cannot be read: {detail}") from error
        if is_claimed(path):
            raise RecordingError(BEING_RECORDED.format(path)) from error
        if "not indexed" in detail:
            problem = "was never closed"
            detail = "the capture was killed, so it has no index"
        elif "index looks damaged" in detail:
            detail = "its index cannot be read"
        raise RecordingError(f"{path} {problem} ({detail}): {repair_advice(path)}") from error


def repair_advice(path: Path) -> str:
    """Return the advice for a recording that cannot be read to its end."""
    return f"`{repair_command(path)}` recovers the undamaged part"
