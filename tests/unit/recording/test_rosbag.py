import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.recording import rosbag
from nlos_cam.recording.rosbag import BagFormatError, Ending, Op, pack_record, read_connection, read_record, reader

NAMES = st.text(st.characters(codec="ascii", exclude_characters="="), min_size=1, max_size=9)
FIELDS = st.dictionaries(NAMES.filter(lambda name: name != "op"), st.binary(max_size=30), max_size=5)
DESCRIBED = {"type": b"std_msgs/String", "md5sum": b"0" * 32, "message_definition": b"string data"}


def packed(fields: dict[str, bytes]) -> bytes:
    """Pack fields as the data of a connection."""
    return pack_record(fields, b"")[4:-4]


def connection(topic: bytes = b"/a", conn: int = 7, **changed: bytes) -> bytes:
    fields = {"conn": conn.to_bytes(4, "little"), "op": b"\x07", "topic": topic}
    return pack_record(fields, packed(DESCRIBED | changed))


def message(seconds: int, nanoseconds: int, conn: int = 0) -> bytes:
    fields = {"conn": conn.to_bytes(4, "little"), "op": b"\x02", "time": struct.pack("<II", seconds, nanoseconds)}
    return pack_record(fields, bytes(50))


def described(content: bytes) -> tuple[rosbag.Source, rosbag.BagRecord]:
    return reader(content), read_record(reader(content), 0)


@given(FIELDS, st.sampled_from(Op), st.binary(max_size=50), st.binary(max_size=9))
def test_read_record_returns_what_was_packed(fields: dict[str, bytes], op: Op, data: bytes, before: bytes) -> None:
    content = before + pack_record({**fields, "op": bytes([op])}, data)
    record = read_record(reader(content), len(before))
    assert (record.op, dict(record.fields)) == (op, {**fields, "op": bytes([op])})
    assert content[record.data_at : record.end] == data
    assert record.end == len(content)


@given(st.binary(max_size=200))
def test_read_record_of_random_bytes_raises_only_format_errors(content: bytes) -> None:
    try:
        read, record = described(content)
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
        found = read_connection(*described(bytes(content)))
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
        pack_record({"conn": bytes(4), "op": b"\x07", "topic": b"/a"}, packed({"type": b"a/b", "md5sum": b""})),
        pack_record({"conn": bytes(4), "op": b"\x07", "topic": b"/a"}, bytes(rosbag.HEADER_LIMIT + 1)),
    ],
)
def test_read_connection_refuses_malformed_records(content: bytes) -> None:
    with pytest.raises(BagFormatError):
        read_connection(*described(content))


def test_check_bookkeeping_refuses_impossible_lengths() -> None:
    index, info = rosbag.pack_index(3, bytes(24)), rosbag.pack_chunk_info(4117, {3: bytes(24), 5: bytes(12)})
    for whole in (index, info, rosbag.pack_file_header(1, 2, 3)):
        rosbag.check_bookkeeping(*described(whole))
    fields = {"count": bytes([9, 0, 0, 0]), "conn": bytes(4)}
    for op, data in ((4, bytes(24)), (6, bytes(24)), (3, b"data"), (3, bytes(rosbag.HEADER_LIMIT + 1))):
        with pytest.raises(BagFormatError):
            rosbag.check_bookkeeping(*described(pack_record({**fields, "op": bytes([op])}, data)))


ONE = message(0, 500)


def content_of(content: bytes, expected_bytes: int = rosbag.CHUNK_LIMIT) -> rosbag.Content:
    return rosbag.read_content(reader(content), 0, rosbag.CHUNK_LIMIT, expected_bytes)


NO_TIME, NO_CONNECTION = (
    pack_record({"conn": bytes(4), "op": b"\x02", "time": bytes(8), field: b"1"}, b"") for field in ("time", "conn")
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
    """Trusts a message only if what follows it is a record."""
    found = content_of(content)
    assert (found.ending, found.bytes, len(found.index[0])) == (ending, len(ONE), 12)


def test_set_up_records_finds_connections_and_first_messages() -> None:
    first, second = connection(b"/1", 1), connection(b"/2", 2)
    content = first + message(0, 1, 1) + message(0, 2, 1) + second + message(0, 1, 2)
    found = list(rosbag.set_up_records(reader(content + b"damage")))
    assert [record.op for _, record in found] == [Op.CONNECTION, Op.MESSAGE, Op.CONNECTION, Op.MESSAGE]
    assert (found[0][0], found[-1][1].end) == (0, len(content))
