"""What librealsense writes into a .bag: its names, and its messages as values.

The .bag container, read through rosbags: its messages, within bounds that no damage breaks.
"""

from bz2 import BZ2Decompressor
from collections import defaultdict
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from io import BufferedReader, BytesIO, FileIO
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from nlos_calibration import Intrinsics
from numpy.typing import NDArray
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, RecordType, read_uint32
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from nlos_cam.camera import repair_command
from nlos_cam.errors import RecordingError
from nlos_cam.recording.rosbag import CHUNK_LIMIT, MAGIC


class Encoding(NamedTuple):
    """How the values of an image are packed."""

    sdk_format: str
    dtype: str
    channels: int
    """Values per pixel."""


ENCODINGS = {
    "mono16": Encoding("z16", "<u2", 1),
    "16UC1": Encoding("y16", "<u2", 1),
    "8UC1": Encoding("y8", "u1", 1),
    "mono8": Encoding("raw8", "u1", 1),
    "rgb8": Encoding("rgb8", "u1", 3),
    "bgr8": Encoding("bgr8", "u1", 3),
    "rgba8": Encoding("rgba8", "u1", 4),
    "bgra8": Encoding("bgra8", "u1", 4),
    "yuv422": Encoding("uyvy", "<u2", 1),
    "YUYV": Encoding("yuyv", "<u2", 1),
}
"""By the name in the file."""
STREAM_INFO = "uint32 fps\nstring encoding\nbool is_recommended\n"
"""Written out here: rosbags makes Python of a definition, and a damaged file's should not become that."""
HAS_TAIL = b"\x01\x00\x00\x001"
"""The frame_id of an image that has its depth unit after it, against its definition; since librealsense 2.49."""
TAIL_BYTES, FRAME_ID_AT = 4, 12
UNIT_TOLERANCE = 1e-3


@cache
def _types() -> Typestore:
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(STREAM_INFO, "realsense_msgs/msg/StreamInfo"))
    return types


def is_known(message_type: str) -> bool:
    """Whether `parse` takes messages of this type; librealsense has some more of its own."""
    return message_type in _types().fielddefs


def parse(raw: memoryview, message_type: str) -> Any:
    """A message as rosbags has it. Raises nearly anything for bytes that are none."""
    if message_type == "sensor_msgs/msg/Image" and _has_tail(raw):
        raw = raw[:-TAIL_BYTES]
    return _types().deserialize_ros1(raw, message_type)


def _has_tail(raw: memoryview) -> bool:
    return bytes(raw[FRAME_ID_AT : FRAME_ID_AT + len(HAS_TAIL)]) == HAS_TAIL


def depth_unit_m(raw: memoryview) -> float | None:
    """The unit in the tail of an image; None where it has none."""
    return float(np.frombuffer(raw[-TAIL_BYTES:], "<f4")[0]) if _has_tail(raw) else None


def sdk_name(name: str) -> str:
    """The name that the SDK's Python wheel gives to what librealsense calls so: "Depth Units" is depth_units."""
    return name.lower().replace(" ", "_").replace("-", "_")


def timestamp_s(image: Any) -> float:
    """The frame's time on the device's clock, rounded as librealsense rounds it."""
    stamp = image.header.stamp
    return (stamp.sec + 1e-9 * stamp.nanosec) * 1e3 / 1e3


def pixels(image: Any, encoding: str, intrinsics: Intrinsics) -> NDArray[Any]:
    """An image's values, (height, width) or (height, width, values per pixel).

    A device may deliver another size than it tells; its rows then follow without a gap. Raises ValueError for an image
    that contradicts itself.
    """
    _, dtype, channels = ENCODINGS[encoding]
    is_usual = (image.width, image.height) == (intrinsics.width, intrinsics.height)
    is_whole = image.step == image.width * channels * np.dtype(dtype).itemsize
    if image.encoding != encoding or not (is_usual or is_whole):
        raise ValueError(f"an image of {image.width} x {image.height} {image.encoding}")
    rows = image.data.reshape(image.height, image.step)
    values = np.array(rows[:, : image.width * channels * np.dtype(dtype).itemsize]).view(dtype)
    return values.reshape(image.height, image.width, *([channels] if channels > 1 else []))


def intrinsics_of(info: Any) -> Intrinsics:
    """The pinhole of a CameraInfo."""
    return Intrinsics(info.width, info.height, *(float(info.K[i]) for i in (0, 4, 2, 5)))


def lens_of(info: Any) -> tuple[str, NDArray[np.float64]]:
    """The distortion of a CameraInfo: its model by the SDK's name, and its coefficients."""
    return sdk_name(info.distortion_model), np.asarray(info.D, np.float64)


def pose_of(transform: Any) -> NDArray[np.float64]:
    """A Transform as a matrix (4, 4). Raises ValueError where its quaternion turns nothing."""
    turn, shift = transform.rotation, transform.translation
    x, y, z, w = quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) < UNIT_TOLERANCE:
        raise ValueError(f"a rotation by the quaternion {quaternion.tolist()}")
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    pose = np.eye(4)
    pose[:3, :3] += 2.0 * w * across + 2.0 * across @ across
    pose[:3, 3] = shift.x, shift.y, shift.z
    return pose


@dataclass(frozen=True)
class FrameMetadata:
    """What is told of a frame besides its image."""

    domain: str
    """Whose clock its timestamp is of: hardware_clock, system_time or global_time; empty where that is not told."""
    values: dict[str, float]
    """By the SDK's name: frame_counter, frame_laser_power, ...; and system_time."""


def metadata(pairs: list[Any]) -> FrameMetadata:
    """The metadata of a frame from its KeyValue messages."""
    found = {sdk_name(pair.key): pair.value for pair in pairs}
    domain = sdk_name(found.pop("timestamp_domain", ""))
    return FrameMetadata(domain, {name: float(value) for name, value in found.items()})


MAX_BYTES = CHUNK_LIMIT
"""Of a chunk; librealsense begins a new one after 768 kB."""
DECOMPRESSORS = {"lz4": LZ4FrameDecompressor, "bz2": BZ2Decompressor}


class Entry(NamedTuple):
    """Where a message is; entries sort by time, then by place in the file."""

    time_ns: int
    """On the recorder's clock, which starts at 0."""
    chunk_pos: int
    offset: int
    connection: int


class _BoundedFile(BufferedReader):
    """A file that gives no more in all than it holds, and at most a chunk at once: absurd lengths read short."""

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self._left = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        wanted = self._left if size is None or size < 0 else size
        found = super().read(min(wanted, self._left, MAX_BYTES))
        self._left -= len(found)
        return found


class _BoundedPath:
    """What rosbags takes for a path."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return True

    def open(self, mode: str) -> _BoundedFile:
        del mode
        return _BoundedFile(self._path)


class BagContainer:
    """The messages of an indexed .bag by topic. Holds the index and one chunk; no file stays open.

    Raises RecordingError, on opening and on reading, for whatever cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, list[Entry]] = {}
        """Of each topic, in order."""
        self.types: dict[str, str] = {}
        """Of each topic, as rosbags names message types."""
        self.end_ns = 0
        """The time of the last message."""
        self._chunk_pos, self._chunk = -1, b""
        _check_start(path)
        with told(path, "is cut short or damaged"):
            self._read_index()

    def _read_index(self) -> None:
        found: dict[str, list[Entry]] = defaultdict(list)
        with Reader(cast("Any", _BoundedPath(self.path))) as reader:
            for connection in reader.connections:
                index = reader.indexes.pop(connection.id)  # of ten minutes, it is half a million tuples
                found[connection.topic].extend(Entry(*place, connection.id) for place in index)
                self.types[connection.topic] = connection.msgtype
        if not found:
            raise ValueError("its index lists nothing")
        self.entries = {topic: sorted(entries) for topic, entries in found.items()}
        self.end_ns = max((entries[-1].time_ns for entries in self.entries.values() if entries), default=0)

    def everything(self) -> Iterator[tuple[str, Entry, Any]]:
        """Every message with its topic, in the order of the file; None for one of a type that `parse` does not know."""
        each = [(entry, topic) for topic, entries in self.entries.items() for entry in entries]
        for entry, topic in sorted(each, key=lambda found: (found[0].chunk_pos, found[0].offset)):
            with self.told_at(entry):
                raw, message_type = self.raw(entry), self.types[topic]
                message = parse(raw, message_type) if is_known(message_type) else None
            yield topic, entry, message

    def read(self, topic: str, entry: Entry) -> Any:
        """A message, as `parse` gives it."""
        with self.told_at(entry):
            return parse(self.raw(entry), self.types[topic])

    def told_at(self, entry: Entry) -> AbstractContextManager[None]:
        """Raise what goes wrong within as a RecordingError that says where in the recording this is."""
        place = f"{entry.time_ns / 1e9:.1f} s into its {self.end_ns / 1e9:.1f} s, at byte {entry.chunk_pos}"
        return told(self.path, f"is damaged {place}")

    def damage(self, what: str) -> RecordingError:
        """The error for a recording that lacks what it should have."""
        return RecordingError(f"{self.path} is damaged ({what}): {advice(self.path)}")

    def raw(self, entry: Entry) -> memoryview:
        """A message's bytes. Raises nearly anything for damaged ones."""
        if entry.chunk_pos != self._chunk_pos:
            self._chunk, self._chunk_pos = self._read_chunk(entry.chunk_pos), entry.chunk_pos
        stream = BytesIO(self._chunk)
        stream.seek(entry.offset)
        header = Header.read(stream, RecordType.MSGDATA)
        if (header.get_time("time"), header.get_uint32("conn")) != (entry.time_ns, entry.connection):
            raise ValueError("the index leads to another message")
        size = read_uint32(stream)
        found = memoryview(self._chunk)[stream.tell() : stream.tell() + size]
        if len(found) != size:
            raise ValueError(f"a message of {size} bytes has {len(found)}")
        return found

    def _read_chunk(self, position: int) -> bytes:
        with _BoundedFile(self.path) as file:
            file.seek(position)
            header = Header.read(file, RecordType.CHUNK)
            packed = file.read(read_uint32(file))
        return _unpacked(packed, header.get_string("compression"), header.get_uint32("size"))


def _unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """A chunk's content, which must be of `size`. Raises ValueError where it is not, or that is absurd."""
    if size > MAX_BYTES:
        raise ValueError(f"a chunk of {size} bytes")
    if compression == "none":
        content, whole = packed, True
    else:
        decompressor = DECOMPRESSORS[compression]()
        content = cast("bytes", decompressor.decompress(packed, size + 1))  # one more: on to the checksum at the end
        whole = decompressor.eof
    if len(content) != size or not whole:
        raise ValueError(f"a chunk of {size} bytes has {len(content)}")
    return content


def _check_start(path: Path) -> None:
    """Say what is wrong with a file in words of our own, before rosbags does in its."""
    if not path.exists():
        raise RecordingError(f"{path} does not exist: give the path of a .bag recording")
    if not path.is_file():  # a pipe would be waited for
        kind = "a folder" if path.is_dir() else "no file"
        raise RecordingError(f"{path} is {kind}: give the path of a .bag recording")
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    if not start:
        raise RecordingError(f"{path} is empty: record it again")
    if start != MAGIC:
        raise RecordingError(f"{path} is not a .bag recording (it starts with {start!r}): give one made by `capture`")


@contextmanager
def told(path: Path, what: str) -> Generator[None]:
    """Raise what goes wrong within as a RecordingError of one line that says what to do."""
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:  # damaged bytes make the libraries raise nearly anything
        if isinstance(error, OSError) and error.strerror:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
        detail = " ".join(str(error).split()) or "its parts do not fit together"
        if "not indexed" in detail:
            what, detail = "was never closed", "its recording was killed, so it has no index"
        elif "index looks damaged" in detail:
            detail = "its index cannot be read"
        raise RecordingError(f"{path} {what} ({detail}): {advice(path)}") from error


def advice(path: Path) -> str:
    """What to do about a recording that cannot be read to its end."""
    return f"`{repair_command(path)}` recovers what is whole in it"
