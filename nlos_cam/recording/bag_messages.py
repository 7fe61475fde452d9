"""Messages that librealsense writes into a .bag, as values: images, intrinsics, poses, metadata."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from nlos_calibration import Intrinsics
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


class Encoding(NamedTuple):
    """Layout of the pixels of an image."""

    sdk_format: str
    dtype: str
    channels: int
    """Values per pixel."""


ENCODINGS = {
    "mono16": Encoding("z16", "<u2", 1),
    "16UC1": Encoding("y16", "<u2", 1),
    "8UC1": Encoding("y8", "u1", 1),
    "mono8": Encoding("raw8", "u1", 1),
    "rgb8": Encoding("rgb8", "u1", 3),
    "bgr8": Encoding("bgr8", "u1", 3),
    "rgba8": Encoding("rgba8", "u1", 4),
    "bgra8": Encoding("bgra8", "u1", 4),
    "yuv422": Encoding("uyvy", "<u2", 1),
    "YUYV": Encoding("yuyv", "<u2", 1),
}
"""By the name in the file."""
STREAM_INFO = "uint32 fps\nstring encoding\nbool is_recommended\n"
"""The one definition that ROS does not have. Never taken from the file: rosbags compiles
definitions to Python.
"""
INFO = "realsense_msgs/msg/StreamInfo"
CAMERA = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
NUMBER = "std_msgs/msg/Float32"
MOTION = "sensor_msgs/msg/Imu"
PAIR = "diagnostic_msgs/msg/KeyValue"
TRANSFORM = "geometry_msgs/msg/Transform"
MAX_PIXELS = 1 << 23
MAX_TEXT = 200
"""Bounds on an image, four times the largest of a RealSense camera, and on the characters of a
value.
"""
TAIL_BYTES = 4
"""Depth unit that librealsense since 2.49 writes after an image, against the definition."""
TEXT_AT = 12
"""Offset of an image's first text: behind number, seconds and nanoseconds."""
UNIT_TOLERANCE = 1e-3
HARDWARE_CLOCK = "hardware_clock"
"""Domain of timestamps by the device's own counter, which wraps."""


@cache
def _types() -> Typestore:
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(STREAM_INFO, INFO))
    return types


def is_known(message_type: str) -> bool:
    """Return whether `parse` accepts messages of this type; librealsense defines a few that it does
    not.
    """
    return message_type in _types().fielddefs


def parse(raw: memoryview, message_type: str, expected: str = "") -> Any:
    """Return a message as rosbags deserialises it. Damaged bytes can raise almost any exception.

    Raises ValueError where it is of another type than `expected`.
    """
    if expected and message_type != expected:
        raise ValueError(f"a message of type {message_type} in place of {expected}")
    if message_type == IMAGE and _has_tail(raw):
        raw = raw[:-TAIL_BYTES]
    return _types().deserialize_ros1(raw, message_type)


def _has_tail(raw: memoryview) -> bool:
    """Return whether an image is longer than its definition, by the lengths in it.

    Its frame_id marks such images too, but other tools copy the mark and not the tail.
    """
    # frame_id, height and width, encoding, is_bigendian, step, data: each text and the data behind
    # their length.
    at = _after_text(raw, TEXT_AT)
    at = _after_text(raw, at + 8)
    at = _after_text(raw, at + 5)
    return at + TAIL_BYTES == len(raw)


def _after_text(raw: memoryview, at: int) -> int:
    return at + 4 + int.from_bytes(raw[at : at + 4], "little")


def depth_unit_m(raw: memoryview) -> float | None:
    """Return the depth unit in metres that follows an image; None where none does."""
    return float(np.frombuffer(raw[-TAIL_BYTES:], "<f4")[0]) if _has_tail(raw) else None


def sdk_name(name: str) -> str:
    """Return a name as the SDK's Python package spells it: "Depth Units" is depth_units."""
    return name.lower().replace(" ", "_").replace("-", "_")


def timestamp_s(image: Any) -> float:
    """Return a frame's time on the device's clock, with librealsense's rounding."""
    stamp = image.header.stamp
    return (stamp.sec + 1e-9 * stamp.nanosec) * 1e3 / 1e3


def stamp(raw: memoryview) -> tuple[int, float]:
    """Return an image's number, and its time in s on the device's clock, from its first bytes."""
    number, seconds, nanoseconds = struct.unpack_from("<III", raw)
    return number, seconds + 1e-9 * nanoseconds


def pixels(image: Any, encoding: str, intrinsics: Intrinsics) -> NDArray[Any]:
    """Return an image's values, (height, width) or (height, width, channels).

    A device may deliver another size than its profile declares; such rows have no padding. Raises
    ValueError for an image whose size, step and encoding contradict each other.
    """
    _, dtype, channels = ENCODINGS[encoding]
    row_bytes = image.width * channels * np.dtype(dtype).itemsize
    is_declared = (image.width, image.height) == (intrinsics.width, intrinsics.height)
    if image.encoding != encoding or not (is_declared or image.step == row_bytes):
        raise ValueError(f"an image of {image.width} x {image.height} {image.encoding}")
    if image.data.nbytes != image.height * image.step or image.width * image.height == 0:
        raise ValueError(
            f"an image of {image.width} x {image.height} with {image.data.nbytes} bytes"
        )
    rows = image.data.reshape(image.height, image.step)
    values = np.array(rows[:, :row_bytes]).view(dtype)
    return values.reshape(image.height, image.width, *([channels] if channels > 1 else []))


def intrinsics_of(info: Any) -> Intrinsics:
    """Return the pinhole parameters of a CameraInfo, whose K is the matrix (3, 3) by rows.

    Raises ValueError where they are not finite, or the size is none of a camera.
    """
    numbers = [float(info.K[i]) for i in (0, 4, 2, 5)]
    if not 0 < info.width * info.height <= MAX_PIXELS or not all(map(isfinite, numbers)):
        raise ValueError(
            f"a camera of {info.width} x {info.height} pixels with the pinhole {numbers}"
        )
    return Intrinsics(info.width, info.height, *numbers)


def lens_of(info: Any) -> tuple[str, Float64]:
    """Return the distortion model of a CameraInfo by the SDK's name, and its coefficients."""
    return sdk_name(info.distortion_model), np.asarray(info.D, np.float64)


def pose_of(transform: Any) -> Float64:
    """Return a Transform as a matrix (4, 4). Raises ValueError for a quaternion that is not of unit
    length.
    """
    turn = transform.rotation
    shift = transform.translation
    x, y, z, w = quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) < UNIT_TOLERANCE:
        raise ValueError(f"a rotation by the quaternion {quaternion.tolist()}")
    # Rodrigues' formula with half angles: R = I + 2 w [v]x + 2 [v]x^2, where [v]x u = v x u and v =
    # (x, y, z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    pose = np.eye(4)
    pose[:3, :3] += 2.0 * w * cross + 2.0 * cross @ cross
    pose[:3, 3] = shift.x, shift.y, shift.z
    return pose


def acceleration_of(motion: Any) -> tuple[float, float, float]:
    """Return the acceleration of a motion sample in m/s^2."""
    found = motion.linear_acceleration
    return float(found.x), float(found.y), float(found.z)


@dataclass(frozen=True)
class FrameMetadata:
    """Metadata that the device sent with a frame."""

    domain: str
    """Clock of the timestamp: hardware_clock, system_time or global_time; empty where not
    recorded.
    """
    values: dict[str, float]
    """By the SDK's name: frame_counter, frame_laser_power, ...; and system_time."""


def metadata(pairs: list[Any]) -> FrameMetadata:
    """Return a frame's metadata from its KeyValue messages."""
    values = texts_of(pairs)
    domain = sdk_name(values.pop("timestamp_domain", ""))
    return FrameMetadata(domain, finite({name: float(value) for name, value in values.items()}))


def texts_of(pairs: list[Any]) -> dict[str, str]:
    """Return the values of KeyValue messages by the SDK's name, printable and of bounded length."""
    return {sdk_name(_printable(pair.key)): _printable(pair.value) for pair in pairs}


def _printable(text: str) -> str:
    return "".join(filter(str.isprintable, text[:MAX_TEXT]))


def finite(values: Mapping[str, float]) -> dict[str, float]:
    """Return the finite values: JSON has no others."""
    return {name: value for name, value in values.items() if isfinite(value)}
