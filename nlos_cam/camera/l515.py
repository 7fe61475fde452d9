"""A real Intel RealSense L515."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from nlos_cam.camera.clock import Clock
from nlos_cam.camera.inbox import Inbox
from nlos_cam.camera.live_camera import LiveCamera
from nlos_cam.camera.record import Recording
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import Size
from nlos_cam.errors import CameraError, CameraNotFoundError
from nlos_cam.frames import Float32

USB3_SIZE: Size = (640, 480)
USB2_SIZE: Size = (320, 240)
SHORT_RANGE = 5.0
NEAR_WALL = {
    "min_distance": 0.0,
    "confidence_threshold": 1.0,
    "noise_filtering": 2.0,
    "pre_processing_sharpening": 0.0,
    "post_processing_sharpening": 0.0,
    "invalidation_bypass": 0.0,
}
"""For a wall at 0.15 to 0.30 m, on top of the short-range preset: starting values, to be tuned on a bench."""
PRESET_SETTLES_S = 0.5

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DeviceInfo:
    """What the SDK tells of a connected device; empty where it does not."""

    name: str
    serial: str
    firmware: str
    usb_type: str


def connected(sdk: Any, context: Any) -> list[tuple[Any, DeviceInfo]]:
    """Every device that the SDK sees. Raises CameraError where it cannot look."""
    try:
        return [(device, _info(device, sdk)) for device in context.query_devices()]
    except RuntimeError as error:
        raise CameraError(
            f"librealsense cannot list its devices ({error}): replug them, close other programs"
        ) from error


def _info(device: Any, sdk: Any) -> DeviceInfo:
    keys = ("name", "serial_number", "firmware_version", "usb_type_descriptor")
    return DeviceInfo(*(_told(device, getattr(sdk.camera_info, key)) for key in keys))


def _told(device: Any, key: Any) -> str:
    return device.get_info(key) if device.supports(key) else ""


def list_devices() -> list[DeviceInfo]:
    """Every device that the SDK sees now."""
    sdk = load_sdk()
    return [info for _, info in connected(sdk, sdk.context())]


class L515Camera(LiveCamera):
    """An L515 by serial number, or the only one; 640 x 480 at 30 frames/s, 320 x 240 on USB 2.

    Its options are set for a near wall once it runs, and read back into `Frame.settings`; a recording begins with the
    half second that this takes. Raises CameraNotFoundError.
    """

    def __init__(
        self,
        uri: str,
        serial: str,
        *,
        recording: Recording | None = None,
        sdk: Any = None,
        clock: Clock | None = None,
    ) -> None:
        sdk = sdk or load_sdk()
        self._context = sdk.context()  # one for discovery and streaming: two of them fight over the device
        device, info = _find(sdk, self._context, serial)
        size = USB2_SIZE if info.usb_type.startswith("2") else USB3_SIZE
        if size == USB2_SIZE:
            log.warning("%s is on USB %s: only 320 x 240; turn the plug round or use a USB 3 cable", uri, info.usb_type)
        self._serial = info.serial
        super().__init__(uri, device, size, sdk, recording, clock)
        self.identity: Mapping[str, str] = {key: value for key, value in asdict(info).items() if value}

    def _prepare(self, sensor: Any) -> None:
        """Preset first, since it changes the others; after start, since starting resets it."""
        self._set(sensor, {"global_time_enabled": 1.0, "visual_preset": SHORT_RANGE})
        self._clock.wait(self._left, PRESET_SETTLES_S)
        self._set(sensor, NEAR_WALL)
        for name, wanted in NEAR_WALL.items():
            self._check(sensor, name, wanted)

    def _set(self, sensor: Any, values: dict[str, float]) -> None:
        for name, value in values.items():
            option = getattr(self._sdk.option, name)
            try:
                sensor.set_option(option, value)
            except RuntimeError as error:
                log.warning("%s does not take %s = %g: %s", self.uri, name, value, error)

    def _check(self, sensor: Any, name: str, wanted: float) -> None:
        option = getattr(self._sdk.option, name)
        found = sensor.get_option(option) if sensor.supports(option) else None
        if found != wanted:
            log.warning("%s reads back %s = %s where %g was set", self.uri, name, found, wanted)

    def _is_connected(self) -> bool:
        return self._reconnect() is not None

    def _reconnect(self) -> Any | None:
        there = connected(self._sdk, self._context)
        return next((device for device, info in there if info.serial == self._serial), None)

    def _reset(self) -> None:
        self._device.hardware_reset()

    def _begin(self, inbox: Inbox) -> None:
        """It runs already."""

    def _end(self) -> None:
        """It needs nothing."""

    def _truth_depth_m(self, number: int) -> Float32 | None:  # noqa: ARG002  a real device does not know
        return None


def _find(sdk: Any, context: Any, serial: str) -> tuple[Any, DeviceInfo]:
    """The one L515 that is meant. Raises CameraNotFoundError with what to check."""
    there = connected(sdk, context)
    lidars = [(device, info) for device, info in there if "L515" in info.name]
    chosen = [(device, info) for device, info in lidars if serial in {"", info.serial}]
    if len(chosen) == 1:
        return chosen[0]
    if chosen:
        names = ", ".join(f"l515:{info.serial}" for _, info in chosen)
        raise CameraNotFoundError(f"{len(chosen)} L515s are connected: say which ({names})")
    seen = ", ".join(f"{info.name} {info.serial}".strip() for _, info in there) or "no device"
    wanted = f"L515 with serial {serial}" if serial else "L515"
    raise CameraNotFoundError(
        f"no {wanted} found (librealsense sees {seen}): check the USB 3 cable and port, close other programs that use "
        "it, and on Linux install librealsense's udev rules; without a camera, use --camera sim"
    )
