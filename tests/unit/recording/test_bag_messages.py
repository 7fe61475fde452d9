import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.camera.sdk import load_sdk
from nlos_cam.recording.bag_messages import ENCODINGS, lens_of, metadata, parse, pixels, pose_of, sdk_name

IMAGE = "sensor_msgs/msg/Image"


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def raw_image(version: str, tail: bytes, values: bytes = bytes(range(6))) -> memoryview:
    """An image of 3 x 2 as librealsense writes it: the version of the format stands where ROS has the frame_id."""
    header = struct.pack("<III", 7, 12, 345_678_901) + text(version)
    size = struct.pack("<II", 2, 3) + text("mono8") + b"\0" + struct.pack("<I", 3)
    return memoryview(header + size + struct.pack("<I", len(values)) + values + tail)


def pinhole(width: int = 3, height: int = 2) -> Intrinsics:
    return Intrinsics(width, height, 1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    "changed", [{"width": 2}, {"width": 4}, {"height": 3}, {"width": 6, "step": 6}, {"encoding": "8UC1"}, {"step": 4}]
)
def test_pixels_refuses_an_image_that_contradicts_itself(changed: dict[str, object]) -> None:
    image = parse(raw_image("0", b""), IMAGE)
    vars(image).update(changed)
    with pytest.raises(ValueError, match=r"image|reshape"):
        pixels(image, "mono8", pinhole())


def test_pixels_skips_padding_of_rows() -> None:
    image = parse(raw_image("0", b"", bytes(range(10))), IMAGE)
    image.step = 5
    np.testing.assert_array_equal(pixels(image, "mono8", pinhole()), [[0, 1, 2], [5, 6, 7]])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_are_formats_of_the_sdk(encoding: str) -> None:
    found = ENCODINGS[encoding]
    assert found.sdk_format in load_sdk().format.__members__
    bytes_per_pixel = found.channels * np.dtype(found.dtype).itemsize
    values = np.arange(6 * bytes_per_pixel, dtype=np.uint8)
    image = SimpleNamespace(encoding=encoding, width=3, height=2, step=3 * bytes_per_pixel, data=values)
    result = pixels(image, encoding, pinhole())
    assert result.shape == ((2, 3) if found.channels == 1 else (2, 3, found.channels))
    assert result.tobytes() == values.tobytes()


def test_sdk_name_gives_names_of_the_sdk() -> None:
    for recorded, enumeration in (
        ("Depth Units", "option"),
        ("Min_Distance", "option"),
        ("Hardware Clock", "timestamp_domain"),
        ("Frame Laser Power", "frame_metadata_value"),
        ("Brown Conrady", "distortion"),
    ):
        assert sdk_name(recorded) in getattr(load_sdk(), enumeration).__members__
    assert sdk_name("Auto-Exposure Mode") == "auto_exposure_mode"


def test_metadata_and_lens_are_parsed() -> None:
    pairs = {"system_time": "15.25", "timestamp_domain": "System Time", "Frame Counter": "169"}
    found = metadata([SimpleNamespace(key=key, value=value) for key, value in pairs.items()])
    assert (found.domain, found.values) == ("system_time", {"system_time": 15.25, "frame_counter": 169.0})
    assert not metadata([]).domain
    model, coefficients = lens_of(SimpleNamespace(distortion_model="Brown Conrady", D=[0.1, 0.2, 0.3, 0.4, 0.5]))
    assert (model, list(coefficients)) == ("brown_conrady", [0.1, 0.2, 0.3, 0.4, 0.5])


def transform(x: float, y: float, z: float, w: float) -> SimpleNamespace:
    shift = SimpleNamespace(x=0.1, y=0.2, z=-0.3)
    return SimpleNamespace(rotation=SimpleNamespace(x=x, y=y, z=z, w=w), translation=shift)


def test_pose_of_accepts_either_sign_of_a_quaternion() -> None:
    axis, angle = np.array([0.6, 0.0, -0.8]), 0.7
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = cv2.Rodrigues(axis * angle)[0], [0.1, 0.2, -0.3]
    quaternion = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(pose_of(transform(*(sign * quaternion))), expected, atol=1e-12)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), (float("nan"), 0.0, 0.0, 1.0)])
def test_pose_of_refuses_a_quaternion_not_of_unit_length(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        pose_of(transform(*quaternion))
