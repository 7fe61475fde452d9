"""A recording as files that other programs read: PNG or NPZ per stream, timestamps, intrinsics, point clouds.

The files of an export: a PNG per frame with a table, one NPZ per stream, a point cloud per set.
"""

import csv
import json
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event
from typing import IO, Any, Literal, Protocol

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from nlos_cam.camera import FORMATS, FrameSet, FrameSynchronizer, Sample
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.files import atomic_directory
from nlos_cam.recording.bag_reader import BagFile

POINTS = "points"
TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGRA}
"""What a PNG wants of encodings that OpenCV does not write as they are; a .npz keeps every stream's own bytes."""


class Sink(Protocol):
    """Where the frames of one stream go."""

    def add(self, sample: Sample) -> None: ...

    def close(self) -> None:
        """Finish the files."""
        ...


class PngSink:
    """One PNG a frame, named by its number (16 bit for depth, in the stream's own units), and a table of timestamps."""

    def __init__(self, folder: Path, stream: str, encoding: str) -> None:
        self._folder, self._encoding = folder / stream, encoding
        self._folder.mkdir()
        self._table = (folder / f"{stream}.csv").open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._table)
        self._rows.writerow(["file", "frame_number", "timestamp_s"])
        self._seen: Counter[int] = Counter()

    def add(self, sample: Sample) -> None:
        """Raises NlosCamError where the picture cannot be written."""
        self._seen[sample.number] += 1
        again = f"-{self._seen[sample.number]}" if self._seen[sample.number] > 1 else ""
        path = self._folder / f"{sample.number:06d}{again}.png"
        code = TO_BGR.get(self._encoding)
        pixels = sample.pixels if code is None else cv2.cvtColor(sample.pixels, code)
        done, png = cv2.imencode(".png", pixels)
        if not done:
            raise NlosCamError(f"frame {sample.number} of {sample.stream} ({self._encoding}) makes no PNG: use npz")
        path.write_bytes(png.tobytes())
        self._rows.writerow([f"{self._folder.name}/{path.name}", sample.number, f"{sample.timestamp_s:.6f}"])

    def close(self) -> None:
        self._table.close()


class NpzSink:
    """All frames of a stream in one .npz: pixels (N, height, width), frame_number, timestamp_s (N,)."""

    def __init__(self, folder: Path, stream: str, constants: dict[str, Any]) -> None:
        self._path, self._constants = folder / f"{stream}.npz", constants
        self._pixels: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115  closed in close()
        self._shape: tuple[int, ...] = ()
        self._type: np.dtype[Any] = np.dtype(np.uint8)
        self._numbers: list[int] = []
        self._timestamps_s: list[float] = []

    def add(self, sample: Sample) -> None:
        """Raises RecordingError where a frame is of another size than those before it."""
        self._shape, self._type = self._shape or sample.pixels.shape, sample.pixels.dtype
        if sample.pixels.shape != self._shape:
            raise RecordingError(
                f"frame {sample.number} of {sample.stream} is {sample.pixels.shape}, those before are {self._shape}: "
                "export as png"
            )
        self._pixels.write(np.ascontiguousarray(sample.pixels).tobytes())
        self._numbers.append(sample.number)
        self._timestamps_s.append(sample.timestamp_s)

    def close(self) -> None:
        self._pixels.flush()
        shape = len(self._numbers), *self._shape
        pixels = np.memmap(self._pixels, self._type, "r", shape=shape) if self._numbers else np.zeros(shape, self._type)
        np.savez_compressed(
            self._path,
            pixels=pixels,
            frame_number=np.array(self._numbers, np.int64),
            timestamp_s=np.array(self._timestamps_s),
            **self._constants,
        )
        del pixels
        self._pixels.close()


class PointSink:
    """One binary PLY for each whole set, or the first `most`; grey by infrared.

    Metres in the lidar frame: x right, y down, z ahead.
    """

    def __init__(self, folder: Path, rays: NDArray[np.float64], unit_m: float, most: int | None = None) -> None:
        self._folder, self._rays, self._unit_m, self._most = folder / POINTS, rays, unit_m, most
        self._folder.mkdir()
        self._pairing = FrameSynchronizer(rays.shape[:2])
        self.written = 0

    def add(self, sample: Sample) -> None:
        if self.written == self._most or sample.stream not in FORMATS:
            return
        if found := self._pairing.add(sample):
            self._write(found)

    def _write(self, found: FrameSet) -> None:
        seen = found.depth_z16 > 0
        points_m = self._rays[seen] * (found.depth_z16[seen] * self._unit_m)[:, np.newaxis]
        grey = np.repeat(found.ir[seen][:, np.newaxis], 3, axis=1)
        cloud: Any = trimesh.PointCloud(points_m, colors=grey)
        (self._folder / f"{found.number:06d}.ply").write_bytes(cloud.export(file_type="ply"))
        self.written += 1

    def close(self) -> None:
        """Every cloud is a file of its own."""


Format = Literal["png", "npz"]
INFO = "export.json"


@dataclass(frozen=True)
class Exported:
    """What an export wrote."""

    frames: dict[str, int]
    """By stream; and under `points`, point clouds."""
    out: str
    damage: str = ""
    """Why it ends before the recording does; empty if it does not."""


@dataclass(frozen=True)
class Wanted:
    """What is wanted of a recording."""

    format: Format = "png"
    points: bool = False
    """A point cloud for each whole set of depth, infrared and confidence; else for the first, if all is exported."""
    streams: Collection[str] = ()
    """By name; none means all."""
    every: int = 1
    """Only frames whose number this divides."""


def export_recording(
    bag: BagFile,
    out: Path,
    wanted: Wanted,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
) -> Exported:
    """Write what is `wanted` of a recording into the folder `out`.

    Setting `stop` ends it early and keeps what is done, and so does damage within the recording. Raises
    RecordingError for streams that the recording lacks.
    """
    streams = _streams(bag, wanted)
    written: Counter[str] = Counter(dict.fromkeys(streams, 0))
    damage = ""
    with atomic_directory(out) as part:
        (part / INFO).write_text(json.dumps(_info(bag, wanted), indent=1) + "\n", encoding="utf-8")
        with ExitStack() as closing:
            sinks = {stream: _sink(bag, stream, part, wanted.format) for stream in streams}
            points = _points(bag, wanted, part)
            for sink in [*sinks.values(), *([points] if points else [])]:
                closing.callback(sink.close)
            try:
                _pour(bag, wanted, sinks, points, written, stop, on_frame)
            except RecordingError as error:
                damage = str(error)
    if points:
        written[POINTS] = points.written
    return Exported(dict(written), str(out), damage)


def _pour(
    bag: BagFile,
    wanted: Wanted,
    sinks: dict[str, Sink],
    points: PointSink | None,
    written: Counter[str],
    stop: Event,
    on_frame: Callable[[], None],
) -> None:
    needed = {*sinks, *(FORMATS if points else ())}
    for sample in bag.samples(needed):
        if stop.is_set():
            return
        on_frame()
        if sample.stream in sinks and sample.number % wanted.every == 0:
            sinks[sample.stream].add(sample)
            written[sample.stream] += 1
        if points and sample.number % wanted.every == 0:
            points.add(sample)


def _streams(bag: BagFile, wanted: Wanted) -> list[str]:
    """The streams to write. Raises RecordingError for one that is not there."""
    present = [name for name, info in bag.streams.items() if info.format]
    if missing := sorted(set(wanted.streams) - set(present)):
        raise RecordingError(f"{bag.path} has no {' and no '.join(missing)} stream: it has {', '.join(present)}")
    if wanted.points and (missing := [stream for stream in FORMATS if stream not in present]):
        raise RecordingError(f"{bag.path} has no {' and no '.join(missing)} stream: point clouds need all three")
    return [name for name in present if not wanted.streams or name in wanted.streams]


def _sink(bag: BagFile, stream: str, folder: Path, form: Format) -> Sink:
    info = bag.streams[stream]
    if form == "png":
        return PngSink(folder, stream, info.format)
    pinhole = {name: np.array(value) for name, value in asdict(info.intrinsics).items()}
    unit = {"depth_unit_m": np.array(bag.depth_unit_m())} if info.format == "z16" else {}
    return NpzSink(folder, stream, {**pinhole, **unit, "encoding": np.array(info.format)})


def _points(bag: BagFile, wanted: Wanted, folder: Path) -> PointSink | None:
    has_sets = all(stream in bag.streams and bag.streams[stream].format for stream in FORMATS)
    if not wanted.points and (wanted.streams or not has_sets):
        return None
    most = None if wanted.points else 1
    return PointSink(folder, bag.streams["depth"].intrinsics.rays(), bag.depth_unit_m(), most)


def _info(bag: BagFile, wanted: Wanted) -> dict[str, Any]:
    """What holds for the whole recording: the device, its settings, each stream's intrinsics."""
    streams = {
        name: {
            "format": info.format,
            "frames_per_s": info.frames_per_s,
            "frames_in_recording": info.frames,
            "intrinsics": asdict(info.intrinsics),
            "settings": dict(bag.settings(bag.end_ns, name)),
        }
        for name, info in bag.streams.items()
    }
    unit = {"depth_unit_m": bag.depth_unit_m()} if "depth" in bag.streams else {}
    return {
        "recording": bag.path.name,
        "device": dict(bag.device),
        **unit,
        "every": wanted.every,
        "streams": streams,
    } | {"capture": _noted(bag.path.with_suffix(".json"))}


def _noted(beside: Path) -> Any:
    """What `capture` noted of the recording in the file beside it; None where that is not there, or something else."""
    try:
        return json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
