from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.camera.recorder import RESERVE_BYTES, Recording
from nlos_cam.camera.session import CAPACITY
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.playback import ReplayCamera, verify

Make = Callable[[Recording], SimulatedCamera]


@pytest.fixture
def camera(noise_world: Any, hurried_clock: Any) -> Make:
    return lambda recording: SimulatedCamera("sim", noise_world(), clock=hurried_clock(), recording=recording)


@pytest.mark.parametrize("frames", [1, 2, 31])
def test_it_is_full_after_so_many_frames_on_every_stream(camera: Make, tmp_path: Path, frames: int) -> None:
    recording = Recording(tmp_path / "a.bag", frames=frames)
    with camera(recording) as source:
        for _ in source:
            pass
    found = verify(recording.path)
    assert (found.frames, found.dropped, recording.sets) == (frames, 0, frames)
    assert set(found.streams.values()) == {frames}


@pytest.mark.parametrize(("seconds", "frames"), [(0.01, 1), (0.1, 3), (0.5, 15), (1.0, 30)])
def test_it_is_full_after_so_many_seconds_of_the_devices_time(
    camera: Make, tmp_path: Path, seconds: float, frames: int
) -> None:
    recording = Recording(tmp_path / "a.bag", seconds=seconds)
    with camera(recording) as source:
        for _ in source:
            pass
    assert verify(recording.path).frames == recording.sets == frames


def test_leaving_early_keeps_whole_sets_and_all_that_was_seen(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag")
    with camera(recording) as source:
        frames = iter(source)
        last = [next(frames).frame_number for _ in range(10)][-1]
    found = verify(recording.path)
    assert found.frames == recording.sets > last
    assert set(found.streams.values()) == {found.frames}


def test_a_reader_that_does_not_keep_up_costs_the_recording_nothing(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", frames=60)
    with camera(recording) as source:
        source._thread.join(0.01)
        while recording.sets < 60:
            source._thread.join(0.01)
        seen = len(list(source))
    assert seen < 60
    assert source.dropped == 60 - seen
    assert verify(recording.path).frames == 60


def test_a_world_that_fails_leaves_a_recording_that_can_be_read(
    noise_world: Any, hurried_clock: Any, tmp_path: Path
) -> None:
    recording = Recording(tmp_path / "a.bag")
    with (
        pytest.raises(ZeroDivisionError),
        SimulatedCamera("sim", noise_world(fails_at=7), clock=hurried_clock(), recording=recording) as source,
    ):
        list(source)
    assert verify(recording.path).frames == 7


def test_an_old_file_is_replaced(camera: Make, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_text("something else")
    with camera(Recording(path, frames=2)) as source:
        list(source)
    assert verify(path).frames == 2


def test_a_place_that_cannot_be_written_is_told(camera: Make, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        camera(Recording(tmp_path / "no folder" / "a.bag", frames=2)).__enter__()


def watch(recording: Recording, frames: Iterator[Frame]) -> list[int]:
    """The numbers of the frames that a reader of the camera got of a take."""
    numbers: list[int] = []
    for frame in frames:
        if recording.covers(frame.timestamp_s):
            numbers.append(frame.frame_number)
        elif recording.done:
            break
    return numbers


@pytest.mark.parametrize("limit", [{"frames": 6}, {"seconds": 0.2}])
def test_takes_follow_each_other_while_the_camera_runs(camera: Make, tmp_path: Path, limit: dict[str, Any]) -> None:
    paths = [tmp_path / f"{number}.bag" for number in range(3)]
    recording, numbers = Recording(paths[0], **limit, last=False), list[int]()
    with camera(recording) as source:
        frames = iter(source)
        for path in paths:
            if path != paths[0]:
                recording.next_take(path, last=path == paths[-1])
            watch(recording, frames)
            recording.close()
            with ReplayCamera(path) as replayed:
                numbers += [frame.frame_number for frame in replayed]
    for path in paths:
        found = verify(path)
        assert (found.frames, found.dropped) == (6, 0)
        assert set(found.streams.values()) == {6}
    assert numbers == sorted(set(numbers))


def test_only_the_last_take_ends_the_iteration(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", frames=3, last=False)
    with camera(recording) as source:
        assert len(list(islice(source, 20))) == 20
        assert recording.done
        recording.close()
        recording.next_take(tmp_path / "b.bag", last=True)
        assert len(list(source)) <= CAPACITY + 1 + 3
    assert recording.sets == 3


def test_a_frame_is_covered_by_the_take_that_it_is_in(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "0.bag", frames=4, last=False)
    with camera(recording) as source:
        frames = iter(source)
        watch(recording, frames)
        recording.close()
        recording.next_take(tmp_path / "1.bag", last=True)
        seen = watch(recording, frames)
    with ReplayCamera(tmp_path / "1.bag") as replayed:
        assert set(seen) <= {frame.frame_number for frame in replayed}


def test_a_next_take_begins_though_no_frame_comes(camera: Make, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("nlos_cam.camera.recorder.BOUNDARY_WAIT_S", 0.01)
    recording = Recording(tmp_path / "a.bag", frames=1, last=False)
    with camera(recording) as source:
        next(iter(source))
        source._end()
        recording.close()
        recording.next_take(tmp_path / "b.bag", last=True)
        assert recording.begun
        assert not recording.done
    assert (tmp_path / "b.bag").exists()


def test_it_stops_whole_when_little_is_left_on_the_disk(camera: Make, tmp_path: Path) -> None:
    left = iter([RESERVE_BYTES, RESERVE_BYTES, RESERVE_BYTES - 1])
    recording = Recording(tmp_path / "a.bag", free=lambda _: next(left))
    with camera(recording) as source:
        list(source)
    assert recording.disk_full
    found = verify(recording.path)
    assert found.frames == recording.sets == 61
    assert set(found.streams.values()) == {61}


def test_a_disk_that_fills_up_ends_a_take_that_is_not_the_last(camera: Make, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.bag", last=False, free=lambda _: 0)
    with camera(recording) as source:
        assert list(source)
    assert verify(recording.path).frames == recording.sets == 1


@pytest.mark.parametrize("ending", ["little space", "no index"])
def test_a_camera_goes_on_without_an_optional_one(
    camera: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, ending: str
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
