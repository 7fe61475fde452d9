"""Camera that is a real Intel RealSense L515, and its options."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

from nlos_cam.camera.laser_power import PowerLimits, turn_down
from nlos_cam.camera.live_camera import LiveCamera
from nlos_cam.camera.protocol import WaitingClock
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.sdk import load_sdk, sdk_serial
from nlos_cam.camera.session import FrameSize
from nlos_cam.errors import CameraError, CameraNotFoundError
from nlos_cam.frames import MAX_SATURATED, saturated_share

TOLERANCE = 1e-3
NOT_OFFERED = "not offered by this firmware"


class Options:
    """Options of a running sensor, by the SDK's names; the SDK's refusals are returned as notes,
    not raised.
    """

    def __init__(self, sensor: Any, sdk: Any) -> None:
        self._sensor = sensor
        self._sdk = sdk

    def limits(self, name: str) -> PowerLimits | None:
        """Return the range that the firmware reports; None where it reports none."""
        try:
            limits = self._sensor.get_option_range(self._option(name))
        except RuntimeError:
            return None
        return PowerLimits(limits.min, limits.max, limits.step if limits.step > 0 else 1.0)

    def get(self, name: str) -> float | None:
        """Return the present value; None where it cannot be read."""
        option = self._option(name)
        try:
            return float(self._sensor.get_option(option)) if self._sensor.supports(option) else None
        except RuntimeError:
            return None

    def put(self, name: str, wanted: float) -> str:
        """Set an option to the nearest allowed value, and return the `difference` or why it
        failed.
        """
        option = self._option(name)
        value = wanted
        try:
            if not self._sensor.supports(option):
                return NOT_OFFERED
            limits = self.limits(name)
            value = limits.nearest(wanted) if limits else wanted
            self._sensor.set_option(option, value)
        except RuntimeError as error:
            return f"{value:g} was refused ({error})"
        return self.difference(name, wanted)

    def difference(self, name: str, wanted: float) -> str:
        """Describe how the present value differs from the wanted one; empty where it does not."""
        found = self.get(name)
        if found is None:
            return "cannot be read back"
        return (
            ""
            if abs(found - wanted) <= TOLERANCE
            else f"{wanted:g} was requested, {found:g} is read back"
        )

    def put_all(self, wanted: Mapping[str, float]) -> dict[str, str]:
        """Set options in order, and return the differences by name."""
        notes = {name: self.put(name, value) for name, value in wanted.items()}
        return {name: note for name, note in notes.items() if note}

    def _option(self, name: str) -> Any:
        return getattr(self._sdk.option, name)


USB3_SIZE: FrameSize = (640, 480)
USB2_SIZE: FrameSize = (320, 240)
PRESET = {"global_time_enabled": 1.0, "visual_preset": 5.0}
"""Timestamps on the host's clock, and short range, whose lower gain does not saturate near a
wall.
"""
MODES_OFF = ("alternate_ir", "enable_ir_reflectivity", "enable_max_usable_range")
"""Modes in which IR is not intensity, or which set the preset to maximum range; not in every
firmware.
"""
NEAR_WALL = {
    "min_distance": 0.0,
    "confidence_threshold": 1.0,
    "noise_filtering": 2.0,
    "pre_processing_sharpening": 0.0,
    "post_processing_sharpening": 0.0,
    "invalidation_bypass": 0.0,
}
"""Options for a wall at 0.15 to 0.30 m, after the short-range preset: starting values, to be tuned
on a bench.
"""
PRESET_SETTLES_S = 0.5
LASER_POWER = "laser_power"
ADJUSTABLE = (LASER_POWER, "digital_gain", "receiver_gain", *NEAR_WALL)
"""Options that can be changed while the camera runs, where the firmware offers them."""
SETS_IN_FLIGHT = 3
"""Sets that may have been exposed before the last change."""
SETS_MEASURED = 3
LOOK_TIMEOUT_S = 0.5

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DeviceInfo:
    """Identity of a connected device; fields that the SDK does not report are empty."""

    name: str
    serial: str
    firmware: str
    usb_type: str


@cache
def shared_context(sdk: Any) -> Any:
    """Return this process's one context, for discovery and streaming: two of them compete for a
    device.
    """
    return sdk.context()


def connected(sdk: Any, context: Any) -> list[tuple[Any, DeviceInfo]]:
    """Return every device that the SDK can open. Raises CameraError where it fails on all."""
    found: list[tuple[Any, DeviceInfo]] = []
    failure: RuntimeError | None = None
    try:
        listed = context.query_devices()
        for index in range(len(listed)):
            try:
                device = listed[index]
                found.append((device, _info(device, sdk)))
            except RuntimeError as error:
                failure = error
    except RuntimeError as error:
        failure = error
    if failure and not found:
        raise CameraError(
            f"librealsense cannot list its devices ({failure}): replug them, close other programs"
        ) from failure
    return found


def _info(device: Any, sdk: Any) -> DeviceInfo:
    names = ("name", "serial_number", "firmware_version", "usb_type_descriptor")
    keys = [getattr(sdk.camera_info, name) for name in names]
    return DeviceInfo(*(device.get_info(key) if device.supports(key) else "" for key in keys))


class L515Camera(LiveCamera):
    """L515 by serial number, or the only one; 640 x 480 at 30 frames/s, 320 x 240 on USB 2.

    After the start it sets the options for a near wall and lowers the laser power until returns do
    not saturate; then frames are delivered and recorded. Options that were changed by `set_option`
    are set again when the device comes back. `Frame.settings` holds the options as read back.
    Raises CameraNotFoundError.
    """

    differences: Mapping[str, str]
    """Options that differ from the wanted values, and how."""

    def __init__(
        self,
        uri: str,
        serial: str,
        *,
        recording: Recording | None = None,
        sdk: Any = None,
        clock: WaitingClock | None = None,
    ) -> None:
        sdk = sdk or load_sdk()
        self._context = shared_context(sdk)
        device, info = find_l515(sdk, self._context, serial)
        size = USB2_SIZE if info.usb_type.startswith("2") else USB3_SIZE
        if size == USB2_SIZE:
            log.warning(
                "%s is on USB %s: only 320 x 240; turn the plug round or use a USB 3 cable",
                uri,
                info.usb_type,
            )
        self._serial = info.serial
        self.differences = {}
        super().__init__(uri, device, size, sdk, recording, clock)
        self.identity: Mapping[str, str] = {
            key: value for key, value in asdict(info).items() if value
        }

    def _clear_state(self) -> None:
        super()._clear_state()
        self._laser_power: float | None = None
        """The power that did not saturate, for when the device comes back."""
        self._by_hand: dict[str, float] = {}
        """Options of `set_option`, for when the device comes back."""

    def _prepare(self, sensor: Any) -> None:
        """Set the preset first, since it changes other options, and after the start, which resets
        it; options set by hand last, for the same reason.
        """
        options = Options(sensor, self._sdk)
        off = {name: 0.0 for name in MODES_OFF if options.get(name) not in {None, 0.0}}
        near_wall = NEAR_WALL | self._by_hand
        differences = self._put(options, off | PRESET) | self._put(options, near_wall)
        for name, difference in differences.items():
            if self.differences.get(name) != difference:
                log.warning("%s: %s: %s", self.uri, name, difference)
        self.differences = differences
        self._turn_down(options)

    def _put(self, options: Options, wanted: Mapping[str, float]) -> dict[str, str]:
        """Set options, again where they did not hold after settling, and return the differences by
        name.
        """
        missing = {
            name: note for name, note in options.put_all(wanted).items() if note == NOT_OFFERED
        }
        self._clock.wait(self._left, PRESET_SETTLES_S)
        again = {name: value for name, value in wanted.items() if options.difference(name, value)}
        return missing | options.put_all(
            {name: value for name, value in again.items() if name not in missing}
        )

    def _turn_down(self, options: Options) -> None:
        """Lower the laser power until returns do not saturate, from its last power if the device
        came back; a power that was set by hand stays.
        """
        limits = options.limits(LASER_POWER)
        present = options.get(LASER_POWER)
        if limits is None or present is None:
            return
        by_hand = LASER_POWER in self._by_hand and LASER_POWER not in self.differences
        power = present if by_hand or self._laser_power is None else self._laser_power
        if power != present:
            options.put(LASER_POWER, power)

        def put(lower: float) -> bool:
            """Set a lower power, unless one was set by hand; return True if it held."""
            return not by_hand and not options.put(LASER_POWER, lower)

        settled = turn_down(power, limits, self._saturated_share, put)
        self._laser_power = settled.power
        if settled.power < power:
            log.warning(
                "%s: laser power lowered from %g to %g: returns saturated",
                self.uri,
                power,
                settled.power,
            )
        if (settled.saturated or 0.0) > MAX_SATURATED:
            log.warning(
                "%s: %.1f %% of the infrared image is saturated at laser power %g: move away from"
                " the wall, or tilt the camera by 5 to 15 degrees",
                self.uri,
                100 * (settled.saturated or 0.0),
                settled.power,
            )

    def _saturated_share(self) -> float | None:
        """Return the share of saturated pixels now; None where no frames come."""
        shares: list[float] = []
        for index in range(SETS_IN_FLIGHT + SETS_MEASURED):
            found = self._session.look(LOOK_TIMEOUT_S) if self._session else None
            if found is None:
                return None
            if index >= SETS_IN_FLIGHT:
                shares.append(saturated_share(found.ir))
        return sum(shares) / len(shares)

    def adjustable(self) -> list[dict[str, Any]]:
        """Return name, value, min, max and step of laser power, gains and near-wall options, as the
        firmware offers them.
        """
        with self._changing:
            options = Options(self._session.sensor, self._sdk) if self._session else None
            if options is None or self._session is None:
                return []
            found = [(name, options.get(name), options.limits(name)) for name in ADJUSTABLE]
        offered = [
            (name, value, limits) for name, value, limits in found if limits and value is not None
        ]
        return [{"name": name, "value": value, **asdict(limits)} for name, value, limits in offered]

    def set_option(self, name: str, value: float) -> str:
        """Set one of the `adjustable` options to the nearest allowed value, and return the outcome
        in words.

        Raises CameraError where the firmware refuses it, or while the camera does not run.
        """
        if name not in ADJUSTABLE:
            raise CameraError(f"{name} cannot be set here: choose from {', '.join(ADJUSTABLE)}")
        with self._changing:
            if self._session is None:
                raise CameraError(f"{self.uri} is not running: wait until it is back")
            options = Options(self._session.sensor, self._sdk)
            limits = options.limits(name)
            wanted = limits.nearest(value) if limits else value
            if problem := options.put(name, wanted):
                raise CameraError(f"{name}: {problem}")
            self._by_hand[name] = wanted
            self._session.read_settings()
        return f"{name} is {wanted:g}" + ("" if wanted == value else f", the nearest to {value:g}")

    def _is_connected(self) -> bool:
        return self._reconnect() is not None

    def _reconnect(self) -> Any | None:
        there = connected(self._sdk, self._context)
        return next((device for device, info in there if info.serial == self._serial), None)

    def _reset(self) -> None:
        self._device.hardware_reset()


def find_l515(sdk: Any, context: Any, serial: str) -> tuple[Any, DeviceInfo]:
    """Return the L515 with this serial number, or the only one. Raises CameraNotFoundError with
    advice.
    """
    there = connected(sdk, context)
    lidars = [(device, info) for device, info in there if "L515" in info.name]
    wanted_serial = sdk_serial(serial)  # as on the label, which has leading zeros and capitals
    chosen = [pair for pair in lidars if not serial or sdk_serial(pair[1].serial) == wanted_serial]
    if len(chosen) == 1:
        return chosen[0]
    if chosen:
        names = ", ".join(f"l515:{info.serial}" for _, info in chosen)
        raise CameraNotFoundError(f"{len(chosen)} L515s are connected: choose one ({names})")
    present = ", ".join(f"{info.name} {info.serial}".strip() for _, info in there) or "no device"
    wanted = f"L515 with serial {serial}" if serial else "L515"
    raise CameraNotFoundError(
        f"no {wanted} found (librealsense sees {present}): check the USB 3 cable and port, and run"
        " `nlos-cam doctor`, which checks driver and permissions; without a camera, use"
        " --camera sim"
    )
