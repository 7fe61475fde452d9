from browser_page import protobuf_fields


def test_protobuf_fields_are_numbers_and_bytes() -> None:
    message = b"\x08\x96\x01" + b"\x12\x04view" + b"\x12\x00" + b"\x19" + bytes(8) + b"\x18\x05"
    assert protobuf_fields(message) == {1: [150], 2: [b"view", b""], 3: [bytes(8), 5]}
    assert protobuf_fields(b"") == {}
