"""Recordings made of others, message by message."""

from collections.abc import Callable, Iterable
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, Writer

Messages = Iterable[tuple[int, bytes]]
Edit = Callable[[str, int, bytes], Messages]
"""Makes messages (time in ns, bytes) of one (topic, time in ns, bytes)."""


def rewrite(source: Path, target: Path, edit: Edit, compression: str | None = None) -> Path:
    """Write the messages that `edit` makes of a recording's; a topic without any is left out."""
    writer = Writer(target)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    made: dict[int, Connection] = {}
    with Reader(source) as reader, writer:
        for found, time_ns, raw in reader.messages():
            for new_time_ns, new_raw in edit(found.topic, time_ns, raw):
                if found.id not in made:
                    made[found.id] = writer.add_connection(
                        found.topic, found.msgtype, msgdef=found.msgdef.data, md5sum=found.digest
                    )
                writer.write(made[found.id], new_time_ns, new_raw)
    return target


def number_of(raw: bytes) -> int:
    """Return the number of the frame in an image's message."""
    return int.from_bytes(raw[:4], "little")
