"""Recording a live camera to .bag, through librealsense's own recorder."""

import gc
from pathlib import Path
from threading import Event
from typing import Any

from nlos_cam.camera.streams import SAME_INSTANT_S, FrameSet
from nlos_cam.errors import RecordingError

BOUNDARY_WAIT_S = 1.0
"""How long stopping waits for the set in flight, so that no stream has one frame more than another."""


class Recording:
    """A recording to be made: where to, and when it is full (never, unless `frames` or `seconds` says).

    Give it to `open_camera`; the camera begins it on entering and closes it on leaving.
    """

    def __init__(
        self, path: Path, *, frames: int | None = None, seconds: float | None = None, optional: bool = False
    ) -> None:
        self.path = path
        self.optional = optional
        """Whether a camera whose device falls silent, which ends the recording, goes on without it."""
        self.sets = 0
        """Complete sets of streams so far, from the first that a reader of the camera sees."""
        self._frames, self._seconds = frames, seconds
        self._first_s = 0.0
        self._stopping, self._paused = Event(), Event()
        self._recorder: Any = None

    def begin(self, device: Any, sdk: Any) -> None:
        """Wrap `device`: what its sensors deliver is recorded.

        Raises RecordingError where nothing can be written.
        """
        try:
            self.path.unlink(missing_ok=True)
            self._recorder = sdk.recorder(str(self.path), device)
        except (RuntimeError, OSError) as error:
            raise RecordingError(f"{self.path} cannot be written ({error}): choose another --out") from error

    def add(self, found: FrameSet) -> bool:
        """Note a set as it passes, on an SDK thread; True when nothing more is recorded."""
        if self._paused.is_set():
            return True
        self._first_s = found.timestamp_s if self.sets == 0 else self._first_s
        self.sets += 1
        if self._is_full(found.timestamp_s) or self._stopping.is_set():
            self._recorder.pause()  # queued behind the frames seen so far: none of them is lost
            self._paused.set()
        return self._paused.is_set()

    def _is_full(self, timestamp_s: float) -> bool:
        if self._frames is not None and self.sets >= self._frames:
            return True
        period_s = 2 * SAME_INSTANT_S
        return self._seconds is not None and timestamp_s - self._first_s + period_s > self._seconds - SAME_INSTANT_S

    def stop(self) -> None:
        """Record until the set in flight is whole, and no further; the device still runs."""
        self._stopping.set()
        if not self._paused.wait(BOUNDARY_WAIT_S):
            self._recorder.pause()

    def close(self) -> None:
        """Write the index and close the file: the SDK does when nothing refers to the recorder any more."""
        self._recorder = None
        gc.collect()
