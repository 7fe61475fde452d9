"""A recording as a camera: complete, in order, the same each time, as fast as it is read."""

import atexit
import gc
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Rig

from nlos_cam.camera.inbox import Inbox
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import Session, find_streams
from nlos_cam.camera.streams import FORMATS, FrameSet, stream_name
from nlos_cam.errors import CameraError, RecordingError, StreamMissingError
from nlos_cam.frames import Frame

MAGIC = b"#ROSBAG V2.0"
POLL_S = 0.05
START_TIMEOUT_S = 30.0
"""Before its first frame, a playback that has not begun looks like one that has ended."""

END_TOLERANCE_S = 1.0
"""What is recorded besides frames (notifications, options) may be later than the last frame."""


class ReplayCamera:
    """The frames of a .bag. Iterating starts at the first frame each time, and never drops one: the SDK waits.

    Raises RecordingError for a file that cannot be read, StreamMissingError for one that lacks a stream.
    """

    def __init__(self, path: Path) -> None:
        self.uri = f"bag:{path}"
        self.rig: Rig | None = None
        self.incomplete = self.dropped = 0
        self.arrived: Counter[str] = Counter()
        """Frames of each stream in the last iteration."""
        self._path, self._sdk = path, load_sdk()
        self._entered = False
        self._session: Session | None = None
        self.intrinsics: Intrinsics = self._open()[1].intrinsics

    def _open(self) -> tuple[Any, Session]:
        playback = _load(self._path, self._sdk)
        playback.set_real_time(False)
        sensor, profiles = find_streams(playback)
        if missing := [stream for stream in FORMATS if stream not in profiles]:
            raise _lacks(self._path, missing, playback)
        try:
            return playback, Session(sensor, profiles, Inbox(lossless=True))
        except RuntimeError as error:
            raise RecordingError(f"{self._path} cannot be read ({error}): record it again") from error

    def __enter__(self) -> Self:
        self._entered = True
        atexit.register(self._leave)  # for a program that ends without leaving: the SDK's threads would crash it
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leave()

    def _leave(self) -> None:
        atexit.unregister(self._leave)
        self._entered = False
        self._stop()

    def _stop(self) -> None:
        if self._session:
            self._session.stop()
        self._session = None
        gc.collect()

    def __iter__(self) -> Iterator[Frame]:
        if not self._entered:
            raise CameraError(f"{self.uri} is not started: iterate inside `with`")
        self._stop()
        playback, session = self._open()
        self._session = session
        session.start()
        reached_s = 0.0
        while found := self._next(session.inbox, playback):
            reached_s = max(reached_s, playback.get_position() / 1e9)
            self._count(session.inbox)
            yield session.frame(found)
        self._count(session.inbox)
        if not session.inbox.closed:  # else it was left early
            self._check_end(reached_s, playback.get_duration().total_seconds())

    def _check_end(self, reached_s: float, duration_s: float) -> None:
        """The SDK ends quietly where it cannot read on. Raises RecordingError where that is not the end."""
        if duration_s - reached_s > END_TOLERANCE_S:
            raise RecordingError(
                f"{self._path} is damaged {reached_s:.1f} s into its {duration_s:.1f} s: {_repair(self._path)}"
            )

    def _count(self, inbox: Inbox) -> None:
        self.incomplete, self.dropped, self.arrived = inbox.incomplete, inbox.dropped, inbox.arrived

    def _next(self, inbox: Inbox, playback: Any) -> FrameSet | None:
        waited_s = 0.0
        while (found := inbox.take(POLL_S)) is None and not inbox.ended:
            waited_s += POLL_S
            # asked, and not called back: a callback from a thread that ends may find the interpreter waiting for it
            stopped = playback.current_status() == self._sdk.playback_status.stopped
            if stopped and inbox.arrived.total() > 0:
                inbox.finish()
            elif waited_s > START_TIMEOUT_S:
                raise RecordingError(f"{self._path} gave no frame in {START_TIMEOUT_S:.0f} s: record it again")
        return found


def _load(path: Path, sdk: Any) -> Any:
    _check_file(path)
    try:
        return sdk.context().load_device(str(path)).as_playback()
    except RuntimeError as error:
        if "unindexed" in str(error):
            what = "was never closed (its recording was killed), so it has no index"
        else:
            what = f"is cut short or damaged ({error})"
        raise RecordingError(f"{path} {what}: copy it again if it was copied, else {_repair(path)}") from error


def _repair(path: Path) -> str:
    return f"run `nlos-cam repair {path} --out {path.stem}-repaired.bag`"


def _check_file(path: Path) -> None:
    """Say what is wrong with a file in words of our own, before the SDK does in its."""
    if not path.exists():
        raise RecordingError(f"{path} does not exist: give the path of a .bag recording")
    if path.is_dir():
        raise RecordingError(f"{path} is a folder: give the path of a .bag recording")
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    if not start:
        raise RecordingError(f"{path} is empty: record it again")
    if start != MAGIC:
        raise RecordingError(f"{path} is not a .bag recording (it starts with {start!r}): give one made by `capture`")


def _lacks(path: Path, missing: list[str], playback: Any) -> RecordingError:
    profiles = [profile for sensor in playback.query_sensors() for profile in sensor.get_stream_profiles()]
    if not profiles:
        return RecordingError(f"{path} holds no frames: record it again")
    present = ", ".join(sorted({stream_name(profile) for profile in profiles}))
    return StreamMissingError(
        f"{path} has no {' and no '.join(missing)} stream (it has {present}): record depth, infrared and confidence "
        "with an L515, e.g. `nlos-cam capture --camera l515`"
    )


@dataclass(frozen=True)
class Verified:
    """What a recording holds, read back from the file."""

    frames: int
    """Complete sets."""
    dropped: int
    """Numbers between the first and the last set that are not in the file, or lack a stream."""
    seconds: float
    """From the first set to the last."""
    streams: dict[str, int]
    """Frames of each stream."""


def verify(path: Path) -> Verified:
    """Read a recording from end to end. Raises RecordingError where it cannot be."""
    frames, first_s, last_s = 0, 0.0, 0.0
    with ReplayCamera(path) as camera:
        for frame in camera:
            first_s, last_s = first_s if frames else frame.timestamp_s, frame.timestamp_s
            frames += 1
        return Verified(frames, camera.dropped + camera.incomplete, last_s - first_s, dict(camera.arrived))
