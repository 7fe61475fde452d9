"""Repair of a killed, cut or damaged recording: its undamaged chunks with a new index, in a new
file.
"""

import re
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from nlos_cam.camera import FORMATS, OnProgress
from nlos_cam.errors import NlosCamError, OutputExistsError, RecordingError
from nlos_cam.files import atomic_file
from nlos_cam.recording import rosbag
from nlos_cam.recording.descriptions import with_descriptions
from nlos_cam.recording.salvage import Chunk, Damage, Scan, scan_bag

FRAMES_TOPIC = re.compile(r"/([A-Za-z]+)_\d+/image/data$")
VERSION_TOPIC = "/file_version"
"""First message of the device's description; librealsense plays no file without it."""
MISSING = (
    "stream descriptions missing, without which librealsense plays nothing: take them from the"
    " recording's first part with --from"
)
RECORD_BYTES = 128
"""Bound on an index or chunk record without its data."""


@dataclass(frozen=True)
class RepairResult:
    """Contents of a repaired recording, and the damage of the original."""

    recovered_frames: dict[str, int]
    """Of depth, infrared and confidence, and of any other stream of images."""
    chunks: int
    damages: list[Damage]
    """In the order of the file."""
    out: Path


def repair_recording(
    path: Path,
    out: Path,
    report: OnProgress = lambda _done, _total: None,
    *,
    take_from: Path | None = None,
) -> RepairResult:
    """Write the undamaged part of the recording `path` to `out`, replacing it atomically; `path` is
    only read.

    The descriptions of its streams come from `take_from`, if given: the first part of a recording
    that was split.

    Raises RecordingError where nothing can be recovered, OutputExistsError if both are the same
    file, NlosCamError where `out` cannot be written.
    """
    if path.exists() and not (
        path.is_file() or path.is_dir()
    ):  # opening a pipe would wait for a writer
        raise RecordingError(f"{path} is not a file: give the path of a .bag recording")
    try:
        same = out.exists() and any(
            out.samefile(source) for source in (path, take_from) if source and source.exists()
        )
        scan = None if same else scan_bag(path, lambda done, total: report(done, 2 * total))
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror}): give the path of a .bag recording"
        ) from error
    if scan is None:
        raise OutputExistsError(
            f"{out} is the recording itself, which is never changed: choose another --out"
        )
    if take_from:
        scan = with_descriptions(scan, path, take_from)
    chunks, damages = _readable(scan)
    if not any(_holds_frames(chunk) for chunk in chunks):
        raise RecordingError(f"{path} has nothing to recover: {_why_nothing(scan)}")
    _write(path, out, replace(scan, chunks=chunks), report)
    return RepairResult(_count_frames(chunks, scan.connections), len(chunks), damages, out)


def recoverable_frames(path: Path) -> dict[str, int]:
    """Return the frames of each stream that a repair of a recording recovers. Raises OSError where
    it cannot be read.
    """
    scan = scan_bag(path)
    return _count_frames(_readable(scan)[0], scan.connections)


def _readable(scan: Scan) -> tuple[list[Chunk], list[Damage]]:
    """Return the chunks, with each described message and each frame once in their indexes, and all
    damage.
    """
    described = _IndexFilter(scan.connections)
    chunks = [chunk for chunk in map(described.narrow, scan.chunks) if chunk.index]
    damages = [*scan.damages, *described.damages.values()]
    if VERSION_TOPIC not in {
        scan.connections[number].topic.lower() for chunk in chunks for number in chunk.index
    }:
        damages.append(Damage(0, 0, MISSING))
    return chunks, sorted(damages, key=lambda damage: damage.position)


class _IndexFilter:
    """Filter of chunk indexes: drops messages without a description, and repeated frames. Feed
    chunks in order.
    """

    def __init__(self, connections: Mapping[int, rosbag.Connection]) -> None:
        self.damages: dict[int, Damage] = {}
        """The first of each connection."""
        self._connections = connections
        self._frames = set[tuple[int, bytes]]()

    def narrow(self, chunk: Chunk) -> Chunk:
        """Return a chunk with the readable part of its index."""
        index = {
            number: self._filter(chunk.at, number, entries)
            for number, entries in chunk.index.items()
        }
        return replace(
            chunk, index={number: entries for number, entries in index.items() if entries}
        )

    def _filter(self, at: int, number: int, entries: bytes) -> bytes:
        if number not in self._connections:
            self.damages.setdefault(
                number, Damage(at, 0, f"connection {number} without a description")
            )
            return b""
        if not FRAMES_TOPIC.search(self._connections[number].topic):
            return entries
        new: list[bytes] = []
        for start in range(0, len(entries), rosbag.ENTRY_BYTES):
            frame = number, entries[start : start + 8]
            if frame not in self._frames:
                self._frames.add(frame)
                new.append(entries[start : start + rosbag.ENTRY_BYTES])
        if len(new) * rosbag.ENTRY_BYTES < len(entries):
            why = f"frames of connection {number} that are there twice (used once)"
            self.damages.setdefault(number, Damage(at, 0, why))
        return b"".join(new)


def _holds_frames(chunk: Chunk) -> bool:
    return any(
        entries[-rosbag.ENTRY_BYTES : -4] != rosbag.SET_UP_TIME for entries in chunk.index.values()
    )


def _why_nothing(scan: Scan) -> str:
    if not scan.bytes:
        return "it is empty"
    if not scan.chunks:
        return f"its {scan.bytes} bytes hold no complete chunk of a recording"
    if any(_holds_frames(chunk) for chunk in scan.chunks):
        return "the descriptions of its messages are lost"
    return "it ends before the first frame"


def _count_frames(
    chunks: list[Chunk], connections: Mapping[int, rosbag.Connection]
) -> dict[str, int]:
    frames = Counter(dict.fromkeys(FORMATS, 0))
    for chunk in chunks:
        for number, entries in chunk.index.items():
            if stream := FRAMES_TOPIC.search(connections[number].topic):
                frames[stream[1].lower()] += len(entries) // rosbag.ENTRY_BYTES
    return dict(frames)


def _write(path: Path, out: Path, scan: Scan, report: OnProgress) -> None:
    try:
        _check_space(out, scan)
        with path.open("rb") as source, atomic_file(out) as part, part.open("wb") as target:
            _Writer(source, target, scan, report).write()
    except OSError as error:
        if isinstance(error, NlosCamError):
            raise
        raise NlosCamError(
            f"{out} cannot be written ({error.strerror}): choose another --out"
        ) from error


def _check_space(out: Path, scan: Scan) -> None:
    index = sum(
        len(entries) + RECORD_BYTES for chunk in scan.chunks for entries in chunk.index.values()
    )
    needed = scan.bytes + index + RECORD_BYTES * len(scan.chunks) + 2 * rosbag.FILE_HEADER_BYTES
    free = shutil.disk_usage(out.parent).free
    if free < needed:
        raise NlosCamError(
            f"{out} needs {needed / 1e6:.3g} MB, but {free / 1e6:.3g} MB are free: choose another"
            " --out"
        )


class _Writer:
    """Writer of a bag from the chunks and connections of a scan; the data of whole chunks are
    copied unchanged.
    """

    def __init__(self, source: BinaryIO, target: BinaryIO, scan: Scan, report: OnProgress) -> None:
        self._source = source
        self._target = target
        self._scan = scan
        self._report = report

    def write(self) -> None:
        """Write the whole file."""
        self._write_header(0)
        infos = [self._write_chunk(chunk) for chunk in self._scan.chunks]
        index_at = self._target.tell()
        connections = sorted(
            self._scan.connections.values(), key=lambda connection: connection.number
        )
        self._target.writelines([connection.record for connection in connections] + infos)
        self._write_header(index_at)
        self._report(2 * self._scan.bytes, 2 * self._scan.bytes)

    def _write_header(self, index_at: int) -> None:
        self._target.seek(0)
        self._target.write(
            rosbag.MAGIC
            + rosbag.pack_file_header(len(self._scan.connections), len(self._scan.chunks), index_at)
        )

    def _write_chunk(self, chunk: Chunk) -> bytes:
        """Write a chunk and its index; return its chunk info for the end of the file."""
        at = self._target.tell()
        self._target.write(rosbag.pack_chunk_head(chunk.compression, chunk.size, chunk.data_bytes))
        self._target.write(self._data(chunk) if chunk.content is None else chunk.content)
        self._target.writelines(
            rosbag.pack_index(number, entries) for number, entries in chunk.index.items()
        )
        self._report(
            min(2 * self._scan.bytes, self._scan.bytes + self._target.tell()), 2 * self._scan.bytes
        )
        return rosbag.pack_chunk_info(at, chunk.index)

    def _data(self, chunk: Chunk) -> bytes:
        self._source.seek(chunk.data_at)
        data = self._source.read(chunk.data_bytes)
        if len(data) < chunk.data_bytes:
            raise RecordingError(
                f"{self._source.name} shrank during the repair: repair it after writing has ended"
            )
        return data
