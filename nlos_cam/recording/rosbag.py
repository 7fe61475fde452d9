"""The records of a ROS bag (format 2.0): read with every length checked against what is there, and written.

A record is a header of named fields and data, each behind its length (wiki.ros.org/Bags/Format/2.0). Numbers are
little-endian. A chunk's data are records too, packed as its compression says.

The connections and messages in a chunk of a bag, unpacked: where they lie, and up to where they are whole.
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, IntEnum

MAGIC = b"#ROSBAG V2.0\n"
HEADER_LIMIT = 1 << 16
"""Bytes of fields; real ones have some hundred."""
CHUNK_LIMIT = 64 << 20
"""Bytes of a chunk, unpacked; librealsense closes a chunk after 768 KiB and the image that passes that."""
FILE_HEADER_BYTES = 4096
"""Fields and padding of a file's first record."""
ENTRY_BYTES = 12
"""An index's entry: a message's time (4 bytes of seconds, 4 of nanoseconds) and its offset in its chunk's content."""
SET_UP_TIME = struct.pack("<II", 0, 1)
"""What librealsense stamps on all that describes the device: before any frame."""

Read = Callable[[int, int], bytes]
"""Called with where and how many; gives as many bytes as are there."""
Fields = Mapping[str, bytes]


class BagFormatError(ValueError):
    """Bytes that are not the record they should be; never leaves the package."""


class BagCutError(BagFormatError):
    """A record that the file's end cuts off."""


CUT = "the file ends within it"


class Op(IntEnum):
    """What a record is."""

    MESSAGE = 2
    FILE_HEADER = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


@dataclass(frozen=True, slots=True)
class BagRecord:
    """A record's fields, and where its data lies; whether all of it is there, is for the reader to check."""

    op: Op
    fields: Fields
    data_at: int
    data_bytes: int

    @property
    def end(self) -> int:
        """Where the next record starts."""
        return self.data_at + self.data_bytes


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic, the number that messages call it by, and its description word for word."""

    number: int
    topic: str
    kind: str
    """The messages' type, as package/Name."""
    md5sum: bytes
    """Of the type's definition."""
    record: bytes

    def is_like(self, other: "Connection") -> bool:
        """Whether a message of the one can be read as one of the other."""
        return (self.topic, self.kind, self.md5sum) == (other.topic, other.kind, other.md5sum)


def read_record(read: Read, at: int) -> BagRecord:
    """The record at that place. Raises BagFormatError where there is none."""
    head = read(at, 4)
    if len(head) < 4:
        raise BagCutError(CUT)
    header_bytes = _number(head, 4)
    if header_bytes > HEADER_LIMIT:
        raise BagFormatError(f"a record's header claims {header_bytes} bytes")
    header = read(at + 4, header_bytes + 4)
    if len(header) < header_bytes + 4:
        raise BagCutError(CUT)
    fields = parse_fields(header[:header_bytes])
    return BagRecord(_op(fields), fields, at + 8 + header_bytes, _number(header[header_bytes:], 4))


def parse_fields(header: bytes) -> dict[str, bytes]:
    """The fields of a header. Raises BagFormatError where they do not fill it exactly."""
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        start = at + 4
        at = start + _number(header[at:start], 4)
        name, equals, value = header[start:at].partition(b"=")
        if at > len(header) or not equals or not name.isascii():
            raise BagFormatError("a header's field is damaged")
        fields[name.decode()] = value
    return fields


def _op(fields: Fields) -> Op:
    try:
        return Op(_number(_field(fields, "op"), 1))
    except ValueError as error:
        raise BagFormatError("a record is of no known kind") from error


def _field(fields: Fields, name: str) -> bytes:
    try:
        return fields[name]
    except KeyError:
        raise BagFormatError(f"a record lacks its field {name!r}") from None


def _number(value: bytes, size: int) -> int:
    if len(value) != size:
        raise BagFormatError(f"a number of {size} bytes has {len(value)}")
    return int.from_bytes(value, "little")


def number(fields: Fields, name: str, size: int = 4) -> int:
    """A field as an unsigned number of that many bytes. Raises BagFormatError where it is none."""
    return _number(_field(fields, name), size)


def text(fields: Fields, name: str) -> str:
    """A field as text. Raises BagFormatError where it is none."""
    try:
        return _field(fields, name).decode()
    except UnicodeDecodeError as error:
        raise BagFormatError(f"a record's field {name!r} is not text") from error


def message_key(record: BagRecord) -> tuple[int, bytes]:
    """A message's connection number and time (8 bytes: seconds, nanoseconds). Raises BagFormatError."""
    time = _field(record.fields, "time")
    if len(time) != len(SET_UP_TIME):
        raise BagFormatError("a message's time is damaged")
    return number(record.fields, "conn"), time


def read_connection(read: Read, record: BagRecord) -> Connection:
    """What a connection record says. Raises BagFormatError where any reader of bags would stumble over it."""
    if record.data_bytes > HEADER_LIMIT:
        raise BagFormatError(f"the description of a connection claims {record.data_bytes} bytes")
    data = read(record.data_at, record.data_bytes)
    if len(data) < record.data_bytes:
        raise BagCutError(CUT)
    described = parse_fields(data)
    for name in described:
        text(described, name)
    topic, kind = text(record.fields, "topic"), text(described, "type")
    if not topic.isprintable() or not topic.startswith("/") or not re.fullmatch(r"\w+/\w+", kind):
        raise BagFormatError("the description of a connection is damaged")
    _field(described, "message_definition")
    written = pack_record(record.fields, data)
    return Connection(number(record.fields, "conn"), topic, kind, _field(described, "md5sum"), written)


def check_bookkeeping(read: Read, record: BagRecord) -> None:
    """Raise BagFormatError for a file header, index or chunk info whose length cannot be right."""
    if record.op is Op.INDEX and record.data_bytes != ENTRY_BYTES * number(record.fields, "count"):
        raise BagFormatError("an index's length does not fit its entries")
    if record.op is Op.CHUNK_INFO and record.data_bytes != 8 * number(record.fields, "count"):
        raise BagFormatError("a chunk info's length does not fit its entries")
    if record.op is Op.FILE_HEADER and record.data_bytes > HEADER_LIMIT:
        raise BagFormatError(f"the file's header claims {record.data_bytes} bytes")
    if record.op is Op.FILE_HEADER and read(record.data_at, record.data_bytes).strip(b" \0"):
        raise BagFormatError("the file's header is damaged")


def pack_record(fields: Fields, data: bytes) -> bytes:
    """A whole record."""
    return pack_head(fields, len(data)) + data


def pack_head(fields: Fields, data_bytes: int) -> bytes:
    """A record up to its data."""
    named = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(len(field).to_bytes(4, "little") + field for field in named)
    return len(header).to_bytes(4, "little") + header + data_bytes.to_bytes(4, "little")


def pack_file_header(connections: int, chunks: int, index_at: int) -> bytes:
    """A file's first record, padded so that it can be written again in place."""
    fields = {
        "chunk_count": chunks.to_bytes(4, "little"),
        "conn_count": connections.to_bytes(4, "little"),
        "index_pos": index_at.to_bytes(8, "little"),
        "op": bytes([Op.FILE_HEADER]),
    }
    padding = FILE_HEADER_BYTES + 8 - len(pack_head(fields, 0))
    return pack_record(fields, b" " * padding)


def pack_chunk_head(compression: str, size: int, data_bytes: int) -> bytes:
    """A chunk up to its data; `size` is that of its content, unpacked."""
    fields = {
        "compression": compression.encode(),
        "op": bytes([Op.CHUNK]),
        "size": size.to_bytes(4, "little"),
    }
    return pack_head(fields, data_bytes)


def pack_index(connection: int, entries: bytes) -> bytes:
    """Where one connection's messages lie in a chunk, ENTRY_BYTES for each."""
    fields = {
        "conn": connection.to_bytes(4, "little"),
        "count": (len(entries) // ENTRY_BYTES).to_bytes(4, "little"),
        "op": bytes([Op.INDEX]),
        "ver": (1).to_bytes(4, "little"),
    }
    return pack_record(fields, entries)


def pack_chunk_info(chunk_at: int, index: Mapping[int, bytes]) -> bytes:
    """What a chunk holds: how many messages of each connection, from when to when; `index` has their entries."""
    ends = [(entries[:8], entries[-ENTRY_BYTES:-4]) for entries in index.values()]
    times = [struct.unpack("<II", time) for pair in ends for time in pair]
    counts = [struct.pack("<II", connection, len(entries) // ENTRY_BYTES) for connection, entries in index.items()]
    fields = {
        "chunk_pos": chunk_at.to_bytes(8, "little"),
        "count": len(index).to_bytes(4, "little"),
        "end_time": struct.pack("<II", *max(times)),
        "op": bytes([Op.CHUNK_INFO]),
        "start_time": struct.pack("<II", *min(times)),
        "ver": (1).to_bytes(4, "little"),
    }
    return pack_record(fields, b"".join(counts))


class Ending(Enum):
    """How a chunk's data ends."""

    WHOLE = "whole"
    CUT = "cut off"
    BROKEN = "broken"


@dataclass(frozen=True)
class Content:
    """The records in a chunk, as far as they can be read."""

    connections: dict[int, Connection]
    index: dict[int, bytes]
    """Of each connection, its entries as in an index record, sorted by time."""
    bytes: int
    """Up to here all is whole."""
    ending: Ending
    why: str
    """What is wrong with the bytes after that; empty if nothing is."""


def read_content(read: Read, at: int, end: int, expected_bytes: int) -> Content:
    """The connections and messages from `at` on: to `expected_bytes` further, if a record ends there, else to where
    something else comes, at most to `end`.
    """
    connections: dict[int, Connection] = {}
    entries: dict[int, list[bytes]] = {}
    reached, ending, why = at, Ending.WHOLE, ""
    try:
        for start, record in _confirmed(_records(read, at, end, expected_bytes)):
            if record.op is Op.CONNECTION:
                found = read_connection(read, record)
                connections[found.number] = found
            else:
                connection, time = message_key(record)
                entries.setdefault(connection, []).append(time + (start - at).to_bytes(4, "little"))
            reached = record.end
    except BagCutError as error:
        ending, why = Ending.CUT, str(error)
    except BagFormatError as error:
        ending, why = Ending.BROKEN, str(error)
    index = {connection: b"".join(sorted(found, key=_time)) for connection, found in sorted(entries.items())}
    return Content(connections, index, reached - at, ending, why)


def _records(read: Read, at: int, end: int, expected_bytes: int) -> Iterator[tuple[int, BagRecord]]:
    """Messages and connections, and where each starts. Raises BagFormatError where neither comes."""
    expected_end = at + expected_bytes
    while at != expected_end and read(at, 1):
        record = read_record(read, at)
        if record.op not in {Op.MESSAGE, Op.CONNECTION}:
            return
        if not read(record.end - 1, 1):
            raise BagCutError(CUT)
        if record.end > end:
            raise BagFormatError(f"it holds more than {CHUNK_LIMIT >> 20} MiB")
        yield at, record
        at = record.end


def _confirmed(records: Iterator[tuple[int, BagRecord]]) -> Iterator[tuple[int, BagRecord]]:
    """All but the one before damage: its length may be what is wrong."""
    last: tuple[int, BagRecord] | None = None
    try:
        for found in records:
            if last:
                yield last
            last = found
    except BagCutError:
        if last:
            yield last
        raise
    if last:
        yield last


def _time(entry: bytes) -> tuple[int, int]:
    seconds, nanoseconds = struct.unpack_from("<II", entry)
    return seconds, nanoseconds


def set_up_records(read: Read) -> Iterator[tuple[int, BagRecord]]:
    """What describes the device, and the connections, and where each starts; as far as records are whole."""
    with suppress(BagFormatError):
        for start, record in _records(read, 0, CHUNK_LIMIT, CHUNK_LIMIT):
            if record.op is Op.CONNECTION or message_key(record)[1] == SET_UP_TIME:
                yield start, record


def reader(content: bytes) -> Read:
    """Read from memory."""
    return lambda at, count: content[at : at + count]
