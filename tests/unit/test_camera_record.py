from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.camera.record import Recording
from nlos_cam.camera.replay import verify
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.errors import RecordingError

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
