import bz2
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.recording import rosbag
from nlos_cam.recording.rosbag import (
    BagFormatError,
    Ending,
    Op,
    pack_record,
    read_connection,
    read_record,
    reader,
)
from nlos_cam.recording.salvage import Scan, examine, find_chunk, scan_bag, unpack

DESCRIPTION = {
    "type": b"std_msgs/String",
    "md5sum": b"0" * 32,
    "message_definition": b"string data",
}
SET_UP_S = (0, 1)
FIRST_CHUNK_AT = 4117
MESSAGE = b"\x04\0\0\0op=\x02"
Scanned = Callable[[bytes], Scan]


def described(fields: dict[str, bytes]) -> bytes:
    return pack_record(fields, b"")[4:-4]


def connection(topic: bytes = b"/a", conn: int = 7, **changed: bytes) -> bytes:
    fields = {"conn": conn.to_bytes(4, "little"), "op": b"\x07", "topic": topic}
    return pack_record(fields, described(DESCRIPTION | changed))


def message(time: tuple[int, int], data: bytes = b"data", conn: int = 0) -> bytes:
    fields = {"conn": conn.to_bytes(4, "little"), "op": b"\x02", "time": struct.pack("<II", *time)}
    return pack_record(fields, data)


def packed(content: bytes) -> bytes:
    options = {
        "block_size": lz4.frame.BLOCKSIZE_MAX64KB,
        "block_linked": False,
        "content_checksum": True,
    }
    return lz4.frame.compress(content, **options)


CONNECTION = connection(b"/topic", 0)
NOISE = np.random.default_rng(0).bytes(90_000)
CONTENT = (
    CONNECTION + message(SET_UP_S) + b"".join(message((1, number), NOISE) for number in (3, 1, 2))
)
AFTER = rosbag.pack_index(0, bytes(12))
DATA = {"lz4": packed(CONTENT), "bz2": bz2.compress(CONTENT), "none": CONTENT}


def examined(
    data: bytes, compression: str = "lz4", size: int = len(CONTENT), length: int | None = None
) -> tuple:
    """Examine a chunk of that data; returns what was found and the file that it is in."""
    file = rosbag.pack_chunk_head(compression, size, len(data) if length is None else length) + data
    found = find_chunk(reader(file), 0)
    assert found
    return examine(reader(file), 0, found, len(file)), file


@pytest.mark.parametrize("compression", DATA)
@pytest.mark.parametrize("length", [0, 1, 1000, 10**6, 0xFFFFFFFF])
@pytest.mark.parametrize("size", [0, len(CONTENT), 0xFFFFFFFF])
def test_examine_ignores_a_wrong_length_in_the_header(
    compression: str, length: int, size: int
) -> None:
    found, file = examined(DATA[compression] + AFTER, compression, size, length)

    assert found.ending == Ending.WHOLE
    assert found.end == len(file) - len(AFTER)
    assert found.why
    assert found.chunk.size == len(CONTENT)
    assert found.chunk.data_bytes == len(DATA[compression])

    entries = list(struct.iter_unpack("<III", found.chunk.index[0]))

    assert [entry[:2] for entry in entries] == [SET_UP_S, (1, 1), (1, 2), (1, 3)]


@pytest.mark.parametrize("compression", ["lz4", "bz2"])
def test_examine_never_accepts_a_flipped_bit_of_packed_data(compression: str) -> None:
    for at in np.random.default_rng(1).integers(
        7, len(DATA[compression]), 50 if compression == "lz4" else 8
    ):
        bad = bytearray(DATA[compression])
        bad[at] ^= 1
        found, _ = examined(bytes(bad), compression)
        assert found.chunk is None or found.ending is Ending.CUT


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_examine_keeps_whole_messages_of_a_cut_chunk(compression: str) -> None:
    data = DATA[compression]
    block = 1 << 16 if compression == "lz4" else 1
    for length in (len(data) - 20, 190_000, 100_000):
        found, file = examined(data[:length], compression, 0, 0)
        chunk = found.chunk
        content = chunk.content or file[chunk.data_at :][: chunk.data_bytes]
        assert (found.ending, chunk.compression) == (Ending.CUT, "none")
        assert content == CONTENT[: len(content)]
        assert length - block - len(message((1, 1), NOISE)) < len(content) <= length
        assert len(chunk.index[0]) // 12 == 1 + len(content) // len(NOISE)


def test_unpack_refuses_a_bomb(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = packed(bytes(300 << 20))

    assert len(bomb) < 2 << 20

    content, read_bytes, ending, why = unpack(reader(bomb), 0, len(bomb), 1 << 16)

    assert (content, ending, "64 MiB" in why) == (b"", Ending.BROKEN, True)
    assert read_bytes < len(bomb) / 3

    monkeypatch.setattr("nlos_cam.recording.salvage.CHUNK_LIMIT", len(CONTENT) - 1)

    assert examined(DATA["lz4"])[0].chunk is None
    assert examined(CONTENT, "none")[0].ending == Ending.BROKEN


def test_find_chunk_refuses_other_records_and_compressions() -> None:
    assert find_chunk(reader(CONNECTION + CONNECTION), 0) is None
    assert find_chunk(reader(AFTER), 0) is None

    with pytest.raises(BagFormatError):
        find_chunk(reader(b"no record at all"), 0)
    found, _ = examined(CONTENT, "zstd")

    assert (found.chunk, found.ending, "zstd" in found.why) == (None, Ending.BROKEN, True)
    assert examine(reader(b""), 0, rosbag.BagRecord(Op.CHUNK, {}, 0, 0), 0).chunk is None


@pytest.fixture(params=["packed", "plain"])
def bag(request: pytest.FixtureRequest, noise_bags: dict[str, Path]) -> Path:
    return noise_bags[request.param]


def chunk_places(content: bytes) -> list[tuple[int, int]]:
    places = list[tuple[int, int]]()
    at = FIRST_CHUNK_AT
    while at < len(content):
        record = read_record(reader(content), at)
        if record.op is Op.CHUNK:
            places.append((at, record.end))
        at = record.end
    return places


@pytest.fixture
def scanned(tmp_path: Path) -> Scanned:
    def scan(content: bytes) -> Scan:
        (tmp_path / "scanned.bag").write_bytes(content)
        return scan_bag(tmp_path / "scanned.bag")

    return scan


def indexes(scan: Scan) -> list[dict[int, bytes]]:
    return [chunk.index for chunk in scan.chunks]


def count(scan: Scan) -> int:
    return sum(len(entries) for index in indexes(scan) for entries in index.values()) // 12


def test_scan_of_a_whole_bag_finds_every_chunk_and_index(bag: Path) -> None:
    content = bag.read_bytes()
    scan = scan_bag(bag)

    assert not scan.damages

    places = chunk_places(content)

    assert [chunk.at for chunk in scan.chunks] == [at for at, _ in places]
    assert len(scan.chunks) > 3
    assert {connection.topic for connection in scan.connections.values()} >= {
        f"/device_0/sensor_0/{stream}_0/image/data"
        for stream in ("Depth", "Infrared", "Confidence")
    }

    for (_, end), chunk in zip(places, scan.chunks, strict=True):
        written = b"".join(
            rosbag.pack_index(number, entries) for number, entries in chunk.index.items()
        )
        assert content[end:].startswith(written)


def test_scan_names_a_cut_index(bag: Path, scanned: Scanned) -> None:
    (damage,) = scanned(bag.read_bytes()[:-1]).damages

    assert damage.bytes > 0


def test_scan_loses_only_the_damaged_chunk(noise_bags: dict[str, Path], scanned: Scanned) -> None:
    whole = noise_bags["packed"].read_bytes()
    before = indexes(scan_bag(noise_bags["packed"]))
    for number, (at, end) in enumerate(chunk_places(whole)[1:], start=1):
        assert (
            number > 1 or whole.count(MESSAGE, at, end) > 1
        )  # though messages show in packed noise
        content = bytearray(whole)
        content[(at + end) // 2] ^= 16
        scan = scanned(bytes(content))
        assert indexes(scan) == before[:number] + before[number + 1 :]
        assert [(damage.position, damage.bytes) for damage in scan.damages] == [(at, end - at)]


def test_scan_loses_little_of_a_plain_chunk_and_takes_no_foreign(
    noise_bags: dict[str, Path], scanned: Scanned
) -> None:
    whole = noise_bags["plain"].read_bytes()
    expected = scan_bag(noise_bags["plain"])
    at, end = chunk_places(whole)[1]
    middle = whole.index(MESSAGE, (at + end) // 2)
    scan = scanned(whole[:middle] + bytes(8) + whole[middle + 8 :])

    assert 1 <= count(expected) - count(scan) <= 2
    assert len(scan.damages) == 1

    at, end = chunk_places(whole)[0]
    scan = scanned(
        whole[:end] + whole[at:end].replace(b"topic=/device_0", b"topic=/device_1") + whole[end:]
    )

    assert indexes(scan) == indexes(expected)
    assert ["topics" in damage.why for damage in scan.damages] == [True]


def test_scan_bridges_lost_headers_and_ranges(bag: Path, scanned: Scanned) -> None:
    whole = bag.read_bytes()
    expected = indexes(scan_bag(bag))
    places = chunk_places(whole)
    at = places[2][0]
    scan = scanned(whole[:at] + bytes(40) + whole[at + 40 :])

    assert indexes(scan) == expected
    assert [damage.position for damage in scan.damages] == [at]

    scan = scanned(whole[: places[1][0] + 500_000] + whole[places[2][0] + 500_000 :])

    assert indexes(scan)[0] == expected[0]
    assert indexes(scan)[-len(expected) + 3 :] == expected[3:]


def test_scan_finds_connections_without_the_first_chunk(
    noise_bags: dict[str, Path], scanned: Scanned
) -> None:
    whole = noise_bags["packed"].read_bytes()
    expected = scan_bag(noise_bags["packed"]).connections

    assert (
        scanned(whole[:FIRST_CHUNK_AT] + whole[chunk_places(whole)[1][0] :]).connections == expected
    )

    content = bytearray(noise_bags["packed-unindexed"].read_bytes())
    content[400_000] ^= 1  # within the first chunk, and no copy at the end of the file
    scan = scanned(bytes(content))

    assert scan.connections == expected
    assert len(scan.damages) > 0
    assert scan.chunks[0].content is not None
    assert count(scan) > 0.5 * count(scan_bag(noise_bags["packed-unindexed"]))


def test_scan_finds_a_record_across_windows(
    bag: Path, scanned: Scanned, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = bag.read_bytes()
    expected = indexes(scan_bag(bag))[1:3]
    _, (start, _), (_, end), *_ = chunk_places(whole)
    for window in range(40, 90):
        monkeypatch.setattr("nlos_cam.recording.salvage.WINDOW_BYTES", window)
        assert indexes(scanned(b"\1" * 200 + whole[start:end])) == expected


NAMES = st.text(st.characters(codec="ascii", exclude_characters="="), min_size=1, max_size=9)
FIELDS = st.dictionaries(
    NAMES.filter(lambda name: name != "op"), st.binary(max_size=30), max_size=5
)


def read_of(content: bytes) -> tuple[rosbag.Source, rosbag.BagRecord]:
    return reader(content), read_record(reader(content), 0)


@given(FIELDS, st.sampled_from(Op), st.binary(max_size=50), st.binary(max_size=9))
def test_read_record_returns_what_was_packed(
    fields: dict[str, bytes], op: Op, data: bytes, before: bytes
) -> None:
    content = before + pack_record({**fields, "op": bytes([op])}, data)
    record = read_record(reader(content), len(before))

    assert record.op == op
    assert dict(record.fields) == {**fields, "op": bytes([op])}
    assert content[record.data_at : record.end] == data
    assert record.end == len(content)


@given(st.binary(max_size=200))
def test_read_record_of_random_bytes_raises_only_format_errors(content: bytes) -> None:
    try:
        read, record = read_of(content)
        rosbag.check_bookkeeping(read, record)
        found = read_connection(read, record)
    except BagFormatError:
        return
    assert content.startswith(found.record)


@given(st.integers(0, 70), st.integers(0, 255))
def test_read_connection_keeps_or_refuses_a_changed_byte(at: int, value: int) -> None:
    content = bytearray(connection())
    content[at % len(content)] = value
    try:
        found = read_connection(*read_of(bytes(content)))
    except BagFormatError:
        return

    assert found.record == bytes(content)


@given(st.integers(0, 300))
def test_read_record_reports_a_cut_header(length: int) -> None:
    content = pack_record({"op": b"\x02", "name": b"x" * 300}, b"")
    with pytest.raises(rosbag.BagCutError):
        read_record(reader(content[:length]), 0)


def test_read_record_does_not_read_an_absurd_header() -> None:
    asked: list[int] = []

    def read(at: int, count: int) -> bytes:
        asked.append(count)
        return struct.pack("<I", rosbag.HEADER_LIMIT + 1)[at : at + count]

    with pytest.raises(BagFormatError, match="65537"):
        read_record(read, 0)

    assert max(asked) == 4


@pytest.mark.parametrize(
    "content",
    [
        connection(topic=b"a"),
        connection(topic=b"/\x00"),
        connection(topic=b"/\xff"),
        connection(type=b"String"),
        connection(callerid=b"\xff"),
        connection()[:-1],
        pack_record(
            {"conn": bytes(4), "op": b"\x07", "topic": b"/a"},
            described({"type": b"a/b", "md5sum": b""}),
        ),
        pack_record(
            {"conn": bytes(4), "op": b"\x07", "topic": b"/a"}, bytes(rosbag.HEADER_LIMIT + 1)
        ),
    ],
)
def test_read_connection_refuses_malformed_records(content: bytes) -> None:
    with pytest.raises(BagFormatError):
        read_connection(*read_of(content))


def test_check_bookkeeping_refuses_impossible_lengths() -> None:
    index = rosbag.pack_index(3, bytes(24))
    info = rosbag.pack_chunk_info(4117, {3: bytes(24), 5: bytes(12)})
    for whole in (index, info, rosbag.pack_file_header(1, 2, 3)):
        rosbag.check_bookkeeping(*read_of(whole))
    fields = {"count": bytes([9, 0, 0, 0]), "conn": bytes(4)}
    for op, data in (
        (4, bytes(24)),
        (6, bytes(24)),
        (3, b"data"),
        (3, bytes(rosbag.HEADER_LIMIT + 1)),
    ):
        with pytest.raises(BagFormatError):
            rosbag.check_bookkeeping(*read_of(pack_record({**fields, "op": bytes([op])}, data)))


ONE = message((0, 500), bytes(50))
NO_TIME, NO_CONNECTION = (
    pack_record({"conn": bytes(4), "op": b"\x02", "time": bytes(8), field: b"1"}, b"")
    for field in ("time", "conn")
)


@pytest.mark.parametrize(
    ("content", "ending"),
    [
        *(((ONE + ONE)[:-missing], Ending.CUT) for missing in (1, 49, 60, len(ONE) - 1)),
        *(
            (ONE + ONE + damage, Ending.BROKEN)
            for damage in (b"\xff" * 30, bytes(30), pack_record({"op": b"\x09"}, b""))
        ),
        *((ONE + wrong + ONE, Ending.BROKEN) for wrong in (NO_TIME, NO_CONNECTION)),
    ],
)
def test_read_content_keeps_messages_before_damage(content: bytes, ending: Ending) -> None:
    found = rosbag.read_content(reader(content), 0, rosbag.CHUNK_LIMIT, rosbag.CHUNK_LIMIT)

    assert found.ending == ending
    assert found.bytes == len(ONE)
    assert len(found.index[0]) == 12


def test_set_up_records_finds_connections_and_first_messages() -> None:
    first = connection(b"/1", 1)
    second = connection(b"/2", 2)
    content = (
        first + message((0, 1), conn=1) + message((0, 2), conn=1) + second + message((0, 1), conn=2)
    )
    found = list(rosbag.set_up_records(reader(content + b"damage")))

    assert [record.op for _, record in found] == [
        Op.CONNECTION,
        Op.MESSAGE,
        Op.CONNECTION,
        Op.MESSAGE,
    ]
    assert found[0][0] == 0
    assert found[-1][1].end == len(content)
