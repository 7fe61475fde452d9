"""Recording of a live camera to .bag files, in one take or several, up to a length or until the
disk is full.
"""

import ctypes
import faulthandler
import gc
import logging
import os
import shutil
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import inf
from pathlib import Path
from shlex import quote
from threading import Event, Thread
from typing import Any, Literal

from nlos_calibration import Intrinsics

from nlos_cam.camera.streams import BYTES_PER_PIXEL, FRAMES_PER_S, SAME_INSTANT_S, FrameSet
from nlos_cam.camera.timestamps import SAME_CLOCK_S
from nlos_cam.errors import DiskFullError, OutputExistsError, RecordingError
from nlos_cam.files import FileBusyError, claim, replaced_folder
from nlos_cam.threads import BoundedQueue

RESERVE_BYTES = 200_000_000
"""Disk space that a recording leaves free: five seconds of 640 x 480, and its index."""
CHUNK_BYTES = 4_000_000
"""Upper bound of what the SDK has buffered; it writes in chunks of 0.75 MB."""
INDEX_SHARE = 1e-3
"""Upper bound of the index at the end, as a share of the recording."""
SIDECAR_SUFFIX = ".json"
"""Ending of the file beside a recording that describes it."""
GONE = "its file or disk is gone"

WriteFailure = Literal["disk full", "size limit", "file gone"]
"""Why a recording's file could not grow."""
REMEDIES: dict[WriteFailure, str] = {
    "disk full": "free some space",
    "size limit": "raise the limit (ulimit -f)",
    "file gone": "look for the disk",
}


def closing_bytes(recorded_bytes: int) -> int:
    """Return the bytes that a recording of this size still needs until it is closed."""
    return CHUNK_BYTES + int(recorded_bytes * INDEX_SHARE)


def spare_bytes(recorded_bytes: int) -> int:
    """Return the disk space that must be left beside a recording of this size while it grows."""
    return RESERVE_BYTES + closing_bytes(recorded_bytes)


def bytes_per_frame(intrinsics: Intrinsics) -> int:
    """Return the uncompressed size of a frame of three streams; the compression is not known in
    advance.
    """
    return intrinsics.width * intrinsics.height * sum(BYTES_PER_PIXEL.values())


def free_bytes(path: Path) -> int:
    """Return the free space of the disk of `path`, a file that need not exist in a folder that
    does.
    """
    return shutil.disk_usage(path.absolute().parent).free


def recording_s(intrinsics: Intrinsics, free: int) -> float:
    """Return the shortest time in s until a recording leaves only what its end needs, and the
    reserve.
    """
    # It ends at the size n with free - n = spare_bytes(n), and the index grows in proportion to n.
    size_bytes = max(0, free - spare_bytes(0)) / (1 + INDEX_SHARE)
    return size_bytes / (bytes_per_frame(intrinsics) * FRAMES_PER_S)


def check_room(path: Path, intrinsics: Intrinsics, frames: int, free: int) -> None:
    """Raise DiskFullError unless this number of frames fits and leaves the reserve."""
    needed = frames * bytes_per_frame(intrinsics)
    spare = spare_bytes(needed)
    if free < needed + spare:
        size = f"{intrinsics.width} x {intrinsics.height}"
        raise DiskFullError(
            f"{path}: {frames} frames of {size} need up to {needed / 1e9:.2f} GB,"
            f" {spare / 1e9:.1f} GB must stay free, and {free / 1e9:.2f} GB are free: free"
            " space, record less, or choose --out on another disk"
        )


def can_grow(path: Path, by_bytes: int) -> bool:
    """Return True if a file can grow, by trying: quotas and size limits show nowhere else.

    It has its old length afterwards. Nothing else may write to it during the call.
    """
    try:
        length = path.stat().st_size
    except OSError:
        return False
    block = bytes(min(by_bytes, CHUNK_BYTES))
    left = by_bytes
    try:
        with path.open("r+b", buffering=0) as file:
            file.seek(length)
            while left > 0:
                left -= file.write(block[:left])
            os.fsync(file.fileno())
    except OSError:
        return False
    else:
        return True
    finally:
        with suppress(OSError):  # a file that is gone has no length
            os.truncate(path, length)


def size_limit() -> float:
    """Return the system's limit on the size in bytes of a file of this process, as `ulimit -f`
    sets it; infinity without one.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return inf if limit == resource.RLIM_INFINITY else limit


STILL_S = 5.0
"""Time without growth, while frames come, after which the SDK has failed to write."""
FLUSH_S = 9.0
"""A pause that took longer gave up (after 10 s) before everything was written."""
MAX_FLUSHES = 30
"""Pauses, of 10 s each, until the disk counts as unable to write."""


START_WITHIN_S = 10.0
"""Time for the SDK to begin a recording; it usually takes milliseconds."""
END_AFTER_S = 30.0
"""Time after which this process ends, if the SDK holds Python's lock during such a start: nothing
else can end it then, not even SIGTERM."""


def _within_deadline(start: Callable[[], Any]) -> Any:
    """Return what `start` returns. Raises TimeoutError if that takes longer, and its errors."""
    outcome = BoundedQueue[tuple[Any]](1)

    def run() -> None:
        try:
            outcome.put((start(),))
        except Exception as error:  # noqa: BLE001  whatever it was, the caller raises it
            outcome.finish(error)

    faulthandler.dump_traceback_later(END_AFTER_S, exit=True, file=2)
    try:
        Thread(target=run, name="recorder start", daemon=True).start()
        started = outcome.take(START_WITHIN_S)
    finally:
        faulthandler.cancel_dump_traceback_later()
    if started is None:
        outcome.close()
        raise TimeoutError(f"it did not begin within {START_WITHIN_S:g} s")
    return started[0]


class SdkRecorder:
    """librealsense's recorder of one device to one .bag, from construction to `close`.

    The SDK's recorder ignores failed writes. Listening to its notifications from Python deadlocks
    when a device stops or vanishes during one, so `watch` checks the file instead. Raises
    RecordingError where nothing can be written.
    """

    def __init__(
        self, path: Path, device: Any, sdk: Any, *, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.path = path
        self.failure: str | None = None
        """Reason of a failed write, in words."""
        self.cause: WriteFailure = "disk full"
        """What it comes down to, once there is a `failure`."""
        self._size_limit = size_limit()
        self._now = now
        self._grew_s = now()
        self.bytes = 0
        """Size of the file when it was last looked at."""
        try:
            str(path).encode()
        except UnicodeEncodeError as error:  # librealsense takes no other names
            raise RecordingError(
                f"{path} cannot be written (its name is not UTF-8): choose another --out"
            ) from error
        try:
            path.unlink(missing_ok=True)
            self._recorder: Any = _within_deadline(lambda: sdk.recorder(str(path), device))
        except (RuntimeError, OSError) as error:
            raise RecordingError(
                f"{path} cannot be written ({error}): choose another --out"
            ) from error

    def watch(self) -> None:
        """Check that the file grows; call about once a second while frames come."""
        before = self.bytes
        if not self._measure():
            self.fail(GONE)
        elif self.bytes >= self._size_limit:
            self.fail("")
        elif self.bytes != before:
            self._grew_s = self._now()
        elif self._now() - self._grew_s > STILL_S:
            self.fail(f"nothing written for {STILL_S:.0f} s")

    def _measure(self) -> bool:
        """Look at the size of the file, and return whether the file is there."""
        try:
            self.bytes = self.path.stat().st_size
        except OSError:
            return False
        return True

    def fail(self, reason: str) -> None:
        """Note a failed write, and its reason where that is not the limit on a file's size."""
        is_there = self._measure()
        if is_there and self.bytes + closing_bytes(self.bytes) > self._size_limit:
            self.cause = "size limit"
            self.failure = f"it reached the limit on a file's size, {self._size_limit / 1e6:.3g} MB"
        else:
            self.cause = "file gone" if reason == GONE else "disk full"
            self.failure = reason

    def pause(self) -> None:
        """Stop recording. Frames so far are written before this returns, if the disk has room."""
        self._recorder.pause()

    def close(self) -> None:
        """Write the index and close the file, which the SDK does on deleting its recorder.

        Raises DiskFullError where there is no room for it: the SDK would abort the program.
        """
        self._flush()
        if self.failure is None and not self._measure():
            self.fail(GONE)
        if self.failure is None and not can_grow(self.path, closing_bytes(self.bytes)):
            self.fail("no room for its index")
        if self.failure:
            self._abandon()
        self._recorder = None
        gc.collect()

    def _flush(self) -> None:
        for _ in range(MAX_FLUSHES):
            start_s = self._now()
            self.pause()
            if self.failure or self._now() - start_s < FLUSH_S:
                return
        self.fail("the disk no longer accepts data")

    def _abandon(self) -> None:
        """Raise DiskFullError, and leave the file as it is."""
        # One reference too many: never deleted, not even at exit.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._recorder))
        self._recorder = None
        remedy = REMEDIES[self.cause]
        raise DiskFullError(
            f"{self.path} could not be completed ({self.failure}): {remedy}, and recover its"
            f" frames with `{repair_command(self.path)}`"
        )


BOUNDARY_WAIT_S = 1.0
"""Time to wait for the set in flight, so that no stream has one frame more than another."""

log = logging.getLogger(__name__)


class _Replaced:
    """Files that a recording replaces, in the folder of its claim until it has its first set; also
    after a kill, when the next claim puts them back.
    """

    def __init__(self, paths: Sequence[Path] = (), folder: Path = Path()) -> None:
        self._folder = folder
        self._kept = {path: folder / path.name for path in paths}
        self._free: list[Path] = []
        """Paths that are the new recording's by now."""

    def take_away(self) -> None:
        """Move the files into the folder. Raises OSError."""
        for path, kept in self._kept.items():
            with suppress(FileNotFoundError):
                path.replace(kept)
            self._free.append(path)

    def drop(self) -> None:
        """Delete the files: the new recording stands."""
        self._free.clear()
        if self._kept:
            self._kept = {}
            dropped = self._folder.with_suffix(".dropped")
            with suppress(OSError):
                self._folder.rename(dropped)  # both files in one step, for a kill between the two
            shutil.rmtree(dropped, ignore_errors=True)

    def put_back(self) -> None:
        """Put the files in the place of a recording without a set; without effect after `drop`."""
        for path in self._free:
            try:
                path.unlink(missing_ok=True)
                with suppress(FileNotFoundError):
                    self._kept[path].replace(path)
            except OSError as error:
                log.warning("%s: the file from before cannot be put back (%s)", path, error)
        self._free.clear()


class _TakeChange:
    """Change from one take's file to the next between two sets, which the SDK's thread delivers."""

    def __init__(self) -> None:
        self._asked = Event()
        """Set while the file is to be replaced, or is being replaced."""
        self._at_boundary = Event()
        """Set once the SDK's thread waits between two sets: now the file may be replaced."""
        self._over = Event()
        """Set when the file is replaced: the SDK's thread may go on."""

    @property
    def is_asked(self) -> bool:
        """True while a change is under way: the SDK's thread must `wait`, and record nothing."""
        return self._asked.is_set()

    def wait(self) -> None:
        """Hold the SDK's thread between two sets until the change is over."""
        self._at_boundary.set()
        self._over.wait(BOUNDARY_WAIT_S)

    @contextmanager
    def between_sets(self) -> Generator[None]:
        """Run a block while the SDK's thread is held between two sets: none is cut in two.

        A device that delivers nothing is not waited for.
        """
        self._at_boundary.clear()
        self._over.clear()
        self._asked.set()
        self._at_boundary.wait(BOUNDARY_WAIT_S)
        try:
            yield
        finally:
            self._asked.clear()
            self._over.set()


class Recording:
    """Recording of a camera to `path`, up to a number of `frames` or `seconds`, if given.

    Give it to `open_camera`: the camera begins it on entering and closes it on leaving. One that is
    not the `last` take leaves the camera running when it is full, until `next_take`. `add` is
    called on an SDK thread, the rest by the thread that iterates over the camera. A recording that
    this one replaces, and its sidecar, are kept until the first set, and are back after `close`
    where none came; new ones without a set are gone then.
    """

    def __init__(
        self,
        path: Path,
        *,
        frames: int | None = None,
        seconds: float | None = None,
        last: bool = True,
        optional: bool = False,
        overwrite: bool = True,
        free: Callable[[Path], int] = free_bytes,
    ) -> None:
        self.path = path
        self.optional = optional
        """True if the camera goes on without it when it ends early, by a silent device or a full
        disk.
        """
        self.sets = 0
        """Complete sets in this take so far, from the first that the camera yields."""
        self.started = False
        """True once the file is this take's, and no longer the one it replaces."""
        self.disk_full = False
        """True if it stopped for want of disk space, at the limit on a file's size, or as its file
        or disk went away.
        """
        self.cause: WriteFailure = "disk full"
        """Which of these it was."""
        self.error: DiskFullError | None = None
        """Reason for which this take's file has no index."""
        self.added_s = 0.0
        """What the camera adds to the device's timestamps in the frames that it yields."""
        self._frames = frames
        self._seconds = seconds
        self._last = last
        self._free = free
        self._overwrite = overwrite
        self._claim = ExitStack()
        self._replaced = _Replaced()
        self._source: tuple[Any, Any] = (None, None)
        """Device and SDK, for the next take."""
        self._recorder: SdkRecorder | None = None

        self._before_s = float("-inf")
        """Timestamp of the last set before this take."""
        self._first_s = 0.0
        self._first_arrived_s = 0.0
        """Timestamp and arrival of the take's first set, by which its length is measured."""
        self._last_s = 0.0
        """Timestamp of the take's newest set."""

        # Between `add`, on the SDK's thread, and the thread that iterates:
        self._stopping = Event()
        """Set by `stop`: the take ends with the next set."""
        self._paused = Event()
        """Set once no more is recorded in this take."""
        self._change = _TakeChange()
        """The change to the next take."""

    def begin(self, device: Any, sdk: Any) -> None:
        """Record the device's streams.

        Raises RecordingError where nothing can be written, FileBusyError while another process
        writes the same file, and, without `overwrite`, OutputExistsError where the file exists by
        now.
        """
        self._source = device, sdk
        self._take_away(self._own())
        self._recorder = SdkRecorder(self.path, device, sdk)
        self.error = None
        self.started = True

    def _own(self) -> Path:
        """Claim the path until `close`, so that no other process writes to it; return the claim's
        folder.
        """
        self._claim.close()
        try:
            folder = self._claim.enter_context(claim(self.path))
        except FileBusyError:
            raise
        except OSError as error:
            raise self._cannot_be_written(error) from error
        if not self._overwrite and not self.started and os.path.lexists(self.path):
            self._claim.close()
            raise OutputExistsError(
                f"{self.path} exists by now: choose another --out, or add --overwrite"
            )
        return folder

    def _take_away(self, folder: Path) -> None:
        """Move the recording that this one replaces, and its sidecar, into a folder."""
        paths = self.path, self.path.with_suffix(SIDECAR_SUFFIX)
        try:
            self._replaced = _Replaced(paths, replaced_folder(folder))
            self._claim.callback(self._replaced.put_back)
            self._replaced.take_away()
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def _cannot_be_written(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"{self.path} cannot be written ({error.strerror}): choose another --out"
        )

    def join(self, device: Any, sdk: Any) -> None:
        """Begin with the next set of a device that runs. Raises RecordingError where nothing can be
        written.
        """
        self._source = device, sdk
        self.next_take(self.path, last=self._last)

    def next_take(self, path: Path, *, last: bool) -> None:
        """Record to `path` from the next set on, with the same device and settings, after this take
        was closed.

        Raises RecordingError where nothing can be written.
        """
        with self._change.between_sets():
            self.path = path
            self.sets = 0
            self.started = False
            self._last = last
            try:
                self.begin(*self._source)
            finally:
                self._stopping.clear()
                self._paused.clear()

    def add(self, found: FrameSet, arrived_s: float) -> bool:
        """Count a passing set, on an SDK thread; return True once no more is recorded, in this or a
        later take.

        `arrived_s` is on a clock that does not jump.
        """
        if self._change.is_asked:
            self._before_s = found.timestamp_s
            self._change.wait()
            return False
        if self._recorder and not self._paused.is_set():
            self._count(found, arrived_s, self._recorder)
        if self.disk_full:
            return self._paused.is_set() and not self.optional
        return self._paused.is_set() and self._last

    def _count(self, found: FrameSet, arrived_s: float, recorder: SdkRecorder) -> None:
        if self.sets == 0:
            self._replaced.drop()
            self._first_s = found.timestamp_s
            self._first_arrived_s = arrived_s
        self._last_s = found.timestamp_s
        self.sets += 1
        is_due = self.sets % FRAMES_PER_S == 1  # once a second
        self.disk_full = is_due and self._is_disk_full(recorder)
        is_full = self._is_full(found.timestamp_s, arrived_s)
        if self.disk_full or is_full or self._stopping.is_set():
            recorder.pause()  # queued behind the frames so far: none of them is lost
            self._paused.set()
        if self.disk_full and self.optional:
            reason = recorder.failure or "disk full"
            log.warning("%s: %s, the recording ends", self.path, reason)

    def _is_disk_full(self, recorder: SdkRecorder) -> bool:
        recorder.watch()
        if recorder.failure:
            return True
        try:
            free = self._free(self.path)
        except OSError:  # the SDK would swallow it, on its thread
            recorder.fail(GONE)
            return True
        return free < spare_bytes(recorder.bytes)

    def _is_full(self, timestamp_s: float, arrived_s: float) -> bool:
        if self._frames is not None and self.sets >= self._frames:
            return True
        if self._seconds is None:
            return False
        length_s = timestamp_s - self._first_s
        arrived_after_s = arrived_s - self._first_arrived_s
        # Timestamps are finer than arrivals, but may be on the host's time of day, which can be
        # set during a take.
        if abs(length_s - arrived_after_s) > SAME_CLOCK_S:
            length_s = arrived_after_s
        # A set lasts a period, and timestamps jitter by less than half of one.
        end_s = length_s + 2 * SAME_INSTANT_S
        return end_s > self._seconds - SAME_INSTANT_S

    @property
    def done(self) -> bool:
        """True once no more is recorded in this take."""
        return self._paused.is_set()

    def covers(self, timestamp_s: float) -> bool:
        """Return True if a frame is in this take: those yielded now may have queued since before
        it.
        """
        device_s = timestamp_s - self.added_s
        # a sum and a difference of two fractions are not exact
        is_after = device_s > self._before_s + SAME_INSTANT_S
        return is_after and (not self.done or device_s < self._last_s + SAME_INSTANT_S)

    def stop(self) -> None:
        """Stop after the set in flight; the device still runs."""
        self._stopping.set()
        if self._recorder and not self._paused.wait(BOUNDARY_WAIT_S):
            self._recorder.pause()
            self._paused.set()

    def close(self) -> None:
        """Write the index and close the file. Raises DiskFullError without room; if optional, warns
        instead.
        """
        recorder = self._recorder
        self._recorder = None
        try:
            if recorder:
                recorder.close()
        except DiskFullError as error:
            self.error = error
            if not self.optional:
                raise
            log.warning("%s", error)
        finally:
            self.cause = recorder.cause if recorder else self.cause
            self._claim.close()


def repair_command(path: Path, take_from: str = "") -> str:
    """Return the command that repairs a recording into the current folder, with descriptions from
    another file if given.
    """
    source = f" --from {quote(take_from)}" if take_from else ""
    return f"nlos-cam repair {quote(str(path))}{source} --out {quote(f'{path.stem}-repaired.bag')}"
