import gc
import os
import re
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera import simulated
from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import RecordingError, StreamMissingError
from nlos_cam.recording.playback import ReplayCamera, verify


def record_streams(path: Path, world: Any) -> Path:
    """A recording of the streams that a SoftwareLidar has just now."""
    sdk = load_sdk()
    lidar = simulated.SoftwareLidar(world.rig.pinhole, sdk)
    recorder = sdk.recorder(str(path), lidar.device)
    sensor = lidar.device.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles())
    sensor.start(lambda _: None)
    lidar.push(0, 0.0, world.images(0))
    sensor.stop()
    sensor.close()
    del recorder
    gc.collect()
    return path


def without_index(path: Path) -> bytes:
    """The file as a killed recording leaves it: the header's index_pos is 0."""
    content = path.read_bytes()
    return re.sub(rb"(?s)(index_pos=).{8}", rb"\1" + bytes(8), content, count=1)


def test_every_pushed_bit_comes_back(noise_bag: Path, noise_world: Any) -> None:
    world = noise_world()
    with ReplayCamera(noise_bag) as camera:
        frames = list(camera)
    assert [frame.frame_number for frame in frames] == list(range(20))
    for frame in frames:
        images = world.images(frame.frame_number)
        np.testing.assert_array_equal(np.isnan(frame.depth_m), images.depth_z16 == 0)
        np.testing.assert_array_equal(np.nan_to_num(frame.depth_m / np.float32(0.00025)).round(), images.depth_z16)
        np.testing.assert_array_equal(frame.ir, images.ir)
        np.testing.assert_array_equal(frame.confidence, images.confidence)


def test_counters_are_those_of_the_last_iteration(noise_bag: Path) -> None:
    with ReplayCamera(noise_bag) as camera:
        for _ in range(2):
            assert len(list(camera)) == 20
            assert set(camera.arrived.values()) == {20}


def test_verifying_tells_what_is_in_the_file(noise_bag: Path) -> None:
    found = verify(noise_bag)
    assert (found.frames, found.dropped) == (20, 0)
    assert found.seconds == pytest.approx(19 / 30, abs=1e-3)
    assert found.streams == {"depth": 20, "infrared": 20, "confidence": 20}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "is empty"),
        (b"a text file\n", "is not a .bag recording"),
        (b"#ROSBAG V2.0\n", "cut short or damaged"),
    ],
)
def test_a_file_that_is_no_recording_is_told_in_one_line(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "broken.bag"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=told) as raised:
        ReplayCamera(path)
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_recording_is_told(noise_bag: Path, tmp_path: Path, share: float) -> None:
    path = tmp_path / "cut.bag"
    content = noise_bag.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(RecordingError, match="cut short or damaged"):
        ReplayCamera(path)


def test_a_killed_recording_is_told(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "killed.bag"
    path.write_bytes(without_index(noise_bag))
    with pytest.raises(RecordingError, match="was never closed"):
        ReplayCamera(path)


def test_a_missing_path_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="does not exist"):
        ReplayCamera(tmp_path / "none.bag")
    with pytest.raises(RecordingError, match="is a folder"):
        ReplayCamera(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes have names here")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.bag")
    with pytest.raises(RecordingError, match="is no file"):
        ReplayCamera(tmp_path / "pipe.bag")


def test_the_repair_that_is_offered_can_be_typed(tmp_path: Path, noise_bag: Path) -> None:
    (path := tmp_path / "my run.bag").write_bytes(without_index(noise_bag))
    with pytest.raises(RecordingError, match=r"nlos-cam repair '.*/my run\.bag' --out 'my run-repaired\.bag'"):
        ReplayCamera(path)


def test_damage_within_is_told_after_the_frames_before_it(recorded: Any, tmp_path: Path) -> None:
    path = recorded(tmp_path / "damaged.bag", frames=150)  # more than the SDK writes as one compressed piece
    assert verify(path).frames == 150
    content = bytearray(path.read_bytes())
    where = content.rindex(b"compression=lz4") + 200
    content[where : where + 100] = bytes(100)
    path.write_bytes(content)
    frames: list[int] = []
    with ReplayCamera(path) as camera, pytest.raises(RecordingError, match=r"is damaged \d+\.\d s into its") as raised:
        frames.extend(frame.frame_number for frame in camera)
    assert f"`nlos-cam repair {path} --out damaged-repaired.bag`" in str(raised.value)
    assert frames == list(range(len(frames)))
    assert max(camera.arrived.values()) - len(frames) == camera.incomplete <= 1
    assert 0 < len(frames) < 150
    with pytest.raises(RecordingError, match="is damaged"):
        verify(path)


def test_what_never_came_and_what_came_in_part_are_counted(rewritten: Any) -> None:
    def with_gaps(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        number = int.from_bytes(raw[:4], "little") if topic.endswith("/image/data") else -1
        lacks = {8: "Infrared_0", 12: "Confidence_0", 19: "Depth_0"}.get(number, "none")
        return [] if number in {3, 4} or lacks in topic else [(time_ns, raw)]

    with ReplayCamera(rewritten(with_gaps)) as camera:
        numbers = [frame.frame_number for frame in camera]
    assert numbers == [n for n in range(20) if n not in {3, 4, 8, 12, 19}]
    assert (camera.dropped, camera.incomplete) == (2, 3)
    assert camera.arrived == {"depth": 17, "infrared": 17, "confidence": 17}


def test_settings_are_those_in_force_when_the_frame_was_recorded(rewritten: Any) -> None:
    value, changed_ns = "/device_0/sensor_0/option/Frames_Queue_Size/value", 5_000_000

    def changing(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        number = int.from_bytes(raw[:4], "little")
        time_ns = time_ns if topic.endswith(value) or time_ns == 1 else 1000 + number * 1_000_000
        changes = [(changed_ns, struct.pack("<f", 7.0))] if topic == value else []
        return [] if topic.endswith("/metadata") else [(time_ns, raw), *changes]

    with ReplayCamera(rewritten(changing)) as camera:
        for frame in camera:
            assert frame.settings["frames_queue_size"] == (7.0 if frame.frame_number >= 5 else 0.0)
            assert camera.telemetry() == frame.settings


def test_it_tells_which_camera_was_recorded(noise_bag: Path) -> None:
    assert ReplayCamera(noise_bag).identity == {"name": "Simulated L515", "serial": "simulated"}


def test_an_iteration_ends_where_another_begins(noise_bag: Path) -> None:
    with ReplayCamera(noise_bag) as camera:
        first = iter(camera)
        assert next(first).frame_number == 0
        assert len(list(camera)) == 20
        assert list(first) == []
        assert set(camera.arrived.values()) == {20}


@pytest.mark.parametrize("streams", [("depth",), ("depth", "infrared"), ("infrared", "confidence")])
def test_a_missing_stream_is_named_with_what_to_do(
    noise_world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, streams: tuple[str, ...]
) -> None:
    monkeypatch.setattr(simulated, "FORMATS", {stream: FORMATS[stream] for stream in streams})
    path = record_streams(tmp_path / "partial.bag", noise_world())
    with pytest.raises(StreamMissingError) as raised:
        ReplayCamera(path)
    for stream in FORMATS:
        assert (f"no {stream}" in str(raised.value)) == (stream not in streams)
    assert "--camera l515" in str(raised.value)


def test_a_recording_of_no_frames_is_told(noise_world: Any, hurried_clock: Any, tmp_path: Path) -> None:
    path = tmp_path / "nothing.bag"
    camera = SimulatedCamera("sim", noise_world(), clock=hurried_clock(), recording=Recording(path))
    camera._world.fails_at = 0
    with camera, pytest.raises(ZeroDivisionError):
        next(iter(camera))
    with pytest.raises(RecordingError, match="holds no frames"):
        ReplayCamera(path)


def test_a_real_recording_of_another_camera_says_what_it_lacks(real_bag: Path) -> None:
    with pytest.raises(StreamMissingError, match="no infrared and no confidence stream") as raised:
        ReplayCamera(real_bag)
    assert "--camera l515" in str(raised.value)


WITHOUT_SDK = """
import sys
sys.modules["pyrealsense2"] = None
from nlos_cam.camera import open_camera
from nlos_cam.errors import CameraError
uri = sys.argv[1]
with open_camera(uri) as camera:
    print(len(list(camera)))
try:
    open_camera(uri, reader="sdk")
except CameraError as error:
    print(error)
"""


def test_a_recording_is_read_where_there_is_no_sdk(noise_bag: Path) -> None:
    run = [sys.executable, "-c", WITHOUT_SDK, f"bag:{noise_bag}"]
    told = subprocess.run(run, capture_output=True, text=True, check=True, timeout=120).stdout.splitlines()
    assert told[0] == "20"
    assert told[1].startswith("librealsense cannot be loaded")


def test_reading_starts_no_thread(noise_bag: Path) -> None:
    before = threading.active_count()
    with ReplayCamera(noise_bag) as camera:
        for _ in camera:
            assert threading.active_count() == before


@pytest.mark.parametrize("reads", ["list(camera)", "next(iter(camera))", "None"])
@pytest.mark.parametrize("leaves", ["camera.__exit__(None, None, None)", "None"])
def test_the_process_ends_cleanly_wherever_it_stops(noise_bag: Path, reads: str, leaves: str) -> None:
    program = (
        "from nlos_cam.camera import open_camera\n"
        f"camera = open_camera('bag:{noise_bag}').__enter__()\nfound = {reads}\n{leaves}\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)  # noqa: PLW1510  the code is what is tested
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
