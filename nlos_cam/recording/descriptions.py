"""Descriptions of device and streams for a later part of a recording, from its first part."""

from dataclasses import replace
from pathlib import Path

from nlos_cam.errors import RecordingError
from nlos_cam.recording import rosbag
from nlos_cam.recording.bag_reader import STREAM, BagReader, raise_as_recording_error
from nlos_cam.recording.salvage import Chunk, Scan, scan_bag

FRAMES = "/image/"
"""In the topics of frames and of their metadata, and in no other."""
NEEDED = ("/info", "/info/camera_info")
"""Topics below a stream's without which no frame of it can be read."""


def with_descriptions(part: Scan, path: Path, first: Path) -> Scan:
    """Return a scan of the recording `path` with the descriptions of `first` before its chunks.

    Raises RecordingError where `first` cannot be read or does not describe its streams.
    """
    bag = BagReader(first)
    first_ns = min(
        (
            entries[0].time_ns
            for topic, entries in bag.entries.items()
            if FRAMES in topic and entries
        ),
        default=bag.end_ns,
    )
    described = {
        topic: [entry for entry in entries if entry.time_ns <= first_ns]
        for topic, entries in bag.entries.items()
        if FRAMES not in topic and topic not in _set_up_topics(part)
    }
    _check_streams(part, path, first, {topic for topic, entries in described.items() if entries})
    theirs = {
        connection.topic: connection for connection in scan_bag(bag.path).connections.values()
    }
    connections = {**part.connections}
    numbers = {connection.topic: number for number, connection in connections.items()}
    content = bytearray()
    index = dict[int, bytes]()
    for topic, entries in described.items():
        if not entries:
            continue
        connection = _numbered(theirs[topic], numbers.get(topic, max(connections, default=-1) + 1))
        connections[connection.number] = connection
        content += connection.record
        for entry in entries:
            index[connection.number] = (
                index.get(connection.number, b"")
                + rosbag.SET_UP_TIME
                + len(content).to_bytes(4, "little")
            )
            with raise_as_recording_error(bag.path, "is damaged"):
                content += _message(connection.number, bytes(bag.raw(entry)))
    chunk = Chunk(0, "none", len(content), 0, len(content), bytes(content), index)
    return replace(part, chunks=[chunk, *part.chunks], connections=connections)


def _set_up_topics(scan: Scan) -> set[str]:
    """Return the topics that are described in the recording itself."""
    return {
        scan.connections[number].topic
        for chunk in scan.chunks
        for number, entries in chunk.index.items()
        if entries.startswith(rosbag.SET_UP_TIME) and number in scan.connections
    }


def _check_streams(part: Scan, path: Path, first: Path, described: set[str]) -> None:
    known = described | _set_up_topics(part)
    for connection in part.connections.values():
        if not (stream := STREAM.match(connection.topic)):
            continue
        if missing := [stream[0] + ending for ending in NEEDED if stream[0] + ending not in known]:
            raise RecordingError(
                f"{first} has no {missing[0]}, which describes a stream of {path}: give the first"
                " part of the same recording"
            )


def _numbered(connection: rosbag.Connection, number: int) -> rosbag.Connection:
    """Return a connection under another number."""
    read = rosbag.reader(connection.record)
    record = rosbag.read_record(read, 0)
    fields = {**record.fields, "conn": number.to_bytes(4, "little")}
    packed = rosbag.pack_record(fields, read(record.data_at, record.data_bytes))
    return replace(connection, number=number, record=packed)


def _message(connection: int, raw: bytes) -> bytes:
    fields = {
        "op": bytes([rosbag.Op.MESSAGE]),
        "conn": connection.to_bytes(4, "little"),
        "time": rosbag.SET_UP_TIME,
    }
    return rosbag.pack_record(fields, raw)
