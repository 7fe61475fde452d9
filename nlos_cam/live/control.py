"""Controls and status of a live run: one object that the page, the command line and programs use
alike.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np
from nlos_calibration import MeasuredWall, WallRecord
from nlos_calibration.errors import CalibrationError, OccluderRefusedError
from numpy.typing import NDArray

from nlos_cam import calibrate
from nlos_cam import view as views  # both load their heavy parts when they are used
from nlos_cam.camera import FRAMES_PER_S, Camera, free_bytes, recording_s
from nlos_cam.errors import NlosCamError
from nlos_cam.files import atomic_file
from nlos_cam.frames import Frame
from nlos_cam.live.frame_queue import ignore
from nlos_cam.live.live_recording import LiveRecording
from nlos_cam.live.statistics import camera_ms
from nlos_cam.objects import mesh_from_depth, object_box
from nlos_cam.reconstruct import CalibratedRig, Clock, Pipeline
from nlos_cam.view import Moment

REFERENCE_FRAMES = 60
REFERENCE_TIMEOUT_S = 10.0
RECENT_FRAMES = 300
"""Frames (10 s) over which the status gives rate and latency."""
CONTROL_ERRORS = NlosCamError, CalibrationError, OSError

log = logging.getLogger(__name__)


class RunControl:
    """Controls of one live run; every method may be called from any thread, and one command runs at
    a time.

    A command returns its outcome in words, and raises NlosCamError with the reason if it fails.
    Files get dated names in `folder`, and replace nothing. The loop calls `attach`, `watch`, `add`
    and `end`.
    """

    def __init__(self, uri: str = "", *, folder: Path = Path(), clock: Clock = time.time) -> None:
        self.folder = folder
        self.paused = False
        self.load_setting: Callable[[str], tuple[Any, int]] | None = None
        """Loads the networks and number of averaged frames of a setting by name; None without other
        settings.
        """
        self.settings: Sequence[tuple[str, str]] = ()
        """Names of the settings, and their costs in words."""
        self.setting = ""
        self.on_bench: Callable[[CalibratedRig], None] = ignore
        """Called with the bench once it has another reference."""
        self.thread_start: Callable[[], None] = ignore
        """Called in a command's thread before it works."""
        self.warnings: tuple[str, ...] = ()
        """Warnings about the run's pace."""
        self._uri = uri
        self._clock = clock
        self._state = "connecting"
        self._message = ""
        self._rendering_s: float | None = None
        """Time at which the pre-rendering of a simulated scene began."""
        self._camera: Camera | None = None
        self._pipeline: Pipeline | None = None
        self._options: list[dict[str, Any]] = []
        self._newest: Moment | None = None
        self._recent: deque[tuple[float, float]] = deque(maxlen=RECENT_FRAMES)
        """Time of result and latency, both in s."""
        self._taps: list[Callable[[Frame], None]] = []
        self._recording: LiveRecording | None = None
        self._session: tuple[views.SessionFile, ExitStack] | None = None
        self._command = threading.Lock()
        named = self.record, self.stop_recording, self.snapshot, self.save_session, self.end_session
        named += self.pause, self.resume, self.take_reference, self.average
        self._commands: dict[str, Callable[..., str]] = {
            command.__name__: command for command in named
        }
        self._commands |= {"setting": self.use_setting, "option": self.set_option}

    # ---- the loop's side

    def set_state(self, state: str, message: str = "") -> None:
        """Set the state that the page shows: connecting, running, stalled, ended; with a
        message.
        """
        self._state = state
        self._message = message

    def show_progress(self, done: int, total: int) -> None:
        """Show how far the pre-rendering of a simulated scene is, and when the first frame is to be
        expected.
        """
        if done <= 1 or self._rendering_s is None:
            self._rendering_s = self._clock()
        left_s = (self._clock() - self._rendering_s) * (total - done) / max(done, 1)
        when = f", first frame in about {left_s + 4:.0f} s" if done > 1 else ""
        self.set_state("connecting", f"pre-rendering the simulated scene, {done} of {total}{when}")

    def attach(self, camera: Camera, pipeline: Pipeline) -> None:
        """Take over an entered camera and the pipeline of its frames."""
        self._camera = camera
        self._pipeline = pipeline
        self._uri = camera.uri
        self._options = adjustable(camera)
        self.set_state("connecting", "waiting for the first frame")

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the camera's frames; in the reader's thread, those who record or measure see them
        pass.
        """
        for frame in frames:
            for tap in tuple(self._taps):
                tap(frame)
            yield frame

    def add(self, moment: Moment) -> None:
        """Take a new result, in the loop's thread."""
        self._newest = moment
        self._state = "running"
        self._message = ""
        self._recent.append((moment.published_s, moment.latency_s))
        if session := self._session:
            session[0].show(moment)

    def end(self) -> None:
        """Close what was begun, while the camera still runs; errors are logged, since the run ends
        anyway.
        """
        for stop, open_now in (
            (self.stop_recording, self._recording),
            (self.end_session, self._session),
        ):
            if open_now:
                try:
                    stop()
                except CONTROL_ERRORS as error:
                    log.warning("%s", error)
        self.set_state("ended")

    # ---- the page's side

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Run a command by name. Raises NlosCamError, also for arguments that it does not take."""
        if command not in self._commands:
            raise NlosCamError(f"no command {command!r}: choose from {', '.join(self._commands)}")
        if not self._command.acquire(blocking=False):
            raise NlosCamError("another command is running: wait for its answer")
        try:
            self.thread_start()
            return self._commands[command](**arguments)
        except NlosCamError:
            raise
        except CONTROL_ERRORS as error:
            raise NlosCamError(str(error)) from error
        except TypeError as error:
            raise NlosCamError(f"{command} does not take {dict(arguments)!r}") from error
        except ValueError as error:
            raise NlosCamError(f"{command}: {error}") from error
        finally:
            self._command.release()

    def status(self) -> dict[str, Any]:
        """Return the run's state, pace and controls, ready for JSON."""
        now_s = self._clock()
        recent = list(self._recent)
        newest = self._newest
        pipeline = self._pipeline
        state = "paused" if self.paused and self._state == "running" else self._state
        status: dict[str, Any] = {"state": state, "message": self._message, "camera": self._name}
        status["warnings"] = list(self.warnings)
        if newest and len(recent) > 1:
            times_s, latencies_s = np.array(recent).T
            p50_s, p99_s = np.percentile(latencies_s, [50, 99])
            span_s = times_s[-1] - times_s[0]
            pace = {"fps": (len(recent) - 1) / span_s if span_s > 0 else 0.0, "p50_ms": 1e3 * p50_s}
            age_s = now_s - newest.published_s + newest.latency_s
            status |= {name: round(float(value), 2) for name, value in pace.items()}
            status |= {
                "p99_ms": round(1e3 * float(p99_s), 2),
                "age_s": round(age_s, 2),
                "dropped": newest.dropped,
            }
        if self._camera and (simulated := camera_ms(self._camera)):
            status["camera_ms"] = round(simulated["p50"], 2)
        if self._camera and pipeline:
            status["disk_s"] = round(
                recording_s(self._camera.intrinsics, free_bytes(self.folder / "any.bag"))
            )
        if recording := self._recording:
            status["recording"] = {
                "path": str(recording.path),
                "seconds": round(now_s - recording.start_s, 1),
            }
        elif begun := getattr(self._camera, "recording", None):  # by --record: it ends with the run
            status["recording"] = {
                "path": str(begun.path),
                "seconds": round(begun.sets / FRAMES_PER_S, 1),
            }
        status["control"] = {
            "commands": list(self._commands) if pipeline else [],
            "settings": list(self.settings),
            "setting": self.setting,
            "options": self._options,
            "average": pipeline.average if pipeline else 1,
            "paused": self.paused,
            "recording": self._recording is not None,
            "saving": self._session is not None,
            "note": (
                ""
                if not pipeline or self._options
                else f"{self._name} has no laser or near-wall settings"
            ),
        }
        return status

    @property
    def _name(self) -> str:
        """The camera's name, of a file without its folder: it is on the page, which others may
        see.
        """
        scheme, colon, rest = self._uri.partition(":")
        return f"{scheme}{colon}{Path(rest).name}"

    def _attached(self) -> tuple[Camera, Pipeline]:
        if self._camera is None or self._pipeline is None:
            raise NlosCamError("the camera is not running yet: wait for the first frame")
        return self._camera, self._pipeline

    def _file(self, stem: str, suffix: str) -> Path:
        path = self.folder / f"{stem}-{datetime.now().astimezone():%Y%m%d-%H%M%S-%f}"[:-3]
        return path.with_name(path.name + suffix)

    # ---- commands

    def record(self, label: str = "") -> str:
        """Record the camera's streams from now on, with a sidecar that holds the label."""
        camera, _ = self._attached()
        if self._recording:
            raise NlosCamError(f"{self._recording.path} is being recorded: stop it first")
        name = re.sub(r"[^\w.-]+", "-", str(label)).strip("-.")[:60]
        self._recording = LiveRecording(
            camera, self._file(name or "live", ".bag"), str(label) or None, self._clock
        )
        self._taps.append(self._recording.add)
        return f"recording {self._recording.path}"

    def stop_recording(self) -> str:
        """Close the recording, and read it back to verify it."""
        if not self._recording:
            raise NlosCamError("nothing is being recorded")
        recording = self._recording
        self._recording = None
        self._taps.remove(recording.add)
        return recording.stop()

    def snapshot(self) -> str:
        """Write the newest frame: picture (.png), arrays (.npz) and, if there is a surface, its
        mesh (.ply).
        """
        _, pipeline = self._attached()
        if (moment := self._newest) is None:
            raise NlosCamError("there is no frame yet: wait for the first one")
        return save_moment(self._file("snapshot", ".npz"), moment, pipeline)

    def save_session(self) -> str:
        """Save what the page shows from now on as one HTML file."""
        _, pipeline = self._attached()
        if self._session:
            raise NlosCamError(f"{self._session[0].path} is being saved: end it first")
        bench = pipeline.bench
        stack = ExitStack()
        file = stack.enter_context(
            views.SessionFile(self._file("session", ".html"), bench.rig, bench.measured)
        )
        self._session = file, stack
        return f"saving the session to {file.path}"

    def end_session(self) -> str:
        """Close the session's file."""
        if not self._session:
            raise NlosCamError("no session is being saved")
        file, stack = self._session
        self._session = None
        stack.close()
        return f"saved {file.kept} moments to {file.path}: any browser plays it"

    def pause(self) -> str:
        """Stop reconstructing; frames still arrive, and a recording goes on."""
        self.paused = True
        return "paused: frames are read and not reconstructed"

    def resume(self) -> str:
        self.paused = False
        return "reconstructing again"

    def average(self, frames: int) -> str:
        """Average the maps of the last `frames` frames (1 to 1000) from now on."""
        _, pipeline = self._attached()
        count = int(frames)
        if not 1 <= count <= 1000 or count != frames:
            raise NlosCamError(f"average {frames}: give a whole number from 1 to 1000")
        pipeline.average = count
        return (
            f"the mean of {count} frame{'s' if count > 1 else ''},"
            f" {(count - 1) / 2 / FRAMES_PER_S:.2f} s older"
        )

    def use_setting(self, name: str) -> str:
        """Use the networks of a measured setting of precision and speed."""
        _, pipeline = self._attached()
        if self.load_setting is None or name not in dict(self.settings):
            raise NlosCamError(
                f"no setting {name!r}: choose from {', '.join(dict(self.settings)) or 'none here'}"
            )
        pipeline.network, pipeline.average = self.load_setting(name)
        self.setting = name
        return dict(self.settings)[name]

    def set_option(self, name: str, value: float) -> str:
        """Set an option of the device, such as laser_power, to the nearest allowed value."""
        camera, _ = self._attached()
        put = getattr(camera, "set_option", None)
        if put is None:
            raise NlosCamError(
                f"{camera.uri} has no option {name}: laser and near-wall settings are an L515's"
            )
        outcome = put(str(name), float(value))
        self._options = adjustable(camera)
        return outcome

    def take_reference(self, frames: int = REFERENCE_FRAMES) -> str:
        """Measure the empty bench (nothing hidden) and use it as the reference of difference maps
        and drift.

        With a wall record the occluder is found again; without one the wall is measured as it is
        now. The record is written beside the other files, for --wall.
        """
        camera, pipeline = self._attached()
        passing: Any = _PassingFrames(camera)
        self._taps.append(passing.frames.put)
        try:
            capture = calibrate.collect_statistics(passing, int(frames))
        finally:
            self._taps.remove(passing.frames.put)
        bench = pipeline.bench
        record, inliers = measure_bench(capture, bench.measured)
        path = self._file("bench", ".toml")
        reference = capture.reference(inliers)
        record = calibrate.write_record(
            calibrate.WallFiles.beside(path, overwrite=False), record, reference
        )
        pipeline.bench = CalibratedRig(bench.rig, MeasuredWall(record, reference), bench.notes)
        self.on_bench(pipeline.bench)
        return (
            f"reference of {capture.statistics.depth.frames} frames ({record.verdict}:"
            f" {record.advice}); wrote {path}"
        )


def adjustable(camera: Camera | None) -> list[dict[str, Any]]:
    """Return name, value and range of the options that a camera lets one change; empty without
    any.
    """
    options = getattr(camera, "adjustable", None)
    return options() if options else []


def measure_bench(
    capture: calibrate.CaptureStatistics, measured: MeasuredWall | None
) -> tuple[WallRecord, NDArray[np.bool_]]:
    """Return the record of an empty bench and the wall's pixels; the occluder is found if the wall
    was measured.

    Raises CalibrationError where the depth is not that of a wall.
    """
    if measured:
        try:
            return calibrate.measure_occluder(capture, measured)
        except OccluderRefusedError:  # a bare wall, without one
            pass
    fit, facts = calibrate.measure_by_depth(capture)
    return capture.record(fit, facts), fit.inliers


class _PassingFrames:
    """Camera-like source of the frames that pass through the run."""

    def __init__(self, camera: Camera) -> None:
        self.uri = camera.uri
        self.intrinsics = camera.intrinsics
        self.identity = camera.identity
        self.telemetry = camera.telemetry
        self.frames: Queue[Frame] = Queue()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            try:
                yield self.frames.get(timeout=REFERENCE_TIMEOUT_S)
            except Empty:
                raise NlosCamError(
                    f"no frame for {REFERENCE_TIMEOUT_S:.0f} s: the camera has stalled"
                ) from None


def save_moment(path: Path, moment: Moment, pipeline: Pipeline) -> str:
    """Write a moment's arrays to `path` (.npz), its picture and mesh beside it; return what was
    written.
    """
    frame = moment.frame
    found = moment.reconstruction
    box = object_box(pipeline.bench.rig)
    arrays: dict[str, Any] = {
        "depth_m": found.depth_m,
        "lidar_depth_m": frame.depth_m,
        "infrared": frame.ir,
    }
    optional = {"uncertainty_m": found.uncertainty_m, "truth_depth_m": frame.truth_depth_m}
    arrays |= {name: array for name, array in optional.items() if array is not None}
    arrays |= {
        "frame_number": frame.frame_number,
        "timestamp_s": frame.timestamp_s,
        "verdict": moment.verdict or "",
    }
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)
    views.Still(pipeline.bench.rig, moment).save(path.with_suffix(".png"), moment)
    mesh = mesh_from_depth(found.depth_m, box, found.uncertainty_m) if found.has_surface else None
    if mesh is not None:
        mesh.save(path.with_suffix(".ply"))
    return f"wrote {path}, .png{' and .ply' if mesh else '; no surface, so no .ply'}"
