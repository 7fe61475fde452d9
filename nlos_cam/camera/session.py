"""One run of a device's three streams through the SDK's sensor API, the same for every backend.

The bounded queue between the SDK's threads, which deliver samples, and whoever iterates over a camera.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import inf
from threading import Condition
from typing import Any

from nlos_calibration import Intrinsics
from nlos_calibration.arrays import Float32

from nlos_cam.camera.streams import (
    FORMATS,
    FRAMES_PER_S,
    SAME_INSTANT_S,
    FrameSet,
    FrameSynchronizer,
    Sample,
    frame_in_si,
    intrinsics_of,
    is_needed,
    sample_from_sdk,
    stream_name,
)
from nlos_cam.camera.timestamps import ClockUnwrap
from nlos_cam.frames import Frame

CAPACITY = 8
"""Sets: a quarter of a second, and 10 MB at 640 x 480."""


class SampleQueue:
    """Pairs what the SDK's threads put, and keeps the sets until they are taken.

    A full inbox drops its oldest set and counts it, so that a live device never waits; a `lossless` one makes the SDK
    wait, which holds up a recording's playback.
    """

    def __init__(self, *, lossless: bool, on_set: Callable[[FrameSet], None] | None = None) -> None:
        self.arrived: Counter[str] = Counter()
        """Samples so far, by stream."""
        self._lossless, self._on_set = lossless, on_set
        self._pairing = FrameSynchronizer()
        self._evicted = 0
        self._sets: deque[FrameSet] = deque()
        self._changed = Condition()
        self.closed = False
        self._finished = False
        self._failure: Exception | None = None

    @property
    def incomplete(self) -> int:
        """Sets that lacked a stream."""
        return self._pairing.incomplete

    @property
    def dropped(self) -> int:
        """Sets that never came, or that nobody took in time."""
        return self._pairing.dropped + self._evicted

    @property
    def counts(self) -> Counter[str]:
        """What else the pairing saw, by name."""
        with self._changed:
            return Counter(self._pairing.counts)

    @property
    def ended(self) -> bool:
        """Whether nothing is left to take, and nothing will come."""
        return (self._finished or self.closed) and not self._sets

    def expect(self, shape: tuple[int, int]) -> None:
        """Take only samples of this shape (rows, columns) for good ones."""
        self._pairing.shape = shape

    def put(self, sample: Sample) -> None:
        """Take a sample from an SDK thread."""
        with self._changed:
            self._changed.wait_for(self._has_room)
            if self.closed or self._finished:
                return
            self.arrived[sample.stream] += 1
            complete = self._pairing.add(sample)
            if complete is None:
                return
            self._sets.append(complete)
            if len(self._sets) > CAPACITY and not self._lossless:
                self._sets.popleft()
                self._evicted += 1
            self._changed.notify_all()
        if self._on_set:
            self._on_set(complete)

    def _has_room(self) -> bool:
        return not self._lossless or len(self._sets) < CAPACITY or self._finished or self.closed

    def take(self, timeout_s: float) -> FrameSet | None:
        """The oldest set; None when none came in time or `ended`. Raises what `fail` was given."""
        with self._changed:
            self._changed.wait_for(lambda: self._sets or self._finished or self.closed, timeout_s)
            if self._sets:
                self._changed.notify_all()
                return self._sets.popleft()
            if self._failure and not self.closed:
                raise self._failure
            return None

    def finish(self) -> None:
        """Nothing more will come; what is here can still be taken."""
        with self._changed:
            self._finished = True
            if self._lossless:  # a live device is left in the middle of a set; a recording's end is the end
                self._pairing.finish()
            self._changed.notify_all()

    def fail(self, error: Exception) -> None:
        """Nothing more will come, because of this error."""
        self._failure = error
        self.finish()

    def close(self) -> None:
        """Nobody will take any more: let go of everybody who waits."""
        with self._changed:
            self.closed = True
            self._sets.clear()
            self._changed.notify_all()


Size = tuple[int, int]
"""Width and height in pixels."""
NOT_YET = -9999.0
"""A temperature that the firmware has not measured yet: the photodiode's, until 5 s after the start."""
BOUNDARY_WAIT_S = 0.2


def find_streams(device: Any, size: Size | None = None) -> tuple[Any, dict[str, Any]]:
    """The sensor that offers most of the needed streams, and their profiles; at `size` and 30 frames/s, if given."""
    best: tuple[Any, dict[str, Any]] = (None, {})
    for sensor in device.query_sensors():
        profiles = [profile for profile in sensor.get_stream_profiles() if is_needed(profile)]
        found = {stream_name(profile): profile for profile in profiles if size is None or _has(profile, size)}
        best = max(best, (sensor, found), key=lambda pair: len(pair[1]))
    return best


def _has(profile: Any, size: Size) -> bool:
    video = profile.as_video_stream_profile()
    return (video.width(), video.height()) == size and profile.fps() == FRAMES_PER_S


def read_settings(sensor: Any, ending: str = "") -> dict[str, float]:
    """Every option with such a name that the sensor lets be read, by the SDK's name; empty when it is gone."""
    settings: dict[str, float] = {}
    for option in sensor.get_supported_options():
        if not option.name.endswith(ending):
            continue
        try:
            settings[option.name] = float(sensor.get_option(option))
        except RuntimeError:  # listed, but not readable in this state
            continue
    return {name: value for name, value in settings.items() if value != NOT_YET}


def _depth_unit_m(sensor: Any) -> float:
    settings = read_settings(sensor)
    if "depth_units" not in settings:
        raise RuntimeError("it does not tell its depth unit")
    return settings["depth_units"]


class Session:
    """Three streams of one sensor, delivered to an inbox from `start` to `stop`. Errors are the SDK's RuntimeError."""

    def __init__(self, sensor: Any, profiles: Mapping[str, Any], inbox: SampleQueue) -> None:
        self.inbox = inbox
        self.settings: dict[str, float] = {}
        self.intrinsics: Intrinsics = intrinsics_of(profiles["depth"])
        inbox.expect((self.intrinsics.height, self.intrinsics.width))
        self._sensor: Any = sensor
        self._profiles = list(profiles.values())
        self._unit_m = _depth_unit_m(sensor)
        self._clocks = {stream: ClockUnwrap() for stream in profiles}
        self._preview = SampleQueue(lossless=False)
        """Of frames from before the settings hold."""
        self._listening = False
        self._previewed_s = -inf
        """When the newest sample was taken that came before the settings held."""
        self._held_back = 0

    def start(self, prepare: Callable[[Any], None] | None = None, ready: Callable[[], None] | None = None) -> None:
        """Let frames come, once `prepare` has had the running sensor; from `ready` on, none is lost.

        Raises RuntimeError when the device vanishes meanwhile.
        """
        self._sensor.open(self._profiles)
        self._listening = prepare is None  # a recording's first frame comes while `start` still runs
        self._sensor.start(self._on_frame)
        if prepare:
            prepare(self._sensor)
        self.settings = read_settings(self._sensor)
        if not self.settings:
            raise RuntimeError("it vanished while it was set up")
        if self._preview.arrived:
            self.look(BOUNDARY_WAIT_S)  # else the first set of a recording would lack what came before this
        if ready:
            ready()
        self._listening = True
        self._preview.close()

    def look(self, timeout_s: float) -> FrameSet | None:
        """While the sensor is prepared, the next set that comes; None when none does, or `end_wait` was called."""
        while self._preview.take(0.0):
            pass
        return self._preview.take(timeout_s)

    def end_wait(self) -> None:
        """Let go of whoever looks, from any thread."""
        self._preview.close()

    def _on_frame(self, frame: Any) -> None:
        sample = self._unwrapped(sample_from_sdk(frame), frame.get_frame_timestamp_domain().name)
        inbox = self.inbox if self._is_heard(sample) else self._preview
        inbox.put(sample)

    def _is_heard(self, sample: Sample) -> bool:
        """Whether it is delivered: not one of a set that had begun before, which would lack what came until then.

        No more than that set is held back, so that a clock which stands still silences nothing.
        """
        if not self._listening:
            self._previewed_s = max(self._previewed_s, sample.timestamp_s)
            return False
        began_before = abs(sample.timestamp_s - self._previewed_s) <= SAME_INSTANT_S
        self._held_back += began_before
        return not began_before or self._held_back >= len(FORMATS)

    def _unwrapped(self, sample: Sample, domain: str) -> Sample:
        """A sample on a clock that goes on: the device's own wraps every 71.6 minutes, for each stream by itself."""
        if domain != "hardware_clock":
            return sample
        return replace(sample, timestamp_s=self._clocks[sample.stream].add(sample.timestamp_s))

    def telemetry(self, ending: str = "") -> dict[str, float]:
        """The options as they read now; empty when the device is gone, or the session has stopped."""
        sensor = self._sensor
        try:
            return read_settings(sensor, ending) if sensor else {}
        except RuntimeError:
            return {}

    def stop(self) -> None:
        """Stop and close the sensor, and let go of it."""
        self.end_wait()
        self.inbox.close()  # first: the SDK waits for its callbacks, and a callback may wait for room
        for end in (self._sensor.stop, self._sensor.close):
            with suppress(RuntimeError):  # a device that vanished, or never started, is stopped already
                end()
        self._sensor = None
        self._profiles.clear()

    def frame(self, found: FrameSet, truth_depth_m: Float32 | None = None) -> Frame:
        """A set in SI units."""
        return frame_in_si(found, self._unit_m, self.intrinsics, self.settings, truth_depth_m)
