import subprocess
import sys
from pathlib import Path

import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.camera.recorder import RESERVE_BYTES, bytes_per_frame, can_grow, check_room, free_bytes, recording_s
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import DiskFullError

VGA = Intrinsics(640, 480, 460.0, 460.0, 320.0, 240.0)


def test_a_frame_takes_what_its_streams_do(noise_world: type) -> None:
    images = noise_world().images(0)
    streams = images.depth_z16, images.ir, images.confidence
    assert len(streams) == len(FORMATS)
    small = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)
    assert bytes_per_frame(small) == sum(pixels.nbytes for pixels in streams)


def test_uncompressed_is_the_most_that_a_recording_takes(recorded: object, tmp_path: Path) -> None:
    path = recorded(tmp_path / "noise.bag", 200)
    small = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)
    overhead = 3 * 600 * 200  # metadata and index of a stream's frame, which count where frames are this small
    assert 0.5 * 200 * bytes_per_frame(small) < path.stat().st_size < 200 * bytes_per_frame(small) + overhead


def test_free_bytes_are_told_of_a_file_that_is_not_there_yet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert free_bytes(tmp_path / "none.bag") > 0
    monkeypatch.chdir(tmp_path)
    assert free_bytes(Path("none.bag")) > 0


def test_room_is_for_the_frames_and_the_reserve(tmp_path: Path) -> None:
    path, enough = tmp_path / "a.bag", 300 * bytes_per_frame(VGA) + RESERVE_BYTES
    check_room(path, VGA, 300, enough)
    with pytest.raises(DiskFullError, match=r"a\.bag: 300 frames of 640 x 480 may need 0\.37 GB .* 0\.57 GB are free"):
        check_room(path, VGA, 300, enough - 1)
    with pytest.raises(DiskFullError):
        check_room(path, VGA, 0, RESERVE_BYTES - 1)


@pytest.mark.parametrize("seconds", [0, 1, 600])
def test_the_time_that_a_disk_lasts_is_the_time_that_fits(tmp_path: Path, seconds: int) -> None:
    free = RESERVE_BYTES + 30 * seconds * bytes_per_frame(VGA)
    assert recording_s(VGA, free) == seconds
    check_room(tmp_path / "a.bag", VGA, 30 * seconds, free)
    assert recording_s(VGA, 0) == 0


def test_a_file_that_can_grow_is_as_it_was_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"precious")
    assert can_grow(path, 1_000_000)
    assert path.read_bytes() == b"precious"


def test_a_limit_that_no_disk_tells_of_is_found(tmp_path: Path) -> None:
    pytest.importorskip("resource")
    path = tmp_path / "a.bag"
    path.write_bytes(b"precious")
    program = (
        "import pathlib, resource, sys\nfrom nlos_cam.camera.disk import can_grow\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "path = pathlib.Path(sys.argv[1])\nprint(can_grow(path, 4000), can_grow(path, 6000))"
    )
    told = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    assert told.stdout == "True False\n"
    assert path.read_bytes() == b"precious"
