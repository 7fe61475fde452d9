"""Replay of a whole recording to files: hidden depth, difference maps, contact sheet, media and a
report.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event

import numpy as np

from nlos_cam.camera import Camera
from nlos_cam.files import atomic_directory
from nlos_cam.reconstruct import (
    UNEXPLAINED,
    Clock,
    FrameReader,
    OnWarning,
    Pipeline,
    ignore,
    iterate_batched,
    verdict_limits,
)
from nlos_cam.recording import require_frames, with_telemetry
from nlos_cam.replay.media import FrameSampler, ReplayMedia, draw_contact_sheet
from nlos_cam.replay.report import replay_document
from nlos_cam.replay.results import ReplayResults
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
    """Of the frames with an object: medians `expected_iou` and `expected_error_mm`, share
    `trusted`; empty without.
    """
    weights: str = ""
    """Name and checksum of the networks' weights."""


def replay_recording(
    camera: Camera,
    pipeline: Pipeline,
    out: Path,
    *,
    stop: Event,
    on_frame: Callable[[], None] = ignore,
    on_warning: OnWarning = ignore,
    media: ReplayMedia | None = None,
    options: Sequence[str] = (),
    clock: Clock = time.time,
) -> ReplayReport:
    """Reconstruct every frame of an entered recording into the folder `out`; files of the same
    names are replaced.

    Difference maps are written if the bench has a reference; else those of an earlier replay are
    removed, like its media. `options` are the words of the command line that chose bench, weights
    and average, which the report repeats. Setting `stop` ends the replay early and keeps its
    results; before the first frame it raises KeyboardInterrupt and writes nothing. Raises
    RecordingError for a recording without a complete frame, OutputExistsError where hidden objects
    would replace what no replay wrote, and the camera's errors.
    """
    start_s = clock()
    bench = pipeline.bench
    media = media or ReplayMedia(bench)
    samples = FrameSampler(SHEET_FRAMES)
    replayed = (out / RESULT).is_file()
    media.check_folder(out, replayed=replayed)
    with atomic_directory(out) as part, ExitStack() as files:
        results = ReplayResults(
            lambda: files.enter_context(TemporaryFile(dir=part)),
            on_warning,
            _unexplained_empty(pipeline),
            pipeline.weights,
        )
        frames, telemetry = with_telemetry(camera)
        reader = FrameReader(frames, lossless=True, stop=stop, clock=clock)
        with media.into(part):
            with reader, pipeline.checks:
                for result in iterate_batched(reader, pipeline, clock, telemetry):
                    results.add(result)
                    samples.add(result)
                    media.add(result, telemetry.celsius)
                    on_frame()
            missing = f"{camera.uri} has no frame with depth and infrared: record it again"
            require_frames(len(results.numbers), stop, missing)

        np.savez_compressed(part / RESULT, **results.hidden_arrays(bench.rig))
        if bench.reference:
            np.savez_compressed(part / DIFFERENCE, **results.difference_arrays(bench))
        draw_contact_sheet(part / SHEET, samples.results())
        document = replay_document(
            camera, bench, results, part, out=out, options=options, interrupted=stop.is_set()
        )
        write_document(document, part / REPORT)

    if replayed:
        if not bench.reference:
            (out / DIFFERENCE).unlink(missing_ok=True)
        media.remove_stale(out)
    return ReplayReport(
        frames=len(results.numbers),
        seconds=clock() - start_s,
        out=str(out),
        warnings=results.warnings.frames,
        verdicts=results.verdicts,
        quality=results.quality.summary,
        weights=pipeline.weights,
    )


def _unexplained_empty(pipeline: Pipeline) -> float:
    """Return the score of the physics check from which on a verdict without a surface changes;
    without verdicts, that of a surface.
    """
    model = pipeline.uncertainty_model
    return verdict_limits(model).unexplained_empty if model else UNEXPLAINED
