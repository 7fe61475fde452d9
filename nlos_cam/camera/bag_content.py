"""The connections and messages in a chunk of a bag, unpacked: where they lie, and up to where they are whole."""

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

from nlos_cam.camera.bag_format import (
    CHUNK_LIMIT,
    CUT,
    SET_UP_TIME,
    BagCutError,
    BagFormatError,
    Connection,
    Op,
    Read,
    Record,
    message_key,
    read_connection,
    read_record,
)


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


def _records(read: Read, at: int, end: int, expected_bytes: int) -> Iterator[tuple[int, Record]]:
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


def _confirmed(records: Iterator[tuple[int, Record]]) -> Iterator[tuple[int, Record]]:
    """All but the one before damage: its length may be what is wrong."""
    last: tuple[int, Record] | None = None
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


def set_up_records(read: Read) -> Iterator[tuple[int, Record]]:
    """What describes the device, and the connections, and where each starts; as far as records are whole."""
    with suppress(BagFormatError):
        for start, record in _records(read, 0, CHUNK_LIMIT, CHUNK_LIMIT):
            if record.op is Op.CONNECTION or message_key(record)[1] == SET_UP_TIME:
                yield start, record


def reader(content: bytes) -> Read:
    """Read from memory."""
    return lambda at, count: content[at : at + count]
