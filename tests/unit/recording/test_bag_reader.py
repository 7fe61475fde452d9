import re
import struct
import tracemalloc
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nlos_calibration.geometry import Intrinsics
from rosbags.rosbag1 import Reader

from nlos_cam.camera.sdk import load_sdk
from nlos_cam.errors import RecordingError
from nlos_cam.recording import BagReader, verify
from nlos_cam.recording.bag_messages import (
    ENCODINGS,
    lens_of,
    metadata,
    parse,
    pixels,
    pose_of,
    sdk_name,
)
from nlos_cam.recording.rosbag import CHUNK_LIMIT


@pytest.fixture(params=["noise_bag", "noise_bag_uncompressed", "real_bag"])
def bag(request: pytest.FixtureRequest) -> BagReader:
    return BagReader(request.getfixturevalue(request.param))


def contents(bag: BagReader) -> dict[str, list[tuple[int, bytes]]]:
    return {
        topic: [(entry.time_ns, bytes(bag.raw(entry))) for entry in entries]
        for topic, entries in bag.entries.items()
    }


def changed(source: Path, target: Path, edit: Callable[[bytes], bytes]) -> Path:
    target.write_bytes(edit(source.read_bytes()))
    return target


def test_reader_reads_the_messages_that_rosbags_reads(bag: BagReader) -> None:
    expected: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(bag.path) as reader:
        for connection, time_ns, raw in reader.messages():
            expected.setdefault(connection.topic, []).append((time_ns, bytes(raw)))

    assert contents(bag) == expected
    assert bag.end_ns == max(messages[-1][0] for messages in expected.values())


@pytest.mark.parametrize("compression", ["LZ4", "BZ2"])
def test_reader_reads_each_compression(noise_bag: Path, rewritten: Any, compression: str) -> None:
    path = rewritten(lambda _, time_ns, raw: [(time_ns, raw)], compression=compression)
    assert contents(BagReader(path)) == contents(BagReader(noise_bag))


def test_reader_unpacks_no_more_than_its_bound(
    noise_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.recording.rosbag.CHUNK_LIMIT", 10_000)
    with pytest.raises(RecordingError, match="chunk"):
        BagReader(noise_bag)


def test_damage_is_reported_with_its_place_and_the_repair(noise_bag: Path, tmp_path: Path) -> None:
    where = noise_bag.read_bytes().index(b"compression=lz4") + 1000
    path = changed(
        noise_bag,
        tmp_path / "damaged.bag",
        lambda old: old[:where] + bytes(100) + old[where + 100 :],
    )
    position = BagReader(noise_bag).entries["/file_version"][0].chunk_pos
    with pytest.raises(RecordingError, match=rf"0\.0 s .* byte {position}") as raised:
        BagReader(path)

    assert f"`nlos-cam repair {path} --out damaged-repaired.bag`" in str(raised.value)


def test_reader_refuses_a_wrong_or_empty_index(noise_bag: Path, tmp_path: Path) -> None:
    bag = BagReader(noise_bag)
    one, other = (
        bag.entries[f"/device_0/sensor_0/{name}_0/image/data"][0] for name in ("Depth", "Infrared")
    )
    with pytest.raises(RecordingError, match="index"):
        bag.read("/file_version", one._replace(offset=other.offset))
    none = re.compile(rb"(?s)(chunk_count=).{4}")
    path = changed(
        noise_bag, tmp_path / "nothing.bag", lambda old: none.sub(rb"\1" + bytes(4), old, count=1)
    )
    with pytest.raises(RecordingError, match=r"nothing\.bag"):
        BagReader(path)


def test_reader_keeps_no_file_open_and_reports_its_loss(noise_bag: Path, tmp_path: Path) -> None:
    path = changed(noise_bag, tmp_path / "gone.bag", bytes)
    bag = BagReader(path)
    if (
        open_files := Path("/proc/self/fd")
    ).is_dir():  # only Linux lists the open files of a process
        assert path not in {each.readlink() for each in open_files.iterdir() if each.is_symlink()}
    path.unlink()
    bag._chunk_pos = -1
    with pytest.raises(RecordingError, match="No such file"):
        bag.read("/file_version", bag.entries["/file_version"][0])


def test_frames_come_in_recorded_order_and_by_index(bag: BagReader) -> None:
    bag.check()
    places = list(bag.order(bag.streams))

    assert all(one.time_ns <= other.time_ns for one, other in pairwise(places))

    for stream, info in bag.streams.items():
        assert [place.index for place in places if place.stream == stream] == list(
            range(info.frames)
        )

    assert places[-1].time_ns <= bag.end_ns

    for place, sample in reversed(list(zip(places, bag.samples(bag.streams), strict=True))):
        again = bag.sample(place.stream, place.index)
        assert (again.stream, again.number, again.timestamp_s) == (
            sample.stream,
            sample.number,
            sample.timestamp_s,
        )
        np.testing.assert_array_equal(again.pixels, sample.pixels)


def test_packaged_recording_opens_beside_a_folder_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sample").mkdir()

    assert BagReader(Path("sample")).streams.keys() >= {"depth", "infrared"}


def test_sample_owns_its_pixels_and_ends_at_the_last(noise_bag: Path) -> None:
    bag = BagReader(noise_bag)
    bag.sample("depth", 0).pixels[:] = 0

    assert bag.sample("depth", 0).pixels.any()

    with pytest.raises(IndexError):
        bag.sample("depth", 20)


def with_unit(
    *, option: bool, tail_m: float | None
) -> Callable[[str, int, bytes], list[tuple[int, bytes]]]:
    """Put the depth unit into an option, after the images (librealsense before 2.49 did not), or
    nowhere.
    """

    def edit(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        if topic.endswith("/image/data"):
            raw = (
                raw[:16] + b"0" + raw[17:-4]
                if tail_m is None
                else raw[:-4] + struct.pack("<f", tail_m)
            )
        return [(time_ns, raw)] if option or "/Depth_Units/value" not in topic else []

    return edit


@pytest.mark.parametrize(("option", "tail_m"), [(True, None), (True, 0.5), (False, 0.00025)])
def test_depth_unit_is_an_option_or_follows_the_images(
    rewritten: Any, option: bool, tail_m: float | None
) -> None:
    path = rewritten(with_unit(option=option, tail_m=tail_m))
    assert BagReader(path).depth_unit_m() == pytest.approx(0.00025)


@pytest.mark.parametrize("tail_m", [None, 0.0, -1.0, float("nan"), float("inf")])
def test_bag_without_a_depth_unit_is_an_error(rewritten: Any, tail_m: float | None) -> None:
    with pytest.raises(RecordingError, match="depth unit"):
        BagReader(rewritten(with_unit(option=False, tail_m=tail_m))).depth_unit_m()


def test_bag_without_intrinsics_is_an_error(rewritten: Any) -> None:
    with pytest.raises(RecordingError, match="camera_info"):
        BagReader(
            rewritten(
                lambda topic, time_ns, raw: (
                    [] if topic.endswith("camera_info") else [(time_ns, raw)]
                )
            )
        )


def test_unknown_encoding_is_an_error_when_read(rewritten: Any) -> None:
    bag = BagReader(rewritten(lambda _, time_ns, raw: [(time_ns, raw.replace(b"8UC1", b"Y10B"))]))

    assert not bag.streams["infrared"].format
    assert bag.sample("depth", 0).number == 0

    with pytest.raises(RecordingError, match="Y10B"):
        bag.sample("infrared", 0)


def test_streams_of_one_kind_differ_by_their_index(
    noise_bag_uncompressed: Path, tmp_path: Path
) -> None:
    path = tmp_path / "stereo.bag"
    bag = BagReader(
        changed(noise_bag_uncompressed, path, lambda old: old.replace(b"Infrared_0", b"Infrared_2"))
    )

    assert set(bag.streams) == {"depth", "infrared_2", "confidence"}
    assert bag.sample("infrared_2", 19).number == 19


@pytest.mark.parametrize(
    "topic", ["/sensor_0/info", "/Depth_Units/description", "/Infrared_0/tf/1", "/image/data"]
)
def test_check_finds_damage_in_any_message(
    noise_bag_uncompressed: Path, tmp_path: Path, topic: str
) -> None:
    bag = BagReader(noise_bag_uncompressed)
    name = next(name for name in bag.entries if name.endswith(topic))
    content = noise_bag_uncompressed.read_bytes()
    message = bytes(bag.raw(bag.entries[name][-1]))
    where = content.rindex(message) - 4  # its length
    path = changed(
        bag.path, tmp_path / "damaged.bag", lambda old: old[:where] + b"\xff\xff" + old[where + 2 :]
    )
    with pytest.raises(RecordingError, match=r"damaged\.bag"):
        BagReader(path).check()


def test_check_finds_an_image_smaller_than_its_header(rewritten: Any) -> None:
    def wider(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        doubled = raw.replace(struct.pack("<II", 48, 64), struct.pack("<II", 48, 128), 1)
        return [(time_ns, doubled if topic.endswith("Depth_0/image/data") else raw)]

    with pytest.raises(RecordingError, match="128 x 48"):
        BagReader(rewritten(wider)).check()


def test_check_passes_over_unknown_types(noise_bag_uncompressed: Path, tmp_path: Path) -> None:
    old = b"geometry_msgs/Transform"
    new = b"realsense_msgs/Transfor"
    path = changed(
        noise_bag_uncompressed, tmp_path / "other.bag", lambda content: content.replace(old, new)
    )
    BagReader(path).check()


OPTION = "/device_0/sensor_0/option/Frames_Queue_Size/value"
CHANGES = {10_000_000: 3.0, 20_000_000: 5.0, 30_000_000: 4.0}


def test_settings_at_a_time_are_those_last_set(rewritten: Any) -> None:
    def edit(topic: str, time_ns: int, raw: bytes) -> Iterable[tuple[int, bytes]]:
        yield time_ns, raw
        for later_ns, value in CHANGES.items() if topic == OPTION else ():
            yield later_ns, struct.pack("<f", value)

    path = rewritten(edit)
    bag = BagReader(path)
    for time_ns, value in {1: 0.0, 9_999_999: 0.0, **CHANGES, 10**12: 4.0}.items():
        assert bag.settings(time_ns)["frames_queue_size"] == value
        assert bag.settings(time_ns)["depth_units"] == pytest.approx(0.00025)
    for time_ns in (10**12, 1, 25_000_000, 15_000_000, 35_000_000, 0):  # in any order
        assert bag.settings(time_ns) == BagReader(path).settings(time_ns)

    assert bag.settings(0) == {}

    before = bag.settings(11_000_000)

    assert bag.settings(12_000_000) is before
    assert bag.settings(21_000_000) is not before
    assert before["frames_queue_size"] == 3.0


def read_all(path: Path) -> None:
    verify(path)
    bag = BagReader(path)
    for place in bag.order(bag.streams):
        bag.sample(place.stream, place.index)
        bag.metadata(place.stream, place.index)
        bag.settings(place.time_ns)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_reader_of_a_damaged_bag_raises_one_line(
    kind: str, seed: int, request: pytest.FixtureRequest, tool: Any, tmp_path: Path
) -> None:
    content = bytearray(request.getfixturevalue(kind).read_bytes())
    path = tmp_path / "damaged.bag"
    ways = tool("mutations").WAYS
    random = np.random.default_rng(seed)
    for _ in range(random.integers(1, 4)):
        if content:
            ways[random.integers(len(ways))](content, random)
    path.write_bytes(content)
    message = str(path)
    try:
        read_all(path)
    except RecordingError as error:
        message = str(error)

    assert message.startswith(str(path))
    assert "\n" not in message


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed"])
@pytest.mark.parametrize(
    "field", [b"size=", b"count=", b"chunk_count=", b"conn_count=", b"index_pos=", b"chunk_pos="]
)
def test_absurd_size_is_not_allocated(
    kind: str, field: bytes, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    content = request.getfixturevalue(kind).read_bytes()
    path = tmp_path / "absurd.bag"
    places = [found.end() for found in re.finditer(re.escape(field), content)][:3]

    assert places

    for at in places:
        path.write_bytes(content[:at] + b"\xff\xff\xff\xff" + content[at + 4 :])
        tracemalloc.start()
        with pytest.raises(RecordingError):
            read_all(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 2 * CHUNK_LIMIT


def parsed_image(values: bytes = bytes(range(6))) -> Any:
    """An image of 3 x 2 as librealsense writes it: the version of the format stands where ROS has
    the frame_id.
    """
    header = struct.pack("<IIII", 7, 12, 345_678_901, 1) + b"0" + struct.pack("<III", 2, 3, 5)
    raw = header + b"mono8\0" + struct.pack("<II", 3, len(values)) + values
    return parse(memoryview(raw), "sensor_msgs/msg/Image")


PINHOLE = Intrinsics(3, 2, 1.0, 1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    "changed",
    [
        {"width": 2},
        {"width": 4},
        {"height": 3},
        {"width": 6, "step": 6},
        {"encoding": "8UC1"},
        {"step": 4},
    ],
)
def test_pixels_refuses_an_image_that_contradicts_itself(changed: dict[str, object]) -> None:
    image = parsed_image()
    vars(image).update(changed)
    with pytest.raises(ValueError, match=r"image|reshape"):
        pixels(image, "mono8", PINHOLE)


def test_pixels_skips_padding_of_rows() -> None:
    image = parsed_image(bytes(range(10)))
    image.step = 5

    np.testing.assert_array_equal(pixels(image, "mono8", PINHOLE), [[0, 1, 2], [5, 6, 7]])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_are_formats_of_the_sdk(encoding: str) -> None:
    found = ENCODINGS[encoding]

    assert found.sdk_format in load_sdk().format.__members__

    bytes_per_pixel = found.channels * np.dtype(found.dtype).itemsize
    values = np.arange(6 * bytes_per_pixel, dtype=np.uint8)
    image = SimpleNamespace(
        encoding=encoding, width=3, height=2, step=3 * bytes_per_pixel, data=values
    )
    result = pixels(image, encoding, PINHOLE)

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

    assert found.domain == "system_time"
    assert found.values == {"system_time": 15.25, "frame_counter": 169.0}
    assert not metadata([]).domain

    model, coefficients = lens_of(
        SimpleNamespace(distortion_model="Brown Conrady", D=[0.1, 0.2, 0.3, 0.4, 0.5])
    )

    assert model == "brown_conrady"
    assert list(coefficients) == [0.1, 0.2, 0.3, 0.4, 0.5]


SHIFT_M = 0.1, 0.2, -0.3


def transform(*quaternion: float) -> SimpleNamespace:
    rotation, shift = (
        SimpleNamespace(**dict(zip("xyzw", values, strict=False)))
        for values in (quaternion, SHIFT_M)
    )
    return SimpleNamespace(rotation=rotation, translation=shift)


def test_pose_of_accepts_either_sign_of_a_quaternion() -> None:
    axis = np.array([0.6, 0.0, -0.8])
    angle = 0.7
    expected = np.eye(4)
    expected[:3, :3] = cv2.Rodrigues(axis * angle)[0]
    expected[:3, 3] = SHIFT_M
    quaternion = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(pose_of(transform(*(sign * quaternion))), expected, atol=1e-12)


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0), (float("nan"), 0.0, 0.0, 1.0)]
)
def test_pose_of_refuses_a_quaternion_not_of_unit_length(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        pose_of(transform(*quaternion))
