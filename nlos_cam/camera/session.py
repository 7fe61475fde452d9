"""One run of a device's three streams through the SDK's sensor API, for every backend, and its
queue of sets.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import inf
from typing import Any

from nlos_calibration import Intrinsics, is_temperature
from nlos_calibration.arrays import Float32

from nlos_cam.camera import streams
from nlos_cam.camera.accelerometer import Accelerometer
from nlos_cam.camera.timestamps import ClockUnwrap
from nlos_cam.frames import Frame
from nlos_cam.threads import BoundedQueue

QUEUED_SETS = 8
"""Sets: a quarter of a second, and 10 MB at 640 x 480."""


class SampleQueue:
    """Queue of paired samples between the SDK's threads, which `put`, and the thread that iterates
    over a camera.

    When full it drops and counts the oldest set, so that the device never waits. `on_set` is called
    on an SDK thread with every set.
    """

    def __init__(self, on_set: Callable[[streams.FrameSet], None] | None = None) -> None:
        self.arrived: Counter[str] = Counter()
        """Samples so far, by stream."""
        self._on_set = on_set
        self._pairing = streams.FrameSynchronizer()
        self._evicted = 0
        self._sets = BoundedQueue[streams.FrameSet](QUEUED_SETS)

    @property
    def incomplete(self) -> int:
        """Sets without all streams."""
        return self._pairing.incomplete

    @property
    def dropped(self) -> int:
        """Sets that never came, or were not taken in time."""
        return self._pairing.dropped + self._evicted

    @property
    def counts(self) -> Counter[str]:
        """Other events of the pairing, by name."""
        with self._sets.changed:
            return Counter(self._pairing.counts)

    @property
    def ended(self) -> bool:
        """True once no set is left and none will come."""
        return self._sets.ended

    def expect(self, shape: tuple[int, int]) -> None:
        """Reject samples of any other shape (rows, columns)."""
        self._pairing.shape = shape

    def put(self, sample: streams.Sample) -> None:
        """Pair a sample, on an SDK thread."""
        with self._sets.changed:
            if self._sets.closed or self._sets.finished:
                return
            self.arrived[sample.stream] += 1
            complete = self._pairing.add(sample)
            if complete is None:
                return
            if self._sets.put(complete) is not None:
                self._evicted += 1
        if self._on_set:
            self._on_set(complete)

    def take(self, timeout_s: float) -> streams.FrameSet | None:
        """Return the oldest set; None after the timeout or once `ended`. Raises the error given to
        `finish`.
        """
        return self._sets.take(timeout_s)

    def finish(self, error: Exception | None = None) -> None:
        """Accept no more samples, optionally because of an error; sets that wait can still be
        taken.
        """
        self._sets.finish(error)

    def close(self) -> None:
        """Discard all sets and wake every thread that waits."""
        self._sets.close()


FrameSize = tuple[int, int]
"""Width and height in pixels."""
THERMOMETER = "_temperature"
"""End of the names of options that read a temperature: the photodiode's is none until 5 s after the
start.
"""
BOUNDARY_WAIT_S = 0.2
"""Time to wait for a whole set before frames are delivered, so that delivery begins between two."""


def find_streams(device: Any, size: FrameSize | None = None) -> tuple[Any, dict[str, Any]]:
    """Return the sensor with most of the needed streams, and their profiles; at `size` and 30
    frames/s, if given.
    """
    best: tuple[Any, dict[str, Any]] = (None, {})
    for sensor in device.query_sensors():
        profiles = [
            profile for profile in sensor.get_stream_profiles() if streams.is_needed(profile)
        ]
        found = {
            streams.stream_name(profile): profile
            for profile in profiles
            if size is None or _has(profile, size)
        }
        best = max(best, (sensor, found), key=lambda pair: len(pair[1]))
    return best


def _has(profile: Any, size: FrameSize) -> bool:
    video = profile.as_video_stream_profile()
    return (video.width(), video.height()) == size and profile.fps() == streams.FRAMES_PER_S


def read_settings(sensor: Any, ending: str = "") -> dict[str, float]:
    """Return every readable option whose name ends so, by the SDK's name, but for temperatures that
    are none; empty when the sensor is gone.
    """
    settings: dict[str, float] = {}
    for option in sensor.get_supported_options():
        if not option.name.endswith(ending):
            continue
        with suppress(RuntimeError):  # listed, but not readable in this state
            settings[option.name] = float(sensor.get_option(option))
    return {
        name: value
        for name, value in settings.items()
        if not name.endswith(THERMOMETER) or is_temperature(value)
    }


class Session:
    """Three streams of one sensor, delivered to an inbox between `start` and `stop`, both called by
    the owner.

    Samples come on the SDK's threads. Errors are the SDK's RuntimeError.
    """

    def __init__(
        self,
        sensor: Any,
        profiles: Mapping[str, Any],
        inbox: SampleQueue,
        accelerometer: Accelerometer | None = None,
    ) -> None:
        self.inbox = inbox
        self.settings: dict[str, float] = {}
        self.intrinsics: Intrinsics = streams.intrinsics_of(profiles["depth"])
        inbox.expect((self.intrinsics.height, self.intrinsics.width))
        self._sensor: Any = sensor
        self._profiles = list(profiles.values())
        self._accelerometer = accelerometer
        if (unit_m := read_settings(sensor).get("depth_units")) is None:
            raise RuntimeError("it does not report its depth unit")
        self._unit_m = unit_m
        self._clocks = {stream: ClockUnwrap() for stream in profiles}
        self._preview = SampleQueue()
        """Frames from before the settings hold."""
        self._listening = False
        self._previewed_s = -inf
        """Timestamp of the newest sample from before the settings held."""
        self._held_back = 0

    def start(self, prepare: Callable[[Any], None], ready: Callable[[], None]) -> None:
        """Start the sensor, set it up with `prepare`, call `ready`, and deliver every frame from
        then on.

        Raises RuntimeError when the device vanishes during this.
        """
        if self._accelerometer:  # first, so that a recording has it
            self._accelerometer.start()
        self._sensor.open(self._profiles)
        self._listening = False
        self._sensor.start(self._on_frame)
        prepare(self._sensor)
        self.read_settings()
        if not self.settings:
            raise RuntimeError("it vanished while it was set up")
        if self._preview.arrived:
            # Else the first set of a recording would miss the streams that came before.
            self.look(BOUNDARY_WAIT_S)
        ready()
        self._listening = True
        self._preview.close()

    def read_settings(self) -> None:
        """Read the options that frames bear: again after one of them was set."""
        self.settings = read_settings(self._sensor)

    def look(self, timeout_s: float) -> streams.FrameSet | None:
        """Return the next set to come while the sensor is prepared; None after the timeout or
        `end_wait`.
        """
        while self._preview.take(0.0):
            pass
        return self._preview.take(timeout_s)

    def end_wait(self) -> None:
        """End `look`, from any thread."""
        self._preview.close()

    def _on_frame(self, frame: Any) -> None:
        sample = streams.sample_from_sdk(frame)
        if frame.get_frame_timestamp_domain().name == "hardware_clock":
            # It wraps, for each stream by itself.
            unwrapped_s = self._clocks[sample.stream].add(sample.timestamp_s)
            sample = replace(sample, timestamp_s=unwrapped_s)
        inbox = self.inbox if self._is_heard(sample) else self._preview
        inbox.put(sample)

    def _is_heard(self, sample: streams.Sample) -> bool:
        """Return False for samples of a set that began before the settings held, which would be
        incomplete.

        At most one set is held back, so that a device whose clock stands still is not silenced.
        """
        if not self._listening:
            self._previewed_s = max(self._previewed_s, sample.timestamp_s)
            return False
        began_before = abs(sample.timestamp_s - self._previewed_s) <= streams.SAME_INSTANT_S
        if not began_before:
            return True
        self._held_back += 1
        return self._held_back >= len(streams.FORMATS)

    @property
    def sensor(self) -> Any:
        """The SDK's sensor; None once stopped."""
        return self._sensor

    def telemetry(self, ending: str = "") -> dict[str, float]:
        """Return the options as they read now; empty when the device is gone or the session has
        stopped.
        """
        sensor = self._sensor
        try:
            return read_settings(sensor, ending) if sensor else {}
        except RuntimeError:
            return {}

    def stop(self) -> None:
        """Stop, close and release the sensor."""
        self.end_wait()
        self.inbox.close()
        for end in (self._sensor.stop, self._sensor.close):
            # A device that vanished or never started is already stopped.
            with suppress(RuntimeError):
                end()
        if self._accelerometer:
            self._accelerometer.stop()
        self._sensor = None
        self._profiles.clear()

    def frame(self, found: streams.FrameSet, truth_depth_m: Float32 | None = None) -> Frame:
        """Return a set in SI units."""
        gravity_m_s2 = self._accelerometer.gravity() if self._accelerometer else None
        return streams.frame_in_si(
            found, self._unit_m, self.intrinsics, self.settings, truth_depth_m, gravity_m_s2
        )
