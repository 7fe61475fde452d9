"""A recording as files that other programs read: PNG or NPZ per stream, timestamps, intrinsics, point clouds."""

import json
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any, Literal

import numpy as np

from nlos_cam.camera.bag_file import BagFile
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import RecordingError
from nlos_cam.export_files import POINTS, NpzSink, PngSink, PointSink, Sink
from nlos_cam.folders import renamed_when_whole

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


def export(
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
    with renamed_when_whole(out) as part:
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
