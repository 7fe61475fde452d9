"""What librealsense writes into a .bag: its names, and its messages as values."""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from nlos_calibration.projection import Intrinsics
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


class Encoding(NamedTuple):
    """How the values of an image are packed."""

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
"""Written out here: rosbags makes Python of a definition, and a damaged file's should not become that."""
HAS_TAIL = b"\x01\x00\x00\x001"
"""The frame_id of an image that has its depth unit after it, against its definition; since librealsense 2.49."""
TAIL_BYTES, FRAME_ID_AT = 4, 12
UNIT_TOLERANCE = 1e-3


@cache
def _types() -> Typestore:
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(STREAM_INFO, "realsense_msgs/msg/StreamInfo"))
    return types


def is_known(message_type: str) -> bool:
    """Whether `parse` takes messages of this type; librealsense has some more of its own."""
    return message_type in _types().fielddefs


def parse(raw: memoryview, message_type: str) -> Any:
    """A message as rosbags has it. Raises nearly anything for bytes that are none."""
    if message_type == "sensor_msgs/msg/Image" and _has_tail(raw):
        raw = raw[:-TAIL_BYTES]
    return _types().deserialize_ros1(raw, message_type)


def _has_tail(raw: memoryview) -> bool:
    return bytes(raw[FRAME_ID_AT : FRAME_ID_AT + len(HAS_TAIL)]) == HAS_TAIL


def depth_unit_m(raw: memoryview) -> float | None:
    """The unit in the tail of an image; None where it has none."""
    return float(np.frombuffer(raw[-TAIL_BYTES:], "<f4")[0]) if _has_tail(raw) else None


def sdk_name(name: str) -> str:
    """The name that the SDK's Python wheel gives to what librealsense calls so: "Depth Units" is depth_units."""
    return name.lower().replace(" ", "_").replace("-", "_")


def timestamp_s(image: Any) -> float:
    """The frame's time on the device's clock, rounded as librealsense rounds it."""
    stamp = image.header.stamp
    return (stamp.sec + 1e-9 * stamp.nanosec) * 1e3 / 1e3


def pixels(image: Any, encoding: str, intrinsics: Intrinsics) -> NDArray[Any]:
    """An image's values, (height, width) or (height, width, values per pixel).

    A device may deliver another size than it tells; its rows then follow without a gap. Raises ValueError for an image
    that contradicts itself.
    """
    _, dtype, channels = ENCODINGS[encoding]
    is_usual = (image.width, image.height) == (intrinsics.width, intrinsics.height)
    is_whole = image.step == image.width * channels * np.dtype(dtype).itemsize
    if image.encoding != encoding or not (is_usual or is_whole):
        raise ValueError(f"an image of {image.width} x {image.height} {image.encoding}")
    rows = image.data.reshape(image.height, image.step)
    values = np.array(rows[:, : image.width * channels * np.dtype(dtype).itemsize]).view(dtype)
    return values.reshape(image.height, image.width, *([channels] if channels > 1 else []))


def intrinsics_of(info: Any) -> Intrinsics:
    """The pinhole of a CameraInfo."""
    return Intrinsics(info.width, info.height, *(float(info.K[i]) for i in (0, 4, 2, 5)))


def lens_of(info: Any) -> tuple[str, NDArray[np.float64]]:
    """The distortion of a CameraInfo: its model by the SDK's name, and its coefficients."""
    return sdk_name(info.distortion_model), np.asarray(info.D, np.float64)


def pose_of(transform: Any) -> NDArray[np.float64]:
    """A Transform as a matrix (4, 4). Raises ValueError where its quaternion turns nothing."""
    turn, shift = transform.rotation, transform.translation
    x, y, z, w = quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) < UNIT_TOLERANCE:
        raise ValueError(f"a rotation by the quaternion {quaternion.tolist()}")
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    pose = np.eye(4)
    pose[:3, :3] += 2.0 * w * across + 2.0 * across @ across
    pose[:3, 3] = shift.x, shift.y, shift.z
    return pose


@dataclass(frozen=True)
class FrameMetadata:
    """What is told of a frame besides its image."""

    domain: str
    """Whose clock its timestamp is of: hardware_clock, system_time or global_time; empty where that is not told."""
    values: dict[str, float]
    """By the SDK's name: frame_counter, frame_laser_power, ...; and system_time."""


def metadata(pairs: list[Any]) -> FrameMetadata:
    """The metadata of a frame from its KeyValue messages."""
    found = {sdk_name(pair.key): pair.value for pair in pairs}
    domain = sdk_name(found.pop("timestamp_domain", ""))
    return FrameMetadata(domain, {name: float(value) for name, value in found.items()})
