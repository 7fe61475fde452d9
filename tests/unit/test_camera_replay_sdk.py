"""Two readers, one truth: librealsense's playback and our own reading of the same files."""

import gc
import re
import struct
import time
from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nlos_cam.camera import open_camera
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import SampleQueue
from nlos_cam.camera.simulated import SoftwareLidar
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.errors import RecordingError, StreamMissingError
from nlos_cam.recording.playback import ReplayCamera
from nlos_cam.recording.sdk_playback import SdkReplayCamera

IMAGE, METADATA = "/image/data", "/image/metadata"
Messages = Iterable[tuple[int, bytes]]


def seen(camera: Any, pause_s: float = 0.0) -> tuple[list[Any], dict[str, Any]]:
    """Everything that a camera gives, and what it counted."""
    frames: list[Any] = []
    with camera:
        for frame in camera:
            time.sleep(pause_s)
            images = frame.depth_m.tobytes(), frame.ir.tobytes(), frame.confidence.tobytes()
            frames.append((frame.frame_number, frame.timestamp_s, frame.intrinsics, dict(frame.settings), images))
        return frames, {name: getattr(camera, name) for name in ("incomplete", "dropped", "arrived", "identity")}


def as_recorded(topic: str, time_ns: int, raw: bytes) -> Messages:
    del topic
    yield time_ns, raw


def before_2_49(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Images without the tail."""
    yield time_ns, raw[:16] + b"0" + raw[17:-4] if topic.endswith(IMAGE) else raw


def around_a_wrap(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Stamped by a device's counter of microseconds, which wraps at the tenth frame."""
    if topic.endswith(METADATA):
        raw = raw.replace(b"\x0b\0\0\0Global Time", b"\x0e\0\0\0Hardware Clock")
    if topic.endswith(IMAGE):
        stamp_us = (2**32 + (number_of(raw) - 10) * 33_333) % 2**32
        raw = raw[:4] + struct.pack("<II", stamp_us // 10**6, stamp_us % 10**6 * 1000) + raw[12:]
    yield time_ns, raw


def with_gaps(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Frames 3 to 5 never came; of 8 the infrared, of 19 the depth."""
    number = number_of(raw) if topic.endswith(IMAGE) else -1
    lacks = {8: "Infrared_0", 19: "Depth_0"}.get(number, "none")
    if number not in {3, 4, 5} and lacks not in topic:
        yield time_ns, raw


def number_of(raw: bytes) -> int:
    return int.from_bytes(raw[:4], "little")


@pytest.mark.parametrize("edit", [as_recorded, before_2_49, around_a_wrap, with_gaps])
def test_both_readers_give_the_same_frames(rewritten: Any, edit: Callable[[str, int, bytes], Messages]) -> None:
    path = rewritten(edit)
    ours, theirs = seen(ReplayCamera(path)), seen(SdkReplayCamera(path))
    assert len(ours[0]) == (15 if edit is with_gaps else 20)
    assert ours == theirs


def test_both_readers_give_the_same_frames_of_a_compressed_file(noise_bag: Path) -> None:
    assert seen(ReplayCamera(noise_bag)) == seen(SdkReplayCamera(noise_bag))


def test_both_readers_give_the_same_frames_of_a_file_that_the_sdk_did_not_compress(
    noise_world: Any, tmp_path: Path
) -> None:
    sdk, world, path = load_sdk(), noise_world(), tmp_path / "uncompressed.bag"
    lidar = SoftwareLidar(world.rig.pinhole, sdk)
    recorder = sdk.recorder(str(path), lidar.device, False)
    sensor = lidar.device.query_sensors()[0]
    sensor.open(sensor.get_stream_profiles())
    sensor.start(lambda _: None)
    for number in range(5):
        lidar.push(number, 100.0 + number / 30, world.images(number))
    sensor.stop()
    sensor.close()
    del recorder
    gc.collect()
    assert b"compression=none" in path.read_bytes()
    ours = seen(ReplayCamera(path))
    assert len(ours[0]) == 5
    assert ours == seen(SdkReplayCamera(path))


@pytest.mark.parametrize("camera", [ReplayCamera, SdkReplayCamera])
def test_a_clock_that_wraps_goes_on(rewritten: Any, camera: type[ReplayCamera | SdkReplayCamera]) -> None:
    frames, _ = seen(camera(rewritten(around_a_wrap)))
    assert [frame[1] for frame in frames] == pytest.approx([WRAP_PERIOD_S + (i - 10) * 0.033333 for i in range(20)])


@pytest.mark.parametrize("reader", ["plain", "sdk"])
def test_a_slow_reader_gets_the_same_frames(noise_bag: Path, reader: Any) -> None:
    uri = f"bag:{noise_bag}"
    assert seen(open_camera(uri, reader=reader), pause_s=0.01) == seen(open_camera(uri, reader=reader))


@pytest.mark.parametrize("reader", ["plain", "sdk"])
def test_leaving_early_and_beginning_anew_gives_the_first_frames(noise_bag: Path, reader: Any) -> None:
    with open_camera(f"bag:{noise_bag}", reader=reader) as camera:
        for taken in (1, 9, 20, 3):
            assert [frame.frame_number for frame in islice(camera, taken)] == list(range(taken))


def last_chunk_damaged(path: Path, target: Path) -> Path:
    """The recording's frames from half its size on, unreadable; its index is whole."""
    content = bytearray(path.read_bytes())
    where = content.rindex(b"compression=lz4") + 200
    content[where : where + 100] = bytes(100)
    target.write_bytes(content)
    return target


@pytest.fixture(scope="module")
def damaged(recorded: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    whole = recorded(folder / "whole.bag", frames=150)  # more than the SDK writes as one compressed piece
    return last_chunk_damaged(whole, folder / "damaged.bag")


TOLD = r"is damaged \d+\.\d s into its .*nlos-cam repair"


def test_damage_does_not_reach_the_sdk(damaged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(context=lambda: pytest.fail("the SDK was given the file"))
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.load_sdk", lambda: fake)
    with pytest.raises(RecordingError, match=TOLD):
        SdkReplayCamera(damaged)


def test_damage_that_only_the_sdk_would_meet_does_not_reach_it(
    noise_bag_uncompressed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, path = bytearray(noise_bag_uncompressed.read_bytes()), tmp_path / "damaged.bag"
    headers = list(re.finditer(rb"(?s)\x2f\0\0\0.\0\0\0(?:op|ver|conn|count)=", content))  # of indexes
    content[headers[-1].start() + 3] = 0xFF
    path.write_bytes(content)
    assert len(seen(ReplayCamera(path))[0]) == 20
    fake = SimpleNamespace(context=lambda: pytest.fail("the SDK was given the file"))
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.load_sdk", lambda: fake)
    with pytest.raises(RecordingError, match=r"is damaged \(at byte \d+: a record's header .*nlos-cam repair"):
        SdkReplayCamera(path)


def test_a_playback_that_ends_too_early_is_told(damaged: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SdkReplayCamera, "_check_all", lambda _: None)
    found: dict[type, list[int]] = {}
    for camera in (ReplayCamera(damaged), SdkReplayCamera(damaged)):
        frames: list[int] = []
        with camera, pytest.raises(RecordingError, match=TOLD):
            frames.extend(frame.frame_number for frame in camera)
        assert camera.dropped == 0
        found[type(camera)] = frames
    ours, theirs = found[ReplayCamera], found[SdkReplayCamera]
    assert theirs == ours[: len(theirs)]  # it loses what it holds when it comes upon the damage
    assert 0 <= len(ours) - len(theirs) <= 2
    assert 0 < len(ours) < 150


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_file_without_a_whole_index_does_not_reach_the_sdk(
    noise_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(noise_bag.read_bytes()[: int(share * noise_bag.stat().st_size)])
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.load_sdk", lambda: pytest.fail("the SDK was asked"))
    with pytest.raises(RecordingError):
        SdkReplayCamera(path)


def test_a_stream_that_is_missing_is_told(real_bag: Path) -> None:
    with pytest.raises(StreamMissingError, match="no infrared and no confidence"):
        SdkReplayCamera(real_bag)


def test_what_the_sdk_refuses_is_told(noise_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: str) -> None:
        raise RuntimeError("no such stream")

    fake = SimpleNamespace(context=lambda: SimpleNamespace(load_device=refuse))
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.load_sdk", lambda: fake)
    with pytest.raises(RecordingError, match=r"cut short or damaged \(no such stream\): `nlos-cam repair"):
        SdkReplayCamera(noise_bag)


def test_a_stream_that_the_sdk_does_not_find_is_told(noise_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.find_streams", lambda _: (None, {}))
    with pytest.raises(RecordingError, match=r"is damaged \(librealsense finds no 'depth' in it\): `nlos-cam repair"):
        SdkReplayCamera(noise_bag)


def test_a_playback_that_never_begins_is_told(noise_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.START_TIMEOUT_S", 0.0)
    stopped = SimpleNamespace(current_status=lambda: load_sdk().playback_status.stopped)
    with SdkReplayCamera(noise_bag) as camera, pytest.raises(RecordingError, match="gave no frame"):
        camera._next(SampleQueue(lossless=True), stopped)
