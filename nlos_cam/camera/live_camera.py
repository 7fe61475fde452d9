"""What the simulated camera and a real one share: everything but where the device comes from."""

import atexit
import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from threading import Event, RLock
from typing import Any, Self

from nlos_calibration import Intrinsics, Rig
from nlos_calibration.arrays import Float32

from nlos_cam.camera.protocol import Clock, WallClock
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.recovery import NO_INTRINSICS, Hooks, Recovery
from nlos_cam.camera.session import SampleQueue, Session, Size, find_streams
from nlos_cam.camera.streams import FORMATS, FrameSet
from nlos_cam.camera.timestamps import Continuity
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Frame

log = logging.getLogger(__name__)


class LiveCamera(ABC):
    """A device that delivers frames from entering to leaving, recorded meanwhile if a `Recording` is given.

    Iterating goes on until the camera is left, by whichever thread, or the recording is full. When no whole set comes
    for `silence_s`, `Recovery` makes the device deliver again, and `Continuity` numbers what follows; a recording ends
    there, whole, since the device's numbers begin anew. Raises CameraLostError where nothing helps, or at once where
    the recording that ends is not `optional`.
    """

    intrinsics: Intrinsics

    def __init__(
        self, uri: str, device: Any, size: Size, sdk: Any, recording: Recording | None, clock: Clock | None = None
    ) -> None:
        self.uri = uri
        self.rig: Rig | None = None
        self.identity: Mapping[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.silence_s = 5.0
        self.replug_s = 60.0
        """How long a device that was unplugged is waited for."""
        self._device, self._size, self._sdk, self._recording = device, size, sdk, recording
        self._clock: Clock = clock or WallClock()
        self._session: Session | None = None
        self._changing = RLock()
        """Held while streams start or stop: one thread iterates, and another may leave."""
        self._entered = False
        self._begin_anew()
        self._cured(self._start)

    def _begin_anew(self) -> None:
        """Nothing was seen yet."""
        self.incomplete = self.dropped = 0
        self.counts.clear()
        self._past_incomplete = self._past_dropped = 0
        self._past_counts, self._arrived = Counter[str](), Counter[str]()
        self._continuity = Continuity()
        self._left = Event()
        self._recovery: Recovery | None = None
        """Of the silence under way, and only then: it and the camera refer to each other, which frees a device late."""

    @abstractmethod
    def _prepare(self, sensor: Any) -> None:
        """Set up the sensor, which runs; no frame is delivered or recorded before this is done."""

    @abstractmethod
    def _begin(self, inbox: SampleQueue) -> None:
        """Frames may come now."""

    @abstractmethod
    def _end(self) -> None:
        """No more frames are wanted."""

    def _is_connected(self) -> bool:
        """Whether the device is still there."""
        return True

    def _reconnect(self) -> Any | None:
        """The device anew, when it is there or has come back; None while it is not."""
        return self._device

    def _reset(self) -> None:  # noqa: B027  a device that cannot be reset is only restarted
        """Make the device start afresh, as by unplugging it; it vanishes and comes back."""

    @abstractmethod
    def _truth_depth_m(self, number: int) -> Float32 | None:
        """The hidden depth at a frame, by the device's own number, where it is known."""

    def _new_session(self) -> Session:
        try:
            sensor, profiles = find_streams(self._device, self._size)
            if not (missing := [stream for stream in FORMATS if stream not in profiles]):
                return Session(sensor, profiles, SampleQueue(lossless=False, on_set=self._on_set))
        except RuntimeError as error:
            raise CameraError(f"{self.uri} cannot be read ({error}): unplug it, wait 10 s, plug it in again") from error
        width, height = self._size
        raise CameraError(f"{self.uri} offers no {' and no '.join(missing)} at {width} x {height}, 30 frames/s")

    def _cured(self, start: Callable[[], None]) -> None:
        """Start; where the device has lost its calibration, once more after a reset."""
        try:
            start()
        except (RuntimeError, CameraError) as error:
            if NO_INTRINSICS not in str(error) or not self._new_recovery().reset():
                raise

    def _new_recovery(self) -> Recovery:
        hooks = Hooks(self._start, self._stop, self._is_connected, self._reconnect, self._reset)
        return Recovery(self.uri, hooks, self._clock, self._left, self.counts)

    def __enter__(self) -> Self:
        self._begin_anew()
        self._entered = True
        try:
            self._cured(self._start)
        except RuntimeError as error:
            self._abandon()
            raise CameraError(f"{self.uri} does not start ({error}): close what else uses it, or replug it") from error
        except BaseException:
            self._abandon()
            raise
        atexit.register(self._leave)  # for a program that ends without leaving: the SDK's threads would crash it
        return self

    def _start(self, device: Any | None = None) -> None:
        """Start the streams, of another device if given; before entering, only check that they could be."""
        with self._changing:
            self._device = device or self._device
            session = self._new_session()
            self.intrinsics = session.intrinsics
            if not self._entered or self._left.is_set():
                return
            self._session = session
            try:
                session.start(self._prepare, self._record)
                self._begin(session.inbox)
            except BaseException:
                self._stop()
                raise

    def _record(self) -> None:
        """The settings hold: the SDK's recorder takes to a sensor that runs."""
        if self._recording:
            # never paused meanwhile: the SDK then stamps frames out of order when it resumes
            self._recording.begin(self._device, self._sdk)

    def __exit__(self, *_: object) -> None:
        self._leave()

    def _leave(self) -> None:
        """Stop, and end an iteration under way; again does nothing."""
        atexit.unregister(self._leave)
        self._left.set()
        if session := self._session:
            session.end_wait()
        with self._changing:
            if self._recording and self._session:
                self._recording.stop()
            self._abandon()

    def _abandon(self) -> None:
        self._left.set()
        with self._changing:
            self._entered, self._recovery = False, None
            self._stop()

    def _stop(self) -> None:
        """Stop the streams, which may be started again; what was counted stays so."""
        with self._changing:
            self._end()
            if self._session:
                self._count_session(self._session.inbox)
                self._session.stop()
                self._session = None
            if self._recording:
                self._recording.close()

    def _count_session(self, inbox: SampleQueue) -> None:
        told = self.incomplete + self.dropped
        self._count(inbox)
        self._continuity.restart(counted=self.incomplete + self.dropped - told)
        self._past_incomplete += inbox.incomplete
        self._past_dropped += inbox.dropped
        self._past_counts += inbox.counts
        self._arrived += inbox.arrived

    def _count(self, inbox: SampleQueue) -> None:
        self.incomplete = self._past_incomplete + inbox.incomplete
        self.dropped = self._past_dropped + inbox.dropped + self._continuity.missed
        self.counts.update({name: self._past_counts[name] + n - self.counts[name] for name, n in inbox.counts.items()})

    def __iter__(self) -> Iterator[Frame]:
        if not self._entered:
            raise CameraError(f"{self.uri} is not started: iterate inside `with`")
        left = self._left
        while not left.is_set() and (session := self._session):
            if found := session.inbox.take(self.silence_s):
                yield self._passed_on(session, found)
            elif session.inbox.ended:
                break
            else:
                self._recover(session.inbox)

    def _passed_on(self, session: Session, found: FrameSet) -> Frame:
        self._recovery = None
        frame = session.frame(found, self._truth_depth_m(found.number))
        frame = self._continuity.add(frame, self._clock.now())
        self._count(session.inbox)
        return frame

    def _recover(self, inbox: SampleQueue) -> None:
        arrived = self._arrived + inbox.arrived
        came = ", ".join(f"{arrived[stream]} {stream}" for stream in FORMATS)
        silence = f"{self.uri} gave no whole frame for {self.silence_s:.0f} s (so far {came})"
        self._end_recording(silence)
        self._recovery = self._recovery or self._new_recovery()
        self._recovery.recover(silence, self.replug_s)

    def _end_recording(self, silence: str) -> None:
        """Close a recording that holds something; one that does not begins anew with the streams."""
        recording = self._recording
        if not recording or not recording.sets:
            return
        recording.stop()
        self._stop()
        self._recording = None
        if not recording.optional:
            raise CameraLostError(f"{silence}: the recording ends there, whole; replug the camera and record again")
        log.warning("%s: the recording ends there, whole, after %d frames", silence, recording.sets)

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return session.telemetry(ending) if (session := self._session) else {}

    def _on_set(self, found: FrameSet) -> None:
        recording, session = self._recording, self._session
        if recording and session and recording.add(found):
            session.inbox.finish()
