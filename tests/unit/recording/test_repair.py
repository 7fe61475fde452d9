import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import lz4.frame
import pytest
from rosbags.rosbag1 import Reader
from sdk_playback import SdkReplay
from small_frames import assert_exposed

from nlos_cam.errors import NlosCamError, OutputExistsError, RecordingError
from nlos_cam.recording import RepairResult, repair_recording, verify

Bags = dict[str, Path]
ALL = {"depth": 40, "infrared": 40, "confidence": 40}


@pytest.fixture(params=["packed", "plain", "packed-unindexed", "plain-unindexed"])
def bag(request: pytest.FixtureRequest, noise_bags: Bags) -> Path:
    return noise_bags[request.param]


def repaired(tmp_path: Path, content: bytes) -> RepairResult:
    path = tmp_path / "bad.bag"
    path.write_bytes(content)
    return repair_recording(path, tmp_path / "good.bag")


def whys(found: RepairResult) -> str:
    return "; ".join(damage.why for damage in found.damages)


@pytest.mark.parametrize("name", ["packed", "plain", "of an old SDK"])
def test_repair_copies_a_whole_bag(
    noise_bags: Bags, request: pytest.FixtureRequest, tmp_path: Path, name: str
) -> None:
    source = noise_bags[name] if name in noise_bags else request.getfixturevalue("real_bag")
    path = shutil.copy2(source, tmp_path / "original.bag")
    progress = list[tuple[int, int]]()
    before = path.stat()
    content = path.read_bytes()
    path.chmod(0o400)
    found = repair_recording(
        path, tmp_path / "good.bag", lambda done, total: progress.append((done, total))
    )
    old = {"depth": 2, "infrared": 0, "confidence": 0, "color": 1}

    expected = ALL if name in noise_bags else old
    assert found.recovered_frames == expected
    assert found.damages == []
    assert (tmp_path / "good.bag").read_bytes() == path.read_bytes() == content
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert progress == sorted(progress)
    assert progress[-1][0] == progress[-1][1] == 2 * before.st_size


def test_every_reader_reads_repaired_bag_exactly(
    bag: Path, tmp_path: Path, tool: Callable[[str], ModuleType]
) -> None:
    found = repair_recording(bag, tmp_path / "good.bag")
    twice = repair_recording(found.out, tmp_path / "twice.bag")

    assert twice.out.read_bytes() == found.out.read_bytes()
    assert twice.recovered_frames == found.recovered_frames
    assert twice.damages == []
    assert verify(found.out).streams == found.recovered_frames

    with Reader(found.out) as reader:
        images = [
            connection
            for connection in reader.connections
            if connection.topic.endswith("/image/data")
        ]
        assert sum(1 for _ in reader.messages(images)) == sum(found.recovered_frames.values())
        assert sum(1 for _ in reader.messages()) == reader.message_count
    noise = tool("noise_recordings").noise
    frames = list(SdkReplay(found.out))

    assert [frame.frame_number for frame in frames] == list(
        range(min(found.recovered_frames.values()))
    )

    for frame in frames:
        assert_exposed(frame, noise(frame.frame_number))


@pytest.mark.parametrize("name", ["packed", "plain"])
def test_repair_recovers_more_where_more_is_left(
    noise_bags: Bags, tmp_path: Path, name: str
) -> None:
    content = noise_bags[name].read_bytes()
    frames = list[int]()
    for share in (0.4, 0.6, 0.8, 1.0):
        found = repaired(tmp_path, content[: int(share * len(content))])
        frames.append(found.recovered_frames["depth"])
        assert verify(found.out).streams == found.recovered_frames

    assert frames == sorted(frames)
    assert frames[0] >= 10
    assert frames[-1] == 40


def test_repair_takes_messages_of_an_unfinished_chunk(noise_bags: Bags, tmp_path: Path) -> None:
    whole = noise_bags["plain"]
    killed = noise_bags["plain-unindexed"]
    lost = whole.stat().st_size - killed.stat().st_size
    found = repair_recording(killed, tmp_path / "good.bag")

    assert sum(found.recovered_frames.values()) > 3 * 40 - lost // 19_000
    assert found.damages[-1].position + found.damages[-1].bytes == killed.stat().st_size


def test_repair_takes_repeated_frames_once(noise_bags: Bags, tmp_path: Path) -> None:
    content = noise_bags["plain"].read_bytes()
    start, end = (
        content.index(b"\x04\0\0\0op=\x02", after) - 17 for after in (2_000_000, 2_500_000)
    )
    found = repaired(tmp_path, content[:end] + content[start:end] + content[end:])

    assert found.recovered_frames == verify(found.out).streams == ALL
    assert "twice" in whys(found)


def test_repair_leaves_out_messages_without_description(noise_bags: Bags, tmp_path: Path) -> None:
    content = noise_bags["plain-unindexed"].read_bytes()
    described = content.index(b"topic=/device_0/sensor_0/Infrared_0/image/data")
    found = repaired(tmp_path, content[:described] + b"tonic" + content[described + 5 :])

    assert found.recovered_frames["infrared"] == 0
    assert found.recovered_frames["depth"] > 30
    assert len(found.damages) > len(
        repair_recording(noise_bags["plain-unindexed"], tmp_path / "other.bag").damages
    )


def test_repair_warns_where_librealsense_will_not_play(noise_bags: Bags, tmp_path: Path) -> None:
    content = noise_bags["plain"].read_bytes()
    found = repaired(tmp_path, content[:4117] + bytes(500) + content[4617:])

    assert "librealsense" in whys(found)

    with pytest.raises(RuntimeError):
        list(SdkReplay(found.out))
    with Reader(found.out) as reader:
        assert sum(1 for _ in reader.messages()) == reader.message_count


def test_repair_refuses_a_file_without_frames(noise_bags: Bags, tmp_path: Path) -> None:
    content = noise_bags["plain"].read_bytes()
    first = content.index(b"\x04\0\0\0op=\x07", content.index(b"/option/Depth_Units/description"))
    other = (
        b"",
        b"a text file\n",
        bytes(3 << 20),
        b"\0\0\0op=" * 9999,
        b"#ROSBAG V2.0\n" + bytes(9000),
    )
    for part in (*other, content[:first]):
        with pytest.raises(RecordingError, match=r"bad\.bag") as raised:
            repaired(tmp_path, part)
        assert "\n" not in str(raised.value)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.bag"]


@pytest.mark.parametrize("link", [None, os.link, os.symlink])
def test_repair_never_writes_to_the_original(
    noise_bags: Bags, tmp_path: Path, link: Callable[[Path, Path], None] | None
) -> None:
    bag = noise_bags["packed"]
    path = shutil.copy(bag, tmp_path / "original.bag")
    out = tmp_path / "link.bag" if link else path
    if link:
        link(path, out)
    with pytest.raises(OutputExistsError, match=out.name):
        repair_recording(path, out)

    assert path.read_bytes() == bag.read_bytes()


def test_repair_that_is_interrupted_leaves_the_old_output(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "good.bag"
    out.write_bytes(b"as it was")

    def interrupt(done: int, total: int) -> None:
        if done > 0.8 * total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        repair_recording(bag, out, interrupt)

    assert out.read_bytes() == b"as it was"
    assert list(tmp_path.iterdir()) == [out]


def test_repair_refuses_a_full_disk_and_a_missing_folder(
    noise_bags: Bags, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(NlosCamError, match="nowhere"):
        repair_recording(noise_bags["plain"], tmp_path / "nowhere" / "good.bag")
    monkeypatch.setattr(
        "nlos_cam.recording.repair.shutil.disk_usage", lambda _: SimpleNamespace(free=1_500_000)
    )
    with pytest.raises(NlosCamError, match=r"\d+ MB.* 1\.5 MB") as raised:
        repair_recording(noise_bags["plain"], tmp_path / "good.bag")

    assert not isinstance(raised.value, RecordingError)
    assert list(tmp_path.iterdir()) == []


PROGRAM = Path(__file__).parents[2] / "fakes/noise_process.py"
FIRST_CHUNK_AT = 4117


def chunks_in(path: Path) -> Iterator[bytes]:
    """Yield the whole chunks of a recording, decompressed and in order."""
    with path.open("rb") as file:
        file.seek(FIRST_CHUNK_AT)
        while len(head := file.read(4)) == 4:
            header = file.read(*struct.unpack("<I", head))
            (data_bytes,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            data = file.read(data_bytes)
            if len(data) < data_bytes or (b"op=\x05" in header and not data):
                return
            if b"op=\x05" in header:
                yield lz4.frame.decompress(data) if b"compression=lz4" in header else data


@pytest.mark.slow
def test_repair_recovers_every_chunk_of_a_killed_capture(noise_world: Any, tmp_path: Path) -> None:
    path = tmp_path / "killed.bag"
    out = tmp_path / "repaired.bag"
    world = noise_world()
    with subprocess.Popen([sys.executable, PROGRAM, path, str(10**9)]) as capture:
        while not (path.exists() and path.stat().st_size) and capture.poll() is None:
            time.sleep(0.01)
        time.sleep(1.0)
        assert capture.poll() is None
        capture.kill()
    on_disk = list(chunks_in(path))
    found = repair_recording(path, out)

    assert on_disk
    assert set(on_disk) <= set(chunks_in(out))
    assert min(found.recovered_frames.values()) > 40

    played = SdkReplay(out)
    for frame in played:
        assert_exposed(frame, world.images(frame.frame_number))

    assert played.arrived == found.recovered_frames
