"""Recordings made of others, message by message."""

import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
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


TURNED = np.array(
    [
        [0.28, 0.0, -0.96, 0.026],
        [0.0, 1.0, 0.0, 0.02],
        [0.96, 0.0, 0.28, -0.018],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of the infrared camera of `turned_infrared` in the frame of the depth stream."""
LENS = [0.15, -0.5, -0.001, 0.0006, 0.47]


def turned_infrared(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Give a camera's infrared a pose and a lens of its own, so that none passes by chance."""
    if topic.endswith("/Infrared_0/tf/1"):
        raw = struct.pack("<7d", 0.01, -0.02, 0.03, 0.0, 0.6, 0.0, 0.8)  # the inverse of TURNED
    yield from infrared_lens("Brown Conrady", LENS)(topic, time_ns, raw)


def infrared_lens(model: str, coefficients: Sequence[float]) -> Edit:
    """Return the edit that gives a camera's infrared a lens, by the SDK's name of its model."""

    def edit(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith("/Infrared_0/info/camera_info"):
            none = struct.pack("<I4sI5d", 4, b"None", 5, *[0.0] * 5)
            assert none in raw
            name = model.encode()
            lens = struct.pack(f"<I{len(name)}sI5d", len(name), name, 5, *coefficients)
            raw = raw.replace(none, lens)
        yield time_ns, raw

    return edit


def number_of(raw: bytes) -> int:
    """Return the number of the frame in an image's message."""
    return int.from_bytes(raw[:4], "little")
