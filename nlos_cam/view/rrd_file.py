"""Viewer that saves the view to a .rrd file."""

from datetime import timedelta
from pathlib import Path
from threading import Thread
from typing import Self

import rerun as rr
from nlos_calibration import MeasuredWall, Rig

from nlos_cam.threads import BoundedQueue
from nlos_cam.view.drawing import Drawing, new_recording
from nlos_cam.view.viewer import Moment

PERIOD_S = 0.1
"""Seconds between saved moments, by their own clock."""
LIDAR_EVERY, SURFACE_EVERY = 5, 2
SLACK_S = 0.01
"""Frames come at 30 per second: every third is kept, and not every fourth because of a thousandth."""
QUEUE_MOMENTS = 4
BATCH_S = 1.0
"""Seconds that a kill may cost."""
MAX_BYTES = 2 << 30
"""Largest size, about two hours: browsers cannot load more."""


class RrdFile:
    """Writer of ten moments per second to `path`, in its own thread while entered.

    Five of them have the 3D surface, two the lidar's pictures. A moment that finds the queue full is skipped, or waited
    for with `keeps_all`. An existing file is replaced. After a kill the file lacks its last second and is readable.
    """

    address: str | None = None

    def __init__(self, path: Path, rig: Rig, measured: MeasuredWall | None = None, *, keeps_all: bool = False) -> None:
        self.kept = 0
        """Moments written."""
        self.left_out = 0
        """Moments that were due and did not fit."""
        self.full = False
        """True if the file ended before the run."""
        self._path, self._rig, self._measured, self._keeps_all = path, rig, measured, keeps_all
        self._queue = BoundedQueue[Moment](QUEUE_MOMENTS)
        self._due_s = float("-inf")
        self._error: Exception | None = None
        self._thread = Thread(target=self._write, name="saved view")

    def __enter__(self) -> Self:
        self._path.open("wb").close()  # a path that cannot be written to is an error now, not in the thread
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.finish()
        self._thread.join()
        if self._error:
            raise self._error

    def show(self, moment: Moment) -> None:
        """Queue a moment if one is due."""
        if self.full or moment.published_s < self._due_s:
            return
        self._due_s = moment.published_s + PERIOD_S - SLACK_S
        while self._keeps_all and self._thread.is_alive() and not self._queue.wait_for_room(BATCH_S):
            pass
        if self._queue.wait_for_room(0.0):
            self._queue.put(moment)
        else:
            self.left_out += 1

    def _write(self) -> None:
        try:
            self._draw_all()
        except Exception as error:  # noqa: BLE001  whatever it was, who entered raises it
            self._error = error

    def _draw_all(self) -> None:
        recording = new_recording(rr.ChunkBatcherConfig(flush_tick=timedelta(seconds=BATCH_S)))
        recording.save(self._path)
        try:
            drawing: Drawing | None = None
            while (moment := self._queue.take()) is not None:
                if self.full:
                    continue
                drawing = drawing or Drawing(recording, self._rig, moment, self._measured, saved=True)
                kept = self.kept
                drawing.draw(moment, with_lidar=kept % LIDAR_EVERY == 0, with_surface=kept % SURFACE_EVERY == 0)
                self.kept += 1
                self.full = self._path.stat().st_size > MAX_BYTES
        finally:
            recording.disconnect()
