"""Recording a live camera to .bag, until it is full, or the disk is: one take, or several in a row."""

import logging
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

from nlos_cam.camera.disk import RESERVE_BYTES, free_bytes
from nlos_cam.camera.sdk_recorder import SdkRecorder
from nlos_cam.camera.streams import FRAMES_PER_S, SAME_INSTANT_S, FrameSet
from nlos_cam.errors import DiskFullError

BOUNDARY_WAIT_S = 1.0
"""How long to wait for the set in flight, so that no stream has one frame more than another."""

log = logging.getLogger(__name__)


class Recording:
    """A recording to be made: where to, and when it is full (never, unless `frames` or `seconds` says).

    Give it to `open_camera`; the camera begins it on entering and closes it on leaving. One that is not the `last`
    take leaves the camera running when it is full, and `next_take` records on.
    """

    def __init__(
        self,
        path: Path,
        *,
        frames: int | None = None,
        seconds: float | None = None,
        last: bool = True,
        optional: bool = False,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        self.path = path
        self.optional = optional
        """Whether a camera goes on without it when it ends early: the device fell silent, or the disk is full."""
        self.sets = 0
        """Complete sets of streams in this take so far, from the first that a reader of the camera sees."""
        self.begun = False
        """Whether the file is this take's, and not what it may replace."""
        self.disk_full = False
        """Whether it stopped because little was left on the disk."""
        self._frames, self._seconds, self._last, self._free = frames, seconds, last, free
        self._before_s, self._first_s, self._last_s = float("-inf"), 0.0, 0.0
        self._stopping, self._paused = Event(), Event()
        self._changing, self._at_boundary, self._changed = Event(), Event(), Event()
        self._source: tuple[Any, Any] = (None, None)
        self._recorder: SdkRecorder | None = None

    def begin(self, device: Any, sdk: Any) -> None:
        """Wrap `device`: what its sensors deliver is recorded.

        Raises RecordingError where nothing can be written.
        """
        self._source = device, sdk
        self._recorder = SdkRecorder(self.path, device, sdk)
        self.begun = True

    def next_take(self, path: Path, *, last: bool) -> None:
        """Record on to `path`, from the next set, after this take was closed: device and settings stay as they are.

        Raises RecordingError where nothing can be written.
        """
        self._at_boundary.clear()
        self._changed.clear()
        self._changing.set()
        self._at_boundary.wait(BOUNDARY_WAIT_S)  # `add` holds the SDK's thread there: no set is cut in two
        self.path, self.sets, self.begun, self._last = path, 0, False, last
        try:
            self.begin(*self._source)
        finally:
            self._stopping.clear()
            self._paused.clear()
            self._changing.clear()
            self._changed.set()

    def add(self, found: FrameSet) -> bool:
        """Note a set as it passes, on an SDK thread; True when nothing more is recorded, in this take or a next."""
        if self._changing.is_set():
            self._before_s = found.timestamp_s
            self._at_boundary.set()
            self._changed.wait(BOUNDARY_WAIT_S)
            return False
        if self._recorder and not self._paused.is_set():
            self._count(found, self._recorder)
        return self._paused.is_set() and (self._last or self.disk_full) and not (self.disk_full and self.optional)

    def _count(self, found: FrameSet, recorder: SdkRecorder) -> None:
        self._first_s = found.timestamp_s if self.sets == 0 else self._first_s
        self._last_s = found.timestamp_s
        self.sets += 1
        self.disk_full = self.sets % FRAMES_PER_S == 1 and self._is_disk_full(recorder)  # looked at once a second
        if self.disk_full or self._is_full(found.timestamp_s) or self._stopping.is_set():
            recorder.pause()  # queued behind the frames seen so far: none of them is lost
            self._paused.set()
        if self.disk_full and self.optional:
            log.warning("%s: the disk is full, and the recording ends after %d frames", self.path, self.sets)

    def _is_disk_full(self, recorder: SdkRecorder) -> bool:
        recorder.watch()
        return recorder.failure is not None or self._free(self.path) < RESERVE_BYTES

    def _is_full(self, timestamp_s: float) -> bool:
        if self._frames is not None and self.sets >= self._frames:
            return True
        period_s = 2 * SAME_INSTANT_S
        return self._seconds is not None and timestamp_s - self._first_s + period_s > self._seconds - SAME_INSTANT_S

    @property
    def done(self) -> bool:
        """Whether nothing more is recorded in this take."""
        return self._paused.is_set()

    def covers(self, timestamp_s: float) -> bool:
        """Whether a frame that a reader got now is in this take: some may have waited for their reader since before."""
        return self._before_s < timestamp_s and (not self.done or timestamp_s <= self._last_s)

    def stop(self) -> None:
        """Record until the set in flight is whole, and no further; the device still runs."""
        self._stopping.set()
        if self._recorder and not self._paused.wait(BOUNDARY_WAIT_S):
            self._recorder.pause()
            self._paused.set()

    def close(self) -> None:
        """Write the index and close the file. Raises DiskFullError where that cannot be; an optional one warns."""
        recorder, self._recorder = self._recorder, None
        try:
            if recorder:
                recorder.close()
        except DiskFullError as error:
            if not self.optional:
                raise
            log.warning("%s", error)
