"""Commands of a live run, by group: pipeline, saved views, recording, camera and bench."""

import re
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from threading import Event
from typing import Any, Protocol, runtime_checkable

from nlos_calibration import MeasuredWall, Rig, WallRecord
from nlos_calibration.arrays import Mask
from nlos_calibration.errors import OccluderRefusedError

from nlos_cam import calibrate
from nlos_cam import view as views  # both load their heavy parts when they are used
from nlos_cam.camera import FRAMES_PER_S, Camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.live.live_recording import LiveRecording
from nlos_cam.reconstruct import (
    MAX_AVERAGE,
    CalibratedRig,
    Clock,
    Pipeline,
    ignore,
    occluder_assumed,
    weights_serve,
)
from nlos_cam.recording import WallFile, load_measured_wall
from nlos_cam.view import Moment, WrittenFiles

REFERENCE_FRAMES = 60
MAX_REFERENCE_FRAMES = 1800
"""A minute."""
REFERENCE_TIMEOUT_S = 10.0
POLL_S = 0.2
"""Interval at which a wait for a frame looks whether the run has ended."""

OnFrame = Callable[[Frame], None]
Commands = dict[str, Callable[..., str]]
"""By name; each returns its outcome in words, and raises NlosCamError with the reason if it fails.
"""


@runtime_checkable
class AdjustableCamera(Protocol):
    """Camera whose laser and near-wall options can be set while it runs: an L515."""

    def adjustable(self) -> list[dict[str, Any]]:
        """Return name, value and range of each option."""
        ...

    def set_option(self, name: str, value: float) -> str:
        """Set an option to the nearest allowed value; return the outcome in words."""
        ...


@dataclass
class RunContext:
    """State of a live run that its commands share."""

    uri: str
    folder: Path
    """Files get dated names here, and replace nothing."""
    clock: Clock
    camera: Camera | None = None
    """None until the camera runs."""
    pipeline: Pipeline | None = None
    newest: Moment | None = None
    ended: bool = False
    """True once the run ends: no more frames come, and no command begins anything."""
    wall: tuple[Rig, WallFile] | None = None
    """Rig and record of the measured wall, for sidecars of recordings."""
    files: WrittenFiles = field(default_factory=WrittenFiles)
    hurry: Event = field(default_factory=Event)
    """Set once recordings are no longer to be read back."""
    on_frame: list[OnFrame] = field(default_factory=list[OnFrame])
    """Called with each frame of the camera, in the reader's thread."""

    def attached(self) -> tuple[Camera, Pipeline]:
        """Return camera and pipeline. Raises NlosCamError before they run, and once the run ends."""
        if self.ended:
            raise NlosCamError("the run ends: start it again")
        if self.camera is None or self.pipeline is None:
            raise NlosCamError("the camera is not running yet: wait for the first frame")
        return self.camera, self.pipeline

    def new_file(self, stem: str, suffix: str) -> Path:
        """Return a path with the present date in the run's folder."""
        return views.dated_file(self.folder, stem, suffix)


def _checked_count(frames: object, most: int, purpose: str) -> int:
    """Return a number of frames. Raises NlosCamError unless it is a whole number from 1 to
    `most`.
    """
    if not isinstance(frames, int | float) or not 1 <= frames <= most or frames != int(frames):
        raise NlosCamError(f"{frames} frames {purpose}: give a whole number from 1 to {most}")
    return int(frames)


class PipelineCommands:
    """Commands that change how frames are reconstructed."""

    def __init__(self, run: RunContext) -> None:
        self.paused = False
        self._run = run

    @property
    def commands(self) -> Commands:
        return {"pause": self.pause, "resume": self.resume, "average": self.average}

    def pause(self) -> str:
        """Stop reconstructing; frames still arrive, and a recording goes on."""
        self.paused = True
        return "paused: frames are read and not reconstructed"

    def resume(self) -> str:
        """Reconstruct again, with a new mean: the object may have been changed in between."""
        if self._run.pipeline:
            self._run.pipeline.begin_mean()
        self.paused = False
        return "reconstructing again"

    def average(self, frames: int) -> str:
        """Average the maps of the last `frames` frames (1 to 1000) from now on."""
        _, pipeline = self._run.attached()
        count = _checked_count(frames, MAX_AVERAGE, "to average")
        pipeline.average = count
        older_s = (count - 1) / 2 / FRAMES_PER_S
        return f"the mean of {count} frame{'s' if count > 1 else ''}, {older_s:.2f} s older"


class SavingCommands:
    """Commands that save what the page shows: one frame, or a session."""

    def __init__(self, run: RunContext) -> None:
        self._run = run
        self._session: tuple[views.SessionFile, ExitStack] | None = None

    @property
    def commands(self) -> Commands:
        return {
            "snapshot": self.snapshot,
            "save_session": self.save_session,
            "end_session": self.end_session,
        }

    @property
    def is_saving(self) -> bool:
        """True while a session is being saved."""
        return self._session is not None

    @property
    def problems(self) -> list[str]:
        """Reason why the session that is being saved takes no more; empty while it does, or none
        is.
        """
        session = self._session
        return [session[0].problem] if session and session[0].problem else []

    def show(self, moment: Moment) -> None:
        """Add a moment to the session that is being saved, if any."""
        if session := self._session:
            session[0].show(moment)

    def snapshot(self) -> str:
        """Write the newest frame: picture (.png), arrays (.npz) and, if there is a surface, its
        mesh (.ply).
        """
        self._run.attached()
        moment = self._run.newest
        if moment is None:
            raise NlosCamError("there is no frame yet: wait for the first one")
        path = self._run.new_file("snapshot", ".npz")
        outcome = views.save_moment(path, moment)
        return f"{outcome}, {self._run.files.note(path)}"

    def save_session(self) -> str:
        """Save what the page shows from now on as one HTML file."""
        _, pipeline = self._run.attached()
        if self._session:
            raise NlosCamError(f"{self._session[0].path} is being saved: end it first")
        bench = pipeline.bench
        path = self._run.new_file("session", ".html")
        entered = ExitStack()
        file = entered.enter_context(views.SessionFile(path, bench.rig, bench.measured))
        self._session = file, entered
        return f"saving the session to {path}"

    def end_session(self) -> str:
        """Close the session's file."""
        if not self._session:
            raise NlosCamError("no session is being saved")
        file, entered = self._session
        problem = file.problem
        self._session = None
        entered.close()
        place = self._run.files.note(file.path)
        saved = f"saved {file.kept} moments to {file.path}, {place}: any browser plays it"
        return f"{saved}; {problem}" if problem else saved


class RecordingCommands:
    """Commands that record the camera's streams."""

    def __init__(self, run: RunContext) -> None:
        self.recording: LiveRecording | None = None
        """The recording that runs, if a command began it."""
        self._run = run

    @property
    def commands(self) -> Commands:
        return {"record": self.record, "stop_recording": self.stop_recording}

    @property
    def problems(self) -> list[str]:
        """Reason why the recording that runs takes no more; empty while it does, or none runs."""
        recording = self.recording
        return [recording.problem] if recording and recording.problem else []

    def record(self, label: str = "") -> str:
        """Record the camera's streams from now on, with a sidecar that holds the label."""
        camera, _ = self._run.attached()
        if self.recording:
            raise NlosCamError(f"{self.recording.path} is being recorded: stop it first")
        label = str(label)
        name = re.sub(r"[^\w.-]+", "-", label).strip("-.")[:60]
        path = self._run.new_file(name or "live", ".bag")
        self.recording = LiveRecording(camera, path, label or None, self._run.wall)
        self._run.on_frame.append(self.recording.add)
        return f"recording {path}"

    def stop_recording(self) -> str:
        """Close the recording, and read it back to verify it."""
        recording = self.recording
        if not recording:
            raise NlosCamError("nothing is being recorded")
        self.recording = None
        self._run.on_frame.remove(recording.add)
        outcome = recording.stop(self._run.hurry)
        if not recording.path.exists():  # no frame came
            return outcome
        return f"{outcome}, {self._run.files.note(recording.path)}"


class BenchCommands:
    """Commands that set the camera's options, or measure the empty bench."""

    def __init__(self, run: RunContext) -> None:
        self.options: list[dict[str, Any]] = []
        """Name, value and range of the options that the camera lets one change."""
        self.on_bench: Callable[[CalibratedRig], None] = ignore
        """Called with the bench once it has another reference."""
        self.is_saving: Callable[[], bool] = lambda: False
        """Returns whether a session with the present bench is being saved."""
        self._run = run

    @property
    def commands(self) -> Commands:
        return {"option": self.set_option, "take_reference": self.take_reference}

    @property
    def no_reference(self) -> str:
        """Reason why no reference can be taken here; empty if it can."""
        if self.is_saving():
            return (
                "No reference can be taken while a session is saved, which holds one bench: end it"
                " first (with --save-view it ends with the run)."
            )
        camera = self._run.camera
        pipeline = self._run.pipeline
        if camera is None or pipeline is None or pipeline.bench.measured:
            return ""
        if camera.rig is None or camera.rig.occluder is None:
            return ""
        return (
            "No reference can be taken: this bench has an occluder, and no wall record says where"
            " the wall is. Start with --wall wall.toml (`nlos-cam calibrate --wall` measures one)."
        )

    def read_options(self) -> None:
        """Read the camera's options."""
        camera = self._run.camera
        self.options = camera.adjustable() if isinstance(camera, AdjustableCamera) else []

    def set_option(self, name: str, value: float | str) -> str:
        """Set an option of the device, such as laser_power, to the nearest allowed value."""
        camera, pipeline = self._run.attached()
        if not isinstance(camera, AdjustableCamera):
            raise NlosCamError(
                f"{camera.uri} has no option {name}: laser and near-wall settings are an L515's"
            )
        if isinstance(value, str):
            raise NlosCamError(f"{name} {value!r} is no number: give one")
        outcome = camera.set_option(str(name), float(value))
        self.read_options()
        pipeline.begin_mean()  # light of two settings has no mean
        return outcome

    def take_reference(self, frames: int = REFERENCE_FRAMES) -> str:
        """Measure the empty bench (nothing hidden), and use its rig from now on, and its frames as
        the reference of difference maps and drift.

        With a wall record the occluder is found again; without one the wall is measured as it is
        now. The record is written beside the other files, for --wall. Raises CalibrationError where
        something is in the way.
        """
        camera, pipeline = self._run.attached()
        if self.is_saving():
            raise NlosCamError(self.no_reference)
        count = _checked_count(frames, MAX_REFERENCE_FRAMES, "for a reference")
        passing: Any = _PassingFrames(self._run, camera)  # all that measuring needs of a camera
        self._run.on_frame.append(passing.frames.put)
        try:
            capture = calibrate.collect_statistics(passing, count)
        finally:
            self._run.on_frame.remove(passing.frames.put)

        bench = pipeline.bench
        record, inliers = measure_bench(capture, bench.measured)
        path = self._run.new_file("bench", ".toml")
        before = bench.measured.record.rig if bench.measured else bench.rig
        record = record.model_copy(update={"rig": measured_rig(before, record)})
        reference = capture.reference(inliers)
        files = calibrate.WallFiles.beside(path, overwrite=False)
        record = calibrate.write_record(files, record, reference)
        # What was noted before is of a wall or an occluder that had not been measured.
        assumed = bool(bench.notes) and record.occluder is None
        notes = (occluder_assumed(path),) if assumed else ()
        pipeline.bench = CalibratedRig(record.beam_rig, MeasuredWall(record, reference), notes)
        self._run.wall = load_measured_wall(path)
        self.on_bench(pipeline.bench)
        taken = capture.statistics.depth.frames
        place = f"{1e3 * record.distance_m:.1f} mm away, faced at {record.facing_deg:.1f} degrees"
        outcomes = [
            f"reference of {taken} frames ({record.verdict}: {record.advice})",
            f"from now on the wall is {place}",
            *notes,
            *_weights_warnings(record.beam_rig, pipeline, path),
            f"wrote {path}, {self._run.files.note(path)}",
        ]
        return "; ".join(outcomes)


def measured_rig(rig: Rig, record: WallRecord) -> Rig:
    """Return the rig of a run with lidar, intrinsics and, if it was found, occluder of a new
    record.
    """
    measured = record.rig
    changed = {name: getattr(measured, name) for name in ("name", "lidar", "intrinsics")}
    if record.occluder:
        changed["occluder"] = measured.occluder
    return rig.model_copy(update=changed)


def _weights_warnings(rig: Rig, pipeline: Pipeline, record: Path) -> list[str]:
    """Return the verdict on the run's weights for the rig of a wall record, if larger errors are to
    be expected.
    """
    if pipeline.trained is None:
        return []
    served = weights_serve(rig, pipeline.trained, bench=shlex.quote(str(record)))
    return [served.sentence] if served.is_warning else []


def measure_bench(
    capture: calibrate.CaptureStatistics, measured: MeasuredWall | None
) -> tuple[WallRecord, Mask]:
    """Return the record of an empty bench and the wall's pixels; the occluder is found if the wall
    was measured.

    Raises CalibrationError where the depth is not that of a wall, or where the record's occluder is
    not found.
    """
    if measured:
        try:
            return calibrate.measure_occluder(capture, measured)
        except OccluderRefusedError:
            # a bare wall has none; one that was entered by hand is out of view, and must not be lost
            if measured.record.occluder:
                raise
    known = measured.record if measured else None
    fit, facts = calibrate.measure_by_depth(capture, known=known)
    if known and capture.gravity_m_s2 is None:
        facts["way_up"] = known.way_up
    return capture.record(fit, facts), fit.inliers


class _PassingFrames:
    """Camera-like source of the frames that pass through the run."""

    def __init__(self, run: RunContext, camera: Camera) -> None:
        self._run = run
        self.uri = camera.uri
        self.intrinsics = camera.intrinsics
        self.identity = camera.identity
        self.telemetry = camera.telemetry
        self.frames: Queue[Frame] = Queue()

    def __iter__(self) -> Iterator[Frame]:
        newest_s = time.monotonic()
        while True:
            try:
                yield self.frames.get(timeout=min(POLL_S, REFERENCE_TIMEOUT_S))
            except Empty:
                if self._run.ended:
                    raise NlosCamError("the run has ended: start it again to measure") from None
                if time.monotonic() - newest_s >= REFERENCE_TIMEOUT_S:
                    raise NlosCamError(
                        f"no frame for {REFERENCE_TIMEOUT_S:.0f} s: the camera has stalled"
                    ) from None
            else:
                newest_s = time.monotonic()
