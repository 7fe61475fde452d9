import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from nlos_cam.errors import NlosCamError, OutputExistsError, RecordingError
from nlos_cam.recording import repair as module
from nlos_cam.recording.playback import verify
from nlos_cam.recording.repair import Repaired, repair_recording
from nlos_cam.recording.sdk_playback import SdkReplayCamera

KINDS = ("packed", "plain", "packed-unindexed", "plain-unindexed")


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, noise_bags: dict[str, Path]) -> Path:
    return noise_bags[request.param]


def repaired(tmp_path: Path, content: bytes) -> Repaired:
    path = tmp_path / "bad.bag"
    path.write_bytes(content)
    return repair_recording(path, tmp_path / "good.bag")


@pytest.mark.parametrize("name", ["packed", "plain"])
def test_a_whole_recording_is_repaired_to_the_same_bytes(
    noise_bags: dict[str, Path], tmp_path: Path, name: str
) -> None:
    found = repair_recording(noise_bags[name], tmp_path / "good.bag")
    assert found.recovered_frames == {"depth": 40, "infrared": 40, "confidence": 40}
    assert found.damages == []
    assert (tmp_path / "good.bag").read_bytes() == noise_bags[name].read_bytes()


def test_a_recording_of_an_old_sdk_is_too(real_bag: Path, tmp_path: Path) -> None:
    found = repair_recording(real_bag, tmp_path / "good.bag")
    assert found.recovered_frames == {"depth": 2, "infrared": 0, "confidence": 0, "color": 1}
    assert found.out.read_bytes() == real_bag.read_bytes()


def test_what_is_repaired_needs_no_repair(bag: Path, tmp_path: Path) -> None:
    once = repair_recording(bag, tmp_path / "once.bag")
    twice = repair_recording(once.out, tmp_path / "twice.bag")
    assert twice.out.read_bytes() == once.out.read_bytes()
    assert (twice.recovered_frames, twice.damages) == (once.recovered_frames, [])


def test_both_readers_read_what_is_claimed_and_librealsense_bit_for_bit(
    bag: Path, tmp_path: Path, tool: Callable[[str], ModuleType]
) -> None:
    found = repair_recording(bag, tmp_path / "good.bag")
    assert verify(found.out).streams == found.recovered_frames
    with Reader(found.out) as reader:
        images = [connection for connection in reader.connections if connection.topic.endswith("/image/data")]
        assert sum(1 for _ in reader.messages(images)) == sum(found.recovered_frames.values())
        assert sum(1 for _ in reader.messages()) == reader.message_count
    noise = tool("noise_recordings").noise
    with SdkReplayCamera(found.out) as camera:
        frames = list(camera)
    assert [frame.frame_number for frame in frames] == list(range(min(found.recovered_frames.values())))
    for frame in frames:
        images = noise(frame.frame_number)
        np.testing.assert_array_equal(frame.ir, images.ir)
        np.testing.assert_array_equal(frame.confidence, images.confidence)
        np.testing.assert_array_equal(np.nan_to_num(frame.depth_m / np.float32(0.00025)).round(), images.depth_z16)


@pytest.mark.parametrize("name", ["packed", "plain"])
def test_the_more_is_left_the_more_is_recovered(noise_bags: dict[str, Path], tmp_path: Path, name: str) -> None:
    content = noise_bags[name].read_bytes()
    frames = []
    for share in (0.4, 0.6, 0.8, 1.0):
        found = repaired(tmp_path, content[: int(share * len(content))])
        frames.append(found.recovered_frames["depth"])
        assert verify(found.out).streams == found.recovered_frames
    assert frames == sorted(frames)
    assert frames[0] >= 10
    assert frames[-1] == 40


def test_the_unfinished_chunk_of_a_plain_recording_gives_its_messages(
    noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    whole, killed = noise_bags["plain"], noise_bags["plain-unindexed"]
    lost = whole.stat().st_size - killed.stat().st_size
    found = repair_recording(killed, tmp_path / "good.bag")
    assert sum(found.recovered_frames.values()) > 3 * 40 - lost // 19_000
    assert found.damages[-1].position + found.damages[-1].bytes == killed.stat().st_size


def test_frames_that_a_file_holds_twice_are_taken_once(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    content = noise_bags["plain"].read_bytes()
    start = content.index(b"\x04\0\0\0op=\x02", 2_000_000) - 17
    end = content.index(b"\x04\0\0\0op=\x02", 2_500_000) - 17
    found = repaired(tmp_path, content[:end] + content[start:end] + content[end:])
    assert found.recovered_frames == {"depth": 40, "infrared": 40, "confidence": 40}
    assert any("twice" in damage.why for damage in found.damages)
    assert verify(found.out).streams == found.recovered_frames


def test_messages_that_nothing_describes_are_told_and_left_out(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    content = noise_bags["plain-unindexed"].read_bytes()
    described = content.index(b"topic=/device_0/sensor_0/Infrared_0/image/data")
    found = repaired(tmp_path, content[:described] + b"tonic" + content[described + 5 :])
    assert found.recovered_frames["infrared"] == 0
    assert found.recovered_frames["depth"] > 30
    assert any("nothing tells what it is" in damage.why for damage in found.damages)


def test_it_is_told_where_librealsense_will_not_play_the_result(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    content = noise_bags["plain"].read_bytes()
    found = repaired(tmp_path, content[:4117] + bytes(500) + content[4617:])
    assert any("librealsense will not play" in damage.why for damage in found.damages)
    with pytest.raises(RecordingError):
        SdkReplayCamera(found.out)
    with Reader(found.out) as reader:
        assert sum(1 for _ in reader.messages()) == reader.message_count


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "it is empty"),
        (b"a text file\n", "none of its 12 bytes"),
        (b"#ROSBAG V2.0\n" + bytes(9000), "none of its 9013 bytes"),
    ],
)
def test_nothing_to_recover_is_told_in_one_line(tmp_path: Path, content: bytes, told: str) -> None:
    with pytest.raises(RecordingError, match=told) as raised:
        repaired(tmp_path, content)
    assert "\n" not in str(raised.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.bag"]


def test_a_recording_that_ends_before_its_first_frame_has_nothing_to_recover(
    noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    content = noise_bags["plain"].read_bytes()
    first = content.index(b"\x04\0\0\0op=\x07", content.index(b"/option/Depth_Units/description"))
    with pytest.raises(RecordingError, match="ends before the first frame"):
        repaired(tmp_path, content[:first])


def test_a_missing_path_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        repair_recording(tmp_path / "none.bag", tmp_path / "good.bag")
    with pytest.raises(RecordingError, match=r"cannot be read \("):
        repair_recording(tmp_path, tmp_path / "good.bag")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes have names here")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.bag")
    with pytest.raises(RecordingError, match="is no file"):
        repair_recording(tmp_path / "pipe.bag", tmp_path / "good.bag")


@pytest.mark.parametrize("link", [None, os.link, os.symlink])
def test_the_original_is_never_the_output(bag: Path, tmp_path: Path, link: Callable[[Path, Path], None] | None) -> None:
    path = shutil.copy(bag, tmp_path / "original.bag")
    out = tmp_path / "link.bag" if link else path
    if link:
        link(path, out)
    with pytest.raises(OutputExistsError, match="is the recording itself"):
        repair_recording(path, out)
    assert path.read_bytes() == bag.read_bytes()


def test_the_original_is_left_as_it_was(bag: Path, tmp_path: Path) -> None:
    path = shutil.copy2(bag, tmp_path / "original.bag")
    before = path.stat()
    path.chmod(0o400)
    repair_recording(path, tmp_path / "good.bag")
    assert path.read_bytes() == bag.read_bytes()
    assert path.stat().st_mtime_ns == before.st_mtime_ns


def test_an_interruption_leaves_nothing_behind_and_what_was_there(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "good.bag"
    out.write_bytes(b"as it was")

    def interrupt(done: int, total: int) -> None:
        if done > 0.8 * total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        repair_recording(bag, out, interrupt)
    assert out.read_bytes() == b"as it was"
    assert list(tmp_path.iterdir()) == [out]


def test_a_full_disk_is_told_before_anything_is_written(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: SimpleNamespace(free=1_500_000))
    with pytest.raises(NlosCamError, match=r"needs \d+ MB, and 1 MB are free") as raised:
        repair_recording(bag, tmp_path / "good.bag")
    assert not isinstance(raised.value, RecordingError)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_to_is_told(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(NlosCamError, match="cannot be written"):
        repair_recording(bag, tmp_path / "nowhere" / "good.bag")


def test_progress_ends_at_all_of_it(bag: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    repair_recording(bag, tmp_path / "good.bag", lambda done, total: told.append((done, total)))
    assert told == sorted(told)
    assert told[-1][0] == told[-1][1] == 2 * bag.stat().st_size
