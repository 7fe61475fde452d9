"""Records of a ROS bag (format 2.0): reading with every length checked, packing, and the contents
of a chunk.

A record is a header of named fields and data, each after its length (wiki.ros.org/Bags/Format/2.0).
Numbers are little-endian. The data of a chunk are records too, compressed as its header says.
"""

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, IntEnum

MAGIC = b"#ROSBAG V2.0\n"
HEADER_LIMIT = 1 << 16
"""Bound on the bytes of a header; real ones have some hundred."""
CHUNK_LIMIT = 64 << 20
"""Bound on the bytes of an unpacked chunk; librealsense closes one after 768 KiB and the image that
exceeds that.
"""
FILE_HEADER_BYTES = 4096
"""Fields and padding of a file's first record."""
ENTRY_BYTES = 12
"""Index entry: a message's time (4 bytes of seconds, 4 of nanoseconds) and its offset in the
unpacked chunk.
"""
SET_UP_TIME = struct.pack("<II", 0, 1)
"""The time that librealsense gives to all that describes the device, before any frame."""

Fields = Mapping[str, bytes]


class BagFormatError(ValueError):
    """Bytes that are not the expected record; never leaves the package."""


class BagCutError(BagFormatError):
    """A record that extends beyond the end of the file."""


class BagBudgetError(Exception):
    """More work than a file of its size deserves; never leaves the package."""


CUT = "file truncated"
MAX_CONNECTIONS = 10_000
"""Bound on the topics of a file; librealsense writes some hundred."""
MIN_WORK = 4_000_000
BYTES_PER_WORK = 8
"""Bound on the work for a file: calls that read, and 4 KiB read or unpacked; a record takes
four.
"""


class Budget:
    """Work left for a file, from its size in bytes, so that crafted files end in bounded time and
    memory.
    """

    def __init__(self, file_bytes: int) -> None:
        self._left = MIN_WORK + file_bytes // BYTES_PER_WORK

    def spend(self, work: int) -> None:
        """Take from the work left. Raises BagBudgetError when none is."""
        self._left -= work
        if self._left < 0:
            raise BagBudgetError("more work than a recording of this size can need")


@dataclass(frozen=True, slots=True)
class Source:
    """Bytes to read; called with an offset and a number of bytes, it returns those, fewer at the
    end.
    """

    fetch: Callable[[int, int], bytes]
    budget: Budget

    def __call__(self, at: int, count: int) -> bytes:
        self.budget.spend(1 + (count >> 12))
        return self.fetch(at, count)

    def over(self, content: bytes) -> "Source":
        """Return a source of bytes in memory, unpacked from this one."""
        self.budget.spend(len(content) >> 12)
        return Source(lambda at, count: content[at : at + count], self.budget)


def reader(content: bytes) -> Source:
    """Return a source of bytes in memory."""
    return Source(lambda at, count: content[at : at + count], Budget(len(content)))


class Op(IntEnum):
    """Kind of a record."""

    MESSAGE = 2
    FILE_HEADER = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


@dataclass(frozen=True, slots=True)
class BagRecord:
    """Fields of a record, and the place of its data, which may extend beyond the end of the
    file.
    """

    op: Op
    fields: Fields
    data_at: int
    data_bytes: int

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.data_at + self.data_bytes


@dataclass(frozen=True, slots=True)
class Connection:
    """Topic, the number by which messages refer to it, and its description, verbatim."""

    number: int
    topic: str
    kind: str
    """Type of the messages, as package/Name."""
    md5sum: bytes
    """Of the type's definition."""
    record: bytes

    def is_like(self, other: "Connection") -> bool:
        """Return whether both have the same topic and message type."""
        return (self.topic, self.kind, self.md5sum) == (other.topic, other.kind, other.md5sum)


def read_record(read: Source, at: int) -> BagRecord:
    """Return the record at an offset. Raises BagFormatError where there is none."""
    head = read(at, 4)
    if len(head) < 4:
        raise BagCutError(CUT)
    header_bytes = _number(head, 4)
    if header_bytes > HEADER_LIMIT:
        raise BagFormatError(f"implausible record header of {header_bytes} bytes")
    header = read(at + 4, header_bytes + 4)
    if len(header) < header_bytes + 4:
        raise BagCutError(CUT)
    fields = parse_fields(header[:header_bytes])
    try:
        op = Op(number(fields, "op", 1))
    except ValueError as error:
        raise BagFormatError("record of unknown kind") from error
    return BagRecord(op, fields, at + 8 + header_bytes, _number(header[header_bytes:], 4))


def parse_fields(header: bytes) -> dict[str, bytes]:
    """Return the fields of a header. Raises BagFormatError where they do not fill it exactly."""
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        start = at + 4
        at = start + _number(header[at:start], 4)
        name, equals, value = header[start:at].partition(b"=")
        if at > len(header) or not equals or not name.isascii():
            raise BagFormatError("damaged field of a record header")
        fields[name.decode()] = value
    return fields


def _field(fields: Fields, name: str) -> bytes:
    try:
        return fields[name]
    except KeyError:
        raise BagFormatError(f"record without its field {name!r}") from None


def _number(value: bytes, size: int) -> int:
    if len(value) != size:
        raise BagFormatError(f"number of {len(value)} bytes in place of {size}")
    return int.from_bytes(value, "little")


def number(fields: Fields, name: str, size: int = 4) -> int:
    """Return a field as an unsigned number of `size` bytes. Raises BagFormatError for another
    size.
    """
    return _number(_field(fields, name), size)


def text(fields: Fields, name: str) -> str:
    """Return a field as text. Raises BagFormatError where it is not UTF-8."""
    try:
        return _field(fields, name).decode()
    except UnicodeDecodeError as error:
        raise BagFormatError(f"record whose field {name!r} is not text") from error


def message_key(record: BagRecord) -> tuple[int, bytes]:
    """Return a message's connection number and time (8 bytes: seconds, nanoseconds). Raises
    BagFormatError.
    """
    time = _field(record.fields, "time")
    if len(time) != len(SET_UP_TIME):
        raise BagFormatError("message with a damaged time")
    return number(record.fields, "conn"), time


def read_connection(read: Source, record: BagRecord) -> Connection:
    """Return a connection record's content. Raises BagFormatError for one that readers of bags
    would refuse.
    """
    if record.data_bytes > HEADER_LIMIT:
        raise BagFormatError(f"implausible connection of {record.data_bytes} bytes")
    data = read(record.data_at, record.data_bytes)
    if len(data) < record.data_bytes:
        raise BagCutError(CUT)
    description = parse_fields(data)
    for name in description:
        text(description, name)
    topic = text(record.fields, "topic")
    kind = text(description, "type")
    if not topic.isprintable() or not topic.startswith("/") or not re.fullmatch(r"\w+/\w+", kind):
        raise BagFormatError("damaged description of a connection")
    _field(description, "message_definition")
    packed = pack_record(record.fields, data)
    return Connection(
        number(record.fields, "conn"), topic, kind, _field(description, "md5sum"), packed
    )


def add_connection(connections: dict[int, Connection], found: Connection) -> None:
    """Add a connection by its number. Raises BagFormatError beyond MAX_CONNECTIONS."""
    connections[found.number] = found
    if len(connections) > MAX_CONNECTIONS:
        raise BagFormatError(f"more than {MAX_CONNECTIONS} topics")


def check_bookkeeping(read: Source, record: BagRecord) -> None:
    """Raise BagFormatError for a file header, index or chunk info of an impossible length."""
    if record.op is Op.INDEX and record.data_bytes != ENTRY_BYTES * number(record.fields, "count"):
        raise BagFormatError("index whose length contradicts its number of entries")
    if record.op is Op.CHUNK_INFO and record.data_bytes != 8 * number(record.fields, "count"):
        raise BagFormatError("chunk info whose length contradicts its number of entries")
    if record.op is Op.FILE_HEADER and record.data_bytes > HEADER_LIMIT:
        raise BagFormatError(f"implausible file header of {record.data_bytes} bytes")
    if record.op is Op.FILE_HEADER and read(record.data_at, record.data_bytes).strip(b" \0"):
        raise BagFormatError("damaged file header")


def pack_record(fields: Fields, data: bytes) -> bytes:
    """Return the bytes of a record."""
    return pack_head(fields, len(data)) + data


def pack_head(fields: Fields, data_bytes: int) -> bytes:
    """Return the bytes of a record up to its data."""
    named = [name.encode() + b"=" + value for name, value in fields.items()]
    header = b"".join(len(field).to_bytes(4, "little") + field for field in named)
    return len(header).to_bytes(4, "little") + header + data_bytes.to_bytes(4, "little")


def pack_file_header(connections: int, chunks: int, index_at: int) -> bytes:
    """Return the first record of a file, padded to a fixed length so that it can be overwritten in
    place.
    """
    fields = {
        "chunk_count": chunks.to_bytes(4, "little"),
        "conn_count": connections.to_bytes(4, "little"),
        "index_pos": index_at.to_bytes(8, "little"),
        "op": bytes([Op.FILE_HEADER]),
    }
    padding = FILE_HEADER_BYTES + 8 - len(pack_head(fields, 0))
    return pack_record(fields, b" " * padding)


def pack_chunk_head(compression: str, size: int, data_bytes: int) -> bytes:
    """Return a chunk up to its data; `size` counts the unpacked bytes."""
    fields = {
        "compression": compression.encode(),
        "op": bytes([Op.CHUNK]),
        "size": size.to_bytes(4, "little"),
    }
    return pack_head(fields, data_bytes)


def pack_index(connection: int, entries: bytes) -> bytes:
    """Return the index of one connection's messages in a chunk, from entries of ENTRY_BYTES."""
    fields = {
        "conn": connection.to_bytes(4, "little"),
        "count": (len(entries) // ENTRY_BYTES).to_bytes(4, "little"),
        "op": bytes([Op.INDEX]),
        "ver": (1).to_bytes(4, "little"),
    }
    return pack_record(fields, entries)


def pack_chunk_info(chunk_at: int, index: Mapping[int, bytes]) -> bytes:
    """Return the summary of a chunk: message counts by connection, and the time span, from its
    index entries.
    """
    ends = [(entries[:8], entries[-ENTRY_BYTES:-4]) for entries in index.values()]
    times = [struct.unpack("<II", time) for pair in ends for time in pair]
    counts = [
        struct.pack("<II", connection, len(entries) // ENTRY_BYTES)
        for connection, entries in index.items()
    ]
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
    """Condition of a chunk's data at its end."""

    WHOLE = "whole"
    CUT = "cut off"
    BROKEN = "broken"


@dataclass(frozen=True)
class Content:
    """Readable records of a chunk."""

    connections: dict[int, Connection]
    index: dict[int, bytes]
    """Entries of each connection as in an index record, sorted by time."""
    bytes: int
    """Length of the undamaged part."""
    ending: Ending
    why: str
    """Damage after that; empty if there is none."""


def read_content(read: Source, at: int, end: int, expected_bytes: int) -> Content:
    """Return the connections and messages from `at` on.

    They end after `expected_bytes`, if a record ends there, else at the first record of another
    kind, at most at `end`.
    """
    connections: dict[int, Connection] = {}
    entries: dict[int, list[bytes]] = {}
    reached = at
    ending = Ending.WHOLE
    why = ""
    try:
        for start, record in _confirmed(_records(read, at, end, expected_bytes)):
            if record.op is Op.CONNECTION:
                add_connection(connections, read_connection(read, record))
            else:
                connection, time = message_key(record)
                entries.setdefault(connection, []).append(time + (start - at).to_bytes(4, "little"))
            reached = record.end
    except BagCutError as error:
        ending = Ending.CUT
        why = str(error)
    except BagFormatError as error:
        ending = Ending.BROKEN
        why = str(error)
    by_time = {
        number: sorted(found, key=lambda e: struct.unpack_from("<II", e))
        for number, found in entries.items()
    }
    index = {number: b"".join(by_time[number]) for number in sorted(by_time)}
    return Content(connections, index, reached - at, ending, why)


def _records(
    read: Source, at: int, end: int, expected_bytes: int
) -> Iterator[tuple[int, BagRecord]]:
    """Yield messages and connections with their offsets. Raises BagFormatError where neither
    follows.
    """
    expected_end = at + expected_bytes
    while at != expected_end and read(at, 1):
        record = read_record(read, at)
        if record.op not in {Op.MESSAGE, Op.CONNECTION}:
            return
        if not read(record.end - 1, 1):
            raise BagCutError(CUT)
        if record.end > end:
            raise BagFormatError(f"chunk of more than {CHUNK_LIMIT >> 20} MiB")
        yield at, record
        at = record.end


def _confirmed(records: Iterator[tuple[int, BagRecord]]) -> Iterator[tuple[int, BagRecord]]:
    """Yield all records but the last one before damage: its length may be the damaged part."""
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


def set_up_records(read: Source) -> Iterator[tuple[int, BagRecord]]:
    """Yield the records that describe the device, and connections, with their offsets, up to the
    first damage.
    """
    with suppress(BagFormatError):
        for start, record in _records(read, 0, CHUNK_LIMIT, CHUNK_LIMIT):
            if record.op is Op.CONNECTION or message_key(record)[1] == SET_UP_TIME:
                yield start, record
