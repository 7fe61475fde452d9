"""The stream that tests serve lasts until it is told to end, and notes how it ended."""

import pytest
from view_streams import Streams


def test_streams_send_until_their_end(streams: Streams) -> None:
    sent = list[bytes]()

    def send(content: bytes) -> None:
        sent.append(content)
        if len(sent) == 3:
            streams.end.set()

    streams(send)
    assert len(sent) == 3
    assert streams.ended.is_set()
    assert streams.error is None


def test_streams_keep_the_error_of_a_closed_connection(streams: Streams) -> None:
    def send(_: bytes) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        streams(send)
    assert isinstance(streams.error, BrokenPipeError)
    assert streams.ended.is_set()
