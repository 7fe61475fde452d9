"""Recording that begins and ends while a live run goes on, with its sidecar."""

from collections import Counter
from functools import partial
from pathlib import Path
from threading import Event
from typing import Protocol, runtime_checkable

from nlos_calibration import Rig

from nlos_cam import recording as recordings
from nlos_cam.camera import FRAMES_PER_S, Camera, Recording
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame


@runtime_checkable
class RecordableCamera(Protocol):
    """Camera whose streams can be recorded while it runs: a live one."""

    @property
    def recording(self) -> Recording | None:
        """The recording that runs, if any."""
        ...

    def start_recording(self, recording: Recording) -> None:
        """Record from the next set on."""
        ...

    def stop_recording(self) -> None:
        """Close the recording, if any; frames go on."""
        ...


class LiveRecording:
    """Recording of a running camera from construction to `stop`; `add` gets its frames in the
    reader's thread.

    Raises NlosCamError for a camera that cannot be recorded, and the errors of `Recording`.
    """

    def __init__(
        self,
        camera: Camera,
        path: Path,
        label: str | None,
        wall: tuple[Rig, recordings.WallFile] | None = None,
    ) -> None:
        if not isinstance(camera, RecordableCamera):
            raise NlosCamError(
                f"{camera.uri} cannot be recorded: only a live camera (l515, sim) can"
            )
        self.path = path
        self._recordable = camera
        self._counts = camera.counts
        self._counts_before = Counter(camera.counts)
        self._target = recordings.CaptureTarget(path, label)
        self._meter = recordings.QualityMeter()
        self._recording = Recording(path, optional=True, last=False)
        camera.start_recording(self._recording)
        try:
            self._sidecar = recordings.SidecarFile(
                recordings.sidecar_path(path), camera, label=label, wall=wall
            )
        except BaseException:
            camera.stop_recording()
            path.unlink(missing_ok=True)
            raise

    def add(self, frame: Frame) -> None:
        """Note a frame, if it is part of the recording."""
        if self._recording.covers(frame.timestamp_s):
            self._meter.add(frame)
            self._sidecar.on_frame(frame)

    @property
    def seconds(self) -> float:
        """Recorded time so far."""
        return self._recording.sets / FRAMES_PER_S

    @property
    def problem(self) -> str:
        """Reason why no more is recorded, for the page; empty while frames are."""
        if self._recording.disk_full:
            return f"{self.path.name} cannot grow (disk full?): the recording has ended, stop it"
        if self._fell_silent:
            return f"{self.path.name} ended as the camera fell silent: stop it, and record again"
        return ""

    @property
    def _fell_silent(self) -> bool:
        """True if the camera closed the file, since no frame came."""
        return self._recording.done and not self._recording.disk_full

    def stop(self, hurry: Event) -> str:
        """Close the file, read it back until `hurry` is set, write the sidecar's end, and return the
        outcome in words.

        Raises RecordingError for a damaged file, DiskFullError where there was no room.
        """
        sets = self._recording.sets
        fell_silent = self._fell_silent
        self._recordable.stop_recording()
        error = self._recording.error
        state: recordings.TakeState = "lost" if fell_silent else "complete"
        if self._recording.disk_full or error:
            state = self._recording.cause
        result = recordings.CaptureResult(
            self._target,
            state,
            self._recording.sets or sets,
            self._meter.quality(),
            self._sidecar,
            error=error,
            closed=error is None,
            follows_another=True,
            events=Counter(self._counts) - self._counts_before,
        )
        final = recordings.finalize(result, partial(_read_back, hurry))
        if final.error:
            raise final.error
        if not final.sets:
            return "nothing was recorded: no frame came"
        ends = {"disk full": "; the disk is full", "lost": "; it ended as the camera fell silent"}
        verified = "verified" if final.verified else "not read back"
        return (
            f"recorded {final.sets} frames ({final.sets / FRAMES_PER_S:.1f} s) to {self.path};"
            f" {verified}{ends.get(state, '')}"
        )


class _Hurried(Exception):  # noqa: N818  # no error: the user would not wait
    """End of a reading that the user did not wait for."""


def _read_back(hurry: Event, path: Path) -> recordings.VerifyResult | None:
    """Return the contents of a closed recording; None once `hurry` is set."""

    def go_on() -> None:
        if hurry.is_set():
            raise _Hurried

    try:
        return recordings.verify(path, on_frame=go_on)
    except _Hurried:
        return None
