import os
import re
import struct
import sys
import threading
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from small_frames import assert_exposed

from nlos_cam.camera import FORMATS, Recording, SimulatedCamera, open_camera
from nlos_cam.errors import RecordingError, StreamMissingError
from nlos_cam.recording import ReplayCamera, repair_recording, verify


def test_replay_returns_every_recorded_bit(noise_bag: Path, noise_world: Any) -> None:
    world = noise_world()
    threads = threading.active_count()
    with ReplayCamera(noise_bag) as camera:
        for count, frame in enumerate(camera):
            assert frame.frame_number == count
            assert threading.active_count() == threads
            assert_exposed(frame, world.images(count))
    found = verify(noise_bag)

    assert found.frames == count + 1
    assert found.dropped == 0
    assert found.seconds == pytest.approx(19 / 30, abs=1e-3)
    assert found.streams == {"depth": 20, "infrared": 20, "confidence": 20}
    assert camera.identity == {"name": "Simulated L515", "serial": "simulated"}


def test_iterating_again_restarts_frames_and_counters(noise_bag: Path) -> None:
    with open_camera(f"bag:{noise_bag}") as camera:
        first = iter(camera)
        assert next(first).frame_number == 0
        for taken in (1, 9, 20, 3):
            assert [frame.frame_number for frame in islice(camera, taken)] == list(range(taken))
        assert len(list(camera)) == 20
        assert set(camera.arrived.values()) == {20}
        assert list(first) == []


@pytest.mark.parametrize(
    "content", [b"", b"a text file\n", b"#ROSBAG V2.0\n", 0.1, 0.5, 0.99, "killed"]
)
def test_replay_refuses_broken_file_with_repair(
    noise_bag: Path, tmp_path: Path, content: bytes | float | str
) -> None:
    whole = noise_bag.read_bytes()
    path = tmp_path / "my run.bag"
    if isinstance(content, float):
        content = whole[: int(content * len(whole))]
    elif isinstance(content, str):  # the header's index_pos is 0
        content = re.sub(rb"(?s)(index_pos=).{8}", rb"\1" + bytes(8), whole, count=1)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=str(path)) as raised:
        ReplayCamera(path)

    assert "\n" not in str(raised.value)

    advice = r"nlos-cam repair '.*/my run\.bag' --out 'my run-repaired\.bag'"

    assert bool(re.search(advice, str(raised.value))) == content.startswith(b"#ROSBAG")
    assert ("nlos-cam repair" in str(raised.value)) == content.startswith(b"#ROSBAG")


@pytest.mark.parametrize(
    "read", [ReplayCamera, lambda path: repair_recording(path, path.with_name("good.bag"))]
)
def test_missing_paths_folders_and_pipes_are_refused(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    paths = [tmp_path / "none.bag", tmp_path]
    if sys.platform != "win32":  # pipes have names
        os.mkfifo(tmp_path / "pipe.bag")
        paths.append(tmp_path / "pipe.bag")
    for path in paths:
        with pytest.raises(RecordingError, match=str(path)):
            read(path)


def test_replay_gives_the_frames_before_damage(damaged: Path) -> None:
    frames: list[int] = []
    with (
        ReplayCamera(damaged) as camera,
        pytest.raises(RecordingError, match=r"\d+\.\d s") as raised,
    ):
        frames.extend(frame.frame_number for frame in camera)

    assert f"`nlos-cam repair {damaged} --out damaged-repaired.bag`" in str(raised.value)
    assert frames == list(range(len(frames)))
    assert max(camera.arrived.values()) - len(frames) == camera.incomplete <= 1
    assert 0 < len(frames) < 150

    with pytest.raises(RecordingError, match=r"damaged\.bag"):
        verify(damaged)


def test_settings_are_those_at_the_time_of_the_frame(rewritten: Any) -> None:
    value = "/device_0/sensor_0/option/Frames_Queue_Size/value"
    changed_ns = 5_000_000

    def changing(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        number = int.from_bytes(raw[:4], "little")
        time_ns = time_ns if topic.endswith(value) or time_ns == 1 else 1000 + number * 1_000_000
        changes = [(changed_ns, struct.pack("<f", 7.0))] if topic == value else []
        return [] if topic.endswith("/metadata") else [(time_ns, raw), *changes]

    with ReplayCamera(rewritten(changing)) as camera:
        seen = [(frame.frame_number, frame.settings, camera.telemetry()) for frame in camera]

    assert len(seen) == 20

    for number, settings, telemetry in seen:
        assert settings["frames_queue_size"] == (7.0 if number >= 5 else 0.0)
        assert telemetry == settings


@pytest.mark.parametrize("missing", [("infrared", "confidence"), ("infrared",), ("depth",)])
def test_replay_names_missing_streams(
    noise_bag_uncompressed: Path, tmp_path: Path, missing: tuple[str, ...]
) -> None:
    content = noise_bag_uncompressed.read_bytes()
    for stream in missing:  # as of another camera
        content = content.replace(f"{stream.title()}_0".encode(), f"{stream.title()}_2".encode())
    (tmp_path / "partial.bag").write_bytes(content)
    with pytest.raises(StreamMissingError, match="--camera l515") as raised:
        ReplayCamera(tmp_path / "partial.bag")
    for stream in FORMATS:
        assert (f"no {stream}" in str(raised.value)) == (stream in missing)


def test_replay_refuses_a_recording_of_no_frames(
    noise_world: Any, hurried_clock: Any, tmp_path: Path
) -> None:
    path = tmp_path / "nothing.bag"
    recording = Recording(tmp_path / "deleted.bag")
    camera = SimulatedCamera("sim", noise_world(), clock=hurried_clock(), recording=recording)
    camera._world.fails_at = 0

    def record() -> None:
        with camera:
            path.hardlink_to(recording.path)  # which goes at the end, as it is empty
            next(iter(camera))

    with pytest.raises(ZeroDivisionError):
        record()
    with pytest.raises(RecordingError, match=r"nothing\.bag holds no frames"):
        ReplayCamera(path)


def test_replay_refuses_a_recording_of_another_camera(real_bag: Path) -> None:
    with pytest.raises(StreamMissingError, match=r"infrared.*--camera l515"):
        open_camera(f"bag:{real_bag}")
