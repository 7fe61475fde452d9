"""What the simulated camera and a real one share: everything but where the device comes from."""

import atexit
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Self

from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Rig

from nlos_cam.camera.inbox import Inbox
from nlos_cam.camera.record import Recording
from nlos_cam.camera.session import Session, Size, find_streams
from nlos_cam.camera.streams import FORMATS, FrameSet
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Float32, Frame


class LiveCamera(ABC):
    """A device that delivers frames from entering to leaving, recorded meanwhile if a `Recording` is given.

    Iterating goes on until the camera is left or the recording is full. Raises CameraLostError when no complete set
    comes for `silence_s`.
    """

    def __init__(self, uri: str, device: Any, size: Size, sdk: Any, recording: Recording | None) -> None:
        self.uri = uri
        self.rig: Rig | None = None
        self.identity: Mapping[str, str] = {}
        self.incomplete = self.dropped = 0
        self.counts: Counter[str] = Counter()
        self.silence_s = 5.0
        self._device, self._size, self._sdk, self._recording = device, size, sdk, recording
        self._session: Session | None = None
        self.intrinsics: Intrinsics = self._new_session().intrinsics

    @abstractmethod
    def _prepare(self, sensor: Any) -> None:
        """Set up the sensor, which runs; no frame is delivered before this is done."""

    @abstractmethod
    def _begin(self, inbox: Inbox) -> None:
        """Frames may come now."""

    @abstractmethod
    def _end(self) -> None:
        """No more frames are wanted."""

    def _is_connected(self) -> bool:
        """Whether the device is still there."""
        return True

    def _reconnect(self) -> Any | None:
        """The device anew, when it has come back; None while it has not."""
        return self._device

    def _reset(self) -> None:  # noqa: B027  a device that has no such thing
        """Make the device start afresh, as by unplugging it; it vanishes and comes back."""

    @abstractmethod
    def _truth_depth_m(self, number: int) -> Float32 | None:
        """The hidden depth at a frame, where it is known."""

    def _new_session(self) -> Session:
        sensor, profiles = find_streams(self._device, self._size)
        if missing := [stream for stream in FORMATS if stream not in profiles]:
            width, height = self._size
            raise CameraError(f"{self.uri} offers no {' and no '.join(missing)} at {width} x {height}, 30 frames/s")
        try:
            return Session(sensor, profiles, Inbox(lossless=False, on_set=self._on_set))
        except RuntimeError as error:
            raise CameraError(f"{self.uri} cannot be read ({error}): unplug it, wait 10 s, plug it in again") from error

    def __enter__(self) -> Self:
        try:
            self._start()
        except RuntimeError as error:
            self._stop()
            raise CameraError(f"{self.uri} does not start ({error}): close what else uses it, or replug it") from error
        except BaseException:
            self._stop()
            raise
        atexit.register(self._leave)  # for a program that ends without leaving: the SDK's threads would crash it
        return self

    def _start(self) -> None:
        if self._recording:
            # never paused meanwhile: the SDK then stamps frames out of order when it resumes
            self._recording.begin(self._device, self._sdk)
        self._session = self._new_session()
        self._session.start(self._prepare)
        self._begin(self._session.inbox)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._leave()

    def _leave(self) -> None:
        atexit.unregister(self._leave)
        if self._recording:
            self._recording.stop()
        self._stop()

    def _stop(self) -> None:
        self._end()
        if self._session:
            self._session.stop()
            self._session = None
        if self._recording:
            self._recording.close()

    def __iter__(self) -> Iterator[Frame]:
        if self._session is None:
            raise CameraError(f"{self.uri} is not started: iterate inside `with`")
        session = self._session
        while (found := session.inbox.take(self.silence_s)) or not session.inbox.ended:
            if found is None:
                raise CameraLostError(self._silence(session.inbox))
            self._count(session.inbox)
            yield session.frame(found, self._truth_depth_m(found.number))
        self._count(session.inbox)

    def telemetry(self) -> Mapping[str, float]:
        return self._session.telemetry() if self._session else {}

    def _count(self, inbox: Inbox) -> None:
        self.incomplete, self.dropped = inbox.incomplete, inbox.dropped

    def _silence(self, inbox: Inbox) -> str:
        came = ", ".join(f"{inbox.arrived[stream]} {stream}" for stream in FORMATS)
        return f"{self.uri} gave no whole frame for {self.silence_s:.0f} s (so far {came}): replug it, try another port"

    def _on_set(self, found: FrameSet) -> None:
        if self._recording and self._session and self._recording.add(found):
            self._session.inbox.finish()
