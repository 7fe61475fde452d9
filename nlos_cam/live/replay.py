"""A whole recording to files: every frame's hidden depth, its difference maps, a contact sheet and a short report."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event
from typing import IO, Any

import numpy as np
from nlos_calibration import Rig
from numpy.typing import NDArray

from nlos_cam.camera import Camera
from nlos_cam.errors import RecordingError
from nlos_cam.files import atomic_directory
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.live.frame_queue import FrameReader
from nlos_cam.live.loop import describe_counts, iterate_batched, with_telemetry
from nlos_cam.live.replay_media import Looks, Samples, draw_sheet
from nlos_cam.live.statistics import OnWarning, WarningLog, frames_by_verdict, ignore
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import UNEXPLAINED, CalibratedRig, Clock, FrameResult, Pipeline, Verdict

RESULT, DIFFERENCE, SHEET, REPORT = "reconstruction.npz", "difference.npz", "frames.png", "report.md"
SHEET_FRAMES = 6


@dataclass(frozen=True)
class ReplayReport:
    """What a replay did."""

    frames: int
    seconds: float
    """How long the replay took."""
    out: str
    warnings: Mapping[str, int] = field(default_factory=dict[str, int])
    """Of the bench, and the frames that each held for."""
    verdicts: Mapping[str, int] = field(default_factory=dict[str, int])
    """By verdict, the frames that it was passed on; empty from networks that pass none."""


class _Stack:
    """Arrays of one shape that go to a file as they come, so that an hour of them fits into memory."""

    def __init__(self, file: IO[bytes], *shape: int) -> None:
        self._file, self._shape, self._count = file, shape, 0

    def add(self, array: NDArray[np.float32]) -> None:
        self._file.write(np.ascontiguousarray(array, np.float32).tobytes())
        self._count += 1

    def all(self) -> NDArray[np.float32]:
        """(count, *shape), mapped from the file."""
        self._file.flush()
        return np.memmap(self._file, np.float32, "r", shape=(self._count, *self._shape))


class _Results:
    """What is collected from the steps; `new_file` gives what the arrays go to."""

    def __init__(self, new_file: Callable[[], IO[bytes]], on_warning: OnWarning) -> None:
        self.hidden_m = _Stack(new_file(), OBJECT_PIXELS, OBJECT_PIXELS)
        self.difference_m, self.difference_intensity = (_Stack(new_file(), MAP_ROWS, MAP_COLUMNS) for _ in range(2))
        self.timestamps_s: list[float] = []
        self.numbers: list[int] = []
        self.uncertainty_m = _Stack(new_file(), OBJECT_PIXELS, OBJECT_PIXELS)
        self.told: list[str] = []
        self.with_surface = 0
        self.verdicts: Counter[Verdict] = Counter()
        self.checks: dict[int, float] = {}
        """Scores by the number of the frame that was checked."""
        self.samples, self.warned = Samples(SHEET_FRAMES), WarningLog(on_warning)

    def add(self, step: FrameResult) -> None:
        depth_m = step.reconstruction.depth_m
        self.hidden_m.add(depth_m)
        uncertainty_m = step.reconstruction.uncertainty_m
        self.uncertainty_m.add(np.full_like(depth_m, np.nan) if uncertainty_m is None else uncertainty_m)
        self.told.append(step.verdict or "")
        if step.difference:
            self.difference_m.add(step.difference.depth_m)
            self.difference_intensity.add(step.difference.intensity)
        self.timestamps_s.append(step.frame.timestamp_s)
        self.numbers.append(step.frame.frame_number)
        self.with_surface += bool(np.isfinite(depth_m).any())
        if step.check:
            self.checks[step.check.frame_number] = step.check.score
        self.samples.add(step)
        self.warned.add(step)
        if step.verdict:
            self.verdicts[step.verdict] += 1


def replay_recording(
    camera: Camera,
    processing: Pipeline,
    out: Path,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
    on_warning: OnWarning = ignore,
    looks: Looks | None = None,
    clock: Clock = time.time,
) -> ReplayReport:
    """Reconstruct every frame of an entered recording into the folder `out`; its files of the same names are replaced.

    Difference maps are written where the bench has a reference; those of an earlier replay go. Setting `stop` ends it
    early and keeps what is done. Raises RecordingError for a recording without a whole frame, and what the camera
    raises.
    """
    start_s, bench = clock(), processing.bench
    with atomic_directory(out) as part, ExitStack() as files:
        results = _Results(lambda: files.enter_context(TemporaryFile(dir=part)), on_warning)
        looking = files.enter_context((looks or Looks(bench)).into(part))
        frames, thermometer = with_telemetry(camera, camera)
        with FrameReader(frames, lossless=True, stop=stop, clock=clock) as reader, processing.checks:
            for step in iterate_batched(reader, processing, clock, thermometer):
                results.add(step)
                looking.add(step, thermometer.celsius)
                on_frame()
        if not results.numbers:
            raise RecordingError(f"{camera.uri} holds no frame with depth, infrared and confidence: record it again")
        np.savez_compressed(part / RESULT, **_of_frames(results, bench.rig), **_hidden(results, bench.rig))
        if bench.reference:
            np.savez_compressed(part / DIFFERENCE, **_of_frames(results, bench.rig), **_difference(results, bench))
        draw_sheet(part / SHEET, results.samples.chosen())
        (part / REPORT).write_text(_report(camera, bench, results, stopped=stop.is_set()), encoding="utf-8")
    if not bench.reference:
        (out / DIFFERENCE).unlink(missing_ok=True)
    looking.forget_others(out)
    told = results.warned.frames(), frames_by_verdict(results.verdicts)
    return ReplayReport(len(results.numbers), clock() - start_s, str(out), *told)


def _of_frames(results: _Results, rig: Rig) -> dict[str, Any]:
    """Which frames a file's arrays are of, and by which rig."""
    return {
        "timestamp_s": np.array(results.timestamps_s),
        "frame_number": np.array(results.numbers, np.int64),
        "rig_name": rig.name,
        "rig_checksum": rig.checksum,
    }


def _hidden(results: _Results, rig: Rig) -> dict[str, Any]:
    box = object_box(rig)
    pitch_x_m = (box.x_max_m - box.x_min_m) / OBJECT_PIXELS
    pitch_y_m = (box.y_max_m - box.y_min_m) / OBJECT_PIXELS
    return {
        "depth_m": results.hidden_m.all(),
        "uncertainty_m": results.uncertainty_m.all(),
        "verdict": np.array(results.told, np.str_),
        "origin_m": np.array([box.x_min_m + pitch_x_m / 2, box.y_max_m - pitch_y_m / 2]),  # wall (x, y) of pixel (0, 0)
        "pitch_m": np.array([pitch_x_m, -pitch_y_m]),  # wall (x, y) from one column, one row to the next
        "z_near_m": box.z_near_m,
        "z_far_m": box.z_far_m,
        "check_frame_number": np.array([*results.checks], np.int64),
        "check_score": np.array([*results.checks.values()], np.float64),
    }


def _difference(results: _Results, bench: CalibratedRig) -> dict[str, Any]:
    return {
        "depth_m": results.difference_m.all(),
        "intensity": results.difference_intensity.all(),
        "reference_sha256": bench.measured.record.reference_sha256 if bench.measured else "",
    }


def _report(camera: Camera, bench: CalibratedRig, results: _Results, *, stopped: bool) -> str:
    frames, times_s, rig = len(results.numbers), results.timestamps_s, bench.rig
    lines = [
        f"# Replay of {camera.uri}",
        "",
        f"- frames: {frames}, numbers {results.numbers[0]} to {results.numbers[-1]}, {times_s[-1] - times_s[0]:.2f} s",
        f"- skipped: {camera.incomplete} without all streams, {camera.dropped} that the recording lacks",
        f"- seen: {describe_counts(camera.counts) or 'nothing odd'}",
        f"- frames with a hidden surface: {results.with_surface} ({results.with_surface / frames:.0%})",
        f"- rig: {rig.name} {rig.checksum}, {rig.lidar.distance_m:.3f} m to the wall, {rig.facing_deg:.1f} degrees",
        f"- maps: {MAP_ROWS} x {MAP_COLUMNS}; hidden depth: {OBJECT_PIXELS} x {OBJECT_PIXELS} in `{RESULT}`",
        *(f"- verdict, {frames} frames: {verdict}" for verdict, frames in frames_by_verdict(results.verdicts).items()),
        *_checks_told(results.checks),
        *_bench_told(bench, results.warned),
        "",
        f"![some frames]({SHEET})",
    ]
    if stopped:
        lines.insert(2, "**Interrupted: the frames below are those done until then.**\n")
    return "\n".join(lines) + "\n"


def _checks_told(scores: Mapping[int, float]) -> list[str]:
    if not scores:
        return []
    flagged = sum(score >= UNEXPLAINED for score in scores.values())
    told = f"score {np.median(list(scores.values())):.2f} (median; 0 explains what the lidar saw, 1 explains nothing)"
    return [f"- physics check of {len(scores)} frames: {told}, {flagged} at {UNEXPLAINED:g} or more"]


def _bench_told(bench: CalibratedRig, warned: WarningLog) -> list[str]:
    lines: list[str] = []
    if bench.reference:
        lines.append(f"- difference from the bare wall, the mean of {bench.reference.frames} frames: in `{DIFFERENCE}`")
    told = (f"{held.frames} frames from {held.first} to {held.last}: {held.text}" for held in warned.held)
    return lines + [f"- warning, {each}" for each in told]
