"""A look through the colour camera beside the lidar: the mean grey image, its lens, and where it is seen from.

Done by itself, before the lidar runs: a board is looked for on a wall that stands still, so nothing is to be paired,
and the link has room for the depth. No real L515 was seen: what is held here against librealsense is a software
device with its streams, and a D435's recording.
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

from nlos_cam.camera import (
    FRAMES_PER_S,
    NAMES,
    find_l515,
    find_streams,
    intrinsics_of,
    load_sdk,
    sample_from_sdk,
    shared_context,
    stream_name,
)
from nlos_cam.errors import (
    CameraError,
    CameraLostError,
    CameraNotFoundError,
    NlosCamError,
    RecordingError,
    StreamMissingError,
)
from nlos_cam.recording import BagFile

COLOUR, FORMAT = "color", "rgb8"
"""The SDK's names of the stream, and of the format that a live camera is asked for."""
WIDEST = 1280
"""A wider image shows the corners no better: they are found between pixels."""
SETTLES = 30
"""Frames until the automatic exposure has settled."""
SILENCE_S = 5.0
WAITING = 8
GREY: Mapping[str, Callable[[NDArray[Any]], Any]] = {
    "rgb8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY),
    "bgr8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY),
    "rgba8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_RGBA2GRAY),
    "bgra8": lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_BGRA2GRAY),
    "yuyv": lambda pixels: (pixels & 0xFF).astype(np.uint8),
    "uyvy": lambda pixels: (pixels >> 8).astype(np.uint8),
}
"""What makes grey (height, width), in 8 bits, of the pixels of a format."""


@dataclass(frozen=True)
class _Look:
    """How a live camera is looked through."""

    frames: int
    on_frame: Callable[[], None]
    silence_s: float


def look_in_colour(
    uri: str,
    frames: int,
    *,
    on_frame: Callable[[], None] = lambda: None,
    sdk: Any = None,
    silence_s: float = SILENCE_S,
) -> BoardView:
    """What the colour camera of a recording or a live L515 sees, over at most `frames` frames.

    Of a recording those are the last, when the exposure has settled; of a live camera those after SETTLES others, and
    it is free again afterwards. Raises StreamMissingError and RecordingError for a recording, CameraNotFoundError,
    CameraLostError and CameraError for a live one or one without colour, NlosCamError for a lens of another model.
    """
    scheme, _, rest = uri.partition(":")
    if scheme == "bag" and rest:
        return _recorded(Path(rest), frames, on_frame)
    if scheme == "l515":
        return _live(uri, rest, sdk or load_sdk(), _Look(frames, on_frame, silence_s))
    if scheme == "sim":
        raise CameraError(f"{uri}: the simulated lidar has no colour camera: look in infrared")
    raise CameraNotFoundError(f"no camera is called {uri!r}: use {NAMES}")


def _recorded(path: Path, frames: int, on_frame: Callable[[], None]) -> BoardView:
    bag = BagFile(path)
    if missing := [stream for stream in ("depth", COLOUR) if stream not in bag.streams]:
        raise StreamMissingError(
            f"{path} has no {' and no '.join(missing)} stream (it has {', '.join(sorted(bag.streams))}): record colour "
            "beside depth, e.g. with realsense-viewer, or look in infrared"
        )
    info = bag.streams[COLOUR]
    lens, pose = _lens(f"{path}", *bag.lens(COLOUR)), bag.pose("depth", COLOUR)
    mean = Moments(shape := (info.intrinsics.height, info.intrinsics.width))
    for index in range(max(info.frames - frames, 0), info.frames):
        pixels = bag.sample(COLOUR, index).pixels
        if info.format not in GREY or pixels.shape[:2] != shape:
            size = f"{pixels.shape[1]} x {pixels.shape[0]} {info.format}"
            raise RecordingError(f"{path} has colour images of {size}, which we cannot use: look in infrared")
        mean.add(GREY[info.format](pixels))
        on_frame()
    return BoardView(mean.mean(), info.intrinsics, lens, pose, "colour", CameraErrors())


def _live(uri: str, serial: str, sdk: Any, look: _Look) -> BoardView:
    device, _ = find_l515(sdk, shared_context(sdk), serial)
    try:
        sensor, profile = _colour_of(device)
        depth = find_streams(device)[1].get("depth")
        if profile is None or depth is None:
            raise CameraError(f"{uri} offers no colour beside its depth, at {FRAMES_PER_S} frames/s: look in infrared")
        model = profile.as_video_stream_profile().get_intrinsics()
        lens = _lens(uri, model.model.name, np.array(model.coeffs))
        pose = _pose(profile.get_extrinsics_to(depth))
        image = _mean_of(uri, sensor, profile, look)
    except RuntimeError as error:
        raise CameraError(
            f"{uri} cannot be looked through in colour ({error}): close what else uses it, or replug it"
        ) from error
    return BoardView(image, intrinsics_of(profile), lens, pose, "colour", CameraErrors())


def _colour_of(device: Any) -> tuple[Any, Any]:
    """The colour sensor and its widest profile, up to WIDEST; None where there is none."""
    best: tuple[int, Any, Any] = (0, None, None)
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            named = stream_name(profile), profile.format().name, profile.fps()
            width = profile.as_video_stream_profile().width() if named == (COLOUR, FORMAT, FRAMES_PER_S) else 0
            if best[0] < width <= WIDEST:
                best = width, sensor, profile
    return best[1:]


def _lens(where: str, model: str, coefficients: Float64) -> Float64:
    """The coefficients as OpenCV has them, of a lens that we can undo. Raises NlosCamError for another."""
    if not coefficients.any():
        return np.zeros(5)
    if model != "brown_conrady" or coefficients.shape != (5,) or not np.isfinite(coefficients).all():
        raise NlosCamError(
            f"{where}: the colour camera's lens is told as {model} {coefficients.tolist()}, which we cannot undo: "
            "look in infrared"
        )
    return coefficients.astype(np.float64)


def _pose(extrinsics: Any) -> Float64:
    """(4, 4) from the SDK's, whose rotation is in columns."""
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(extrinsics.rotation, (3, 3)).T
    pose[:3, 3] = extrinsics.translation
    return pose


def _mean_of(uri: str, sensor: Any, profile: Any, look: _Look) -> Float64:
    """The mean grey image of a sensor, which runs only meanwhile."""
    size = intrinsics_of(profile)
    mean, waiting = Moments((size.height, size.width)), Queue[NDArray[Any]](maxsize=WAITING)

    def keep(frame: Any) -> None:
        with suppress(Full):  # the SDK must not wait, and of a scene that stands still another frame will do
            waiting.put_nowait(sample_from_sdk(frame).pixels)

    sensor.open([profile])
    try:
        sensor.start(keep)
        for index in range(SETTLES + look.frames):
            pixels = waiting.get(timeout=look.silence_s)
            if index >= SETTLES:
                mean.add(GREY[FORMAT](pixels))
                look.on_frame()
    except Empty:
        raise CameraLostError(
            f"{uri} gave no colour frame for {look.silence_s:g} s: replug it, close other programs"
        ) from None
    finally:
        for end in (sensor.stop, sensor.close):
            with suppress(RuntimeError):  # a device that vanished, or never started, is stopped already
                end()
    return mean.mean()
