"""Base of the live cameras, simulated and real: everything but the source of the device."""

import atexit
import logging
from collections import Counter
from collections.abc import Iterator, Mapping
from threading import Event, RLock
from typing import Any, Self

from nlos_calibration import Intrinsics, Rig
from nlos_calibration.arrays import Float32

from nlos_cam.camera.accelerometer import Accelerometer
from nlos_cam.camera.protocol import WaitingClock, WallClock
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.recovery import NO_INTRINSICS, Hooks, Recovery
from nlos_cam.camera.session import FrameSize, SampleQueue, Session, find_streams
from nlos_cam.camera.streams import FORMATS, FrameSet
from nlos_cam.camera.timestamps import Continuity
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Frame

log = logging.getLogger(__name__)


class LiveCamera:
    """Device that delivers frames from entering to leaving, and records them if a `Recording` is
    given.

    Iterating goes on until any thread leaves the camera, or the recording is full. When no whole
    set comes for `silence_s`, `Recovery` restarts the device and `Continuity` renumbers its frames;
    a recording is closed there, whole, since the device restarts its numbers. Raises
    CameraLostError where recovery fails, or at once where that recording is not `optional`.
    Subclasses override the methods that their device needs.
    """

    intrinsics: Intrinsics

    def __init__(
        self,
        uri: str,
        device: Any,
        size: FrameSize,
        sdk: Any,
        recording: Recording | None,
        clock: WaitingClock | None = None,
    ) -> None:
        self.uri = uri
        self.rig: Rig | None = None
        self.identity: Mapping[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.silence_s = 5.0
        self.replug_s = 60.0
        """Time to wait for a device that was unplugged."""
        self._device = device
        self._size = size
        self._sdk = sdk
        self._recording = recording
        self._clock: WaitingClock = clock or WallClock()
        self._session: Session | None = None
        self._changing = RLock()
        """Held while streams start or stop: one thread iterates, another may leave."""
        self._entered = False
        self._clear_state()
        self._start_cured()

    def _clear_state(self) -> None:
        """Reset counts and state to those of a camera not yet entered."""
        self.incomplete = self.dropped = 0
        self.counts.clear()
        self._past_incomplete = self._past_dropped = 0
        self._past_counts = Counter[str]()
        self._arrived = Counter[str]()
        self._continuity = Continuity()
        self._left = Event()
        self._recovery: Recovery | None = None
        """Set only during a silence: it and the camera refer to each other, which would free a
        device late.
        """

    def _prepare(self, sensor: Any) -> None:
        """Set up the running sensor; frames are delivered and recorded only after this."""

    def _begin(self, inbox: SampleQueue) -> None:
        """Note that frames may be delivered from now on."""

    def _end(self) -> None:
        """Note that no more frames are wanted."""

    def _is_connected(self) -> bool:
        """Return True while the device is connected."""
        return True

    def _reconnect(self) -> Any | None:
        """Return a handle of the device; None while it is not connected."""
        return self._device

    def _reset(self) -> None:
        """Reset the device, as by unplugging it: it vanishes and comes back."""

    def _truth_depth_m(self, number: int) -> Float32 | None:  # noqa: ARG002  a real device does not know
        """Return the hidden depth at a frame, by the device's own number, if known."""
        return None

    def _new_session(self) -> Session:
        try:
            sensor, profiles = find_streams(self._device, self._size)
            missing = [stream for stream in FORMATS if stream not in profiles]
            if not missing:
                accelerometer = Accelerometer.of(self._device, profiles["depth"])
                return Session(sensor, profiles, SampleQueue(self._on_set), accelerometer)
        except RuntimeError as error:
            raise CameraError(
                f"{self.uri} cannot be read ({error}): unplug it, wait 10 s, plug it in again"
            ) from error
        width, height = self._size
        raise CameraError(
            f"{self.uri} offers no {' and no '.join(missing)} at {width} x {height}, 30 frames/s"
        )

    def _start_cured(self) -> None:
        """Start; if the device lost its calibration, once more after a reset."""
        try:
            self._start()
        except (RuntimeError, CameraError) as error:
            if NO_INTRINSICS not in str(error) or not self._new_recovery().reset():
                raise

    def _new_recovery(self) -> Recovery:
        hooks = Hooks(self._start, self._stop, self._is_connected, self._reconnect, self._reset)
        return Recovery(self.uri, hooks, self._clock, self._left, self.counts)

    def __enter__(self) -> Self:
        self._clear_state()
        self._entered = True
        try:
            self._start_cured()
        except RuntimeError as error:
            self._abandon()
            raise CameraError(
                f"{self.uri} does not start ({error}): close other programs, or replug it"
            ) from error
        except BaseException:
            self._abandon()
            raise
        # The SDK's threads would crash a program that ends without leaving.
        atexit.register(self._leave)
        return self

    def _start(self, device: Any | None = None) -> None:
        """Start the streams, of another device if given; before entering, only check that they
        exist.
        """
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
        """Start recording, once the settings hold: the SDK's recorder can join a running sensor."""
        if self._recording:
            # Not paused before: the SDK then stamps frames out of order when it resumes.
            self._recording.begin(self._device, self._sdk)

    def __exit__(self, *_: object) -> None:
        self._leave()

    def _leave(self) -> None:
        """Stop, and end an iteration in another thread; without effect if repeated."""
        atexit.unregister(self._leave)
        self._left.set()
        session = self._session
        if session:
            session.end_wait()
        with self._changing:
            if self._recording and self._session:
                self._recording.stop()
            self._abandon()

    def _abandon(self) -> None:
        self._left.set()
        with self._changing:
            self._entered = False
            self._recovery = None
            self._stop()

    def _stop(self) -> None:
        """Stop the streams, which may be started again, and keep the counts."""
        with self._changing:
            self._end()
            if self._session:
                self._count_session(self._session.inbox)
                self._session.stop()
                self._session = None
            if self._recording:
                self._recording.close()

    def _count_session(self, inbox: SampleQueue) -> None:
        before = self.incomplete + self.dropped
        self._count(inbox)
        self._continuity.restart(counted=self.incomplete + self.dropped - before)
        self._past_incomplete += inbox.incomplete
        self._past_dropped += inbox.dropped
        self._past_counts += inbox.counts
        self._arrived += inbox.arrived

    def _count(self, inbox: SampleQueue) -> None:
        self.incomplete = self._past_incomplete + inbox.incomplete
        self.dropped = self._past_dropped + inbox.dropped + self._continuity.missed
        for name, count in inbox.counts.items():
            self.counts[name] = self._past_counts[name] + count

    def __iter__(self) -> Iterator[Frame]:
        if not self._entered:
            raise CameraError(f"{self.uri} is not started: iterate inside `with`")
        left = self._left
        while not left.is_set() and (session := self._session):
            if found := session.inbox.take(self.silence_s):
                self._recovery = None
                frame = session.frame(found, self._truth_depth_m(found.number))
                frame = self._continuity.add(frame, self._clock.now())
                if self._recording:
                    self._recording.added_s = self._continuity.added_s
                self._count(session.inbox)
                yield frame
            elif session.inbox.ended:
                break
            else:
                self._recover(session.inbox)

    def _recover(self, inbox: SampleQueue) -> None:
        arrived = self._arrived + inbox.arrived
        came = ", ".join(f"{arrived[stream]} {stream}" for stream in FORMATS)
        silence = f"{self.uri} gave no whole frame for {self.silence_s:.0f} s (so far {came})"
        self._end_recording(silence)
        self._recovery = self._recovery or self._new_recovery()
        self._recovery.recover(silence, self.replug_s)

    def _end_recording(self, silence: str) -> None:
        """Close a recording that holds frames; an empty one starts again with the streams."""
        recording = self._recording
        if not recording or not recording.sets:
            return
        recording.stop()
        self._stop()
        self._recording = None
        if not recording.optional:
            raise CameraLostError(
                f"{silence}: the recording is closed, and whole; replug the camera and record again"
            )
        log.warning("%s: the recording is closed, whole, after %d frames", silence, recording.sets)

    @property
    def recording(self) -> Recording | None:
        """The recording that runs, if any."""
        return self._recording if self._recording and not self._recording.done else None

    def start_recording(self, recording: Recording) -> None:
        """Record from the next set on; `recording` must not be its `last` take, so that frames go
        on after it.

        Raises CameraError while not running or while another recording runs, RecordingError if
        nothing can be written.
        """
        with self._changing:
            if not self._session:
                raise CameraError(f"{self.uri} is not running: wait for the first frame")
            if self.recording:
                raise CameraError(
                    f"{self.recording.path} is being recorded (--record) until the run ends"
                )
            if self._recording:  # it ended by itself, as on a full disk
                self._recording.close()
            # Before it begins: the SDK's thread must pass it a set, as a boundary.
            self._recording = recording
            recording.added_s = self._continuity.added_s
            try:
                recording.join(self._device, self._sdk)
            except BaseException:
                self._recording = None
                raise

    def stop_recording(self) -> None:
        """Close the recording, if any; frames go on. Raises DiskFullError without room, unless it
        is optional.
        """
        with self._changing:
            recording = self._recording
            if recording:
                recording.stop()
                self._recording = None
                recording.close()

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        session = self._session
        return session.telemetry(ending) if session else {}

    def _on_set(self, found: FrameSet) -> None:
        recording = self._recording
        session = self._session
        if recording and session and recording.add(found, self._clock.now()):
            session.inbox.finish()
