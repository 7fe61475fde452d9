import struct

import pytest

from nlos_cam.recording.rosbag import (
    CHUNK_LIMIT,
    Content,
    Ending,
    Op,
    pack_index,
    pack_record,
    read_content,
    reader,
    set_up_records,
)

DESCRIPTION = {"type": b"std_msgs/String", "md5sum": b"0" * 32, "message_definition": b"string data"}
AFTER = pack_index(0, bytes(12))


def connection(number: int) -> bytes:
    fields = {"conn": number.to_bytes(4, "little"), "op": b"\x07", "topic": b"/topic%d" % number}
    return pack_record(fields, pack_record(DESCRIPTION, b"")[4:-4])


def message(seconds: int, nanoseconds: int, number: int = 0) -> bytes:
    fields = {"conn": number.to_bytes(4, "little"), "op": b"\x02", "time": struct.pack("<II", seconds, nanoseconds)}
    return pack_record(fields, bytes(50))


ONE = message(0, 500)


def content_of(content: bytes, expected_bytes: int = CHUNK_LIMIT) -> Content:
    return read_content(reader(content), 0, CHUNK_LIMIT, expected_bytes)


def test_messages_are_indexed_by_time_and_connections_by_number() -> None:
    parts = [connection(5), message(256, 0, 5), connection(2), message(1, 7, 5), message(1, 7, 2), message(1, 7, 5)]
    starts = [sum(map(len, parts[:i])) for i in range(len(parts))]
    found = content_of(b"".join(parts))
    assert {number: each.record for number, each in found.connections.items()} == {5: parts[0], 2: parts[2]}
    assert list(found.index) == [2, 5]
    assert list(struct.iter_unpack("<III", found.index[5])) == [
        (1, 7, starts[3]),
        (1, 7, starts[5]),
        (256, 0, starts[1]),
    ]
    assert (found.ending, found.why, found.bytes) == (Ending.WHOLE, "", sum(map(len, parts)))


def test_it_ends_where_it_is_expected_to_or_something_else_comes() -> None:
    assert content_of(ONE + ONE, len(ONE)).bytes == len(ONE)
    assert content_of(ONE + ONE + AFTER).bytes == content_of(ONE + ONE + AFTER, 7).bytes == 2 * len(ONE)


def test_a_start_elsewhere_moves_nothing_but_the_start() -> None:
    found = read_content(reader(b"before" + ONE + ONE), 6, CHUNK_LIMIT, CHUNK_LIMIT)
    assert found == content_of(ONE + ONE)


@pytest.mark.parametrize("missing", [1, 49, 60, len(ONE) - 1])
def test_a_cut_message_is_left_out(missing: int) -> None:
    found = content_of((ONE + ONE)[:-missing])
    assert (found.ending, found.bytes, len(found.index[0])) == (Ending.CUT, len(ONE), 12)


@pytest.mark.parametrize("damage", [b"\xff" * 30, bytes(30), pack_record({"op": b"\x09"}, b"")])
def test_the_message_before_damage_is_not_trusted(damage: bytes) -> None:
    found = content_of(ONE + ONE + damage)
    assert (found.ending, found.bytes, len(found.index[0])) == (Ending.BROKEN, len(ONE), 12)


def test_a_message_without_time_or_connection_is_damage() -> None:
    for field in ("conn", "time"):
        fields = {"conn": bytes(4), "op": b"\x02", "time": bytes(8)}
        found = content_of(ONE + pack_record({**fields, field: b"1"}, b"") + ONE)
        assert (found.ending, found.bytes) == (Ending.BROKEN, len(ONE))


def test_more_than_there_may_be_is_refused() -> None:
    found = read_content(reader(ONE * 9), 0, 3 * len(ONE), CHUNK_LIMIT)
    assert (found.ending, found.bytes) == (Ending.BROKEN, 2 * len(ONE))


def test_what_describes_the_device_is_found_among_frames() -> None:
    content = connection(1) + message(0, 1, 1) + message(0, 2, 1) + connection(2) + message(0, 1, 2)
    found = list(set_up_records(reader(content + b"damage")))
    assert [record.op for _, record in found] == [Op.CONNECTION, Op.MESSAGE, Op.CONNECTION, Op.MESSAGE]
    assert found[0][0] == 0
    assert found[-1][1].end == len(content)
