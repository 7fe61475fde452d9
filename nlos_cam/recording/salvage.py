"""A bag read chunk by chunk without its index: what is whole, what is damaged and where, and on after damage.

One chunk of a bag: whether it is whole, what is in it, and what of a broken one can still be had.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from lz4.frame import LZ4FrameDecompressor

from nlos_cam.recording.rosbag import (
    CHUNK_LIMIT,
    CUT,
    MAGIC,
    SET_UP_TIME,
    BagFormatError,
    BagRecord,
    Connection,
    Ending,
    Op,
    Read,
    check_bookkeeping,
    read_connection,
    read_content,
    read_record,
    reader,
    set_up_records,
)

MIN_PIECE_BYTES, MAX_PIECE_BYTES = 1 << 16, 4 << 20
LZ4_MAGIC = b'\x04"M\x18'
LZ4_TAIL_BYTES = 8
"""End mark and checksum of an lz4 frame."""


@dataclass(frozen=True)
class Chunk:
    """A chunk that can be written anew: its data as it lies in the file, or what was unpacked of it."""

    at: int
    compression: str
    size: int
    """Bytes of its content, unpacked."""
    data_at: int
    data_bytes: int
    content: bytes | None
    """In place of the data in the file, where that is cut."""
    index: dict[int, bytes]


@dataclass(frozen=True)
class Examined:
    """What became of a chunk."""

    chunk: Chunk | None
    connections: dict[int, Connection]
    end: int
    """Where to read on."""
    ending: Ending
    why: str
    """What is wrong with it; empty if nothing is."""


def find_chunk(read: Read, at: int) -> BagRecord | None:
    """The chunk that begins there, or the data of one that lost its header; None where neither does.

    Raises BagFormatError where no record begins either.
    """
    if read(at, len(LZ4_MAGIC)) == LZ4_MAGIC:
        return BagRecord(Op.CHUNK, {"compression": b"lz4"}, at, 0)
    record = read_record(read, at)
    if record.op is Op.MESSAGE or (record.op is Op.CONNECTION and _is_message(read, record.end)):
        return BagRecord(Op.CHUNK, {"compression": b"none"}, at, 0)
    return record if record.op is Op.CHUNK else None


def is_headless(chunk: BagRecord) -> bool:
    """Whether `find_chunk` found data without its header."""
    return "size" not in chunk.fields


def _is_message(read: Read, at: int) -> bool:
    with suppress(BagFormatError):
        return read_record(read, at).op is Op.MESSAGE
    return False


def examine(read: Read, at: int, record: BagRecord, file_end: int) -> Examined:
    """Unpack and check the chunk that `record`, which starts at `at`, says is there.

    Its lengths are not believed: lz4 data says itself where it ends, other data ends where messages do.
    """
    compression = record.fields.get("compression")
    if compression == b"lz4":
        return _examine_lz4(read, at, record, file_end)
    if compression == b"none":
        return _examine_plain(read, at, record)
    return Examined(None, {}, record.data_at, Ending.BROKEN, "its compression is neither lz4 nor none")


def _examine_plain(read: Read, at: int, record: BagRecord) -> Examined:
    found = read_content(read, record.data_at, record.data_at + CHUNK_LIMIT, record.data_bytes or CHUNK_LIMIT)
    end = record.data_at + found.bytes
    chunk = Chunk(at, "none", found.bytes, record.data_at, found.bytes, None, found.index)
    why = found.why or _wrong_lengths(record, end, found.bytes)
    return Examined(chunk if found.index else None, found.connections, end, found.ending, why)


def _examine_lz4(read: Read, at: int, record: BagRecord, file_end: int) -> Examined:
    unpacked, end, ending, why = unpack(read, record.data_at, file_end, _piece_bytes(record))
    if ending is Ending.BROKEN:
        return Examined(None, {}, record.data_at, ending, why)
    found = read_content(reader(unpacked), 0, len(unpacked), len(unpacked))
    if ending is Ending.CUT:
        chunk = Chunk(at, "none", found.bytes, 0, found.bytes, unpacked[: found.bytes], found.index)
        return Examined(chunk if found.index else None, found.connections, record.data_at, ending, why)
    if found.why:
        return Examined(None, {}, record.data_at, Ending.BROKEN, found.why)
    chunk = Chunk(at, "lz4", len(unpacked), record.data_at, end - record.data_at, None, found.index)
    why = _wrong_lengths(record, end, len(unpacked))
    return Examined(chunk if found.index else None, found.connections, end, ending, why)


def _piece_bytes(record: BagRecord) -> int:
    """All of a chunk at once, if its length is sensible."""
    return min(max(record.data_bytes, MIN_PIECE_BYTES), MAX_PIECE_BYTES)


def _wrong_lengths(record: BagRecord, end: int, size: int) -> str:
    if is_headless(record):
        return ""  # the damage is before it
    if record.data_bytes == 0:
        return "it was never finished"
    if record.end != end or record.fields["size"] != size.to_bytes(4, "little"):
        return "it has another length than it says"
    return ""


def unpack(read: Read, at: int, end: int, piece_bytes: int) -> tuple[bytes, int, Ending, str]:
    """The content of the lz4 frame at `at`, where the frame ends, how, and what is wrong with it.

    Reads `piece_bytes` at a time; never unpacks more than CHUNK_LIMIT, whatever the data claims.
    """
    decoder, parts, room, limit = LZ4FrameDecompressor(), list[bytes](), CHUNK_LIMIT, at + 2 * CHUNK_LIMIT
    while not decoder.eof:
        piece = read(at, min(piece_bytes, end - at)) if decoder.needs_input else b""
        if decoder.needs_input and not piece:
            return b"".join(parts), at, Ending.CUT, CUT
        try:
            parts.append(decoder.decompress(piece, min(room + 1, MAX_PIECE_BYTES)))
        except RuntimeError:
            return b"".join(parts), at, Ending.BROKEN, "its data is damaged"
        at, room = at + len(piece), room - len(parts[-1])
        if room < 0 or at > limit:
            return b"", at, Ending.BROKEN, f"it holds more than {CHUNK_LIMIT >> 20} MiB"
    return b"".join(parts), at - len(decoder.unused_data or b""), Ending.WHOLE, ""


def salvage_set_up(read: Read, at: int, record: BagRecord, file_end: int) -> tuple[Chunk | None, dict[int, Connection]]:
    """What describes the device and its streams, out of a broken lz4 chunk, as far as its checksum can be passed over.

    Not one frame can be read without it, and a recording holds it once. It may be wrong, where frames are not taken.
    """
    end = min(record.end, file_end) - LZ4_TAIL_BYTES
    unpacked = reader(unpack(read, record.data_at, end, MIN_PIECE_BYTES)[0])
    connections = read_content(unpacked, 0, CHUNK_LIMIT, CHUNK_LIMIT).connections
    content = b"".join(unpacked(start, found.end - start) for start, found in set_up_records(unpacked))
    index = read_content(reader(content), 0, len(content), len(content)).index
    return Chunk(at, "none", len(content), 0, len(content), content, index) if index else None, connections


WINDOW_BYTES = 1 << 20
LONGEST_START_BYTES = 32
"""From a record's first byte to the end of what RECORD_START finds in it, at most."""
RECORD_START = re.compile(rb"\x00\x00\x00(?:compression|conn|op|chunk_pos|chunk_count)=|" + re.escape(LZ4_MAGIC))
"""A record's first field, behind the first byte of its length; or a packed chunk's data."""
BEFORE_FIELD_BYTES = 5
"""From where a record begins to what RECORD_START finds."""
COMPRESSIONS = (b"lz4", b"none")
COMPRESSION = re.compile(rb"\x00\x00\x00compression=(lz4|none)")
OnProgress = Callable[[int, int], None]
"""Called with bytes done and bytes in all."""


@dataclass(frozen=True)
class Damage:
    """A place that is not as it should be."""

    position: int
    bytes: int
    """That could not be used."""
    why: str


@dataclass(frozen=True)
class Scan:
    """What is in a bag."""

    bytes: int
    chunks: list[Chunk]
    connections: dict[int, Connection]
    damages: list[Damage]


def unreported(done: int, total: int) -> None:
    """Tell nobody."""
    del done, total


def scan_bag(path: Path, report: OnProgress = unreported) -> Scan:
    """Read a bag from end to end, a chunk at a time. Raises OSError where the file cannot be read."""
    with path.open("rb") as file:
        walk = _Walk(file, report)
        walk.run()
    # what a chunk says of a connection counts more than what the file's end says: it is checked
    return Scan(walk.end, walk.chunks, walk.trailing | walk.connections, walk.damages)


class _Walk:
    """Goes from record to record, and after damage on to the next that makes sense."""

    def __init__(self, file: BinaryIO, report: OnProgress) -> None:
        self._file, self._report = file, report
        self.end = file.seek(0, 2)
        self.chunks: list[Chunk] = []
        self.connections: dict[int, Connection] = {}
        self.trailing: dict[int, Connection] = {}
        self.damages: list[Damage] = []
        self._seen = set[tuple[tuple[int, bytes], ...]]()
        self._set_up = False
        self._is_plain = self._first_chunk_is_plain()

    def read(self, at: int, count: int) -> bytes:
        """As many of these bytes as are there."""
        self._file.seek(at)
        return self._file.read(max(0, min(count, self.end - at)))

    def run(self) -> None:
        """Walk to the file's end."""
        at = len(MAGIC)
        if self.read(0, at) != MAGIC:
            at = self._lose(0, "it does not begin as a recording does", search_at=0)
        while at < self.end:
            at = self._step(at)
            self._report(at, self.end)

    def _step(self, at: int) -> int:
        try:
            if chunk := self._find_chunk(at):
                return self._take_chunk(at, chunk)
            record = read_record(self.read, at)
            self._take_other(record)
        except BagFormatError as error:
            return self._lose(at, str(error), search_at=at + 1)
        return record.end

    def _take_other(self, record: BagRecord) -> None:
        """Note a connection, pass over the index. Raises BagFormatError where that is damaged."""
        if record.op is Op.CONNECTION:
            found = read_connection(self.read, record)
            self.trailing.setdefault(found.number, found)
        check_bookkeeping(self.read, record)
        if record.end > self.end:
            raise BagFormatError("the file ends within its index")

    def _take_chunk(self, at: int, record: BagRecord) -> int:
        found = examine(self.read, at, record, self.end)
        if found.ending is Ending.WHOLE:
            if self._take(found) and found.why:
                self.damages.append(Damage(at, 0, found.why))
            return found.end
        resumed = self._search(found.end + 1)
        if found.chunk is None:
            self._lose_chunk(at, record, resumed, found.why)
        elif found.chunk.content is None or resumed == self.end:
            self._take(found)
            lost_at = at if found.chunk.content else found.end
            self.damages.append(Damage(lost_at, resumed - lost_at, f"{found.why}: what is whole in it is kept"))
        else:
            self._lose_chunk(at, record, resumed, "its data is damaged")
        return resumed

    def _take(self, found: Examined) -> bool:
        """Keep a chunk, unless it contradicts others or is there already."""
        if (chunk := found.chunk) is None:
            self.connections |= found.connections
            return True
        why = ""
        if any(n in self.connections and not self.connections[n].is_like(c) for n, c in found.connections.items()):
            why = "it calls other topics by the same numbers"
        elif (content := tuple(chunk.index.items())) in self._seen:
            why = "it is in the file twice"
        else:
            self._seen.add(content)
            self.connections |= found.connections
            self._keep(chunk)
        if why:
            self.damages.append(Damage(chunk.at, found.end - chunk.at, why))
        return not why

    def _keep(self, chunk: Chunk) -> None:
        self.chunks.append(chunk)
        self._set_up |= any(entries.startswith(SET_UP_TIME) for entries in chunk.index.values())

    def _lose_chunk(self, at: int, record: BagRecord, resumed: int, why: str) -> None:
        if not self._set_up and record.fields.get("compression") == b"lz4":
            chunk, connections = salvage_set_up(self.read, at, record, self.end)
            self.trailing = connections | self.trailing
            if chunk:
                self._keep(chunk)
                why += "; it describes the streams: that is kept, unchecked"
        self.damages.append(Damage(at, resumed - at, why))

    def _lose(self, at: int, why: str, search_at: int) -> int:
        resumed = self._search(search_at)
        self.damages.append(Damage(at, resumed - at, why))
        return resumed

    def _search(self, at: int) -> int:
        """Where the next record that makes sense begins, or the file's end."""
        for window_at in range(at, self.end, WINDOW_BYTES):
            self._report(window_at, self.end)
            for match in RECORD_START.finditer(self.read(window_at, WINDOW_BYTES + LONGEST_START_BYTES)):
                before = 0 if match[0] == LZ4_MAGIC else BEFORE_FIELD_BYTES
                start = window_at + match.start() - before
                if start >= at and self._makes_sense(start):
                    return start
        return self.end

    def _makes_sense(self, at: int) -> bool:
        with suppress(BagFormatError):
            if (chunk := self._find_chunk(at)) is None:
                record = read_record(self.read, at)
                if record.op is Op.CONNECTION and not self._is_at_end(record.end):
                    return False
                self._take_other(record)
                return True
            if is_headless(chunk):
                return examine(self.read, at, chunk, self.end).chunk is not None
            return chunk.fields.get("compression") in COMPRESSIONS
        return False

    def _is_at_end(self, at: int) -> bool:
        """Whether this may follow a connection of the file's end; in a chunk, a message does."""
        return at == self.end or read_record(self.read, at).op in {Op.CONNECTION, Op.CHUNK_INFO}

    def _find_chunk(self, at: int) -> BagRecord | None:
        """As `find_chunk`. Messages that show in packed data are no chunk, though: half of them is elsewhere."""
        chunk = find_chunk(self.read, at)
        if chunk and is_headless(chunk) and chunk.fields["compression"] == b"none" and not self._is_plain:
            raise BagFormatError("a message is outside of any chunk")
        return chunk

    def _first_chunk_is_plain(self) -> bool:
        for window_at in range(0, self.end, WINDOW_BYTES):
            if found := COMPRESSION.search(self.read(window_at, WINDOW_BYTES + LONGEST_START_BYTES)):
                return found[1] == b"none"
        return False
