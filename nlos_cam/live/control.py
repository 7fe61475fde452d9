"""Controls and status of a live run: one object that the page, the command line and programs use
alike.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.errors import CalibrationError

from nlos_cam.camera import FRAMES_PER_S, Camera, free_bytes, recording_s
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.live.live_recording import RecordableCamera
from nlos_cam.live.run_commands import (
    BenchCommands,
    PipelineCommands,
    RecordingCommands,
    RunContext,
    SavingCommands,
)
from nlos_cam.live.statistics import WARM_UP_FRAMES, camera_ms
from nlos_cam.reconstruct import Clock, Pipeline, ignore
from nlos_cam.recording import WallFile
from nlos_cam.view import Moment

STALE_S = 2.0
"""Age of the newest result from which on its pace is no longer the run's."""
RECENT_FRAMES = 300
"""Frames (10 s) over which the status gives rate and latency."""
STRAIN_FRAMES = 60
MAX_DROPS = 3
"""A run is too slow for good, and loses its real-time priority, once more than MAX_DROPS frames are
dropped within STRAIN_FRAMES (2 s). The warning about its pace has a limit of its own
(`statistics.MAX_SLOW_SHARE`)."""
LOADING_S = 4.0
"""Time that the networks take to load, between a pre-rendering and the first frame."""
COMMAND_WAIT_S = 0.5
"""Time after which a command without an answer waits: most take milliseconds."""
MAX_NUMBER = 1e9
MAX_TEXT = 200
"""Bounds of every argument of a command, far above what any takes."""
CONTROL_ERRORS = NlosCamError, CalibrationError, OSError

log = logging.getLogger(__name__)


class RunControl:
    """Controls of one live run; every method may be called from any thread, and one command runs at
    a time.

    A command returns its outcome in words, and raises NlosCamError with the reason if it fails.
    Files get dated names in `folder`, and replace nothing; recordings name the measured `wall`. The
    loop calls `attach`, `watch`, `add` and `end`.
    """

    def __init__(
        self,
        uri: str = "",
        *,
        folder: Path = Path(),
        clock: Clock = time.time,
        wall: tuple[Rig, WallFile] | None = None,
    ) -> None:
        self.thread_start: Callable[[], None] = ignore
        """Called first in the thread of each command: there, the view lets it yield to the loop."""
        self.warnings: tuple[str, ...] = ()
        """Warnings about the run's pace."""
        self._run = RunContext(uri, folder, clock, wall=wall)
        self.hurry = self._run.hurry
        """Set it to end without reading a recording back."""
        self.pipeline = PipelineCommands(self._run)
        self.saving = SavingCommands(self._run)
        self.recording = RecordingCommands(self._run)
        self.bench = BenchCommands(self._run)
        self.bench.is_saving = lambda: self.saving.is_saving
        groups = self.recording, self.saving, self.pipeline, self.bench
        self._commands = {name: call for group in groups for name, call in group.commands.items()}
        self._command_lock = threading.Lock()
        self._command_start_s: float | None = None
        """Monotonic time at which the command that runs began."""
        self._drops: deque[int] = deque(maxlen=STRAIN_FRAMES)
        """Number of frames that processing dropped so far, after each of the last results."""
        self._noted = 0
        """Results so far: the first ones, late while the run warms up, say nothing of its pace."""
        self._too_slow = False
        """True for good once too many were dropped."""
        self._state = "connecting"
        self._message = ""
        self._rendering_start_s: float | None = None
        """Time at which the pre-rendering of a simulated scene began."""
        self._recent: deque[tuple[float, float]] = deque(maxlen=RECENT_FRAMES)
        """Time of result and latency, both in s."""

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
        now_s = self._run.clock()
        if done <= 1 or self._rendering_start_s is None:
            self._rendering_start_s = now_s
        message = f"pre-rendering the simulated scene, {done} of {total}"
        if done > 1:
            left_s = (now_s - self._rendering_start_s) * (total - done) / done
            message += f", first frame in about {left_s + LOADING_S:.0f} s"
        self.set_state("connecting", message)

    def attach(self, camera: Camera, pipeline: Pipeline) -> None:
        """Take over an entered camera and the pipeline of its frames."""
        self._run.camera = camera
        self._run.pipeline = pipeline
        self._run.uri = camera.uri
        self.bench.read_options()
        self.set_state("connecting", "waiting for the first frame")

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the camera's frames; in the reader's thread, those who record or measure see them
        pass.
        """
        for frame in frames:
            for call in tuple(self._run.on_frame):
                call(frame)
            yield frame

    def add(self, moment: Moment) -> None:
        """Take a new result, in the loop's thread."""
        self._run.newest = moment
        self.set_state("running")
        if self._recent and moment.time_s - self._recent[-1][0] > STALE_S:
            self._recent.clear()  # the pace of before a stall says nothing of the one after
        self._recent.append((moment.time_s, moment.latency_s))
        self.saving.show(moment)

    def pass_frame(self) -> None:
        """Note a frame that is not reconstructed, as the run is paused."""
        self.set_state("running")
        self._recent.clear()  # the pace of before says nothing of the one after

    def note_drops(self, count: int) -> None:
        """Take the number of frames that processing was too slow for so far, after each result."""
        self._noted += 1
        if self._noted <= WARM_UP_FRAMES:
            self._drops.clear()
        self._drops.append(count)
        if count - self._drops[0] > MAX_DROPS:
            self._too_slow = True

    def end(self) -> None:
        """End recording and session while the camera still runs; errors are logged, since the run
        ends anyway.

        A command that runs is waited for. No other begins, since what it starts would have no end.
        """
        self._run.ended = True
        with self._command_lock:
            running: list[Callable[[], str]] = []
            if self.recording.recording:
                self._message = "closing the recording and reading it back"
                log.warning("%s: interrupt again to end without it", self._message)
                running.append(self.recording.stop_recording)
            if self.saving.is_saving:
                running.append(self.saving.end_session)
            for stop in running:
                try:
                    stop()
                except CONTROL_ERRORS as error:
                    log.warning("%s", error)
        self.set_state("ended")

    def strain_of(self, stop: threading.Event) -> Callable[[], str]:
        """Return a function, for any thread, that returns the reason why the run should leave more
        processor time to others; empty if there is none.
        """

        def strain() -> str:
            if stop.is_set() or self._run.ended:
                return "the run ends"
            start_s = self._command_start_s
            if start_s is not None and time.monotonic() - start_s > COMMAND_WAIT_S:
                return "a command waits"
            return "frames are dropped" if self._too_slow else ""

        return strain

    # ---- the page's side

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Run a command by name. Raises NlosCamError, also for arguments that it does not take."""
        if command not in self._commands:
            raise NlosCamError(f"no command {command!r}: choose from {', '.join(self._commands)}")
        _check_arguments(command, arguments)
        if not self._command_lock.acquire(blocking=False):
            raise NlosCamError("another command is running: wait for its answer")
        try:
            self._command_start_s = time.monotonic()
            self.thread_start()
            return self._commands[command](**arguments)
        except NlosCamError:
            raise
        except CalibrationError as error:
            raise NlosCamError(str(error)) from error
        except OSError as error:
            place = error.filename or self._run.folder.name or "the folder of the run"
            raise NlosCamError(
                f"{place} cannot be written ({error.strerror or error}): check that its folder is"
                " still there and has room"
            ) from error
        except TypeError as error:
            raise NlosCamError(f"{command} does not take {dict(arguments)!r}") from error
        except (ValueError, ArithmeticError) as error:
            raise NlosCamError(f"{command}: {error}") from error
        finally:
            self._command_start_s = None
            self._command_lock.release()

    def file(self, name: str) -> Path | None:
        """Return the path of a file that a command wrote, by its name; None for any other."""
        return self._run.files.get(name)

    def status(self) -> dict[str, Any]:
        """Return the run's state, pace and controls, ready for JSON."""
        now_s = self._run.clock()
        is_paused = self.pipeline.paused and self._state == "running"
        status: dict[str, Any] = {
            "state": "paused" if is_paused else self._state,
            "message": self._message,
            "camera": self._camera_name,
            "warnings": [*self.warnings, *self.recording.problems, *self.saving.problems],
            **self._pace(now_s),
        }
        camera = self._run.camera
        if camera:
            if simulated_ms := camera_ms(camera):
                status["camera_ms"] = round(simulated_ms["p50"], 2)
            with suppress(OSError):  # the folder may have gone away
                free = free_bytes(self._run.folder / "any.bag")
                status["disk_s"] = round(recording_s(camera.intrinsics, free))
        if recording := self._recording_status():
            status["recording"] = recording
        status["control"] = self._control_status()
        return status

    def _pace(self, now_s: float) -> dict[str, Any]:
        """Return rate, latency and losses of the last frames; empty before the second, and while
        none comes.
        """
        newest = self._run.newest
        recent = list(self._recent)
        if newest is None or len(recent) < 2 or now_s - recent[-1][0] > STALE_S:
            return {}
        times_s, latencies_s = np.array(recent).T
        p50_s, p99_s = np.percentile(latencies_s, [50, 99])
        span_s = times_s[-1] - times_s[0]
        fps = (len(recent) - 1) / span_s if span_s > 0 else 0.0
        return {
            "fps": round(float(fps), 2),
            "p50_ms": round(1e3 * float(p50_s), 2),
            "p99_ms": round(1e3 * float(p99_s), 2),
            "age_s": round(now_s - newest.time_s + newest.latency_s, 2),
            "dropped": newest.dropped,
        }

    def _recording_status(self) -> dict[str, Any] | None:
        """Return name and duration of the recording that runs, by a command or by --record; not its
        folder, since others may see the page.
        """
        if by_command := self.recording.recording:
            return {"path": by_command.path.name, "seconds": round(by_command.seconds, 1)}
        camera = self._run.camera
        by_option = camera.recording if isinstance(camera, RecordableCamera) else None
        if by_option:
            seconds = by_option.sets / FRAMES_PER_S
            return {"path": by_option.path.name, "seconds": round(seconds, 1)}
        return None

    def _control_status(self) -> dict[str, Any]:
        """Return what the page's controls show."""
        pipeline = self._run.pipeline
        has_no_options = pipeline and not self.bench.options
        return {
            "commands": list(self._commands) if pipeline and not self._run.ended else [],
            "options": self.bench.options,
            "average": pipeline.average if pipeline else 1,
            "paused": self.pipeline.paused,
            "recording": self.recording.recording is not None,
            "saving": self.saving.is_saving,
            "files": self._run.files.newest,
            "no_reference": self.bench.no_reference,
            "note": (
                f"{self._camera_name} has no laser or near-wall settings" if has_no_options else ""
            ),
        }

    @property
    def _camera_name(self) -> str:
        """The camera's name, of a file without its folder: it is on the page, which others may
        see.
        """
        scheme, colon, rest = self._run.uri.partition(":")
        return f"{scheme}{colon}{Path(rest).name}"


def _check_arguments(command: str, arguments: Mapping[str, Any]) -> None:
    """Raise NlosCamError for a value that no command takes: a list, a number without bounds, a text
    that is too long or cannot be written.
    """
    for name, value in arguments.items():
        if isinstance(value, str):
            if len(value) > MAX_TEXT or not value.isprintable():
                raise NlosCamError(
                    f"{command}: {name} {value[:MAX_TEXT]!a} is no text of at most {MAX_TEXT}"
                    " printable characters: give another"
                )
        elif isinstance(value, bool) or not isinstance(value, int | float):
            raise NlosCamError(f"{command}: {name} is neither a number nor a text: give one")
        elif not abs(value) <= MAX_NUMBER:  # NaN too
            raise NlosCamError(
                f"{command}: {name} is out of range: give a number up to {MAX_NUMBER:g}"
            )
