"""Playback of a recording by librealsense (`--reader sdk`), with the same results as the built-in
reader.
"""

import atexit
import gc
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from nlos_calibration import Intrinsics, Rig

from nlos_cam.camera import FORMATS, FrameSet, SampleQueue, Session, find_streams, load_sdk
from nlos_cam.errors import CameraError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.bag_reader import raise_as_recording_error, repair_advice
from nlos_cam.recording.playback import identity_of, open_lidar_bag
from nlos_cam.recording.salvage import scan_bag

POLL_S = 0.05
START_TIMEOUT_S = 30.0
"""Before its first frame, a playback that has not begun has the same status as one that has
ended.
"""


class SdkReplayCamera:
    """Camera that plays a .bag through librealsense, from the first frame at each iteration,
    without drops.

    Use it as a context manager, which stops the SDK's threads; iterate in one thread. A frame's
    settings are those with which the recording began. Since damaged files can crash or hang the
    SDK, opening reads every byte with the built-in reader first. Raises what ReplayCamera raises,
    but on opening, and CameraError without the SDK.
    """

    def __init__(self, path: Path) -> None:
        self.uri = f"bag:{path}"
        self.rig: Rig | None = None
        self._bag = open_lidar_bag(path)
        self._sdk = load_sdk()
        self._path = self._bag.path
        self._check_all()
        self.identity: Mapping[str, str] = identity_of(self._bag)
        self.incomplete = self.dropped = 0
        self.counts: Counter[str] = Counter()
        self.arrived: Counter[str] = Counter()
        """Frames of each stream in the last iteration."""
        self._entered = False
        self._session: Session | None = None
        self.intrinsics: Intrinsics = self._open()[1].intrinsics

    def _check_all(self) -> None:
        """Raise RecordingError for damage, also in parts of the file that only the SDK reads."""
        self._bag.check()
        with raise_as_recording_error(self._path, "is damaged"):
            if damages := scan_bag(self._path).damages:
                raise ValueError(f"at byte {damages[0].position}: {damages[0].why}")

    def _open(self) -> tuple[Any, Session]:
        try:
            playback = self._sdk.context().load_device(str(self._path)).as_playback()
            playback.set_real_time(False)
            return playback, Session(*find_streams(playback), SampleQueue(lossless=True))
        except RuntimeError as error:
            raise self._damaged(f"is cut short or damaged ({error})") from error
        except KeyError as error:  # it can take a damaged description for one of another stream
            raise self._damaged(f"is damaged (librealsense finds no {error} in it)") from error

    def _damaged(self, problem: str) -> RecordingError:
        return RecordingError(f"{self._path} {problem}: {repair_advice(self._path)}")

    def __enter__(self) -> Self:
        self._entered = True
        atexit.register(
            self.__exit__
        )  # a program that ends inside the block would crash in the SDK's threads
        return self

    def __exit__(self, *_: object) -> None:
        atexit.unregister(self.__exit__)
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
        while found := self._next(session.inbox, playback):
            self._count(session.inbox)
            yield session.frame(found)
        self._count(session.inbox)
        if not session.inbox.closed:  # else the caller left early
            self._check_end(playback.get_position() / 1e9)

    def _check_end(self, reached_s: float) -> None:
        """Raise RecordingError where fewer frames came than the index lists: the SDK ends silently
        at damage.
        """
        for stream in FORMATS:
            listed = self._bag.streams[stream].frames
            came = self.arrived[stream]
            if came < listed:
                raise self._damaged(
                    f"is damaged {reached_s:.1f} s into its {self._bag.end_ns / 1e9:.1f} s:"
                    f" librealsense played {came} of {listed} {stream} frames"
                )

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return self._session.telemetry(ending) if self._session else {}

    def _count(self, inbox: SampleQueue) -> None:
        self.incomplete = inbox.incomplete
        self.dropped = inbox.dropped
        self.arrived = inbox.arrived
        self.counts = inbox.counts

    def _next(self, inbox: SampleQueue, playback: Any) -> FrameSet | None:
        waited_s = 0.0
        while (found := inbox.take(POLL_S)) is None and not inbox.ended:
            waited_s += POLL_S
            # polled: a callback from one of the SDK's ending threads could deadlock with the
            # interpreter
            stopped = playback.current_status() == self._sdk.playback_status.stopped
            if stopped and inbox.arrived.total() > 0:
                inbox.finish()
            elif waited_s > START_TIMEOUT_S:
                raise RecordingError(
                    f"{self._path} gave no frame in {START_TIMEOUT_S:.0f} s: record it again"
                )
        return found
