"""Export of a recording to files of other programs: PNG or NPZ per stream, timestamps, intrinsics,
point clouds.
"""

import csv
import json
from collections import Counter, deque
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from glob import escape
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event
from typing import IO, TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import trimesh
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.camera import FORMATS, OPTIONAL, SAME_INSTANT_S, FrameSynchronizer, Sample
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.files import TEXT_LIMIT, atomic_directory, read_bounded
from nlos_cam.recording.bag_reader import BagReader
from nlos_cam.recording.device_clock import unwrapped_samples
from nlos_cam.recording.frame_names import FrameNames
from nlos_cam.recording.sidecar import sidecar_path

if TYPE_CHECKING:
    from nlos_cam.recording.ros_reader import RosReader

POINTS = "points"
RECENT_INSTANTS = 30
"""Instants that a stream may lag behind another."""
TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGRA,
    "yuyv": cv2.COLOR_YUV2BGR_YUYV,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
}
"""Conversions to OpenCV's order of channels for PNG; a .npz keeps every stream's own."""
INTERLEAVED = {"yuyv", "uyvy"}
"""Formats of two bytes a pixel, of which the second belongs to two pixels."""


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
        self._names = FrameNames()

    def add(self, sample: Sample) -> None:
        """Write a frame. Raises NlosCamError for an encoding that PNG does not have."""
        if sample.pixels.dtype.kind == "f":  # OpenCV would round metres to whole numbers
            raise self._not_a_png(sample)
        path = self._folder / f"{self._names.stem(sample.number)}.png"
        try:
            done, png = cv2.imencode(".png", self._for_opencv(sample.pixels))
        except cv2.error as error:  # such as an odd width of pixels that share their color
            raise self._not_a_png(sample) from error
        if not done:
            raise self._not_a_png(sample)
        path.write_bytes(png.tobytes())
        self._rows.writerow(
            [f"{self._folder.name}/{path.name}", sample.number, f"{sample.timestamp_s:.6f}"]
        )

    def _not_a_png(self, sample: Sample) -> NlosCamError:
        return NlosCamError(
            f"{sample.stream} ({self._encoding}) cannot be written as PNG: use --format npz"
        )

    def _for_opencv(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return pixels with the channels in OpenCV's order, and YUV ones as 8-bit color."""
        if self._encoding in INTERLEAVED:
            pixels = pixels.view(np.uint8).reshape(*pixels.shape, 2)
        code = TO_BGR.get(self._encoding)
        return pixels if code is None else cv2.cvtColor(pixels, code)

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
    """Writer of one binary PLY per depth frame, at most `limit`.

    With infrared among the `streams`, one per complete set of them, gray by infrared. Points in
    metres in the lidar frame: x right, y down, z forward.
    """

    def __init__(
        self,
        folder: Path,
        rays: Float64,
        unit_m: float,
        streams: Collection[str],
        limit: int | None = None,
    ) -> None:
        self._folder = folder / POINTS
        self._rays = rays
        self._unit_m = unit_m
        self._limit = limit
        self._folder.mkdir()
        self.streams = streams
        self._pairing = FrameSynchronizer((rays.shape[0], rays.shape[1]), streams)
        self._names = FrameNames()
        self._numbers: dict[int, int] = {}
        """Number of the depth frame of each instant that waits for its other frames."""
        self.written = 0

    def add(self, sample: Sample, instant: int) -> None:
        """Take a frame, and the number of its instant, by which frames are paired.

        Raises RecordingError for depth of another size than its camera's.
        """
        if self.written == self._limit or sample.stream not in self.streams:
            return
        if "infrared" not in self.streams:
            if sample.pixels.shape != self._rays.shape[:2]:
                raise RecordingError(
                    f"frame {sample.number} of depth has shape {sample.pixels.shape}, its camera"
                    f" {self._rays.shape[:2]}: no point cloud can be made of it"
                )
            self._write(sample.number, sample.pixels)
            return
        if sample.stream == "depth":
            self._numbers[instant] = sample.number
        if found := self._pairing.add(replace(sample, number=instant)):
            self._write(self._numbers.pop(found.number), found.depth_z16, found.ir)

    def _write(
        self, number: int, depth_z16: NDArray[np.uint16], ir: NDArray[np.uint8] | None = None
    ) -> None:
        valid = depth_z16 > 0
        points_m = self._rays[valid] * (depth_z16[valid] * self._unit_m)[:, np.newaxis]
        # Colors without a point make trimesh write an empty cloud, as of a frame without any depth.
        is_gray = ir is not None or not len(points_m)
        gray = np.zeros(len(points_m), np.uint8) if ir is None else ir[valid]
        colors = np.repeat(gray[:, np.newaxis], 3, axis=1) if is_gray else None
        cloud: Any = trimesh.PointCloud(points_m, colors=colors)
        path = self._folder / f"{self._names.stem(number)}.ply"
        path.write_bytes(cloud.export(file_type="ply"))
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
    """A point cloud for each frame; otherwise one for the first, when all streams are exported."""
    streams: Collection[str] = ()
    """By name; empty for all."""
    every: int = 1
    """Only the first frame of each so many, counted, whatever their numbers."""


def export_recording(
    bag: "BagReader | RosReader",
    out: Path,
    options: ExportOptions,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
) -> ExportResult:
    """Write the selected frames of a recording into the directory `out`.

    What an earlier export wrote there goes. Setting `stop` ends it early and keeps the frames so
    far, and so does damage within the recording; before the first frame it raises KeyboardInterrupt
    and writes nothing. Raises RecordingError for streams that the recording does not have, and where
    there is no frame to write.
    """
    streams = _streams(bag, options)
    written: Counter[str] = Counter(dict.fromkeys(streams, 0))
    damage = ""
    with atomic_directory(out, drop=_written_before(out)) as part:
        (part / INFO).write_text(json.dumps(_info(bag, options), indent=1) + "\n", encoding="utf-8")
        with ExitStack() as closing:
            sinks = {stream: _sink(bag, stream, part, options.format) for stream in streams}
            points = _points(bag, options, part)
            for sink in [*sinks.values(), *([points] if points else [])]:
                closing.callback(sink.close)
            try:
                instants = _Instants()
                wanted = {*sinks, *(points.streams if points else ())}
                for _, sample in unwrapped_samples(bag, wanted):
                    if stop.is_set():
                        break
                    on_frame()
                    instant = instants.count(sample)
                    if instant % options.every:
                        continue
                    if sample.stream in sinks:
                        sinks[sample.stream].add(sample)
                        written[sample.stream] += 1
                    if points:
                        points.add(sample, instant)
            except RecordingError as error:
                damage = str(error)
        reason = f" ({damage})" if damage else f": it has {', '.join(streams)}"
        require_frames(written.total(), stop, f"{bag.path} has no frame to write{reason}")
    if points:
        written[POINTS] = points.written
    return ExportResult(dict(written), str(out), damage)


def require_frames(count: int, stop: Event, problem: str) -> None:
    """Raise for a result without a frame: KeyboardInterrupt if it was stopped before the first,
    which is no fault of the recording, else RecordingError. What it would replace stays.
    """
    if not count:
        raise KeyboardInterrupt if stop.is_set() else RecordingError(problem)


def _written_before(out: Path) -> list[str]:
    """Return the names that an earlier export gave in a folder: its frames are of another recording
    or choice.
    """
    earlier = _read_json(out / INFO)
    streams = earlier.get("streams") if isinstance(earlier, dict) else None
    if not isinstance(streams, dict):
        return []
    names = [escape(name) for name in streams]  # whatever the file says, no name is a pattern
    return [f"{POINTS}/", *(f"{name}{end}" for name in names for end in ("/", ".csv", ".npz"))]


class _Instants:
    """Count of the instants at which frames were taken.

    The lidar's streams share their instants; any other stream counts its own frames. Frame numbers
    are not looked at: cameras skip some, and count streams apart.
    """

    def __init__(self) -> None:
        self._others: Counter[str] = Counter()
        self._begun = 0
        self._recent: deque[tuple[int, float, set[str]]] = deque(maxlen=RECENT_INSTANTS)
        """Number and time in s of the last instants, and the streams that have their frame."""

    def count(self, sample: Sample) -> int:
        """Return the number of the sample's instant, from 0; feed samples in order."""
        if sample.stream not in FORMATS:
            self._others[sample.stream] += 1
            return self._others[sample.stream] - 1
        for number, time_s, streams in self._recent:
            apart_s = abs(time_s - sample.timestamp_s)
            if sample.stream not in streams and apart_s <= SAME_INSTANT_S:
                streams.add(sample.stream)
                return number
        self._recent.append((self._begun, sample.timestamp_s, {sample.stream}))
        self._begun += 1
        return self._begun - 1


def _streams(bag: "BagReader | RosReader", options: ExportOptions) -> list[str]:
    """Return the streams to write. Raises RecordingError for one that the recording does not
    have.
    """
    present = [name for name, info in bag.streams.items() if info.format]
    if not present:
        encodings = ", ".join(f"{name} {info.encoding}" for name, info in bag.streams.items())
        raise RecordingError(f"{bag.path} has no stream that can be read: it has {encodings}")
    if missing := sorted(set(options.streams) - set(present)):
        raise RecordingError(
            f"{bag.path} has no {' and no '.join(missing)} stream: it has {', '.join(present)}"
        )
    if options.points and not _has(bag, "depth"):
        raise RecordingError(
            f"{bag.path} has no depth stream, which point clouds are made of: it has"
            f" {', '.join(present)}"
        )
    return [name for name in present if not options.streams or name in options.streams]


def _sink(
    bag: "BagReader | RosReader", stream: str, folder: Path, form: Format
) -> PngSink | NpzSink:
    info = bag.streams[stream]
    if form == "png":
        return PngSink(folder, stream, info.format)
    pinhole = {name: np.array(value) for name, value in asdict(info.intrinsics).items()}
    unit = {"depth_unit_m": np.array(bag.depth_unit_m())} if info.format == "z16" else {}
    return NpzSink(folder, stream, {**pinhole, **unit, "encoding": np.array(info.format)})


def _points(bag: "BagReader | RosReader", options: ExportOptions, folder: Path) -> PointSink | None:
    has_sets = all(_has(bag, stream) for stream in FORMATS if stream not in OPTIONAL)
    if not options.points and (options.streams or not has_sets):
        return None
    limit = None if options.points else 1
    pinhole = bag.streams["depth"].intrinsics
    # The lidar's infrared has depth's pixels; another camera's need not.
    has_gray = has_sets and bag.streams["infrared"].intrinsics == pinhole
    streams = [name for name in FORMATS if _has(bag, name)] if has_gray else ["depth"]
    return PointSink(folder, pinhole.rays(), bag.depth_unit_m(), streams, limit)


def _has(bag: "BagReader | RosReader", stream: str) -> bool:
    """Return whether a recording has one of the lidar's streams, in the lidar's format."""
    return stream in bag.streams and bag.streams[stream].format == FORMATS[stream]


def _info(bag: "BagReader | RosReader", options: ExportOptions) -> dict[str, Any]:
    """Return facts of the whole recording for JSON: device, settings, intrinsics by stream, and its
    sidecar.
    """
    streams = {
        name: {
            "format": info.format,
            "frames_per_s": info.frames_per_s,
            "frames_in_recording": info.frames,
            "intrinsics": asdict(info.intrinsics),
            "distortion": _distortion(bag, name),
            "pose": _pose(bag, name),
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
        "capture": _read_json(sidecar_path(bag.path)),
    }


def _distortion(bag: "BagReader | RosReader", stream: str) -> dict[str, Any]:
    """Return the distortion model of a stream, by the SDK's name, and its coefficients."""
    model, coefficients = bag.lens(stream)
    return {"model": model, "coefficients": [_or_none(value) for value in coefficients.tolist()]}


def _pose(bag: "BagReader | RosReader", stream: str) -> dict[str, Any] | None:
    """Return reference_from_stream (4, 4), by rows in metres, and the reference stream.

    That is depth, or the first stream where there is no depth; None where the recording has no
    extrinsics between the two.
    """
    reference = "depth" if "depth" in bag.streams else next(iter(bag.streams))
    try:
        pose = bag.pose(reference, stream)
    except RecordingError:
        return None
    return {"in_frame_of": reference, "matrix": pose.tolist()}


def _or_none(value: float) -> float | None:
    return value if isfinite(value) else None


def _read_json(path: Path) -> Any:
    """Return a file's JSON, numbers that are not finite as null; None where there is none."""
    try:
        text = read_bounded(path, TEXT_LIMIT).decode()
        return json.loads(text, parse_constant=lambda _: None, parse_float=_finite)
    except (OSError, ValueError, RecursionError):
        return None


def _finite(digits: str) -> float | None:
    return number if isfinite(number := float(digits)) else None
