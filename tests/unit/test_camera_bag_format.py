import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.recording.rosbag import (
    FILE_HEADER_BYTES,
    HEADER_LIMIT,
    BagCutError,
    BagFormatError,
    BagRecord,
    Op,
    Read,
    check_bookkeeping,
    message_key,
    number,
    pack_chunk_head,
    pack_chunk_info,
    pack_file_header,
    pack_index,
    pack_record,
    parse_fields,
    read_connection,
    read_record,
)

NAMES = st.text(st.characters(codec="ascii", exclude_characters="="), min_size=1, max_size=9)
FIELDS = st.dictionaries(NAMES.filter(lambda name: name != "op"), st.binary(max_size=30), max_size=5)
DESCRIBED = {"type": b"std_msgs/String", "md5sum": b"0" * 32, "message_definition": b"string data"}


def reader(content: bytes) -> Read:
    return lambda at, count: content[at : at + count]


def packed(fields: dict[str, bytes]) -> bytes:
    """Fields as the data of a connection."""
    return pack_record(fields, b"")[4:-4]


def connection(topic: bytes = b"/a", **changed: bytes) -> bytes:
    return pack_record({"conn": bytes([7, 0, 0, 0]), "op": b"\x07", "topic": topic}, packed(DESCRIBED | changed))


def described(content: bytes) -> tuple[Read, BagRecord]:
    return reader(content), read_record(reader(content), 0)


@given(FIELDS, st.sampled_from(Op), st.binary(max_size=50), st.binary(max_size=9))
def test_a_record_that_was_written_is_read_as_it_was(
    fields: dict[str, bytes], op: Op, data: bytes, before: bytes
) -> None:
    content = before + pack_record({**fields, "op": bytes([op])}, data)
    record = read_record(reader(content), len(before))
    assert (record.op, dict(record.fields)) == (op, {**fields, "op": bytes([op])})
    assert content[record.data_at : record.end] == data
    assert record.end == len(content)


@given(st.binary(max_size=200))
def test_bytes_are_a_record_or_an_error_of_one_kind(content: bytes) -> None:
    try:
        read, record = described(content)
        check_bookkeeping(read, record)
        found = read_connection(read, record)
    except BagFormatError:
        return
    assert content.startswith(found.record)


@given(st.integers(0, 70), st.integers(0, 255))
def test_a_connection_with_a_changed_byte_is_one_or_an_error(at: int, value: int) -> None:
    content = bytearray(connection())
    content[at % len(content)] = value
    try:
        found = read_connection(*described(bytes(content)))
    except BagFormatError:
        return
    assert found.record == bytes(content)


@given(st.integers(0, 300))
def test_a_record_that_is_cut_within_its_header_is_told_as_cut(length: int) -> None:
    content = pack_record({"op": b"\x02", "name": b"x" * 300}, b"")
    with pytest.raises(BagCutError):
        read_record(reader(content[:length]), 0)


def test_an_absurd_header_is_not_even_read() -> None:
    asked: list[int] = []

    def read(at: int, count: int) -> bytes:
        asked.append(count)
        return struct.pack("<I", HEADER_LIMIT + 1)[at : at + count]

    with pytest.raises(BagFormatError, match="claims 65537 bytes"):
        read_record(read, 0)
    assert max(asked) == 4


@pytest.mark.parametrize(
    "header", [b"\x03\0\0\0abc", b"\xff\xff\xff\xffa=b", b"\x03\0\0\0a=bx", b"\x04\0\0\0a=b", b"\x03\0\0\0\xe4=b"]
)
def test_fields_that_do_not_fill_the_header_are_an_error(header: bytes) -> None:
    with pytest.raises(BagFormatError):
        parse_fields(header)


def test_a_missing_field_and_one_of_another_size_are_errors() -> None:
    with pytest.raises(BagFormatError, match="lacks its field 'count'"):
        number({}, "count")
    with pytest.raises(BagFormatError, match="4 bytes has 3"):
        number({"count": b"123"}, "count")
    with pytest.raises(BagFormatError, match="time is damaged"):
        message_key(BagRecord(Op.MESSAGE, {"conn": bytes(4), "time": bytes(7)}, 0, 0))
    with pytest.raises(BagFormatError, match="no known kind"):
        read_record(reader(pack_record({"op": b"\x09"}, b"")), 0)


def test_a_connection_keeps_its_description_word_for_word() -> None:
    found = read_connection(*described(connection(latching=b"1")))
    assert (found.number, found.topic, found.kind, found.md5sum) == (7, "/a", "std_msgs/String", b"0" * 32)
    assert found.record == connection(latching=b"1")
    assert found.is_like(read_connection(*described(connection())))
    assert not found.is_like(read_connection(*described(connection(topic=b"/b"))))
    assert not found.is_like(read_connection(*described(connection(md5sum=b"1" * 32))))


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
def test_a_connection_that_a_reader_would_stumble_over_is_an_error(content: bytes) -> None:
    with pytest.raises(BagFormatError):
        read_connection(*described(content))


def test_bookkeeping_is_passed_over_only_where_its_length_can_be_right() -> None:
    index, info = pack_index(3, bytes(24)), pack_chunk_info(4117, {3: bytes(24), 5: bytes(12)})
    for whole in (index, info, pack_file_header(1, 2, 3)):
        check_bookkeeping(*described(whole))
    fields = {"count": bytes([9, 0, 0, 0]), "conn": bytes(4)}
    for op, data in ((4, bytes(24)), (6, bytes(24)), (3, b"data"), (3, bytes(HEADER_LIMIT + 1))):
        with pytest.raises(BagFormatError):
            check_bookkeeping(*described(pack_record({**fields, "op": bytes([op])}, data)))


def test_the_files_header_has_one_size_whatever_it_says() -> None:
    sizes = {len(pack_file_header(*says)) for says in ((0, 0, 0), (9, 10**6, 10**12))}
    assert sizes == {FILE_HEADER_BYTES + 8}


def test_a_chunk_info_tells_counts_and_the_first_and_last_time() -> None:
    early, late = struct.pack("<III", 1, 900, 0), struct.pack("<III", 258, 1, 0)
    _, record = described(pack_chunk_info(99, {4: early + late, 6: early}))
    assert struct.unpack("<II", record.fields["start_time"]) == (1, 900)
    assert struct.unpack("<II", record.fields["end_time"]) == (258, 1)
    assert (number(record.fields, "chunk_pos", 8), number(record.fields, "count")) == (99, 2)


def test_a_chunks_head_says_how_long_it_is() -> None:
    head = pack_chunk_head("lz4", 5000, 12)
    record = read_record(reader(head), 0)
    assert (record.op, record.data_at, record.data_bytes) == (Op.CHUNK, len(head), 12)
    assert (record.fields["compression"], number(record.fields, "size")) == (b"lz4", 5000)
