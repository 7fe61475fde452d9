"""Scan of a bag without its index: undamaged chunks, places of damage, and parts of broken
chunks.
"""

import re
from bz2 import BZ2Decompressor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from lz4.frame import LZ4FrameDecompressor

from nlos_cam.camera import OnProgress
from nlos_cam.recording.rosbag import (
    CHUNK_LIMIT,
    CUT,
    MAGIC,
    MAX_CONNECTIONS,
    SET_UP_TIME,
    BagBudgetError,
    BagFormatError,
    BagRecord,
    Budget,
    Connection,
    Ending,
    Op,
    Source,
    check_bookkeeping,
    read_connection,
    read_content,
    read_record,
    set_up_records,
)

DECODERS = {b"lz4": LZ4FrameDecompressor, b"bz2": BZ2Decompressor}
"""Of compressed chunks; both mark the end of their data and hold checksums."""
BZ2_WORK = 16
"""Work of unpacking bz2 in units of that of lz4."""
MIN_PIECE_BYTES = 1 << 16
MAX_PIECE_BYTES = 4 << 20
LZ4_MAGIC = b'\x04"M\x18'
WORK_PER_CHUNK = 64
"""Work that a chunk in memory counts for, besides reading it."""
LZ4_TAIL_BYTES = 8
"""End mark and checksum of an lz4 frame."""


@dataclass(frozen=True)
class Chunk:
    """Chunk that can be written again, from its data in the file or from its unpacked content."""

    at: int
    compression: str
    size: int
    """Bytes of its content, unpacked."""
    data_at: int
    data_bytes: int
    content: bytes | None
    """Replaces the data in the file where that is cut off."""
    index: dict[int, bytes]


@dataclass(frozen=True)
class Examined:
    """Result of checking one chunk."""

    chunk: Chunk | None
    """None where nothing of it can be used."""
    connections: dict[int, Connection]
    end: int
    """Offset at which reading continues."""
    ending: Ending
    why: str
    """Damage; empty if there is none."""


def find_chunk(read: Source, at: int) -> BagRecord | None:
    """Return the chunk at an offset, or the data of one without its header; None at another record.

    Raises BagFormatError where no record begins.
    """
    if read(at, len(LZ4_MAGIC)) == LZ4_MAGIC:
        return BagRecord(Op.CHUNK, {"compression": b"lz4"}, at, 0)
    record = read_record(read, at)
    if record.op is Op.MESSAGE or (record.op is Op.CONNECTION and _is_message(read, record.end)):
        return BagRecord(Op.CHUNK, {"compression": b"none"}, at, 0)
    return record if record.op is Op.CHUNK else None


def is_headless(chunk: BagRecord) -> bool:
    """Return whether `find_chunk` found data without a header."""
    return "size" not in chunk.fields


def _is_message(read: Source, at: int) -> bool:
    with suppress(BagFormatError):
        return read_record(read, at).op is Op.MESSAGE
    return False


def examine(read: Source, at: int, record: BagRecord, file_end: int) -> Examined:
    """Unpack and check a chunk, given its record at `at`.

    The lengths in its header are not trusted: packed data mark their own end, other data end with
    the last message.
    """
    compression = record.fields.get("compression", b"")
    if compression in DECODERS:
        return _examine_packed(read, at, record, file_end)
    if compression == b"none":
        return _examine_plain(read, at, record)
    name = compression[:20].decode("utf-8", "replace")
    return Examined(
        None,
        {},
        record.data_at,
        Ending.BROKEN,
        f"unknown compression {name!r}, none of lz4, bz2, none",
    )


def _examine_plain(read: Source, at: int, record: BagRecord) -> Examined:
    found = read_content(
        read, record.data_at, record.data_at + CHUNK_LIMIT, record.data_bytes or CHUNK_LIMIT
    )
    end = record.data_at + found.bytes
    chunk = Chunk(at, "none", found.bytes, record.data_at, found.bytes, None, found.index)
    why = found.why or _wrong_lengths(record, end, found.bytes)
    return Examined(chunk if found.index else None, found.connections, end, found.ending, why)


def _examine_packed(read: Source, at: int, record: BagRecord, file_end: int) -> Examined:
    piece_bytes = min(
        max(record.data_bytes, MIN_PIECE_BYTES), MAX_PIECE_BYTES
    )  # a whole chunk, if its length is sane
    name = record.fields["compression"]
    unpacked, end, ending, why = unpack(read, record.data_at, file_end, piece_bytes, name)
    if ending is Ending.BROKEN:
        return Examined(None, {}, record.data_at, ending, why)
    found = read_content(read.over(unpacked), 0, len(unpacked), len(unpacked))
    if ending is Ending.CUT:
        chunk = Chunk(at, "none", found.bytes, 0, found.bytes, unpacked[: found.bytes], found.index)
        return Examined(
            chunk if found.index else None, found.connections, record.data_at, ending, why
        )
    if found.why:
        return Examined(None, {}, record.data_at, Ending.BROKEN, found.why)
    chunk = Chunk(
        at, name.decode(), len(unpacked), record.data_at, end - record.data_at, None, found.index
    )
    why = _wrong_lengths(record, end, len(unpacked))
    return Examined(chunk if found.index else None, found.connections, end, ending, why)


def _wrong_lengths(record: BagRecord, end: int, size: int) -> str:
    if is_headless(record):
        return ""  # the damage is before it
    if record.data_bytes == 0:
        return "unfinished chunk"
    if record.end != end or record.fields["size"] != size.to_bytes(4, "little"):
        return "wrong length in the chunk header"
    return ""


def unpack(
    read: Source, at: int, end: int, piece_bytes: int, compression: bytes = b"lz4"
) -> tuple[bytes, int, Ending, str]:
    """Return the content of the packed data at `at`, the offset of its end, its condition there,
    and the damage.

    Reads `piece_bytes` at a time and never unpacks more than CHUNK_LIMIT.
    """
    decoder = DECODERS[compression]()
    parts = list[bytes]()
    room = CHUNK_LIMIT
    limit = at + 2 * CHUNK_LIMIT
    while not decoder.eof:
        piece = read(at, min(piece_bytes, end - at)) if decoder.needs_input else b""
        if decoder.needs_input and not piece:
            return b"".join(parts), at, Ending.CUT, CUT
        try:
            parts.append(decoder.decompress(piece, min(room + 1, MAX_PIECE_BYTES)))
        except (RuntimeError, OSError):
            return b"".join(parts), at, Ending.BROKEN, "damaged data of a chunk"
        if compression == b"bz2":
            read.budget.spend(BZ2_WORK * len(parts[-1]) >> 12)
        at = at + len(piece)
        room = room - len(parts[-1])
        if room < 0 or at > limit:
            return b"", at, Ending.BROKEN, f"chunk of more than {CHUNK_LIMIT >> 20} MiB"
    return b"".join(parts), at - len(decoder.unused_data or b""), Ending.WHOLE, ""


def salvage_set_up(
    read: Source, at: int, record: BagRecord, file_end: int
) -> tuple[Chunk | None, dict[int, Connection]]:
    """Return the descriptions of device and streams, and connections, from a broken lz4 chunk,
    without its checksum.

    A recording holds them once and no frame can be read without them; unlike frames, they are used
    unverified.
    """
    end = min(record.end, file_end) - LZ4_TAIL_BYTES
    unpacked = read.over(unpack(read, record.data_at, end, MIN_PIECE_BYTES)[0])
    connections = read_content(unpacked, 0, CHUNK_LIMIT, CHUNK_LIMIT).connections
    content = b"".join(
        unpacked(start, found.end - start) for start, found in set_up_records(unpacked)
    )
    index = read_content(read.over(content), 0, len(content), len(content)).index
    return Chunk(
        at, "none", len(content), 0, len(content), content, index
    ) if index else None, connections


WINDOW_BYTES = 1 << 20
MAX_START_BYTES = 32
"""Bound on the bytes from the first of a record to the end of its match of RECORD_START."""
RECORD_START = re.compile(
    rb"\x00\x00\x00(?:compression|conn|op|chunk_pos|chunk_count)=|" + re.escape(LZ4_MAGIC)
)
"""First field of a record, after the first byte of its length; or the data of an lz4 chunk."""
BEFORE_FIELD_BYTES = 5
"""Bytes from the start of a record to its match of RECORD_START."""
COMPRESSION = re.compile(rb"\x00\x00\x00compression=(lz4|bz2|none)")


@dataclass(frozen=True)
class Damage:
    """Damaged place of a file."""

    position: int
    bytes: int
    """Bytes lost."""
    why: str


@dataclass(frozen=True)
class Scan:
    """Contents of a bag, read without its index."""

    bytes: int
    """Size of the file."""
    chunks: list[Chunk]
    connections: dict[int, Connection]
    damages: list[Damage]


def scan_bag(path: Path, report: OnProgress = lambda _done, _total: None) -> Scan:
    """Read a bag from end to end, one chunk at a time; report bytes. Raises OSError where it cannot
    be read.
    """
    with path.open("rb") as file:
        scanner = _Scanner(file, report)
        scanner.run()
    # connections in chunks are checked, so they take precedence over those at the end of the file
    return Scan(
        scanner.end, scanner.chunks, scanner.trailing | scanner.connections, scanner.damages
    )


class _Scanner:
    """Pass over a file from record to record, and after damage to the next plausible one."""

    def __init__(self, file: BinaryIO, report: OnProgress) -> None:
        self._file = file
        self._report = report
        self.end = file.seek(0, 2)
        self.read = Source(self._fetch, Budget(self.end))
        self.chunks: list[Chunk] = []
        self.connections: dict[int, Connection] = {}
        self.trailing: dict[int, Connection] = {}
        """Connections at the end of the file."""
        self.damages: list[Damage] = []
        self._indexes = set[tuple[tuple[int, bytes], ...]]()
        self._has_set_up = False
        self._is_plain = self._first_chunk_is_plain()

    def _fetch(self, at: int, count: int) -> bytes:
        """Return up to `count` bytes from an offset, fewer at the end of the file."""
        self._file.seek(at)
        return self._file.read(max(0, min(count, self.end - at)))

    def run(self) -> None:
        """Scan to the end of the file, or until its budget of work is spent."""
        at = len(MAGIC)
        try:
            if self.read(0, at) != MAGIC:
                at = self._skip(0, "no signature of a .bag", search_at=0)
            while at < self.end:
                at = self._step(at)
                self._report(at, self.end)
        except BagBudgetError as error:
            self.damages.append(Damage(at, self.end - at, str(error)))

    def _step(self, at: int) -> int:
        try:
            if chunk := self._find_chunk(at):
                return self._take_chunk(at, chunk)
            record = read_record(self.read, at)
            self._take_other(record)
        except BagFormatError as error:
            return self._skip(at, str(error), search_at=at + 1)
        return record.end

    def _take_other(self, record: BagRecord) -> None:
        """Note a connection, pass over index records. Raises BagFormatError where they are
        damaged.
        """
        if record.op is Op.CONNECTION:
            found = read_connection(self.read, record)
            if len(self.trailing) >= MAX_CONNECTIONS:
                raise BagBudgetError(f"more than {MAX_CONNECTIONS} topics")
            self.trailing.setdefault(found.number, found)
        check_bookkeeping(self.read, record)
        if record.end > self.end:
            raise BagFormatError("file truncated within its index")

    def _take_chunk(self, at: int, record: BagRecord) -> int:
        found = examine(self.read, at, record, self.end)
        if found.ending is Ending.WHOLE:
            if self._take(at, found) and found.why:
                self.damages.append(Damage(at, 0, found.why))
            return found.end
        resumed = self._search(found.end + 1)
        if found.chunk is None:
            self._drop_chunk(at, record, resumed, found.why)
        elif found.chunk.content is None or resumed == self.end:
            self._take(at, found)
            lost_at = at if found.chunk.content else found.end
            self.damages.append(
                Damage(lost_at, resumed - lost_at, f"{found.why} (undamaged messages recovered)")
            )
        else:
            self._drop_chunk(at, record, resumed, "damaged data of a chunk")
        return resumed

    def _take(self, at: int, found: Examined) -> bool:
        """Add a chunk; return False for one that contradicts others or repeats one."""
        why = ""
        chunk = found.chunk
        if any(
            n in self.connections and not self.connections[n].is_like(c)
            for n, c in found.connections.items()
        ):
            why = "chunk of another recording, with other topics"
        elif len(self.connections.keys() | found.connections) > MAX_CONNECTIONS:
            why = f"more than {MAX_CONNECTIONS} topics"
        elif chunk and tuple(chunk.index.items()) in self._indexes:
            why = "chunk that is in the file twice"
        else:
            self.connections |= found.connections
            if chunk:
                self._indexes.add(tuple(chunk.index.items()))
                self._add(chunk)
        if why:
            self.damages.append(Damage(at, found.end - at, why))
        return not why

    def _add(self, chunk: Chunk) -> None:
        self.read.budget.spend(WORK_PER_CHUNK)
        self.chunks.append(chunk)
        self._has_set_up |= any(entries.startswith(SET_UP_TIME) for entries in chunk.index.values())

    def _drop_chunk(self, at: int, record: BagRecord, resumed: int, why: str) -> None:
        if not self._has_set_up and record.fields.get("compression") == b"lz4":
            chunk, connections = salvage_set_up(self.read, at, record, self.end)
            self.trailing = connections | self.trailing
            if chunk:
                self._add(chunk)
                why += " (stream descriptions recovered, unverified)"
        self.damages.append(Damage(at, resumed - at, why))

    def _skip(self, at: int, why: str, search_at: int) -> int:
        resumed = self._search(search_at)
        self.damages.append(Damage(at, resumed - at, why))
        return resumed

    def _search(self, at: int) -> int:
        """Return the offset of the next plausible record, or the end of the file."""
        for window_at in range(at, self.end, WINDOW_BYTES):
            self._report(window_at, self.end)
            for match in RECORD_START.finditer(
                self.read(window_at, WINDOW_BYTES + MAX_START_BYTES)
            ):
                before = 0 if match[0] == LZ4_MAGIC else BEFORE_FIELD_BYTES
                start = window_at + match.start() - before
                if start >= at and self._is_plausible(start):
                    return start
        return self.end

    def _is_plausible(self, at: int) -> bool:
        with suppress(BagFormatError):
            if (chunk := self._find_chunk(at)) is None:
                record = read_record(self.read, at)
                if record.op is Op.CONNECTION and not self._is_at_end(record.end):
                    return False
                self._take_other(record)
                return True
            if is_headless(chunk):
                return examine(self.read, at, chunk, self.end).chunk is not None
            return chunk.fields.get("compression") in {*DECODERS, b"none"}
        return False

    def _is_at_end(self, at: int) -> bool:
        """Return whether a connection before this offset is one of the file's end; in a chunk, a
        message follows.
        """
        return at == self.end or read_record(self.read, at).op in {Op.CONNECTION, Op.CHUNK_INFO}

    def _find_chunk(self, at: int) -> BagRecord | None:
        """Return `find_chunk`, except messages visible in lz4 data: parts of those are stored
        elsewhere.
        """
        chunk = find_chunk(self.read, at)
        if (
            chunk
            and is_headless(chunk)
            and chunk.fields["compression"] == b"none"
            and not self._is_plain
        ):
            raise BagFormatError("message outside of any chunk")
        return chunk

    def _first_chunk_is_plain(self) -> bool:
        for window_at in range(0, self.end, WINDOW_BYTES):
            if found := COMPRESSION.search(self.read(window_at, WINDOW_BYTES + MAX_START_BYTES)):
                return found[1] == b"none"
        return False
