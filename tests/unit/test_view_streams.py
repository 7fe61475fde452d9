"""The stream that tests serve lasts until it is told to end, and notes how it ended."""

import pytest
from view_streams import Streams


def test_it_sends_until_it_is_told_to_end(streams: Streams) -> None:
    sent = list[bytes]()

    def send(content: bytes) -> None:
        sent.append(content)
        if len(sent) == 3:
            streams.end.set()

    streams(send)
    assert len(sent) == 3
    assert streams.ended.is_set()
    assert streams.error is None


def test_it_notes_that_nobody_listens_any_more(streams: Streams) -> None:
    def send(_: bytes) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        streams(send)
    assert isinstance(streams.error, BrokenPipeError)
    assert streams.ended.is_set()
