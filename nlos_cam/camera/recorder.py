"""Recording a live camera to .bag, until it is full, or the disk is: one take, or several in a row.

Room on the disk that a recording is written to: what it may need, what is free, whether a file can still grow.

librealsense's recorder of one device to one .bag, paused and closed so that a full disk cannot end the program.
"""

import ctypes
import gc
import logging
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from shlex import quote
from threading import Event
from typing import Any

from nlos_calibration import Intrinsics

from nlos_cam.camera.streams import BYTES_PER_PIXEL, FRAMES_PER_S, SAME_INSTANT_S, FrameSet
from nlos_cam.errors import DiskFullError, RecordingError

RESERVE_BYTES = 200_000_000
"""A recording stops before less than this is free: five seconds of 640 x 480, and what its index takes."""
CHUNK_BYTES = 4_000_000
"""More than a recording keeps back before it writes: librealsense writes in pieces of 0.75 MB."""
INDEX_SHARE = 1e-3
"""Of a recording's size: more than its index at the end takes."""


def bytes_per_frame(intrinsics: Intrinsics) -> int:
    """The most that a frame of three streams takes: librealsense compresses, but by how much is not known ahead."""
    return intrinsics.width * intrinsics.height * sum(BYTES_PER_PIXEL.values())


def free_bytes(path: Path) -> int:
    """What is free on the disk of `path`, a file that may not exist yet in a folder that does."""
    return shutil.disk_usage(path.absolute().parent).free


def recording_s(intrinsics: Intrinsics, free: int) -> float:
    """How long a recording lasts, at least, until only the reserve is left."""
    return max(0, free - RESERVE_BYTES) / (bytes_per_frame(intrinsics) * FRAMES_PER_S)


def check_room(path: Path, intrinsics: Intrinsics, frames: int, free: int) -> None:
    """Raise DiskFullError where so many frames may not fit, and leave the reserve."""
    needed = frames * bytes_per_frame(intrinsics)
    if free < needed + RESERVE_BYTES:
        size = f"{intrinsics.width} x {intrinsics.height}"
        raise DiskFullError(
            f"{path}: {frames} frames of {size} may need {needed / 1e9:.2f} GB (uncompressed; how far they compress is "
            f"not known ahead) beside {RESERVE_BYTES / 1e9:.1f} GB that stay free, and {free / 1e9:.2f} GB are free: "
            "make room, record less, or name a --out on another disk"
        )


def closing_bytes(path: Path) -> int:
    """More than closing a recording adds to it."""
    return CHUNK_BYTES + int(path.stat().st_size * INDEX_SHARE)


def can_grow(path: Path, by_bytes: int) -> bool:
    """Whether a file can, tried on the file itself: a quota or a size limit shows nowhere else.

    It has its old length afterwards. Nobody may write to it meanwhile.
    """
    length = path.stat().st_size
    try:
        with path.open("r+b", buffering=0) as file:
            file.seek(length)
            wrote = file.write(bytes(by_bytes))
            os.fsync(file.fileno())
    except OSError:
        return False
    else:
        return wrote == by_bytes
    finally:
        os.truncate(path, length)


STILL_S = 5.0
"""A file that has not grown for so long while frames came is not written any more."""
FLUSH_S = 9.0
"""A pause that took longer gave up (after 10 s) before everything was written."""
FLUSHES = 30
"""Pauses until a disk is taken for one that takes nothing any more (5 minutes)."""


class SdkRecorder:
    """Records what `device` delivers from now on. Raises RecordingError where nothing can be written.

    librealsense's recorder goes on quietly when it cannot write. It would tell in a notification, but whoever listens
    to those from Python locks up when a device is stopped or vanishes in the middle of one: the file is watched.
    """

    def __init__(
        self,
        path: Path,
        device: Any,
        sdk: Any,
        *,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path = path
        self.failure: str | None = None
        """Why it could not write."""
        self._now, self._grew_s, self._bytes = now, now(), 0
        try:
            path.unlink(missing_ok=True)
            self._recorder: Any = sdk.recorder(str(path), device)
        except (RuntimeError, OSError) as error:
            raise RecordingError(f"{path} cannot be written ({error}): choose another --out") from error

    def watch(self) -> None:
        """Look whether the file grows, about once a second, while frames come."""
        if (size := self.path.stat().st_size) != self._bytes:
            self._bytes, self._grew_s = size, self._now()
        elif self._now() - self._grew_s > STILL_S:
            self.failure = f"nothing was written for {STILL_S:.0f} s"

    def pause(self) -> None:
        """Record nothing more. What came is written before this returns, if the disk takes it."""
        self._recorder.pause()

    def close(self) -> None:
        """Write the index and close the file: the SDK does when nothing refers to its recorder any more.

        Raises DiskFullError where it cannot be written: the SDK would end the program if it tried.
        """
        self._flush()
        if self.failure is None and not can_grow(self.path, closing_bytes(self.path)):
            self.failure = "no room for its index"
        if self.failure:
            self._abandon()
        self._recorder = None
        gc.collect()

    def _flush(self) -> None:
        for _ in range(FLUSHES):
            start_s = self._now()
            self.pause()
            if self.failure or self._now() - start_s < FLUSH_S:
                return
        self.failure = "the disk takes nothing any more"

    def _abandon(self) -> None:
        """Leave the file as it is. Raises DiskFullError."""
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._recorder))  # not even the program's end destroys it
        self._recorder = None
        raise DiskFullError(
            f"{self.path} could not be written to its end ({self.failure}): free some space, and get back what is "
            f"there with `{repair_command(self.path)}`"
        )


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


def repair_command(path: Path) -> str:
    """What to type to have a recording repaired, into the current folder."""
    return f"nlos-cam repair {quote(str(path))} --out {quote(f'{path.stem}-repaired.bag')}"
