import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.recording.rosbag import (
    CHUNK_LIMIT,
    HEADER_LIMIT,
    BagCutError,
    BagFormatError,
    BagRecord,
    Content,
    Ending,
    Op,
    Source,
    check_bookkeeping,
    message_key,
    number,
    pack_chunk_info,
    pack_file_header,
    pack_index,
    pack_record,
    parse_fields,
    read_connection,
    read_content,
    read_record,
    reader,
    set_up_records,
)

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


def described(content: bytes) -> tuple[Source, BagRecord]:
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
        check_bookkeeping(read, record)
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
    with pytest.raises(BagCutError):
        read_record(reader(content[:length]), 0)


def test_read_record_does_not_read_an_absurd_header() -> None:
    asked: list[int] = []

    def read(at: int, count: int) -> bytes:
        asked.append(count)
        return struct.pack("<I", HEADER_LIMIT + 1)[at : at + count]

    with pytest.raises(BagFormatError, match="65537"):
        read_record(read, 0)
    assert max(asked) == 4


def test_bad_fields_and_unknown_operations_are_format_errors() -> None:
    with pytest.raises(BagFormatError, match="'count'"):
        number({}, "count")
    with pytest.raises(BagFormatError, match="3"):
        number({"count": b"123"}, "count")
    with pytest.raises(BagFormatError, match="time"):
        message_key(BagRecord(Op.MESSAGE, {"conn": bytes(4), "time": bytes(7)}, 0, 0))
    with pytest.raises(BagFormatError):
        read_record(reader(pack_record({"op": b"\x09"}, b"")), 0)
    for header in (b"\x03\0\0\0abc", b"\xff\xff\xff\xffa=b", b"\x03\0\0\0a=bx", b"\x04\0\0\0a=b", b"\x03\0\0\0\xe4=b"):
        with pytest.raises(BagFormatError):
            parse_fields(header)


def test_read_connection_keeps_its_description() -> None:
    found = read_connection(*described(connection(latching=b"1")))
    assert (found.number, found.topic, found.kind, found.md5sum) == (7, "/a", "std_msgs/String", b"0" * 32)
    assert found.record == connection(latching=b"1")
    assert found.is_like(read_connection(*described(connection())))
    for other in (connection(topic=b"/b"), connection(md5sum=b"1" * 32)):
        assert not found.is_like(read_connection(*described(other)))


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
        pack_record({"conn": bytes(4), "op": b"\x07", "topic": b"/a"}, bytes(HEADER_LIMIT + 1)),
    ],
)
def test_read_connection_refuses_malformed_records(content: bytes) -> None:
    with pytest.raises(BagFormatError):
        read_connection(*described(content))


def test_check_bookkeeping_refuses_impossible_lengths() -> None:
    index, info = pack_index(3, bytes(24)), pack_chunk_info(4117, {3: bytes(24), 5: bytes(12)})
    for whole in (index, info, pack_file_header(1, 2, 3)):
        check_bookkeeping(*described(whole))
    fields = {"count": bytes([9, 0, 0, 0]), "conn": bytes(4)}
    for op, data in ((4, bytes(24)), (6, bytes(24)), (3, b"data"), (3, bytes(HEADER_LIMIT + 1))):
        with pytest.raises(BagFormatError):
            check_bookkeeping(*described(pack_record({**fields, "op": bytes([op])}, data)))


ONE, AFTER = message(0, 500), pack_index(0, bytes(12))


def content_of(content: bytes, expected_bytes: int = CHUNK_LIMIT) -> Content:
    return read_content(reader(content), 0, CHUNK_LIMIT, expected_bytes)


def test_read_content_indexes_messages_by_connection_and_time() -> None:
    five, two = connection(b"/5", 5), connection(b"/2", 2)
    parts = [five, message(256, 0, 5), two, message(1, 7, 5), message(1, 7, 2), message(1, 7, 5)]
    starts = [sum(map(len, parts[:i])) for i in range(len(parts))]
    found = content_of(b"".join(parts))
    assert {number: each.record for number, each in found.connections.items()} == {5: five, 2: two}
    assert list(found.index) == [2, 5]
    expected = [(1, 7, starts[3]), (1, 7, starts[5]), (256, 0, starts[1])]
    assert list(struct.iter_unpack("<III", found.index[5])) == expected
    assert (found.ending, found.why, found.bytes) == (Ending.WHOLE, "", sum(map(len, parts)))
    assert read_content(reader(b"before" + ONE + ONE), 6, CHUNK_LIMIT, CHUNK_LIMIT) == content_of(ONE + ONE)


def test_read_content_ends_at_expected_length_or_other_records() -> None:
    assert content_of(ONE + ONE, len(ONE)).bytes == len(ONE)
    assert content_of(ONE + ONE + AFTER).bytes == content_of(ONE + ONE + AFTER, 7).bytes == 2 * len(ONE)


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


def test_read_content_refuses_more_than_the_limit() -> None:
    found = read_content(reader(ONE * 9), 0, 3 * len(ONE), CHUNK_LIMIT)
    assert (found.ending, found.bytes) == (Ending.BROKEN, 2 * len(ONE))


def test_set_up_records_finds_connections_and_first_messages() -> None:
    first, second = connection(b"/1", 1), connection(b"/2", 2)
    content = first + message(0, 1, 1) + message(0, 2, 1) + second + message(0, 1, 2)
    found = list(set_up_records(reader(content + b"damage")))
    assert [record.op for _, record in found] == [Op.CONNECTION, Op.MESSAGE, Op.CONNECTION, Op.MESSAGE]
    assert (found[0][0], found[-1][1].end) == (0, len(content))
