import errno
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import pytest
from fake_lidar import NapClock
from nlos_calibration import Intrinsics

from nlos_cam.camera import (
    FORMATS,
    RESERVE_BYTES,
    FrameSet,
    Recording,
    SimulatedCamera,
    check_room,
    free_bytes,
    recording_s,
)
from nlos_cam.camera.recorder import (
    FLUSH_S,
    GONE,
    MAX_FLUSHES,
    STILL_S,
    SdkRecorder,
    bytes_per_frame,
    can_grow,
    spare_bytes,
)
from nlos_cam.camera.session import QUEUED_SETS
from nlos_cam.errors import DiskFullError, OutputExistsError, RecordingError
from nlos_cam.files import FileBusyError
from nlos_cam.recording import ReplayCamera, verify
from nlos_cam.recording.salvage import scan_bag

Make = Callable[[Recording], SimulatedCamera]


@pytest.fixture
def camera(noise_world: Any, hurried_clock: Any) -> Make:
    return lambda recording: SimulatedCamera(
        "sim", noise_world(), clock=hurried_clock(), recording=recording
    )


@pytest.mark.parametrize(
    ("limit", "frames"),
    [
        ({"frames": 1}, 1),
        ({"frames": 31}, 31),
        *(({"seconds": s}, n) for s, n in ((0.01, 1), (0.1, 3), (1.0, 30))),
    ],
)
def test_recording_ends_at_frames_or_seconds(
    camera: Make, tmp_path: Path, limit: dict[str, Any], frames: int
) -> None:
    path = tmp_path / "a.bag"
    path.write_text("an old file")
    recording = Recording(path, **limit)
    with camera(recording) as source:
        for _ in source:
            pass
    found = verify(path)

    assert found.frames == frames
    assert found.dropped == 0
    assert recording.sets == frames
    assert set(found.streams.values()) == {frames}


def test_slow_reader_costs_the_recording_nothing(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", frames=60)
    with camera(recording) as source:
        while recording.sets < 60:
            source._thread.join(0.01)
        count = len(list(source))

    assert count < 60
    assert source.dropped == 60 - count
    assert verify(recording.path).frames == 60


@pytest.mark.parametrize("limit", [{"frames": 6}, {"seconds": 0.2}])
def test_takes_follow_each_other_on_a_running_camera(
    camera: Make, tmp_path: Path, limit: dict[str, Any]
) -> None:
    paths = [tmp_path / f"{number}.bag" for number in range(3)]
    recording = Recording(paths[0], **limit, last=False)
    numbers = list[int]()
    with camera(recording) as source:
        frames = iter(source)
        for path in paths:
            if path != paths[0]:
                recording.next_take(path, last=path == paths[-1])
            seen = set[int]()
            for frame in frames:
                if recording.covers(frame.timestamp_s):
                    seen.add(frame.frame_number)
                elif recording.done:
                    break
            recording.close()
            with ReplayCamera(path) as replayed:
                recorded = [frame.frame_number for frame in replayed]
            assert path == paths[0] or seen <= set(recorded)
            numbers += recorded
            found = verify(path)
            assert (found.frames, found.dropped, set(found.streams.values())) == (6, 0, {6})

    assert numbers == sorted(set(numbers))


def test_recordings_of_one_path_refuse_each_other(camera: Make, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with camera(Recording(path, frames=3)) as source:
        list(source)
        before = path.read_bytes()
        with (
            pytest.raises(FileBusyError, match=f"process {os.getpid()}"),
            camera(Recording(path, frames=1)),
        ):
            pytest.fail("two recordings of one file")
        assert path.read_bytes() == before

    assert verify(path).frames == 3

    with (
        pytest.raises(OutputExistsError, match="exists"),
        camera(Recording(path, frames=1, overwrite=False)),
    ):
        pytest.fail("a recording was replaced")

    assert verify(path).frames == 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bag"]


def test_only_the_last_take_ends_the_iteration(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", frames=3, last=False)
    with camera(recording) as source:
        assert len(list(islice(source, 20))) == 20
        assert recording.done
        recording.close()
        recording.next_take(tmp_path / "b.bag", last=True)
        assert len(list(source)) <= QUEUED_SETS + 1 + 3

    assert recording.sets == 3


def test_next_take_starts_though_no_frame_comes(
    camera: Make, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr("nlos_cam.camera.recorder.BOUNDARY_WAIT_S", 0.01)
    recording = Recording(tmp_path / "a.bag", frames=1, last=False)
    with camera(recording) as source:
        next(iter(source))
        source._end()
        recording.close()
        recording.next_take(tmp_path / "b.bag", last=True)
        assert recording.started
        assert not recording.done
        assert (tmp_path / "b.bag").exists()


@pytest.mark.parametrize("ending", ["little space", "no index"])
def test_camera_goes_on_without_an_optional_recording(
    camera: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    ending: str,
) -> None:
    if ending == "no index":
        monkeypatch.setattr("nlos_cam.camera.recorder.can_grow", lambda *_: False)
    left = 0 if ending == "little space" else 2 * RESERVE_BYTES
    recording = Recording(tmp_path / "a.bag", optional=True, free=lambda _: left)
    with camera(recording) as source:
        assert len(list(islice(source, 40))) == 40

    assert recording.sets == 1 or ending == "no index"

    (warning,) = [record.getMessage() for record in caplog.records]

    assert "a.bag" in warning


class FakeRecorder:
    """An `rs.recorder` that writes a file, and calls `on_pause` when it pauses."""

    def __init__(self, path: str, device: Any) -> None:
        Path(path).write_bytes(b"recorded")
        self.device = device
        self.pauses = 0
        self.on_pause: Callable[[], None] = lambda: None

    def pause(self) -> None:
        self.pauses += 1
        self.on_pause()


SDK = SimpleNamespace(recorder=FakeRecorder)
CLOCK = NapClock()


@pytest.fixture
def found(noise_world: Any) -> FrameSet:
    """Return one set of a NoiseWorld."""
    images = noise_world().images(0)
    return FrameSet(0, 0.0, images.depth_z16, images.ir, images.confidence)


@pytest.fixture
def made(tmp_path: Path) -> SdkRecorder:
    path = tmp_path / "a.bag"
    path.write_bytes(b"something else, and longer")
    made = SdkRecorder(path, "device", SDK, now=CLOCK.now)
    assert path.read_bytes() == b"recorded"
    return made


@pytest.mark.parametrize(("slow", "pauses"), [(0, 1), (3, 4), (10**6, MAX_FLUSHES)])
def test_recorder_pauses_again_while_a_disk_is_behind(
    made: SdkRecorder, slow: int, pauses: int
) -> None:
    fake = made._recorder
    fake.on_pause = lambda: CLOCK.wait(Event(), FLUSH_S + 1 if fake.pauses <= slow else 1.0)
    if pauses == MAX_FLUSHES:
        with pytest.raises(DiskFullError, match=r"a\.bag"):
            made.close()
    else:
        made.close()
        assert made._recorder is None

    assert fake.pauses == pauses


def test_recorder_fails_without_folder_or_growing_file(made: SdkRecorder, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no folder"):
        SdkRecorder(tmp_path / "no folder" / "a.bag", "device", SDK)
    for _ in range(10):  # now and then
        made.watch()
        CLOCK.wait(Event(), STILL_S / 2)
        made.watch()
        with made.path.open("ab") as file:
            file.write(b"more")
    made.watch()

    assert made.failure is None

    CLOCK.wait(Event(), STILL_S + 1)
    made.watch()
    with pytest.raises(
        DiskFullError, match=r"nlos-cam repair .*a\.bag --out .*a-repaired\.bag"
    ) as raised:
        made.close()

    assert "\n" not in str(raised.value)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [5_000, 1_700_000])
def test_librealsense_at_a_file_size_limit_keeps_whole_chunks(tmp_path: Path, limit: int) -> None:
    pytest.importorskip("resource")
    path = tmp_path / "a.bag"
    run = [
        sys.executable,
        Path(__file__).parents[2] / "fakes/noise_process.py",
        path,
        "200",
        str(limit),
    ]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=120)  # noqa: PLW1510  the code is what is tested

    assert ended.returncode == 0
    assert ended.stderr == ""
    assert ended.stdout.count("\n") == 1
    assert f"nlos-cam repair {path} --out" in ended.stdout
    assert path.stat().st_size <= limit
    assert (
        sum(chunk.compression == "lz4" for chunk in scan_bag(path).chunks) == limit // 800_000
    )  # a cut one is not


VGA = Intrinsics(640, 480, 460.0, 460.0, 320.0, 240.0)
SMALL = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)


def test_bytes_per_frame_bounds_a_recording(
    noise_world: type, recorded: Any, tmp_path: Path
) -> None:
    images = noise_world().images(0)
    frames = 200
    streams = images.depth_z16, images.ir, images.confidence

    assert len(streams) == len(FORMATS)
    assert bytes_per_frame(SMALL) == sum(pixels.nbytes for pixels in streams)

    size = recorded(tmp_path / "noise.bag", frames).stat().st_size
    overhead = (
        3 * 600 * frames
    )  # metadata and index of a stream's frame, which count where frames are this small

    assert 0.5 * frames * bytes_per_frame(SMALL) < size < frames * bytes_per_frame(SMALL) + overhead


@pytest.mark.parametrize("seconds", [0, 1, 10, 600])
def test_check_room_needs_frames_and_a_reserve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: int
) -> None:
    monkeypatch.chdir(tmp_path)

    assert free_bytes(tmp_path / "none.bag") > 0 < free_bytes(Path("none.bag"))

    path = tmp_path / "a.bag"
    recorded = 30 * seconds * bytes_per_frame(VGA)
    free = recorded + spare_bytes(recorded)

    assert recording_s(VGA, free) == pytest.approx(seconds)
    assert recording_s(VGA, 0) == 0

    check_room(path, VGA, 30 * seconds, free)
    with pytest.raises(DiskFullError, match=rf"a\.bag.*{30 * seconds or ''}"):
        check_room(path, VGA, 30 * seconds, free - 1)


def test_recording_stops_while_there_is_room_for_its_index(tmp_path: Path, found: FrameSet) -> None:
    """Check a recording of 1 TB, whose index is larger than the reserve."""
    recording = Recording(tmp_path / "a.bag", free=lambda _: 2 * RESERVE_BYTES)
    recording.begin("device", SDK)
    os.truncate(recording.path, 10**12)
    recording.add(found, 0.0)

    assert recording.disk_full
    assert recording.done

    os.truncate(recording.path, 0)
    recording.close()


def test_recording_without_a_file_ends_with_its_reason(tmp_path: Path, found: FrameSet) -> None:
    recording = Recording(tmp_path / "a.bag")
    recording.begin("device", SDK)
    recording.path.unlink()
    ends = recording.add(found, 0.0)

    assert ends
    assert recording.disk_full

    with pytest.raises(DiskFullError, match=GONE):
        recording.close()


def test_recording_without_a_disk_ends_with_its_reason(tmp_path: Path, found: FrameSet) -> None:
    def fail(_: Path) -> int:
        raise OSError(errno.EIO, "it was unplugged")

    recording = Recording(tmp_path / "a.bag", free=fail)
    recording.begin("device", SDK)

    assert recording.add(found, 0.0)
    with pytest.raises(DiskFullError, match=GONE):
        recording.close()

    assert recording.cause == "file gone"


def test_recorder_whose_file_goes_before_its_end_fails(made: SdkRecorder) -> None:
    made.path.unlink()
    with pytest.raises(DiskFullError, match=GONE):
        made.close()


@pytest.mark.parametrize("step_s", [86_400.0, -86_400.0])
def test_step_of_the_clock_changes_no_take(tmp_path: Path, found: FrameSet, step_s: float) -> None:
    recording = Recording(tmp_path / "a.bag", seconds=2.0, free=lambda _: 10 * RESERVE_BYTES)
    recording.begin("device", SDK)
    for number in range(100):
        passed_s = number / 30
        timestamp_s = 1e9 + passed_s + (step_s if number > 20 else 0.0)
        if recording.add(replace(found, number=number, timestamp_s=timestamp_s), passed_s):
            break
    recording.close()

    assert recording.sets == 60


def test_take_covers_frames_that_the_camera_moved_in_time(tmp_path: Path, found: FrameSet) -> None:
    recording = Recording(tmp_path / "a.bag", frames=3)
    recording.begin("device", SDK)
    for number in range(3):
        recording.add(replace(found, number=number, timestamp_s=number / 30), number / 30)
    recording.added_s = -3600.1  # the host's clock was set forward in an outage
    times_s = [number / 30 - 3600.1 for number in range(5)]
    recording.close()

    assert [recording.covers(time_s) for time_s in times_s] == [True] * 3 + [False] * 2


def old_pair(folder: Path) -> dict[str, str]:
    """Write a recording and its sidecar, and return their contents."""
    pair = {"a.bag": "an old file", "a.json": "its sidecar"}
    for name, text in pair.items():
        (folder / name).write_text(text)
    return pair


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_recording_without_a_set_leaves_no_file(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", overwrite=False)
    for _ in range(2):  # as after a restart of the device
        recording.begin("device", SDK)
        recording.path.with_suffix(".json").write_text("a new one")
    recording.close()

    assert list(tmp_path.iterdir()) == []


def test_recording_without_a_set_puts_the_old_pair_back(tmp_path: Path) -> None:
    pair = old_pair(tmp_path)
    recording = Recording(tmp_path / "a.bag")
    for _ in range(2):  # as after a restart of the device
        recording.begin("device", SDK)
        recording.path.with_suffix(".json").write_text("a new one")

    assert contents(tmp_path) == {"a.bag": "recorded", "a.json": "a new one"}

    recording.close()

    assert contents(tmp_path) == pair


def test_first_set_drops_the_old_pair(tmp_path: Path, found: FrameSet) -> None:
    old_pair(tmp_path)
    recording = Recording(tmp_path / "a.bag")
    recording.begin("device", SDK)
    recording.add(found, 0.0)
    recording.close()

    assert contents(tmp_path) == {"a.bag": "recorded"}
    assert [path.name for path in tmp_path.iterdir()] == ["a.bag"]


def test_can_grow_finds_a_limit_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"precious")

    assert can_grow(path, 1_000_000)
    assert path.read_bytes() == b"precious"

    pytest.importorskip("resource")
    program = (
        "import pathlib, resource, sys\nfrom nlos_cam.camera.recorder import can_grow\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "path = pathlib.Path(sys.argv[1])\nprint(can_grow(path, 4000), can_grow(path, 6000))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program, path], capture_output=True, text=True, check=True
    )

    assert ended.stdout == "True False\n"
    assert path.read_bytes() == b"precious"


def test_recorder_whose_start_hangs_fails_within_its_deadline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered = Event()
    hanging = SimpleNamespace(recorder=lambda *_: answered.wait(60.0))
    monkeypatch.setattr("nlos_cam.camera.recorder.START_WITHIN_S", 0.01)
    with pytest.raises(RecordingError, match="did not begin"):
        SdkRecorder(tmp_path / "a.bag", "device", hanging)
    answered.set()


LOCKED = """
import ctypes, sys, types
from pathlib import Path
from nlos_cam.camera import recorder
recorder.END_AFTER_S = 0.5
sleep = ctypes.PyDLL(None).sleep  # does not release Python's lock
recorder.SdkRecorder(Path("a.bag"), None, types.SimpleNamespace(recorder=lambda *_: sleep(60)))
"""


@pytest.mark.slow
def test_recorder_whose_start_locks_python_ends_the_process(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-P", "-c", LOCKED], cwd=tmp_path, capture_output=True, check=False
    )

    assert ended.returncode == 1
    assert b"Timeout" in ended.stderr
