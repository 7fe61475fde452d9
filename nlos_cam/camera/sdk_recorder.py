"""librealsense's recorder of one device to one .bag, paused and closed so that a full disk cannot end the program."""

import ctypes
import gc
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nlos_cam.camera.bag_container import repair_command
from nlos_cam.camera.disk import can_grow, closing_bytes
from nlos_cam.errors import DiskFullError, RecordingError

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
            begun_s = self._now()
            self.pause()
            if self.failure or self._now() - begun_s < FLUSH_S:
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
