"""Export of a recording to files of other programs: PNG or NPZ per stream, timestamps, intrinsics,
point clouds.
"""

import csv
import json
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event
from typing import IO, Any, Literal

import cv2
import numpy as np
import trimesh
from nlos_calibration.arrays import Float64

from nlos_cam.camera import FORMATS, FrameSet, FrameSynchronizer, Sample
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.files import TEXT_LIMIT, atomic_directory, read_bounded
from nlos_cam.recording.bag_reader import BagReader

POINTS = "points"
TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGRA}
"""Conversions to OpenCV's order of channels for PNG; a .npz keeps every stream's own."""


class PngSink:
    """Writer of one PNG per frame, named by its number (16 bit depth in raw units), and a table of
    timestamps.
    """

    def __init__(self, folder: Path, stream: str, encoding: str) -> None:
        self._folder = folder / stream
        self._encoding = encoding
        self._folder.mkdir()
        self._table = (folder / f"{stream}.csv").open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._table)
        self._rows.writerow(["file", "frame_number", "timestamp_s"])
        self._repeats: Counter[int] = Counter()

    def add(self, sample: Sample) -> None:
        """Write a frame. Raises NlosCamError for an encoding that PNG does not have."""
        self._repeats[sample.number] += 1
        suffix = f"-{self._repeats[sample.number]}" if self._repeats[sample.number] > 1 else ""
        path = self._folder / f"{sample.number:06d}{suffix}.png"
        code = TO_BGR.get(self._encoding)
        pixels = sample.pixels if code is None else cv2.cvtColor(sample.pixels, code)
        done, png = cv2.imencode(".png", pixels)
        if not done:
            raise NlosCamError(
                f"{sample.stream} ({self._encoding}) cannot be written as PNG: use --format npz"
            )
        path.write_bytes(png.tobytes())
        self._rows.writerow(
            [f"{self._folder.name}/{path.name}", sample.number, f"{sample.timestamp_s:.6f}"]
        )

    def close(self) -> None:
        self._table.close()


class NpzSink:
    """Writer of one .npz with all frames of a stream: pixels (N, height, width), frame_number (N,),
    timestamp_s (N,).

    Collects pixels in a temporary file, not in memory.
    """

    def __init__(self, folder: Path, stream: str, constants: dict[str, Any]) -> None:
        self._path = folder / f"{stream}.npz"
        self._constants = constants
        self._pixels: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115  closed in close()
        self._shape: tuple[int, ...] = ()
        self._type: np.dtype[Any] = np.dtype(np.uint8)
        self._numbers: list[int] = []
        self._timestamps_s: list[float] = []

    def add(self, sample: Sample) -> None:
        """Take a frame. Raises RecordingError for one of another size than those before it."""
        self._shape = self._shape or sample.pixels.shape
        self._type = sample.pixels.dtype
        if sample.pixels.shape != self._shape:
            raise RecordingError(
                f"frame {sample.number} of {sample.stream} has shape {sample.pixels.shape}, those"
                f" before have {self._shape}: use --format png"
            )
        self._pixels.write(np.ascontiguousarray(sample.pixels).tobytes())
        self._numbers.append(sample.number)
        self._timestamps_s.append(sample.timestamp_s)

    def close(self) -> None:
        self._pixels.flush()
        shape = len(self._numbers), *self._shape
        pixels = (
            np.memmap(self._pixels, self._type, "r", shape=shape)
            if self._numbers
            else np.zeros(shape, self._type)
        )
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
    """Writer of one binary PLY per complete set of streams, at most `limit`, gray by infrared.

    Points in metres in the lidar frame: x right, y down, z forward.
    """

    def __init__(
        self, folder: Path, rays: Float64, unit_m: float, limit: int | None = None
    ) -> None:
        self._folder = folder / POINTS
        self._rays = rays
        self._unit_m = unit_m
        self._limit = limit
        self._folder.mkdir()
        self._pairing = FrameSynchronizer((rays.shape[0], rays.shape[1]))
        self.written = 0

    def add(self, sample: Sample) -> None:
        if self.written == self._limit or sample.stream not in FORMATS:
            return
        if found := self._pairing.add(sample):
            self._write(found)

    def _write(self, found: FrameSet) -> None:
        valid = found.depth_z16 > 0
        points_m = self._rays[valid] * (found.depth_z16[valid] * self._unit_m)[:, np.newaxis]
        gray = np.repeat(found.ir[valid][:, np.newaxis], 3, axis=1)
        cloud: Any = trimesh.PointCloud(points_m, colors=gray)
        (self._folder / f"{found.number:06d}.ply").write_bytes(cloud.export(file_type="ply"))
        self.written += 1

    def close(self) -> None:
        """Do nothing: each cloud is a file of its own."""


Format = Literal["png", "npz"]
INFO = "export.json"


@dataclass(frozen=True)
class ExportResult:
    """Files written by an export."""

    frames: dict[str, int]
    """By stream; `points` counts point clouds."""
    out: str
    damage: str = ""
    """Error that ended it before the end of the recording; empty if none did."""


@dataclass(frozen=True)
class ExportOptions:
    """Selection of frames, and their file format."""

    format: Format = "png"
    points: bool = False
    """A point cloud for each complete set; otherwise one for the first, when all streams are
    exported.
    """
    streams: Collection[str] = ()
    """By name; empty for all."""
    every: int = 1
    """Only frames whose number is divisible by this."""


def export_recording(
    bag: BagReader,
    out: Path,
    options: ExportOptions,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
) -> ExportResult:
    """Write the selected frames of a recording into the directory `out`.

    Setting `stop` ends it early and keeps the frames so far, and so does damage within the
    recording. Raises RecordingError for streams that the recording does not have.
    """
    streams = _streams(bag, options)
    written: Counter[str] = Counter(dict.fromkeys(streams, 0))
    damage = ""
    with atomic_directory(out) as part:
        (part / INFO).write_text(json.dumps(_info(bag, options), indent=1) + "\n", encoding="utf-8")
        with ExitStack() as closing:
            sinks = {stream: _sink(bag, stream, part, options.format) for stream in streams}
            points = _points(bag, options, part)
            for sink in [*sinks.values(), *([points] if points else [])]:
                closing.callback(sink.close)
            try:
                for sample in bag.samples({*sinks, *(FORMATS if points else ())}):
                    if stop.is_set():
                        break
                    on_frame()
                    if sample.number % options.every:
                        continue
                    if sample.stream in sinks:
                        sinks[sample.stream].add(sample)
                        written[sample.stream] += 1
                    if points:
                        points.add(sample)
            except RecordingError as error:
                damage = str(error)
    if points:
        written[POINTS] = points.written
    return ExportResult(dict(written), str(out), damage)


def _streams(bag: BagReader, options: ExportOptions) -> list[str]:
    """Return the streams to write. Raises RecordingError for one that the recording does not
    have.
    """
    present = [name for name, info in bag.streams.items() if info.format]
    if missing := sorted(set(options.streams) - set(present)):
        raise RecordingError(
            f"{bag.path} has no {' and no '.join(missing)} stream: it has {', '.join(present)}"
        )
    if options.points and (missing := [stream for stream in FORMATS if stream not in present]):
        raise RecordingError(
            f"{bag.path} has no {' and no '.join(missing)} stream: point clouds need all three"
        )
    return [name for name in present if not options.streams or name in options.streams]


def _sink(bag: BagReader, stream: str, folder: Path, form: Format) -> PngSink | NpzSink:
    info = bag.streams[stream]
    if form == "png":
        return PngSink(folder, stream, info.format)
    pinhole = {name: np.array(value) for name, value in asdict(info.intrinsics).items()}
    unit = {"depth_unit_m": np.array(bag.depth_unit_m())} if info.format == "z16" else {}
    return NpzSink(folder, stream, {**pinhole, **unit, "encoding": np.array(info.format)})


def _points(bag: BagReader, options: ExportOptions, folder: Path) -> PointSink | None:
    has_sets = all(stream in bag.streams and bag.streams[stream].format for stream in FORMATS)
    if not options.points and (options.streams or not has_sets):
        return None
    limit = None if options.points else 1
    return PointSink(folder, bag.streams["depth"].intrinsics.rays(), bag.depth_unit_m(), limit)


def _info(bag: BagReader, options: ExportOptions) -> dict[str, Any]:
    """Return facts of the whole recording for JSON: device, settings, intrinsics by stream, and its
    sidecar.
    """
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
        "every": options.every,
        "streams": streams,
        "capture": _read_json(bag.path.with_suffix(".json")),
    }


def _read_json(path: Path) -> Any:
    """Return a file's JSON, numbers that are not finite as null; None where there is none."""
    try:
        text = read_bounded(path, TEXT_LIMIT).decode()
        return json.loads(text, parse_constant=lambda _: None, parse_float=_finite)
    except (OSError, ValueError, RecursionError):
        return None


def _finite(digits: str) -> float | None:
    return number if isfinite(number := float(digits)) else None
