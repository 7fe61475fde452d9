"""Someone reads a recording that passed through another program: a player, a filter, a driver."""

import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rewritten_bags import Messages, number_of
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from sdk_playback import SdkReplay

from nlos_cam.errors import RecordingError
from nlos_cam.recording import SAMPLE, BagReader, ReplayCamera, repair_recording, verify
from nlos_cam.recording.bag_messages import IMAGE

Run = Callable[..., Any]
Remake = Callable[..., Path]
FRAMES_END = "/image/data"


def depth_of(path: Path) -> list[tuple[int, bytes]]:
    with ReplayCamera(path) as camera:
        return [
            (frame.frame_number, frame.depth_m.tobytes() + frame.ir.tobytes()) for frame in camera
        ]


def as_decoded_and_encoded(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Leave out the depth unit behind an image, which no definition has; the mark stays."""
    yield time_ns, raw[:-4] if topic.endswith(FRAMES_END) else raw


def without_confidence(topic: str, time_ns: int, raw: bytes) -> Messages:
    if "Confidence" not in topic:
        yield time_ns, raw


def second_part(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Keep what was recorded after the first frames, and so no description."""
    del topic
    if time_ns > 100_000_000:
        yield time_ns, raw


def frame_recorded_at(number: int, at_ns: int) -> Callable[[str, int, bytes], Messages]:
    """Return an edit that gives one depth frame another time on the recorder's clock."""

    def edit(topic: str, time_ns: int, raw: bytes) -> Messages:
        is_it = "Depth" in topic and topic.endswith(FRAMES_END) and number_of(raw) == number
        yield at_ns if is_it else time_ns, raw

    return edit


def counting_from_1970(topic: str, time_ns: int, raw: bytes) -> Messages:
    del topic
    yield time_ns + 1_700_000_000_000_000_000, raw


@pytest.mark.parametrize("edit", [as_decoded_and_encoded, counting_from_1970])
def test_rewritten_recording_has_the_same_depth(remake: Remake, edit: Any) -> None:
    assert depth_of(remake(edit)) == depth_of(SAMPLE)


def test_info_calls_a_rewritten_recording_whole(remake: Remake, run: Run) -> None:
    assert run("info", remake(as_decoded_and_encoded), "--verify")["whole"]


def test_replay_needs_no_confidence(remake: Remake, caplog: pytest.LogCaptureFixture) -> None:
    assert depth_of(remake(without_confidence)) == depth_of(SAMPLE)
    assert "no confidence stream" in caplog.text


@pytest.mark.slow
def test_replay_gives_the_same_results_without_confidence(remake: Remake, run: Run) -> None:
    run("replay", SAMPLE, "--out", "whole")
    run("replay", remake(without_confidence), "--out", "partial")
    with (
        np.load("whole/reconstruction.npz") as whole,
        np.load("partial/reconstruction.npz") as partial,
    ):
        assert whole.files == partial.files
        for name in whole.files:
            assert whole[name].tobytes() == partial[name].tobytes()


def test_second_part_is_not_called_damaged(remake: Remake, run: Run) -> None:
    answer = run("replay", remake(second_part), "--out", "r", code=4)

    assert "damaged" not in answer.err
    assert "first part" in answer.err
    assert "--from" in answer.err


def test_repair_takes_descriptions_from_the_first_part(remake: Remake, run: Run) -> None:
    part = remake(second_part)
    run("repair", part, "--from", SAMPLE, "--out", "joined.bag")
    found = depth_of(Path("joined.bag"))

    assert 0 < len(found) < len(depth_of(SAMPLE))
    assert found == depth_of(SAMPLE)[-len(found) :]


def test_librealsense_plays_a_part_with_descriptions(remake: Remake) -> None:
    repair_recording(remake(second_part), Path("joined.bag"), take_from=SAMPLE)
    with ReplayCamera(Path("joined.bag")) as camera:
        ours = [frame.frame_number for frame in camera]

    assert [frame.frame_number for frame in SdkReplay(Path("joined.bag"))] == ours


def test_repair_names_what_a_later_part_lacks(remake: Remake) -> None:
    repaired = repair_recording(remake(second_part), Path("good.bag"))
    assert "--from" in repaired.damages[0].why


def test_repair_names_damage_of_the_first_part(remake: Remake) -> None:
    first = remake(lambda _, time_ns, raw: [(time_ns, raw)], name="first.bag")
    bag = BagReader(first)
    option = next(each[0] for topic, each in bag.entries.items() if "/option/" in topic)
    content = bytearray(first.read_bytes())
    start = content.index(b"time=", option.chunk_pos + option.offset)
    content[start + 5 : start + 13] = bytes(8)
    first.write_bytes(content)

    with pytest.raises(RecordingError, match=r"first\.bag is damaged"):
        repair_recording(remake(second_part), Path("joined.bag"), take_from=first)


def test_repair_refuses_the_first_part_of_another(remake: Remake, run: Run, noise: Path) -> None:
    def renamed(topic: str, time_ns: int, raw: bytes) -> Messages:
        if "Depth" not in topic:
            yield time_ns, raw

    first = remake(renamed, source=noise, name="first.bag")
    answer = run("repair", remake(second_part), "--from", first, "--out", "j.bag", code=4)

    assert "first.bag" in answer.err
    assert not Path("j.bag").exists()


@pytest.mark.parametrize(("number", "at_ns"), [(0, 5 * 10**9), (20, 2), (39, 2), (20, 900_000_000)])
def test_frame_with_a_wrong_recorder_time_stays(
    remake: Remake, noise: Path, number: int, at_ns: int
) -> None:
    path = remake(frame_recorded_at(number, at_ns), source=noise)

    assert depth_of(path) == depth_of(noise)
    assert verify(path).seconds == verify(noise).seconds


@pytest.mark.parametrize("number", [0, 39])
def test_duration_is_that_of_the_stamps(remake: Remake, run: Run, noise: Path, number: int) -> None:
    path = remake(frame_recorded_at(number, 5 * 10**9 if number == 0 else 2), source=noise)
    assert run("info", path)["facts"]["duration"] == "1.3 s"


def test_frame_with_a_wrong_stamp_moves_nothing(remake: Remake, noise: Path) -> None:
    def late(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith(FRAMES_END) and number_of(raw) == 20:
            raw = raw[:4] + struct.pack("<I", 7) + raw[8:]
        yield time_ns, raw

    numbers = [number for number, _ in depth_of(remake(late, source=noise))]

    assert numbers == list(range(40))


@pytest.mark.parametrize("number", [0, 39])
@pytest.mark.parametrize("seconds", [7, 3_000_000_000])
def test_duration_passes_over_a_wrong_stamp(
    remake: Remake, run: Run, noise: Path, number: int, seconds: int
) -> None:
    def edit(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith(FRAMES_END) and number_of(raw) == number:
            raw = raw[:4] + struct.pack("<I", seconds) + raw[8:]
        yield time_ns, raw

    assert run("info", remake(edit, source=noise))["facts"]["duration"] == "1.3 s"


def descriptions_only(topic: str, time_ns: int, raw: bytes) -> Messages:
    if not topic.endswith(FRAMES_END):
        yield time_ns, raw


def of_ros_driver(path: Path) -> Path:
    """Write 24 depth images as the ROS driver publishes them."""
    types = get_typestore(Stores.ROS1_NOETIC)
    image_type: Any = types.types[IMAGE]
    header_type: Any = types.types["std_msgs/msg/Header"]
    time_type: Any = types.types["builtin_interfaces/msg/Time"]
    data = np.zeros(2 * 48 * 64, np.uint8)
    with Writer(path) as writer:
        topic = writer.add_connection("/camera/depth/image_rect_raw", IMAGE, typestore=types)
        for k in range(24):
            header = header_type(seq=k, stamp=time_type(sec=k, nanosec=0), frame_id="camera")
            image = image_type(header, 48, 64, "16UC1", 0, 128, data)
            writer.write(topic, k + 1, bytes(types.serialize_ros1(image, IMAGE)))
    return path


@pytest.mark.parametrize("command", ["info", "replay", "export"])
def test_bag_of_a_ros_driver_names_what_it_lacks(run: Run, command: str) -> None:
    path = of_ros_driver(Path("driver.bag"))
    answer = run(command, path, *([] if command == "info" else ["--out", "out"]), code=4)

    assert "/camera/depth/camera_info, which describes" in str(answer) + answer.err
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["info", "replay", "export"])
def test_descriptions_alone_are_no_recording(remake: Remake, run: Run, command: str) -> None:
    path = remake(descriptions_only)
    answer = run(command, path, *([] if command == "info" else ["--out", "out"]), code=4)

    assert "holds no frames" in str(answer) + answer.err
    assert not Path("out").exists()


@pytest.mark.parametrize("name", ["run.db3", "run.mcap"])
def test_damaged_bags_of_ros_2_are_named(run: Run, name: str) -> None:
    if name.endswith("db3"):
        with sqlite3.connect(name) as file:
            file.execute("create table topics (name text)")
        file.close()
    else:
        Path(name).write_bytes(b"\x89MCAP0\r\n" + bytes(100))

    assert "bag of ROS" in run("info", name, code=4)["problem"]
    assert "bag of ROS" in run("export", name, "--out", "out", code=4).err


def counted_apart(stream: str, at: int, jump: int) -> Callable[[str, int, bytes], Messages]:
    """Return an edit after which one stream's numbers differ from the others' from a frame on."""

    def edit(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith(FRAMES_END) and stream in topic and number_of(raw) >= at:
            raw = (number_of(raw) + jump).to_bytes(4, "little") + raw[4:]
        yield time_ns, raw

    return edit


@pytest.mark.parametrize("stream", ["Depth", "Infrared", "Confidence"])
@pytest.mark.parametrize(("at", "jump"), [(0, 3), (0, 500), (20, 1), (20, -1), (20, 2), (36, 1)])
def test_streams_counted_apart_lose_no_frame(
    remake: Remake, noise: Path, stream: str, at: int, jump: int
) -> None:
    found = depth_of(remake(counted_apart(stream, at, jump), source=noise))
    assert [depth for _, depth in found] == [depth for _, depth in depth_of(noise)]


@pytest.mark.parametrize("stream", ["Depth", "Infrared", "Confidence"])
def test_lost_frame_of_a_stream_counted_apart_loses_one(
    remake: Remake, noise: Path, stream: str
) -> None:
    def edit(topic: str, time_ns: int, raw: bytes) -> Messages:
        number = number_of(raw)
        if not (topic.endswith(FRAMES_END) and stream in topic and number >= 20):
            yield time_ns, raw
        elif number > 20:
            yield time_ns, (number - 1).to_bytes(4, "little") + raw[4:]

    expected = [depth for number, depth in depth_of(noise) if number != 20]
    found = depth_of(remake(edit, source=noise))

    assert [depth for _, depth in found] == expected
