import re
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from rosbags.rosbag1 import Reader

from nlos_cam.camera.sdk import load_sdk
from nlos_cam.errors import RecordingError
from nlos_cam.recording.bag_container import (
    ENCODINGS,
    BagContainer,
    depth_unit_m,
    lens_of,
    metadata,
    parse,
    pixels,
    pose_of,
    sdk_name,
    timestamp_s,
)


def contents(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Read every message by topic with our reader."""
    bag = BagContainer(path)
    return {
        topic: [(entry.time_ns, bytes(bag.raw(entry))) for entry in entries] for topic, entries in bag.entries.items()
    }


def expected(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(path) as reader:
        for connection, time_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time_ns, bytes(raw)))
    return found


def changed(source: Path, target: Path, edit: Callable[[bytes], bytes]) -> Path:
    target.write_bytes(edit(source.read_bytes()))
    return target


def version_of(bag: BagContainer) -> Any:
    return bag.read("/file_version", bag.entries["/file_version"][0])


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed", "real_bag"])
def test_container_reads_the_messages_that_rosbags_reads(kind: str, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(kind)
    assert contents(path) == (found := expected(path))
    assert BagContainer(path).end_ns == max(times[-1][0] for times in found.values())


@pytest.mark.parametrize("compression", ["LZ4", "BZ2"])
def test_container_reads_each_compression(noise_bag: Path, rewritten: Any, compression: str) -> None:
    path = rewritten(lambda _, time_ns, raw: [(time_ns, raw)], compression=compression)
    assert contents(path) == contents(noise_bag)


def test_container_unpacks_no_more_than_its_bound(noise_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.recording.bag_container.MAX_BYTES", 10_000)
    bag = BagContainer(noise_bag)
    with pytest.raises(RecordingError, match="chunk"):
        version_of(bag)


def test_container_reports_place_of_damage_and_repair(noise_bag: Path, tmp_path: Path) -> None:
    where = noise_bag.read_bytes().index(b"compression=lz4") + 1000
    path = changed(noise_bag, tmp_path / "damaged.bag", lambda old: old[:where] + bytes(100) + old[where + 100 :])
    bag = BagContainer(path)
    position = bag.entries["/file_version"][0].chunk_pos
    with pytest.raises(RecordingError, match=rf"0\.0 s .* byte {position}") as raised:
        version_of(bag)
    assert f"`nlos-cam repair {path} --out damaged-repaired.bag`" in str(raised.value)


def test_everything_yields_all_messages_in_file_order(noise_bag: Path) -> None:
    bag = BagContainer(noise_bag)
    found = list(bag.everything())
    listed = [(entry, topic) for topic, entries in bag.entries.items() for entry in entries]
    assert sorted((entry, topic) for topic, entry, _ in found) == sorted(listed)
    places = [(entry.chunk_pos, entry.offset) for _, entry, _ in found]
    assert places == sorted(places)
    assert next(message for topic, _, message in found if topic == "/file_version").data == 4


def test_everything_yields_unknown_types_as_none(noise_bag_uncompressed: Path, tmp_path: Path) -> None:
    old, new = b"geometry_msgs/Transform", b"realsense_msgs/Transfor"
    path = changed(noise_bag_uncompressed, tmp_path / "other.bag", lambda content: content.replace(old, new))
    found = {topic: message for topic, _, message in BagContainer(path).everything()}
    assert [topic for topic, message in found.items() if message is None] == [t for t in found if "/tf/" in t]


def test_container_refuses_a_wrong_or_empty_index(noise_bag: Path, tmp_path: Path) -> None:
    bag = BagContainer(noise_bag)
    one, other = (bag.entries[f"/device_0/sensor_0/{name}_0/image/data"][0] for name in ("Depth", "Infrared"))
    with pytest.raises(RecordingError, match="index"):
        bag.read("/file_version", one._replace(offset=other.offset))
    none = re.compile(rb"(?s)(chunk_count=).{4}")
    path = changed(noise_bag, tmp_path / "nothing.bag", lambda old: none.sub(rb"\1" + bytes(4), old, count=1))
    with pytest.raises(RecordingError, match=r"nothing\.bag"):
        BagContainer(path)


def test_container_keeps_no_file_open_and_reports_its_loss(noise_bag: Path, tmp_path: Path) -> None:
    path = changed(noise_bag, tmp_path / "gone.bag", bytes)
    bag = BagContainer(path)
    version_of(BagContainer(path))
    if (open_files := Path("/proc/self/fd")).is_dir():  # only Linux lists the open files of a process
        assert path not in {each.readlink() for each in open_files.iterdir() if each.is_symlink()}
    path.unlink()
    with pytest.raises(RecordingError, match="No such file"):
        version_of(bag)


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


@pytest.mark.parametrize(("version", "tail"), [("0", b""), ("1", struct.pack("<f", 0.25))])
def test_images_are_read_with_and_without_a_tail(version: str, tail: bytes) -> None:
    raw = raw_image(version, tail)
    image = parse(raw, IMAGE)
    assert (image.header.seq, timestamp_s(image)) == (7, pytest.approx(12.345_678_901))
    for size in ((3, 2), (64, 48)):  # a device may deliver another size than its profile says
        np.testing.assert_array_equal(pixels(image, "mono8", pinhole(*size)), [[0, 1, 2], [3, 4, 5]])
    assert depth_unit_m(raw) == (0.25 if tail else None)


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
    made = pixels(image, encoding, pinhole())
    assert made.shape == ((2, 3) if found.channels == 1 else (2, 3, found.channels))
    assert made.tobytes() == values.tobytes()


@pytest.mark.parametrize(
    ("recorded", "enumeration"),
    [
        ("Depth Units", "option"),
        ("Min_Distance", "option"),
        ("Hardware Clock", "timestamp_domain"),
        ("Frame Laser Power", "frame_metadata_value"),
        ("Brown Conrady", "distortion"),
    ],
)
def test_sdk_name_gives_names_of_the_sdk(recorded: str, enumeration: str) -> None:
    assert sdk_name(recorded) in getattr(load_sdk(), enumeration).__members__


def test_metadata_and_lens_are_parsed() -> None:
    assert sdk_name("Auto-Exposure Mode") == "auto_exposure_mode"
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
def test_pose_of_refuses_a_quaternion_without_length(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        pose_of(transform(*quaternion))
