"""A whole recording to files: every frame's hidden depth, a contact sheet and a short report."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event
from typing import IO

import numpy as np
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.camera.base import Camera
from nlos_cam.errors import RecordingError
from nlos_cam.folders import renamed_when_whole
from nlos_cam.frame_reader import FrameReader
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.live import steps
from nlos_cam.live_report import Step
from nlos_cam.objects.depth_image import object_box
from nlos_cam.reconstruct import Clock, Network
from nlos_cam.sightings import in_words

RESULT, SHEET, REPORT = "reconstruction.npz", "frames.png", "report.md"
SHEET_FRAMES = 6


@dataclass(frozen=True)
class ReplayReport:
    """What a replay did."""

    frames: int
    seconds: float
    """How long the replay took."""
    out: str


class Samples:
    """Steps spread evenly over a run of unknown length: every n-th is kept, and n doubles as the run goes on."""

    def __init__(self, most: int) -> None:
        self._most, self._stride, self._seen = most, 1, 0
        self._kept: list[Step] = []

    def add(self, step: Step) -> None:
        if self._seen % self._stride == 0:
            self._kept.append(step)
        self._seen += 1
        if len(self._kept) > 2 * self._most:
            self._kept, self._stride = self._kept[::2], self._stride * 2

    def chosen(self) -> list[Step]:
        """At most `most` steps, first and last kept one included."""
        count = min(self._most, len(self._kept))
        return [self._kept[i] for i in np.linspace(0, len(self._kept) - 1, count).round().astype(int)]


@dataclass
class _Results:
    """What is collected from the steps; depth maps go to a file, so that an hour fits into memory."""

    depths: IO[bytes]
    timestamps_s: list[float]
    numbers: list[int]
    with_surface: int
    samples: Samples

    def add(self, step: Step) -> None:
        depth_m = step.reconstruction.depth_m
        self.depths.write(np.ascontiguousarray(depth_m, np.float32).tobytes())
        self.timestamps_s.append(step.frame.timestamp_s)
        self.numbers.append(step.frame.frame_number)
        self.with_surface += bool(np.isfinite(depth_m).any())
        self.samples.add(step)


def replay(
    camera: Camera,
    rig: Rig,
    network: Network,
    out: Path,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
    clock: Clock = time.time,
) -> ReplayReport:
    """Reconstruct every frame of an entered recording into the folder `out`; its files of the same names are replaced.

    Setting `stop` ends it early and keeps what is done. Raises RecordingError for a recording without a whole frame,
    and what the camera raises.
    """
    begun_s = clock()
    with renamed_when_whole(out) as part, TemporaryFile(dir=part) as depths:
        results = _Results(depths, [], [], 0, Samples(SHEET_FRAMES))
        with FrameReader(camera, keeps_all=True, stop=stop, clock=clock) as reader:
            for step in steps(reader, rig, network, clock):
                results.add(step)
                on_frame()
        if not results.numbers:
            raise RecordingError(f"{camera.uri} holds no frame with depth, infrared and confidence: record it again")
        _write_result(part / RESULT, results, rig)
        draw_sheet(part / SHEET, results.samples.chosen())
        (part / REPORT).write_text(_report(camera, rig, results, stopped=stop.is_set()), encoding="utf-8")
    return ReplayReport(len(results.numbers), clock() - begun_s, str(out))


def _write_result(path: Path, results: _Results, rig: Rig) -> None:
    box = object_box(rig)
    pitch_x_m = (box.x_max_m - box.x_min_m) / OBJECT_PIXELS
    pitch_y_m = (box.y_max_m - box.y_min_m) / OBJECT_PIXELS
    results.depths.flush()
    shape = len(results.numbers), OBJECT_PIXELS, OBJECT_PIXELS
    np.savez_compressed(
        path,
        depth_m=np.memmap(results.depths, np.float32, "r", shape=shape),
        timestamp_s=np.array(results.timestamps_s),
        frame_number=np.array(results.numbers, np.int64),
        origin_m=np.array([box.x_min_m + pitch_x_m / 2, box.y_max_m - pitch_y_m / 2]),  # wall (x, y) of pixel (0, 0)
        pitch_m=np.array([pitch_x_m, -pitch_y_m]),  # wall (x, y) from one column, one row to the next
        z_near_m=box.z_near_m,
        z_far_m=box.z_far_m,
        rig_name=rig.name,
        rig_checksum=rig.checksum,
    )


def draw_sheet(path: Path, chosen: list[Step]) -> None:
    """A picture of some frames, one column each: lidar depth, infrared, hidden depth."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.2 * len(chosen) + 1, 6.5), layout="constrained")
    rows = figure.subplots(3, len(chosen), squeeze=False)
    looks = {"lidar depth (m)": "turbo_r", "infrared (counts)": "gray", "hidden depth (m)": "inferno_r"}
    parts = zip(
        *((step.maps.depth_m, step.maps.intensity, step.reconstruction.depth_m) for step in chosen), strict=True
    )
    for axes, images, (title, colours) in zip(rows, parts, looks.items(), strict=True):
        low, high = _limits(images)
        drawn = [axis.imshow(image, colours, vmin=low, vmax=high) for axis, image in zip(axes, images, strict=True)]
        figure.colorbar(drawn[0], ax=list(axes), label=title)
        for axis in axes:
            axis.set_axis_off()
    for axis, step in zip(rows[0], chosen, strict=True):
        axis.set_title(f"frame {step.frame.frame_number}")
    figure.savefig(path, dpi=80)


def _limits(images: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


def _report(camera: Camera, rig: Rig, results: _Results, *, stopped: bool) -> str:
    frames, times_s = len(results.numbers), results.timestamps_s
    lines = [
        f"# Replay of {camera.uri}",
        "",
        f"- frames: {frames}, numbers {results.numbers[0]} to {results.numbers[-1]}, {times_s[-1] - times_s[0]:.2f} s",
        f"- skipped: {camera.incomplete} without all streams, {camera.dropped} that the recording lacks",
        f"- seen: {in_words(camera.counts) or 'nothing odd'}",
        f"- frames with a hidden surface: {results.with_surface} ({results.with_surface / frames:.0%})",
        f"- rig: {rig.name} {rig.checksum}, {rig.lidar.distance_m:.3f} m to the wall, {rig.facing_deg:.1f} degrees",
        f"- maps: {MAP_ROWS} x {MAP_COLUMNS}; hidden depth: {OBJECT_PIXELS} x {OBJECT_PIXELS} in `{RESULT}`",
        "",
        f"![some frames]({SHEET})",
    ]
    if stopped:
        lines.insert(2, "**Interrupted: the frames below are those done until then.**\n")
    return "\n".join(lines) + "\n"
