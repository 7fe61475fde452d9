"""Replay of a whole recording to files: hidden depth, difference maps, contact sheet, media and a
report.
"""

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
from nlos_cam.live.frame_queue import FrameReader, ignore
from nlos_cam.live.loop import iterate_batched
from nlos_cam.live.replay_media import FrameSampler, ReplayMedia, draw_contact_sheet
from nlos_cam.live.replay_report import ReplayFacts, replay_document
from nlos_cam.live.statistics import OnWarning, QualityLog, WarningLog, frames_by_verdict
from nlos_cam.live.telemetry import with_telemetry
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import CalibratedRig, Clock, FrameResult, Pipeline, Verdict
from nlos_cam.report import write_document

RESULT = "reconstruction.npz"
DIFFERENCE = "difference.npz"
SHEET = "frames.png"
REPORT = "report.html"
SHEET_FRAMES = 6


@dataclass(frozen=True)
class ReplayReport:
    """Summary of a replay."""

    frames: int
    seconds: float
    """Duration of the replay itself."""
    out: str
    warnings: Mapping[str, int] = field(default_factory=dict[str, int])
    """Number of frames by warning of the bench."""
    verdicts: Mapping[str, int] = field(default_factory=dict[str, int])
    """Number of frames by verdict; empty without an uncertainty model."""
    quality: Mapping[str, float] = field(default_factory=dict[str, float])
    """As in `RunReport`."""


class _Stack:
    """Arrays of one shape, written to a file one by one, so that an hour of them fits into
    memory.
    """

    def __init__(self, file: IO[bytes], *shape: int) -> None:
        self._file = file
        self._shape = shape
        self._count = 0

    def add(self, array: NDArray[np.float32]) -> None:
        self._file.write(np.ascontiguousarray(array, np.float32).tobytes())
        self._count += 1

    def all(self) -> NDArray[np.float32]:
        """Return (count, *shape), mapped from the file."""
        self._file.flush()
        return np.memmap(self._file, np.float32, "r", shape=(self._count, *self._shape))


class _Results:
    """Collector of the frames' results; `new_file` opens a file for arrays."""

    def __init__(self, new_file: Callable[[], IO[bytes]], on_warning: OnWarning) -> None:
        self.hidden_m, self.uncertainty_m = (
            _Stack(new_file(), OBJECT_PIXELS, OBJECT_PIXELS) for _ in range(2)
        )
        self.difference_m, self.difference_intensity = (
            _Stack(new_file(), MAP_ROWS, MAP_COLUMNS) for _ in range(2)
        )
        self.timestamps_s: list[float] = []
        self.numbers: list[int] = []
        self.verdict_of_frame: list[str] = []
        self.with_surface = 0
        self.uncertainty_mm = list[float]()
        self.verdicts: Counter[Verdict] = Counter()
        self.quality = QualityLog()
        self.expected = list[tuple[float, float]]()
        self.checks: dict[int, float] = {}
        """Scores by number of the checked frame."""
        self.samples = FrameSampler(SHEET_FRAMES)
        self.warnings = WarningLog(on_warning)

    def add(self, result: FrameResult) -> None:
        reconstruction = result.reconstruction
        depth_m = reconstruction.depth_m
        uncertainty_m = reconstruction.uncertainty_m
        self.hidden_m.add(depth_m)
        self.uncertainty_m.add(
            np.full_like(depth_m, np.nan) if uncertainty_m is None else uncertainty_m
        )
        if result.difference:
            self.difference_m.add(result.difference.depth_m)
            self.difference_intensity.add(result.difference.intensity)
        self.timestamps_s.append(result.frame.timestamp_s)
        self.numbers.append(result.frame.frame_number)
        self.verdict_of_frame.append(result.verdict or "")
        self.with_surface += reconstruction.has_surface
        if reconstruction.has_surface and uncertainty_m is not None:
            self.uncertainty_mm.append(1e3 * float(np.median(uncertainty_m[np.isfinite(depth_m)])))
        self.quality.add(result)
        quality = reconstruction.uncertainty.quality if reconstruction.uncertainty else None
        self.expected.append((quality.iou[1], quality.error_m) if quality else (np.nan, np.nan))
        if result.check:
            self.checks[result.check.frame_number] = result.check.score
        self.samples.add(result)
        self.warnings.add(result)
        if result.verdict:
            self.verdicts[result.verdict] += 1


def replay_recording(
    camera: Camera,
    pipeline: Pipeline,
    out: Path,
    *,
    stop: Event,
    on_frame: Callable[[], None] = ignore,
    on_warning: OnWarning = ignore,
    media: ReplayMedia | None = None,
    clock: Clock = time.time,
) -> ReplayReport:
    """Reconstruct every frame of an entered recording into the folder `out`; files of the same
    names are replaced.

    Difference maps are written if the bench has a reference; else those of an earlier replay are
    removed. Setting `stop` ends the replay early and keeps its results. Raises RecordingError for a
    recording without a complete frame, and the camera's errors.
    """
    start_s = clock()
    bench = pipeline.bench
    media = media or ReplayMedia(bench)
    with atomic_directory(out) as part, ExitStack() as files:
        results = _Results(lambda: files.enter_context(TemporaryFile(dir=part)), on_warning)
        files.enter_context(media.into(part))
        frames, telemetry = with_telemetry(camera)
        with FrameReader(frames, lossless=True, stop=stop, clock=clock) as reader, pipeline.checks:
            for result in iterate_batched(reader, pipeline, clock, telemetry):
                results.add(result)
                media.add(result, telemetry.celsius)
                on_frame()
        if not results.numbers:
            raise RecordingError(
                f"{camera.uri} has no frame with depth, infrared and confidence: record it again"
            )
        frame_fields = {
            "timestamp_s": np.array(results.timestamps_s),
            "frame_number": np.array(results.numbers, np.int64),
            "rig_name": bench.rig.name,
            "rig_checksum": bench.rig.checksum,
        }
        np.savez_compressed(part / RESULT, **frame_fields, **_hidden_fields(results, bench.rig))
        if bench.reference:
            np.savez_compressed(
                part / DIFFERENCE, **frame_fields, **_difference_fields(results, bench)
            )
        draw_contact_sheet(part / SHEET, results.samples.results())
        facts = _facts(camera, bench, results, interrupted=stop.is_set())
        write_document(replay_document(facts, part, out), part / REPORT)
    if not bench.reference:
        (out / DIFFERENCE).unlink(missing_ok=True)
    media.remove_stale(out)
    return ReplayReport(
        len(results.numbers),
        clock() - start_s,
        str(out),
        warnings=results.warnings.frames,
        verdicts=frames_by_verdict(results.verdicts),
        quality=results.quality.summary,
    )


def _hidden_fields(results: _Results, rig: Rig) -> dict[str, Any]:
    box = object_box(rig)
    pitch_x_m = (box.x_max_m - box.x_min_m) / OBJECT_PIXELS
    pitch_y_m = (box.y_max_m - box.y_min_m) / OBJECT_PIXELS
    return {
        "depth_m": results.hidden_m.all(),
        "uncertainty_m": results.uncertainty_m.all(),
        "verdict": np.array(results.verdict_of_frame, np.str_),
        "expected_iou": np.array(results.expected)[:, 0],
        "expected_error_m": np.array(results.expected)[:, 1],
        "origin_m": np.array(
            [box.x_min_m + pitch_x_m / 2, box.y_max_m - pitch_y_m / 2]
        ),  # wall (x, y) of pixel (0, 0)
        "pitch_m": np.array(
            [pitch_x_m, -pitch_y_m]
        ),  # wall (x, y) from one column, one row to the next
        "z_near_m": box.z_near_m,
        "z_far_m": box.z_far_m,
        "check_frame_number": np.array([*results.checks], np.int64),
        "check_score": np.array([*results.checks.values()], np.float64),
    }


def _difference_fields(results: _Results, bench: CalibratedRig) -> dict[str, Any]:
    return {
        "depth_m": results.difference_m.all(),
        "intensity": results.difference_intensity.all(),
        "reference_sha256": bench.measured.record.reference_sha256 if bench.measured else "",
    }


def _facts(
    camera: Camera, bench: CalibratedRig, results: _Results, *, interrupted: bool
) -> ReplayFacts:
    return ReplayFacts(
        camera,
        bench.rig,
        results.numbers,
        results.timestamps_s,
        results.with_surface,
        results.uncertainty_mm,
        results.quality.summary,
        frames_by_verdict(results.verdicts),
        [*results.checks.values()],
        results.warnings.spans,
        bench.reference.frames if bench.reference else None,
        interrupted=interrupted,
    )
