"""Saved sessions: one HTML file with the page and every kept moment, which any browser plays
without installation.
"""

import base64
import zlib
from importlib import resources
from pathlib import Path
from threading import Thread
from typing import BinaryIO, Self

import numpy as np
from nlos_calibration import MeasuredWall, Rig

from nlos_cam.threads import BoundedQueue
from nlos_cam.view.messages import MomentPacker, bench_message, pack
from nlos_cam.view.viewer import SLACK_S, Moment, Schedule

PERIOD_S = 0.1
"""Seconds between saved moments, by their own clock."""
CHUNK_S = 1.0
"""Seconds of moments compressed together, and that a kill may cost."""
LIDAR_S = 1.0
"""Seconds between pictures of the lidar, which are most of a moment's bytes."""
FALL_S = 0.1
"""Seconds shown between two moments where the time falls back: how long it was, nobody knows."""
PICTURE_WIDTH = 160
QUEUE_MOMENTS = 4
MAX_BYTES = 512 << 20
"""Largest size: browsers cannot load much more."""
SCRIPTS = "bench.js", "pictures.js", "inspect.js", "player.js", "controls.js", "page.js"
"""Scripts of the page, in their order."""


def page_html(mode: str) -> str:
    """Return the page with its scripts inside; `mode` is "live", "recorded" (streamed) or "session"
    (in the file).
    """
    folder = resources.files("nlos_cam.view")
    page = (folder / "page.html").read_text(encoding="utf-8")
    for name in SCRIPTS:
        script = (folder / name).read_text(encoding="utf-8")
        page = page.replace(f'<script src="{name}"></script>', f"<script>\n{script}</script>")
    return page.replace('data-mode="live"', f'data-mode="{mode}"')


class Chunks:
    """Packer of moments into chunks: messages of CHUNK_S, compressed together.

    The times of a chunk, by which the page finds its moments, never fall: where the moments' own
    time falls back, as a device's clock may, they go on FALL_S after the last one.
    """

    def __init__(self, packer: MomentPacker) -> None:
        self._packer = packer
        self._messages = list[bytes]()
        self._times_s: list[float] = []
        self._lidar = Schedule(LIDAR_S)
        self._start_s: float | None = None
        self._last_s: float | None = None
        self._later_s = 0.0
        """Seconds by which the chunks' time is later than the moments' own, after falls."""

    def add(self, moment: Moment) -> bytes | None:
        """Add a moment, and return the chunk before it if that is complete."""
        now_s = self._unfallen_s(moment.time_s)
        is_full = self._times_s and now_s - self._times_s[0] >= CHUNK_S - SLACK_S
        complete = self.rest() if is_full else None

        with_lidar = self._lidar.is_due(now_s) or not self._messages
        self._messages.append(self._packer.pack(moment, with_lidar=with_lidar))
        self._times_s.append(now_s)
        return complete

    def _unfallen_s(self, time_s: float) -> float:
        """Return a moment's time on a clock that does not fall."""
        if self._last_s is not None and time_s < self._last_s:
            self._later_s += self._last_s - time_s + FALL_S
        self._last_s = time_s
        return time_s + self._later_s

    def rest(self) -> bytes | None:
        """Return the last chunk, which may be shorter; None without moments."""
        if not self._messages:
            return None
        if self._start_s is None:
            self._start_s = self._times_s[0]
        times_s = [round(each - self._start_s, 4) for each in self._times_s]
        data = np.frombuffer(zlib.compress(b"".join(self._messages)), np.uint8)
        self._messages = []
        self._times_s = []
        return pack({"kind": "chunk", "times_s": times_s}, {"data": data})


class SessionFile:
    """Writer of ten moments per second to an HTML file, in its own thread while entered.

    A moment that finds the queue full is skipped, or waited for with `keeps_all`. An existing file
    is replaced by the first moment. After a kill the file lacks its last second and plays. A file
    that takes no more, as the disk is full, says so in `problem`; leaving it then raises the error.
    """

    address: str | None = None

    def __init__(
        self, path: Path, rig: Rig, measured: MeasuredWall | None = None, *, keeps_all: bool = False
    ) -> None:
        self.path = path
        self.kept = 0
        """Moments written."""
        self.left_out = 0
        """Moments that were due while the file took any, and found the queue full."""
        self.full = False
        """True if the file ended before the run."""
        self._bench = bench_message(rig, measured)
        self._keeps_all = keeps_all
        self._chunks = Chunks(MomentPacker(picture_width=PICTURE_WIDTH))
        self._queue = BoundedQueue[Moment](QUEUE_MOMENTS)
        self._schedule = Schedule(PERIOD_S)
        self._error: Exception | None = None
        self._thread = Thread(target=self._write, name="saved session")

    def __enter__(self) -> Self:
        # A path that cannot be written to is an error now, not in the thread.
        self.path.open("ab").close()
        self._thread.start()
        return self

    @property
    def problem(self) -> str:
        """Reason why no more is saved, for the page and the terminal; empty while moments are.

        May be read at any time, also after the file was left.
        """
        if self.full:
            limit = f"a browser plays no more than {MAX_BYTES >> 20} MB"
            return f"{self.path.name} is full ({limit}): it ends here and plays"
        if self._error:
            reason = getattr(self._error, "strerror", None) or repr(self._error)
            return f"{self.path.name} ended early ({reason}): it holds only what came before"
        return ""

    def __exit__(self, *_: object) -> None:
        self._queue.finish()
        self._thread.join()
        if self._error:
            raise self._error

    def show(self, moment: Moment) -> None:
        """Queue a moment if one is due."""
        if self.full or self._error or not self._schedule.is_due(moment.time_s):
            return
        if self._keeps_all:
            while self._thread.is_alive() and not self._queue.wait_for_room(CHUNK_S):
                pass
        if self._queue.wait_for_room(0.0):
            self._queue.put(moment)
        else:
            self.left_out += 1

    def _write(self) -> None:
        try:
            moment = self._queue.take()
            if moment is None and self.path.stat().st_size:
                return  # an earlier session
            with self.path.open("wb") as file:
                file.write(page_html("session").encode())
                file.write(element(self._bench))
                while moment is not None:
                    if not self.full:
                        self._append(file, self._chunks.add(moment))
                        self.kept += 1
                    moment = self._queue.take()
                self._append(file, self._chunks.rest())
        except Exception as error:  # noqa: BLE001  whatever it was, who entered raises it
            self._error = error

    def _append(self, file: BinaryIO, chunk: bytes | None) -> None:
        if chunk is not None:
            file.write(element(chunk))
            file.flush()
            self.full = file.tell() > MAX_BYTES


def element(message: bytes) -> bytes:
    """Return the element that holds a message in the page; a cut one is ignored there."""
    return b'<script type="text/x-message">' + base64.b64encode(message) + b"</script>\n"
