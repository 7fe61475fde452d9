"""Messages of the ROS drivers of RealSense cameras, and the bags of ROS 2 that hold them."""

import re
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from backports import zstd
from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag2 import Reader, storage_mcap
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from ruamel.yaml import YAML

from nlos_cam.errors import RecordingError
from nlos_cam.files import TEXT_LIMIT, read_bounded
from nlos_cam.recording import rosbag
from nlos_cam.recording.bag_reader import BagReader
from nlos_cam.recording.formats import METADATA_FILE

METADATA = "realsense2_camera_msgs/msg/Metadata"
METADATA_DEFINITION = "std_msgs/Header header\nstring json_data\n"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
SDK_LENSES = {"plumb_bob": "brown_conrady", "equidistant": "kannala_brandt4"}
"""The SDK's names of distortion models by those of ROS (sensor_msgs), where they differ."""
COMPUTED = re.compile(r"\bas\s*\(|\bvirtual\b|\bgenerated\b", re.IGNORECASE)
"""Words of a table's definition whose columns are computed: their size is not the file's."""


@cache
def ros2_types() -> Typestore:
    """Return the message types of ROS 2. Never those of a file: rosbags compiles them to Python."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(METADATA_DEFINITION, METADATA))
    return types


@cache
def _ros1_types() -> Typestore:
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(METADATA_DEFINITION, "realsense2_camera/msg/Metadata"))
    return types


class Source(Protocol):
    """Messages of a bag, of ROS 1 or ROS 2."""

    @property
    def topics(self) -> Mapping[str, tuple[str, int]]:
        """Message type and number of messages of each topic."""
        ...

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, recorder's time in ns and message, in the order of recording."""
        ...


class Ros1Source:
    """Messages of a .bag, which is read by librealsense's reader with its bounds."""

    def __init__(self, bag: BagReader) -> None:
        self._bag = bag
        self.topics = {
            topic: (bag.types[topic], len(entries)) for topic, entries in bag.entries.items()
        }

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        entries = [
            (entry, topic)
            for topic in topics & self.topics.keys()
            for entry in self._bag.entries[topic]
        ]
        for entry, topic in sorted(entries):
            raw = self._bag.raw(entry)
            yield topic, entry.time_ns, _ros1_types().deserialize_ros1(raw, self.topics[topic][0])


class Ros2Source:
    """Messages of a folder with metadata.yaml, a .db3 or a .mcap.

    Raises RecordingError for a compressed bag, and almost anything for damaged ones.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _bound_chunks()
        for file in _check_folder(path) if path.is_dir() else [path]:
            if not file.is_file():  # opening a pipe would wait for a writer
                raise ValueError(f"{file.name} is not a file")
            if file.suffix == ".db3":
                _check_tables(file)
        self.topics = dict[str, tuple[str, int]]()
        with Reader(path) as reader:
            if len(reader.connections) > rosbag.MAX_CONNECTIONS:
                raise ValueError(f"it has {len(reader.connections)} topics")
            for connection in reader.connections:
                _, before = self.topics.get(connection.topic, ("", 0))
                self.topics[connection.topic] = (connection.msgtype, before + connection.msgcount)

    def messages(self, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
        types = ros2_types()
        with Reader(self.path) as reader:
            _check_chunks(reader)
            wanted = [each for each in reader.connections if each.topic in topics]
            if not wanted:  # rosbags takes no connections for all
                return
            for connection, time_ns, raw in reader.messages(wanted):
                yield connection.topic, time_ns, types.deserialize_cdr(raw, connection.msgtype)


def _check_folder(folder: Path) -> list[Path]:
    """Return the files of a bag's folder. Raises RecordingError for a compressed one."""
    content = YAML(typ="safe").load(read_bounded(folder / METADATA_FILE, TEXT_LIMIT).decode())
    information = content["rosbag2_bagfile_information"]
    mode = str(information.get("compression_mode") or "none").lower()
    if mode != "none":
        raise RecordingError(
            f"{folder} is compressed by {mode[:20]}: decompress it with `ros2 bag convert`, or"
            " record with the compression of .mcap"
        )
    return [folder / Path(str(name)).name for name in information["relative_file_paths"]]


def _check_tables(file: Path) -> None:
    """Raise ValueError for a database whose messages are computed, without bound on their size."""
    with closing(sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)) as database:
        rows = database.execute("select name, type, sql from sqlite_master").fetchall()
    tables = {name: sql for name, kind, sql in rows if kind == "table"}
    for name in ("topics", "messages"):
        if name not in tables:
            raise ValueError(f"it has no table {name}")
        if COMPUTED.search(tables[name] or ""):
            raise ValueError(f"its table {name} is computed")


def _check_chunks(reader: Reader) -> None:
    storages = getattr(reader.storage, "storages", [reader.storage])
    for storage in storages:
        chunks = getattr(storage, "chunks", [])
        if len({chunk.chunk_start_offset for chunk in chunks}) < len(chunks):
            raise ValueError("its index lists a chunk twice")


def _bound_chunks() -> None:
    """Let rosbags unpack no more of a chunk of .mcap than the chunk declares, at most
    CHUNK_LIMIT.
    """

    def bounded(new: Any) -> Any:
        def unpack(packed: bytes, size: int) -> bytes:
            if size > rosbag.CHUNK_LIMIT:
                raise ValueError(f"a chunk of {size} bytes")
            return new().decompress(packed, size + 1)

        return unpack

    storage_mcap.DECOMPRESSORS["lz4"] = bounded(LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS["zstd"] = bounded(zstd.ZstdDecompressor)
