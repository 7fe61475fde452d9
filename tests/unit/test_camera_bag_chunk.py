import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

from nlos_cam.recording import rosbag, salvage
from nlos_cam.recording.rosbag import (
    BagFormatError,
    BagRecord,
    Ending,
    Op,
    Read,
    pack_chunk_head,
    pack_index,
    pack_record,
    read_record,
)
from nlos_cam.recording.salvage import examine, find_chunk, is_headless, salvage_set_up, unpack

DESCRIPTION = {"type": b"std_msgs/String", "md5sum": b"0" * 32, "message_definition": b"string data"}
SET_UP_S, FIRST_S = (0, 1), (0, 500)


def reader(content: bytes) -> Read:
    return lambda at, count: content[at : at + max(count, 0)]


def connection(number: int = 0) -> bytes:
    fields = {"conn": number.to_bytes(4, "little"), "op": b"\x07", "topic": b"/topic%d" % number}
    return pack_record(fields, pack_record(DESCRIPTION, b"")[4:-4])


def message(time: tuple[int, int], data: bytes = b"data", number: int = 0) -> bytes:
    fields = {"conn": number.to_bytes(4, "little"), "op": b"\x02", "time": struct.pack("<II", *time)}
    return pack_record(fields, data)


def packed(content: bytes) -> bytes:
    return lz4.frame.compress(
        content, block_size=lz4.frame.BLOCKSIZE_MAX64KB, block_linked=False, content_checksum=True
    )


NOISE = np.random.default_rng(0).bytes(90_000)
CONTENT = connection() + message(SET_UP_S) + b"".join(message((1, number), NOISE) for number in (3, 1, 2))
AFTER = pack_index(0, bytes(12))


def examined(data: bytes, compression: str = "lz4", size: int = len(CONTENT), length: int | None = None) -> tuple:
    """What is made of a chunk of that data, and the file that it lies in; an index follows it."""
    file = pack_chunk_head(compression, size, len(data) if length is None else length) + data
    found = find_chunk(reader(file), 0)
    assert found
    return examine(reader(file), 0, found, len(file)), file


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_a_whole_chunk_is_known_to_be_and_its_messages_are_found(compression: str) -> None:
    data = packed(CONTENT) if compression == "lz4" else CONTENT
    found, file = examined(data, compression)
    assert (found.ending, found.why, found.end) == (Ending.WHOLE, "", len(file))
    assert (found.chunk.compression, found.chunk.size) == (compression, len(CONTENT))
    assert file[found.chunk.data_at :][: found.chunk.data_bytes] == data
    assert found.connections[0].record == connection()
    entries = list(struct.iter_unpack("<III", found.chunk.index[0]))
    assert [entry[:2] for entry in entries] == [SET_UP_S, (1, 1), (1, 2), (1, 3)]
    for *time, at in entries:
        assert CONTENT[at:].startswith(message(tuple(time), b"data" if time == [*SET_UP_S] else NOISE))


@pytest.mark.parametrize("compression", ["lz4", "none"])
@pytest.mark.parametrize("length", [0, 1, 1000, 10**6, 0xFFFFFFFF])
@pytest.mark.parametrize("size", [0, len(CONTENT), 0xFFFFFFFF])
def test_a_chunk_that_tells_its_length_wrong_is_whole_all_the_same(compression: str, length: int, size: int) -> None:
    data = packed(CONTENT) if compression == "lz4" else CONTENT
    found, file = examined(data + AFTER, compression, size, length)
    assert (found.ending, found.end) == (Ending.WHOLE, len(file) - len(AFTER))
    assert found.why == ("it has another length than it says" if length else "it was never finished")
    assert (found.chunk.size, found.chunk.data_bytes) == (len(CONTENT), len(data))


def test_a_flipped_bit_of_a_packed_chunk_never_passes() -> None:
    data = packed(CONTENT)
    for at in np.random.default_rng(1).integers(7, len(data), 50):
        bad = bytearray(data)
        bad[at] ^= 1
        found, _ = examined(bytes(bad))
        assert found.chunk is None or found.ending is Ending.CUT


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_a_chunk_that_the_files_end_cuts_gives_what_is_whole(compression: str) -> None:
    data, block = (packed(CONTENT), 1 << 16) if compression == "lz4" else (CONTENT, 1)
    for length in (len(data) - 20, 190_000, 100_000):
        found, file = examined(data[:length], compression, 0, 0)
        chunk = found.chunk
        content = chunk.content or file[chunk.data_at :][: chunk.data_bytes]
        assert (found.ending, chunk.compression) == (Ending.CUT, "none")
        assert content == CONTENT[: len(content)]
        assert length - block - len(message((1, 1), NOISE)) < len(content) <= length
        assert len(chunk.index[0]) // 12 == 1 + len(content) // len(NOISE)


def test_the_message_before_damage_is_not_trusted_and_those_before_it_are() -> None:
    found, _ = examined(CONTENT + b"damage here, and on", "none", 0, 0)
    assert found.ending is Ending.BROKEN
    assert len(found.chunk.index[0]) // 12 == 3


def test_a_bomb_is_refused_before_it_goes_off(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = packed(bytes(300 << 20))
    assert len(bomb) < 2 << 20
    content, read_bytes, ending, why = unpack(reader(bomb), 0, len(bomb), 1 << 16)
    assert (content, ending, why) == (b"", Ending.BROKEN, "it holds more than 64 MiB")
    assert read_bytes < len(bomb) / 3
    for module in (salvage, rosbag):
        monkeypatch.setattr(module, "CHUNK_LIMIT", len(CONTENT) - 1)
    assert examined(packed(CONTENT))[0].chunk is None
    found, _ = examined(CONTENT, "none")
    assert (found.ending, found.why) == (Ending.BROKEN, "it holds more than 0 MiB")


def test_what_describes_the_streams_is_taken_from_a_broken_chunk_and_no_frame() -> None:
    data = bytearray(packed(CONTENT))
    data[-20] ^= 1
    file = pack_chunk_head("lz4", len(CONTENT), len(data)) + data
    record = read_record(reader(file), 0)
    chunk, connections = salvage_set_up(reader(file), 0, record, len(file))
    assert chunk is not None
    assert chunk.content == connection() + message(SET_UP_S)
    assert list(chunk.index) == list(connections) == [0]
    data[7:] = bytes(len(data) - 7)
    assert salvage_set_up(reader(file[: record.data_at] + data), 0, record, len(file)) == (None, {})


def test_data_that_lost_its_header_is_found() -> None:
    for start, compression in (
        (packed(CONTENT), b"lz4"),
        (CONTENT, b"none"),
        (message(FIRST_S) + message(FIRST_S), b"none"),
    ):
        found = find_chunk(reader(start + AFTER), 0)
        assert found is not None
        assert is_headless(found)
        assert found.fields["compression"] == compression
        ended = examine(reader(start + AFTER), 0, found, len(start + AFTER))
        assert (ended.ending, ended.end, ended.why) == (Ending.WHOLE, len(start), "")
    assert find_chunk(reader(connection() + connection()), 0) is None
    assert find_chunk(reader(AFTER), 0) is None
    with pytest.raises(BagFormatError):
        find_chunk(reader(b"no record at all"), 0)


def test_an_unknown_compression_is_no_chunk() -> None:
    found, _ = examined(CONTENT, "bz2")
    assert (found.chunk, found.ending) == (None, Ending.BROKEN)
    record = BagRecord(Op.CHUNK, {}, 0, 0)
    assert examine(reader(b""), 0, record, 0).chunk is None


def test_a_recorded_chunk_is_read_whole(noise_bags: dict[str, Path]) -> None:
    for name in ("packed", "plain"):
        content = noise_bags[name].read_bytes()
        record = find_chunk(reader(content), 4117)
        assert record is not None
        found = examine(reader(content), 4117, record, len(content))
        assert (found.ending, found.why, found.end) == (Ending.WHOLE, "", record.end)
