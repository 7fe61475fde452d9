"""Damage of every format that nlos-cam reads: consistent changes (lengths, counts, checksums
right), and raw bytes.

`mutate(path, content, random)` changes a file's content by its suffix. The same random generator
gives the same damage.
"""

import hashlib
import io
import json
import pickle
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import torch

from nlos_cam.recording import rosbag

Random = np.random.Generator
NUMBERS = (
    0,
    1,
    2,
    3,
    0x7F,
    0xFF,
    0x7FFF,
    0xFFFF,
    30_000,
    1 << 20,
    1 << 24,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
)
FLOATS = (0.0, -1.0, 1e-300, 1e30, 1e308, float("inf"), float("-inf"), float("nan"))
TEXTS = (
    "",
    "nan",
    "-1",
    "1e999",
    "9" * 5000,
    "../../../evil",
    "/etc/passwd",
    "\x00",
    "\x1b[2J",
    "ä" * 300,
    "mono8",
)
TYPES = ["std_msgs/String", "std_msgs/Float32", "sensor_msgs/Image", "sensor_msgs/CameraInfo"]
TYPES += ["diagnostic_msgs/KeyValue", "geometry_msgs/Transform", "realsense_msgs/StreamInfo"]
TYPES += ["sensor_msgs/PointCloud2", "evil_msgs/Unknown"]
SENSORS = "0", "1", "99", "9" * 5000, "-1", "٣"
DEPTH = 20_000
LENGTH = re.compile(rb"(?s)....(?=(?:compression|conn|count|index_pos|op|size|topic|time)=)")
"""The length of a record's field; the 4 bytes before it may be the length of the record's header."""
ABSURD = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFF0)


def pick(random: Random, values: Any) -> Any:
    """Return one of some values."""
    return values[int(random.integers(len(values)))]


def _span(content: bytearray, random: Random, most: int = 1 << 18) -> slice:
    start = int(random.integers(len(content)))
    return slice(start, start + int(random.integers(1, most)))


def cut(content: bytearray, random: Random) -> None:
    """Lose the end."""
    del content[int(random.integers(len(content))) :]


def flip(content: bytearray, random: Random) -> None:
    """Change some bytes."""
    for at in random.integers(len(content), size=int(random.integers(1, 64))):
        content[at] ^= int(random.integers(1, 256))


def set_lengths(content: bytearray, random: Random) -> None:
    """Put another number where a length is, or just before or after."""
    places = [match.start() for match in LENGTH.finditer(content)]
    for _ in range(int(random.integers(1, 4)) if places else 0):
        at = int(random.choice(places)) + int(random.choice([-4, 0, 4, 8, 13]))
        absurd = random.random() < 0.5
        value = int(random.choice(ABSURD)) if absurd else int(random.integers(1 << 20))
        content[at : at + 4] = value.to_bytes(4, "little")


def zero(content: bytearray, random: Random) -> None:
    """Blank a range."""
    span = _span(content, random)
    content[span] = bytes(len(content[span]))


def remove(content: bytearray, random: Random) -> None:
    """Lose a range."""
    del content[_span(content, random)]


def repeat(content: bytearray, random: Random) -> None:
    """Write a range twice, the second time somewhere."""
    at = int(random.integers(len(content)))
    content[at:at] = content[_span(content, random, 1 << 21)]


def swap(content: bytearray, random: Random) -> None:
    """Exchange two ranges."""
    first, second, third = sorted(int(at) for at in random.integers(len(content), size=3))
    content[first:] = content[second:third] + content[first:second] + content[third:]


WAYS: tuple[Callable[[bytearray, Random], None], ...] = (
    cut,
    flip,
    set_lengths,
    zero,
    remove,
    repeat,
    swap,
)


@dataclass(frozen=True)
class Message:
    """Message of a bag in the making."""

    connection: int
    time: tuple[int, int]
    data: bytes


@dataclass
class Bag:
    """Topics and messages of a bag, to be changed and written again."""

    topics: dict[int, tuple[str, str]]
    """Topic and type by the number of the connection."""
    messages: list[Message]


def read_bag(content: bytes) -> Bag:
    """Return a whole bag's messages in the order of the file."""
    read = rosbag.reader(content)
    at = len(rosbag.MAGIC)
    bag = Bag({}, [])
    while at < len(content):
        record = rosbag.read_record(read, at)
        at = record.end
        if record.op is not rosbag.Op.CHUNK:
            continue
        data = content[record.data_at : record.end]
        data = lz4.frame.decompress(data) if record.fields["compression"] == b"lz4" else data
        chunk = rosbag.reader(data)
        place = 0
        while place < len(data):
            inner = rosbag.read_record(chunk, place)
            place = inner.end
            if inner.op is rosbag.Op.CONNECTION:
                found = rosbag.read_connection(chunk, inner)
                bag.topics[found.number] = found.topic, found.kind
            else:
                number, time = rosbag.message_key(inner)
                seconds, nanoseconds = struct.unpack("<II", time)
                bag.messages.append(
                    Message(number, (seconds, nanoseconds), data[inner.data_at : inner.end])
                )
    return bag


def write_bag(bag: Bag, random: Random, *, packed: bool) -> bytes:
    """Return the bag as a file whose lengths, counts and index are right; now and then it lists
    messages twice.
    """
    out = io.BytesIO()
    infos = list[bytes]()
    connections = b"".join(_connection(number, *names) for number, names in bag.topics.items())
    out.write(rosbag.MAGIC + rosbag.pack_file_header(0, 0, 0))
    for start in range(0, len(bag.messages), 40):
        content = bytearray(connections if start == 0 else b"")
        entries = dict[int, list[bytes]]()
        for message in bag.messages[start : start + 40]:
            time = struct.pack("<II", *message.time)
            entries.setdefault(message.connection, []).append(
                time + len(content).to_bytes(4, "little")
            )
            fields = {"conn": message.connection.to_bytes(4, "little"), "op": b"\x02", "time": time}
            content += rosbag.pack_record(fields, message.data)
        at = out.tell()
        repeats = 1000 if random.random() < 0.01 else 1
        data = lz4.frame.compress(bytes(content)) if packed else bytes(content)
        out.write(
            rosbag.pack_chunk_head("lz4" if packed else "none", len(content), len(data)) + data
        )
        index = {number: b"".join(found) * repeats for number, found in entries.items()}
        out.write(b"".join(rosbag.pack_index(number, found) for number, found in index.items()))
        infos.append(rosbag.pack_chunk_info(at, index))
    index_at = out.tell()
    out.write(connections + b"".join(infos))
    out.seek(len(rosbag.MAGIC))
    out.write(rosbag.pack_file_header(len(bag.topics), len(infos), index_at))
    return out.getvalue()


def _connection(number: int, topic: str, kind: str) -> bytes:
    about = {"type": kind.encode(), "md5sum": b"0" * 32, "message_definition": b"byte x"}
    data = rosbag.pack_head(about, 0)[4:-4]
    return rosbag.pack_record(
        {"conn": number.to_bytes(4, "little"), "op": b"\x07", "topic": topic.encode()}, data
    )


def change_type(bag: Bag, random: Random) -> None:
    """Give a topic another type; its messages stay."""
    number = pick(random, list(bag.topics))
    bag.topics[number] = bag.topics[number][0], pick(random, TYPES)


def change_topic(bag: Bag, random: Random) -> None:
    """Swap two topics, or rename one: another sensor, a path, a stream of another name."""
    one = pick(random, list(bag.topics))
    other = pick(random, list(bag.topics))
    topic, kind = bag.topics[one]
    if random.random() < 0.4:
        other_topic, other_kind = bag.topics[other]
        bag.topics[one] = other_topic, kind
        bag.topics[other] = topic, other_kind
    elif random.random() < 0.6:
        bag.topics[one] = topic.replace("sensor_0", f"sensor_{pick(random, SENSORS)}"), kind
    else:
        stream = pick(random, ("../../x_0", "Infrared_0", "Depth_1", "x" * 300))
        bag.topics[one] = topic.replace("Depth_0", stream), kind


def share_topic(bag: Bag, random: Random) -> None:
    """Add a second connection for a topic, of the same or another type, and spread the messages
    over both.
    """
    one = pick(random, list(bag.topics))
    new = max(bag.topics) + 1
    topic, kind = bag.topics[one]
    bag.topics[new] = topic, pick(random, [kind, *TYPES])
    bag.messages = [
        replace(message, connection=new)
        if message.connection == one and random.random() < 0.5
        else message
        for message in bag.messages
    ]


def many_topics(bag: Bag, random: Random) -> None:
    """Add very many connections."""
    start = max(bag.topics) + 1
    for number in range(start, start + int(10 ** random.uniform(1, 4.5))):
        bag.topics[number] = f"/device_0/sensor_0/Extra_{number}/image/data", pick(random, TYPES)


def change_messages(bag: Bag, random: Random) -> None:
    """Drop, double or shuffle messages."""
    way = pick(random, ("drop", "double", "shuffle", "topic"))
    if way == "shuffle":
        bag.messages = [bag.messages[int(k)] for k in random.permutation(len(bag.messages))]
    elif way == "topic":
        gone = pick(random, list(bag.topics))
        bag.messages = [message for message in bag.messages if message.connection != gone]
    else:
        counts = random.choice([0, 1] if way == "drop" else [1, 2], len(bag.messages))
        bag.messages = [
            m for m, count in zip(bag.messages, counts, strict=True) for _ in range(int(count))
        ]


def change_times(bag: Bag, random: Random) -> None:
    """Change the times of some messages, or of all."""
    share = pick(random, (0.05, 1.0))
    bag.messages = [
        replace(m, time=(pick(random, NUMBERS), pick(random, NUMBERS)))
        if random.random() < share
        else m
        for m in bag.messages
    ]


def change_number(bag: Bag, random: Random) -> None:
    """Put another number into some messages of one topic, at the same place in each."""
    kind = pick(random, list(bag.topics))
    at = int(random.integers(64)) * int(random.integers(1, 3))
    size = pick(random, (1, 4, 8))
    value = (
        struct.pack("<d", pick(random, FLOATS))[:size]
        if size == 8
        else pick(random, NUMBERS).to_bytes(4, "little")
    )
    bag.messages = [
        replace(
            m,
            data=(m.data[:at] + value[:size] + m.data[at + size :])[: max(len(m.data), at + size)],
        )
        if m.connection == kind
        else m
        for m in bag.messages
    ]


def change_size(bag: Bag, random: Random) -> None:
    """Declare another size of images or cameras, with as many bytes as that takes, or without."""
    images = [
        n
        for n, (_, kind) in bag.topics.items()
        if kind in {"sensor_msgs/Image", "sensor_msgs/CameraInfo"}
    ]
    if not images:
        return
    chosen = pick(random, images)
    (height, width) = (pick(random, (0, 1, 7, 60, 240, 30_000)) for _ in range(2))
    is_whole = random.random() < 0.5 and height * width < 1 << 20
    changed = list[Message]()
    for m in bag.messages:
        data = m.data
        if m.connection == chosen and len(data) > 24:
            frame_id_bytes = int.from_bytes(data[12:16], "little") % (len(data) - 16)
            at = 16 + frame_id_bytes
            data = data[:at] + struct.pack("<II", height, width) + data[at + 8 :]
            if is_whole and bag.topics[chosen][1] == "sensor_msgs/Image":
                name_end = at + 12 + int.from_bytes(data[at + 8 : at + 12], "little")
                pixel_bytes = pick(random, (1, 2))
                head = data[: name_end + 1] + struct.pack(
                    "<II", width * pixel_bytes, width * height * pixel_bytes
                )
                data = head + bytes(width * height * pixel_bytes)
        changed.append(replace(m, data=data))
    bag.messages = changed


def change_text(bag: Bag, random: Random) -> None:
    """Put other strings into KeyValue and StreamInfo messages, with their lengths."""
    for k, m in enumerate(bag.messages):
        kind = bag.topics[m.connection][1]
        if (
            kind not in {"diagnostic_msgs/KeyValue", "realsense_msgs/StreamInfo"}
            or random.random() < 0.6
        ):
            continue
        text = pick(random, TEXTS).encode()
        packed = len(text).to_bytes(4, "little") + text
        at = 4 + int.from_bytes(m.data[:4], "little") if "KeyValue" in kind else 4
        tail = b"" if "KeyValue" in kind else m.data[-1:]
        bag.messages[k] = replace(m, data=m.data[:at] + packed + tail)


BAG_WAYS = (change_type, change_topic, share_topic, many_topics, change_messages, change_times)
BAG_WAYS += (change_number, change_size, change_text)


def mutate_bag(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change a whole bag in one to three consistent ways."""
    bag = read_bag(content)
    ways = [pick(random, BAG_WAYS) for _ in range(int(random.integers(1, 4)))]
    for way in ways:
        way(bag, random)
    return "+".join(way.__name__ for way in ways), write_bag(
        bag, random, packed=bool(random.random() < 0.3)
    )


def mutate_shard(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change an HDF5 shard with the library; right checksums now and then."""
    memory = io.BytesIO(content)
    with h5py.File(memory, "r+") as file:
        name = pick(random, list(file))
        way = pick(random, ("value", "shape", "type", "link", "gone", "attribute", "sum"))
        values = file[name][:]
        checksum = file[name].attrs["sha256"]
        if way in {"value", "sum"} and values.dtype.kind in "fiu":
            values.ravel()[int(random.integers(values.size))] = pick(random, (0, 1, 77))
            file[name][:] = values
            if way == "sum":
                del file[name].attrs["sha256"]
        elif way == "attribute":
            file.attrs[pick(random, list(file.attrs))] = pick(random, (*TEXTS[:3], 5, 1e300))
        else:
            del file[name]
            if way == "link":
                links = (
                    h5py.ExternalLink("/etc/passwd", "/x"),
                    h5py.SoftLink("/seed"),
                    h5py.SoftLink("/no"),
                )
                file[name] = pick(random, links)
            elif way != "gone":
                shape = (int(pick(random, NUMBERS)),) if way == "shape" else (3,)
                kind = (
                    "f4"
                    if way == "shape"
                    else pick(random, ("c16", h5py.ref_dtype, h5py.string_dtype(), "i1"))
                )
                chunks = (min(max(shape[0], 1), pick(random, (1, 1 << 20))),)
                file.create_dataset(name, shape, kind, chunks=chunks, compression="gzip").attrs[
                    "sha256"
                ] = checksum
    return way, memory.getvalue()


def mutate_transient(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change a field of a transient with the library."""
    memory = io.BytesIO(content)
    with h5py.File(memory, "r+") as file:
        name = pick(random, list(file))
        way = pick(random, ("value", "shape", "type", "rank", "gone"))
        values = np.array(file[name])
        if way == "value" and values.dtype.kind == "f":
            values.reshape(-1)[int(random.integers(values.size))] = pick(random, FLOATS)
            file[name][...] = values
            return f"{way} {name}", memory.getvalue()
        del file[name]
        if way == "shape":
            size = int(pick(random, NUMBERS))
            file.create_dataset(name, (size,), "f4", chunks=(1 << 10,), compression="gzip")
        elif way == "type":
            file[name] = pick(random, TEXTS[:3])
        elif way == "rank":
            file[name] = values[None]
    return f"{way} {name}", memory.getvalue()


def mutate_tensors(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change the header of a safetensors file with its length right again, or its tensors."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    data = bytearray(content[start:])
    way = pick(random, ("header", "bits", "fill"))
    if way == "header":
        entry = header[pick(random, [name for name in header if name != "__metadata__"])]
        key = pick(random, list(entry))
        entry[key] = pick(
            random, ("F16", "F64", "BOOL", [0, 1 << 62], [1 << 40], [-1], None, [], {}, "x" * 1000)
        )
    elif way == "bits":
        for at in random.integers(len(data), size=int(random.integers(1, 20))):
            data[at] ^= 1 << int(random.integers(8))
    else:
        data[:] = pick(random, (b"\x00", b"\xff", b"\x7e")) * len(data)
    text = json.dumps(header).encode()
    return way, len(text).to_bytes(8, "little") + text + bytes(data)


def mutate_arrays(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change one array of an .npz file, packed again: values, shape, type, or a header that
    lies.
    """
    with np.load(io.BytesIO(content)) as file:
        arrays = dict(file)
    name = pick(random, list(arrays))
    way = pick(random, ("value", "shape", "type", "object", "gone", "lie"))
    values = arrays[name]
    out = io.BytesIO()
    if way == "gone":
        del arrays[name]
    elif way == "value":
        is_number = values.dtype.kind in "fiu"
        arrays[name] = (
            np.full_like(values, pick(random, (0, 1, 7))) if is_number else np.array("[" * 900)
        )
    elif way == "shape":
        arrays[name] = pick(
            random, (values.ravel(), values[None], np.zeros(0, values.dtype), np.zeros((3, 3)))
        )
    elif way == "type":
        arrays[name] = np.array(pick(random, ("text", b"bytes", 5, [1j], [True])))
    np.savez(out, **({**arrays, name: np.array([{}], object)} if way == "object" else arrays))
    if way == "lie":
        return way, out.getvalue().replace(b"'shape': (", b"'shape': (9999999, ", 1)
    return way, out.getvalue()


def mutate_text(content: bytes, random: Random) -> tuple[str, bytes]:
    """Change TOML or JSON: values, names, lines, nesting, length."""
    lines = content.decode().splitlines()
    way = pick(random, ("value",) * 3 + ("gone", "twice", "nest", "long"))
    at = int(random.integers(max(len(lines), 1)))
    start, mark, value = lines[at].partition(": " if content.startswith(b"{") else " = ")
    if way == "value" and mark:
        texts = '""', "true", "[]", "{}", "null", '"' + "x" * 5000 + '"', "[[[[]]]]", "1e999"
        new = pick(random, (*map(str, (*NUMBERS, *FLOATS)), *texts))
        lines[at] = start + mark + new + ("," if value.endswith(",") else "")
    elif way == "gone":
        del lines[at]
    elif way == "twice":
        lines.insert(at, lines[at])
    elif way == "nest":
        lines[at] = start + mark + pick(random, ("[", '{"a":', "{a = ", "a." * 9)) * DEPTH
    elif way == "long":
        lines.insert(at, "# " + "x" * int(10 ** random.uniform(3, 6.5)))
    return way, "\n".join(lines).encode()


NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
HEADER_BYTES = 4096


def mutate_numbers(content: bytes, random: Random) -> tuple[str, bytes]:
    """Put other numbers into the text or the header of a mesh or an array, or another count into a
    binary one.
    """
    bad = bytearray(content)
    if content[:80] == bytes(80):  # a binary .stl
        bad[80:84] = pick(random, NUMBERS).to_bytes(4, "little")
        return "count", bytes(bad)
    for _ in range(int(random.integers(1, 4))):
        found = list(NUMBER.finditer(bytes(bad[:HEADER_BYTES])))
        if found:
            start, end = pick(random, found).span()
            bad[start:end] = str(pick(random, (*NUMBERS, *FLOATS, -5, 10**30))).encode()
    return "numbers", bytes(bad)


class _Evil:
    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return print, ("unpickled",)


def mutate_state(content: bytes, random: Random) -> tuple[str, bytes]:
    """Replace a run's state by another with its digest: other types, hostile pickles, other
    parts.
    """
    state = torch.load(io.BytesIO(content[32:]), weights_only=True)
    key = pick(random, list(state))
    other = {**state, key: pick(random, (None, 5, "x", [], {}))}
    bad: tuple[Any, ...] = (5, None, [], "x", other, _Evil(), {key: state[key]})
    out = io.BytesIO()
    chosen = int(random.integers(len(bad) + 1))
    if chosen < len(bad):
        torch.save(bad[chosen], out)
    else:
        pickle.dump(_Evil(), out)
    return f"state {chosen}", hashlib.sha256(out.getvalue()).digest() + out.getvalue()


FORMATS: Mapping[str, Callable[[bytes, Random], tuple[str, bytes]]] = {
    ".bag": mutate_bag,
    ".h5": mutate_shard,
    ".hdf5": mutate_transient,
    ".safetensors": mutate_tensors,
    ".npz": mutate_arrays,
    ".toml": mutate_text,
    ".json": mutate_text,
    ".ckpt": mutate_state,
    **dict.fromkeys((".obj", ".ply", ".stl", ".npy"), mutate_numbers),
}


def mutate(path: Path, content: bytes, random: Random) -> tuple[str, bytes]:
    """Return the ways taken and the content, changed by the rules of its format (mostly), or as
    bytes.
    """
    if (change := FORMATS.get(path.suffix)) and random.random() < 0.8:
        return change(content, random)
    bad = bytearray(content)
    way = pick(random, WAYS)
    way(bad, random)
    return way.__name__, bytes(bad)
