"""Simulated L515: a rendered world behind a software device of librealsense."""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from math import cos, radians, sin
from threading import Event, Thread
from typing import Any, Self

import numpy as np
from nlos_calibration import G_M_S2, Gravity, Intrinsics, Rig
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.camera.fault_injection import Delivery, FaultyDevice
from nlos_cam.camera.live_camera import LiveCamera
from nlos_cam.camera.protocol import SIMULATED_SERIAL, WaitingClock, WallClock
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import SampleQueue
from nlos_cam.camera.simulated_world import World
from nlos_cam.camera.streams import BYTES_PER_PIXEL, FORMATS, FRAMES_PER_S
from nlos_cam.errors import CameraLostError
from nlos_cam.render import DEPTH_UNIT_M, Fault, SensedImages

NAME = "Simulated L515"
SENSOR_NAME = "L500 Depth Sensor"
MOTION_NAME = "Motion Module"


class SoftwareLidar:
    """`rs.software_device` with the L515's depth sensor, which delivers the images pushed into it.

    It has the L515's sensor name, streams, formats and depth unit, and streams at one size; with
    `has_other_size` also at half the rows and columns. Timestamps are host time, or the device's
    with `has_own_clock`. Its options are the depth unit and the temperatures `celsius`, by the
    SDK's names, which stay constant. With `has_accelerometer` it has an L515's second sensor too.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        sdk: Any,
        *,
        celsius: Mapping[str, float] | None = None,
        has_other_size: bool = False,
        has_own_clock: bool = False,
        has_accelerometer: bool = False,
    ) -> None:
        self._sdk = sdk
        domains = sdk.timestamp_domain
        self._domain = domains.hardware_clock if has_own_clock else domains.global_time
        self.device: Any = sdk.software_device()
        self.device.update_info(sdk.camera_info.name, NAME)
        self.device.register_info(sdk.camera_info.serial_number, SIMULATED_SERIAL)
        self.device.register_info(sdk.camera_info.product_line, "L500")
        self._sensor: Any = self.device.add_sensor(SENSOR_NAME)
        self._sensor.add_read_only_option(sdk.option.depth_units, DEPTH_UNIT_M)
        for name, value in (celsius or {}).items():
            self._sensor.add_read_only_option(getattr(sdk.option, name), value)
        sizes = [intrinsics, intrinsics.scaled(intrinsics.width // 2, intrinsics.height // 2)]
        self._profiles: dict[tuple[str, tuple[int, ...]], Any] = {}
        for size in sizes if has_other_size else sizes[:1]:
            for stream in FORMATS:
                self._profiles[stream, (size.height, size.width)] = self._add(stream, size)
        self._motion = self._add_accelerometer() if has_accelerometer else None
        self._register_extrinsics()

    def _add(self, stream: str, size: Intrinsics) -> Any:
        video = self._sdk.video_stream()
        video.type = getattr(self._sdk.stream, stream)
        video.index = 0
        video.uid = len(self._profiles)
        video.width = size.width
        video.height = size.height
        video.fps = FRAMES_PER_S
        video.bpp = BYTES_PER_PIXEL[stream]
        video.fmt = getattr(self._sdk.format, FORMATS[stream])
        video.intrinsics = self._sdk_intrinsics(size)
        is_default = video.uid < len(FORMATS)
        return self._sdk.video_stream_profile(self._sensor.add_video_stream(video, is_default))

    def _sdk_intrinsics(self, pinhole: Intrinsics) -> Any:
        lens = self._sdk.intrinsics()
        lens.width = pinhole.width
        lens.height = pinhole.height
        lens.fx = pinhole.fx
        lens.fy = pinhole.fy
        lens.ppx = pinhole.ppx
        lens.ppy = pinhole.ppy
        lens.model = self._sdk.distortion.none
        lens.coeffs = [0.0] * 5
        return lens

    def _add_accelerometer(self) -> tuple[Any, Any]:
        """Return the motion sensor and the profile of its accelerometer."""
        sensor = self.device.add_sensor(MOTION_NAME)
        motion = self._sdk.motion_stream()
        motion.type = self._sdk.stream.accel
        motion.index = 0
        motion.uid = len(self._profiles)
        motion.fps = FRAMES_PER_S
        motion.fmt = self._sdk.format.motion_xyz32f
        exact = self._sdk.motion_device_intrinsic()
        exact.data = np.eye(3, 4).tolist()
        exact.noise_variances = exact.bias_variances = [0.0] * 3
        motion.intrinsics = exact
        return sensor, sensor.add_motion_stream(motion, True).as_motion_stream_profile()

    def _register_extrinsics(self) -> None:
        """Declare that all streams share one origin; without it, playback fails."""
        same = self._sdk.extrinsics()
        same.rotation = np.eye(3).ravel().tolist()
        same.translation = [0.0] * 3
        profiles = [*self._profiles.values(), *([self._motion[1]] if self._motion else [])]
        for one in profiles:
            for other in profiles:
                if one is not other:
                    one.register_extrinsics_to(other, same)

    def push(
        self,
        number: int,
        timestamp_s: float,
        images: SensedImages,
        streams: Collection[str] = tuple(FORMATS),
    ) -> None:
        """Deliver one instant on `streams`, at the size of its images; only while the sensor
        streams.
        """
        pixels = {
            "depth": images.depth_z16,
            "infrared": images.ir,
            "confidence": images.confidence << 4,
        }
        for (stream, shape), profile in self._profiles.items():
            if stream in streams and shape == images.ir.shape:
                self._push(profile, stream, number, timestamp_s, pixels[stream])

    def push_gravity(self, number: int, timestamp_s: float, gravity_m_s2: Gravity) -> None:
        """Deliver a sample of the accelerometer, if there is one, of a device at rest."""
        if self._motion is None:
            return
        up = self._sdk.vector()
        up.x, up.y, up.z = (-component for component in gravity_m_s2)
        frame = self._sdk.software_motion_frame()
        frame.data = up
        frame.timestamp = timestamp_s * 1e3
        frame.frame_number = number
        frame.domain = self._domain
        sensor, frame.profile = self._motion
        sensor.on_motion_frame(frame)

    def _push(
        self, profile: Any, stream: str, number: int, timestamp_s: float, pixels: NDArray[Any]
    ) -> None:
        frame = self._sdk.software_video_frame()  # new each time: the SDK owns a pushed one
        frame.pixels = np.ascontiguousarray(pixels)
        frame.bpp = BYTES_PER_PIXEL[stream]
        frame.stride = pixels.shape[1] * BYTES_PER_PIXEL[stream]
        frame.timestamp = timestamp_s * 1e3
        frame.frame_number = number
        frame.domain = self._domain
        frame.profile = profile  # of its size: the SDK reads that number of pixels
        self._sensor.on_video_frame(frame)


MAX_LATE_FRAMES = FRAMES_PER_S
"""Lateness in frames, on a busy machine, beyond which the world drops numbers."""
JOIN_TIMEOUT_S = 5.0
RESET_INSTANTS = FRAMES_PER_S
"""Instants for which a device that is reset is disconnected."""
# A real camera exposes a frame without this machine's processor; a simulated one computes it here,
# beside the reconstruction of the frame before. So each image is computed as late as it can be:
# half a period before it is due, or twice the time that the last image took, whichever is earlier.
MIN_LEAD_S = 0.5 / FRAMES_PER_S
"""Shortest time between the start of an image's computation and its delivery."""
MAX_EXPOSURES = 3000
"""Frames (100 s) whose computing time is stored."""
MAX_TRUTHS = 1000
"""Frames whose instant is stored for their ground truth; no reader is that late."""


class SimulatedCamera(LiveCamera):
    """Camera on a world through librealsense's software device, at 30 frames/s, with the given
    `faults`.

    A thread of its own delivers frames while entered; the world goes on through faults of the
    device. Its accelerometer has one sample a frame, without noise. Not modeled: the seconds that
    a start takes, options and presets beyond depth unit and temperatures, other resolutions, the
    color camera and gyroscope, per-frame metadata, clock drift and jitter, faults that are not
    given, and the cooling of an unplugged device. For the images, see `World` and `Sensor`.
    """

    roll_deg = 0.0
    """Roll of camera and bench together, 180 upside down: only the accelerometer shows it."""

    def __init__(
        self,
        uri: str,
        world: World,
        *,
        clock: WaitingClock | None = None,
        recording: Recording | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        self._world = world
        self._full_world = world
        self._empty_world: World | None = None
        self._clock = clock or WallClock()
        self._faults = tuple(faults)
        world.images(0)  # compiles, which would delay the first frames
        self.exposures_s = deque[float](maxlen=MAX_EXPOSURES)
        """Seconds that the last frames' images took to compute: a real camera takes none of this
        machine's.
        """
        self._stopping = Event()
        self._thread: Thread | None = None
        self._start_s: float | None = None
        self._plug_in(0)
        pinhole = world.rig.pinhole
        super().__init__(
            uri,
            self._lidar.device,
            (pinhole.width, pinhole.height),
            load_sdk(),
            recording,
            self._clock,
        )
        self.rig: Rig | None = world.rig
        self.identity: Mapping[str, str] = {"name": NAME, "serial": SIMULATED_SERIAL}

    def __enter__(self) -> Self:
        self._start_s = None
        self._plug_in(0)
        self._device = self._lidar.device
        return super().__enter__()

    def _plug_in(self, instant: int) -> None:
        self._model = FaultyDevice(self._faults, instant)
        self._instants: dict[int, int] = {}
        """Instant of each frame, by the device's own number."""
        self._lidar = SoftwareLidar(
            self._world.rig.pinhole,
            load_sdk(),
            celsius=self._world.celsius(instant),
            has_other_size=self._model.has_other_size,
            has_own_clock=self._model.has_own_clock,
            has_accelerometer=True,
        )

    def _begin(self, inbox: SampleQueue) -> None:
        if self._start_s is None:
            first = 0
            self._start_s = self._clock.now()
        else:  # the world went on while the device was away
            first = self._instant() + 1
        self._stopping.clear()
        self._thread = Thread(
            target=self._run, args=(inbox, first), name=f"world of {self.uri}", daemon=True
        )
        self._thread.start()

    def _end(self) -> None:
        self._stopping.set()
        if self._thread is None:
            return
        self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive():
            raise CameraLostError(f"{self.uri} did not stop within {JOIN_TIMEOUT_S:.0f} s")
        self._thread = None

    def _instant(self) -> int:
        if self._start_s is None:
            return 0
        return int((self._clock.now() - self._start_s) * FRAMES_PER_S)

    def _is_connected(self) -> bool:
        return self._model.is_connected(self._instant())

    def _reconnect(self) -> Any | None:
        instant = self._instant()
        if not self._model.is_connected(instant):
            if self._model.is_gone(instant):
                return None
            self._plug_in(instant)
        return self._lidar.device

    def _reset(self) -> None:
        self._model.unplug(self._instant(), RESET_INSTANTS)

    def _truth_depth_m(self, number: int) -> Float32 | None:
        instant = self._instants.get(number)
        return None if instant is None else self._world.truth_depth_m(instant)

    def place_object(self, *, present: bool) -> None:
        """Put the hidden object in, or take it away, from the next image computed on; the time of
        the world goes on.
        """
        if not present and self._empty_world is None:
            self._empty_world = self._full_world.without_object()
        self._world = self._full_world if present else (self._empty_world or self._full_world)

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        """Return the options with the temperatures of the present instant; the SDK's own stay
        constant.
        """
        options = super().telemetry(ending)
        celsius = self._world.celsius(self._instant())
        return {name: celsius.get(name, value) for name, value in options.items()}

    def _run(self, inbox: SampleQueue, first: int) -> None:
        try:
            self._deliver(first)
        except Exception as error:  # noqa: BLE001  any error is raised in the consumer's thread
            inbox.finish(error)

    def _deliver(self, instant: int) -> None:
        """Expose each instant ahead of time, and deliver the device's frames when it is due."""
        start_s = self._start_s or 0.0
        lead_s = MIN_LEAD_S
        while True:
            due_s = start_s + instant / FRAMES_PER_S
            if self._clock.wait(self._stopping, due_s - lead_s - self._clock.now()):
                return
            computed_from_s = self._clock.now()
            images = self._world.images(instant)
            computing_s = self._clock.now() - computed_from_s
            self.exposures_s.append(computing_s)
            lead_s = max(MIN_LEAD_S, 2 * computing_s)

            if self._clock.wait(self._stopping, due_s - self._clock.now()):
                return
            self._lidar.push_gravity(instant, due_s, level_gravity(self._world.rig, self.roll_deg))
            for delivery in self._model.deliver(instant, due_s, images):
                self._push(delivery)

            # On a machine too busy to keep up, skip instants rather than fall behind without end.
            late = int((self._clock.now() - start_s) * FRAMES_PER_S) - instant
            instant += max(1, late - MAX_LATE_FRAMES)

    def _push(self, delivery: Delivery) -> None:
        self._instants[delivery.number] = delivery.instant
        if len(self._instants) > MAX_TRUTHS:
            del self._instants[next(iter(self._instants))]
        self._lidar.push(delivery.number, delivery.timestamp_s, delivery.images, delivery.streams)


def level_gravity(rig: Rig, roll_deg: float = 0.0) -> Gravity:
    """Return gravity in the lidar frame of a bench that stands level, or rolled by an angle
    clockwise about the optical axis.
    """
    # The second row of the rotation is the wall's y axis, which is up, in the lidar frame. Rolled
    # clockwise, the lidar sees all else turn counterclockwise: from its y (down) to its x (right).
    x, y, z = -G_M_S2 * rig.wall_from_lidar[1, :3]
    cosine = cos(radians(roll_deg))
    sine = sin(radians(roll_deg))
    return float(cosine * x + sine * y), float(cosine * y - sine * x), float(z)
