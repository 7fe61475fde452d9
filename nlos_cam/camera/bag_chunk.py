"""One chunk of a bag: whether it is whole, what is in it, and what of a broken one can still be had."""

from contextlib import suppress
from dataclasses import dataclass

from lz4.frame import LZ4FrameDecompressor

from nlos_cam.camera.bag_content import Ending, read_content, reader, set_up_records
from nlos_cam.camera.bag_format import (
    CHUNK_LIMIT,
    CUT,
    BagFormatError,
    Connection,
    Op,
    Read,
    Record,
    read_record,
)

LEAST_PIECE_BYTES, MOST_PIECE_BYTES = 1 << 16, 4 << 20
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


def find_chunk(read: Read, at: int) -> Record | None:
    """The chunk that begins there, or the data of one that lost its header; None where neither does.

    Raises BagFormatError where no record begins either.
    """
    if read(at, len(LZ4_MAGIC)) == LZ4_MAGIC:
        return Record(Op.CHUNK, {"compression": b"lz4"}, at, 0)
    record = read_record(read, at)
    if record.op is Op.MESSAGE or (record.op is Op.CONNECTION and _is_message(read, record.end)):
        return Record(Op.CHUNK, {"compression": b"none"}, at, 0)
    return record if record.op is Op.CHUNK else None


def is_headless(chunk: Record) -> bool:
    """Whether `find_chunk` found data without its header."""
    return "size" not in chunk.fields


def _is_message(read: Read, at: int) -> bool:
    with suppress(BagFormatError):
        return read_record(read, at).op is Op.MESSAGE
    return False


def examine(read: Read, at: int, record: Record, file_end: int) -> Examined:
    """Unpack and check the chunk that `record`, which starts at `at`, says is there.

    Its lengths are not believed: lz4 data says itself where it ends, other data ends where messages do.
    """
    compression = record.fields.get("compression")
    if compression == b"lz4":
        return _examine_lz4(read, at, record, file_end)
    if compression == b"none":
        return _examine_plain(read, at, record)
    return Examined(None, {}, record.data_at, Ending.BROKEN, "its compression is neither lz4 nor none")


def _examine_plain(read: Read, at: int, record: Record) -> Examined:
    found = read_content(read, record.data_at, record.data_at + CHUNK_LIMIT, record.data_bytes or CHUNK_LIMIT)
    end = record.data_at + found.bytes
    chunk = Chunk(at, "none", found.bytes, record.data_at, found.bytes, None, found.index)
    why = found.why or _wrong_lengths(record, end, found.bytes)
    return Examined(chunk if found.index else None, found.connections, end, found.ending, why)


def _examine_lz4(read: Read, at: int, record: Record, file_end: int) -> Examined:
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


def _piece_bytes(record: Record) -> int:
    """All of a chunk at once, if its length is sensible."""
    return min(max(record.data_bytes, LEAST_PIECE_BYTES), MOST_PIECE_BYTES)


def _wrong_lengths(record: Record, end: int, size: int) -> str:
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
            parts.append(decoder.decompress(piece, min(room + 1, MOST_PIECE_BYTES)))
        except RuntimeError:
            return b"".join(parts), at, Ending.BROKEN, "its data is damaged"
        at, room = at + len(piece), room - len(parts[-1])
        if room < 0 or at > limit:
            return b"", at, Ending.BROKEN, f"it holds more than {CHUNK_LIMIT >> 20} MiB"
    return b"".join(parts), at - len(decoder.unused_data or b""), Ending.WHOLE, ""


def salvage_set_up(read: Read, at: int, record: Record, file_end: int) -> tuple[Chunk | None, dict[int, Connection]]:
    """What describes the device and its streams, out of a broken lz4 chunk, as far as its checksum can be passed over.

    Not one frame can be read without it, and a recording holds it once. It may be wrong, where frames are not taken.
    """
    end = min(record.end, file_end) - LZ4_TAIL_BYTES
    unpacked = reader(unpack(read, record.data_at, end, LEAST_PIECE_BYTES)[0])
    connections = read_content(unpacked, 0, CHUNK_LIMIT, CHUNK_LIMIT).connections
    content = b"".join(unpacked(start, found.end - start) for start, found in set_up_records(unpacked))
    index = read_content(reader(content), 0, len(content), len(content)).index
    return Chunk(at, "none", len(content), 0, len(content), content, index) if index else None, connections
