"""Color view of the board: mean gray image of the color camera beside the lidar, its lens and its
pose.

It is captured before the lidar runs: the wall stands still, so no frames are paired, and later the
link has room for the depth. Not tried on a physical L515: checked against a software device and a
D435's recording.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any

import cv2
import numpy as np
from nlos_calibration import BoardView, CameraErrors, Moments
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam import camera as cameras
from nlos_cam import errors
from nlos_cam.recording import BagReader

COLOR_STREAM = "color"
COLOR_FORMAT = "rgb8"
"""The SDK's name of the stream, and the format requested from a live camera."""
WANTED = COLOR_STREAM, COLOR_FORMAT, cameras.FRAMES_PER_S
MAX_WIDTH_PX = 1280
"""A wider image does not improve the corners, which are found with subpixel accuracy."""
SETTLING_FRAMES = 30
"""Frames until the automatic exposure has settled."""
SILENCE_S = 5.0
QUEUE_FRAMES = 8
TO_GRAY: Mapping[str, Callable[[NDArray[Any]], Any]] = {
    "rgb8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY),
    "bgr8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY),
    "rgba8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGBA2GRAY),
    "bgra8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGRA2GRAY),
    "yuyv": lambda pixels: (pixels & 0xFF).astype(np.uint8),
    "uyvy": lambda pixels: (pixels >> 8).astype(np.uint8),
}
"""Conversion of each pixel format to gray (height, width), 8 bits."""


@dataclass(frozen=True)
class _LiveOptions:
    frames: int
    on_frame: Callable[[], None]
    silence_s: float


def capture_color_view(
    uri: str,
    frames: int,
    *,
    on_frame: Callable[[], None] = lambda: None,
    sdk: Any = None,
    silence_s: float = SILENCE_S,
) -> BoardView:
    """Return the mean gray view over at most `frames` frames of the color camera of a recording or
    a live L515.

    A recording's last frames are used, when the exposure has settled; a live camera's frames after
    SETTLING_FRAMES, and the camera is released. Raises StreamMissingError and RecordingError for a
    recording, CameraNotFoundError, CameraLostError and CameraError for a live camera or one without
    color, NlosCamError for another lens model.
    """
    scheme, _, rest = uri.partition(":")
    if scheme == "bag" and rest:
        return _recorded(Path(rest), frames, on_frame)
    if scheme == "l515":
        return _live(
            uri, rest, sdk or cameras.load_sdk(), _LiveOptions(frames, on_frame, silence_s)
        )
    if scheme == "sim":
        raise errors.CameraError(
            f"{uri}: the simulated lidar has no colour camera: use --board-in infrared"
        )
    raise errors.CameraNotFoundError(f"no camera is called {uri!r}: use {cameras.NAMES}")


def _recorded(path: Path, frames: int, on_frame: Callable[[], None]) -> BoardView:
    bag = BagReader(path)
    if missing := [stream for stream in ("depth", COLOR_STREAM) if stream not in bag.streams]:
        raise errors.StreamMissingError(
            f"{path} has no {' and no '.join(missing)} stream (it has"
            f" {', '.join(sorted(bag.streams))}): record colour beside depth, e.g. with"
            " realsense-viewer, or use --board-in infrared"
        )
    info = bag.streams[COLOR_STREAM]
    lens = _lens(f"{path}", *bag.lens(COLOR_STREAM))
    pose = bag.pose("depth", COLOR_STREAM)
    mean = Moments(shape := (info.intrinsics.height, info.intrinsics.width))
    for index in range(max(info.frames - frames, 0), info.frames):
        pixels = bag.sample(COLOR_STREAM, index).pixels
        if info.format not in TO_GRAY or pixels.shape[:2] != shape:
            size = f"{pixels.shape[1]} x {pixels.shape[0]} {info.format}"
            raise errors.RecordingError(
                f"{path} has unsupported colour images ({size}): use --board-in infrared"
            )
        mean.add(TO_GRAY[info.format](pixels))
        on_frame()
    return BoardView(mean.mean(), info.intrinsics, lens, pose, "colour", CameraErrors())


def _live(uri: str, serial: str, sdk: Any, options: _LiveOptions) -> BoardView:
    device, _ = cameras.find_l515(sdk, cameras.shared_context(sdk), serial)
    try:
        sensor, profile = _color_profile(device)
        depth = cameras.find_streams(device)[1].get("depth")
        if profile is None or depth is None:
            raise errors.CameraError(
                f"{uri} offers no colour beside its depth at {cameras.FRAMES_PER_S} frames/s: use"
                " --board-in infrared"
            )
        model = profile.as_video_stream_profile().get_intrinsics()
        lens = _lens(uri, model.model.name, np.array(model.coeffs))
        pose = _pose(profile.get_extrinsics_to(depth))
        image = _mean_of(uri, sensor, profile, options)
    except RuntimeError as error:
        raise errors.CameraError(
            f"cannot open the colour camera of {uri} ({error}): close other programs that use it,"
            " or replug it"
        ) from error
    return BoardView(image, cameras.intrinsics_of(profile), lens, pose, "colour", CameraErrors())


def _color_profile(device: Any) -> tuple[Any, Any]:
    """Return the color sensor and its widest profile, up to MAX_WIDTH_PX; None, None without
    one.
    """
    best: tuple[int, Any, Any] = (0, None, None)
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if (cameras.stream_name(profile), profile.format().name, profile.fps()) != WANTED:
                continue
            width = profile.as_video_stream_profile().width()
            if best[0] < width <= MAX_WIDTH_PX:
                best = width, sensor, profile
    return best[1:]


def _lens(where: str, model: str, coefficients: Float64) -> Float64:
    """Return the lens coefficients in OpenCV's order. Raises NlosCamError for an unsupported
    model.
    """
    if not coefficients.any():
        return np.zeros(5)
    if (
        model != "brown_conrady"
        or coefficients.shape != (5,)
        or not np.isfinite(coefficients).all()
    ):
        raise errors.NlosCamError(
            f"{where}: unsupported distortion model for the colour stream: {model}"
            f" {coefficients.tolist()}; use --board-in infrared"
        )
    return coefficients.astype(np.float64)


def _pose(extrinsics: Any) -> Float64:
    """Return the pose (4, 4) from the SDK's extrinsics, whose rotation is stored by columns."""
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(extrinsics.rotation, (3, 3)).T
    pose[:3, 3] = extrinsics.translation
    return pose


def _mean_of(uri: str, sensor: Any, profile: Any, options: _LiveOptions) -> Float64:
    """Return the mean gray image (height, width) of a sensor; it streams only during the call."""
    size = cameras.intrinsics_of(profile)
    mean = Moments((size.height, size.width))
    queue = Queue[NDArray[Any]](maxsize=QUEUE_FRAMES)

    def keep(frame: Any) -> None:
        with suppress(
            Full
        ):  # never block the SDK: the scene stands still, so a later frame is as good
            queue.put_nowait(cameras.sample_from_sdk(frame).pixels)

    sensor.open([profile])
    try:
        sensor.start(keep)
        for index in range(SETTLING_FRAMES + options.frames):
            pixels = queue.get(timeout=options.silence_s)
            if index >= SETTLING_FRAMES:
                mean.add(TO_GRAY[COLOR_FORMAT](pixels))
                options.on_frame()
    except Empty:
        raise errors.CameraLostError(
            f"{uri} gave no colour frame for {options.silence_s:g} s: replug it, close other"
            " programs"
        ) from None
    finally:
        for end in (sensor.stop, sensor.close):
            with suppress(RuntimeError):  # unplugged, or never started
                end()
    return mean.mean()
