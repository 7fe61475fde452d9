"""One suite for every camera; rows of a real L515 are skipped where none is connected."""

import json
import subprocess
import sys
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeSdk
from fake_lidar import FakeLidar

from nlos_cam.camera import Camera, Recording, World, connected, load_sdk, open_camera, open_world, shared_context
from nlos_cam.errors import CameraError, NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.recording import verify

FAKE_L515 = "l515:fake"
RECORDED = 12
SEEN = 5
READERS = {"bag": "plain", "bag-sdk": "sdk"}
ENDS_CLEANLY = """
import json
import sys
from itertools import islice
from nlos_cam.camera import open_camera
with open_camera(**json.loads(sys.argv[1])) as camera:
    print(len(list(islice(camera, 3))))
"""


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the bare wall as `capture` does."""
    path = tmp_path_factory.mktemp("contract") / "wall.bag"
    with open_camera("sim:bare-wall", recording=Recording(path, frames=RECORDED)) as camera:
        assert len(list(camera)) == RECORDED
    return path


@pytest.fixture(
    params=["sim", "sim:bare-wall", "bag", "bag-sdk", FAKE_L515, pytest.param("l515", marks=pytest.mark.hardware)]
)
def opens(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments of `open_camera`."""
    if request.param == FAKE_L515:
        sdk = FakeSdk(FakeLidar("fake", runs=(10**6, 10**6), laser_power=93.0))
        monkeypatch.setattr("nlos_cam.camera.l515.load_sdk", lambda: sdk)
    found = connected(load_sdk(), shared_context(load_sdk())) if request.param == "l515" else []
    if request.param == "l515" and not any("L515" in info.name for _, info in found):
        pytest.skip("no L515 is connected")
    if request.param in READERS:
        return {"uri": f"bag:{request.getfixturevalue('bag')}", "reader": READERS[request.param]}
    return {"uri": request.param}


@pytest.fixture
def uri(opens: dict[str, Any]) -> str:
    return opens["uri"]


@pytest.fixture
def camera(opens: dict[str, Any]) -> Camera:
    return open_camera(**opens)


def look(camera: Camera, count: int = SEEN) -> list[Frame]:
    with camera:
        return list(islice(camera, count))


def world_of(uri: str) -> World | None:
    """Open the world of a camera, if it is known."""
    if uri.startswith("l515"):
        return None
    return open_world("" if uri == "sim" else "bare-wall")


def test_frames_have_the_shapes_and_types_of_the_protocol(camera: Camera) -> None:
    shape = camera.intrinsics.height, camera.intrinsics.width
    for frame in look(camera):
        assert frame.depth_m.shape == frame.ir.shape == frame.confidence.shape == shape
        assert (frame.depth_m.dtype, frame.ir.dtype, frame.confidence.dtype) == (np.float32, np.uint8, np.uint8)
        assert frame.intrinsics == camera.intrinsics


def test_depth_is_in_metres_and_confidence_in_levels(camera: Camera) -> None:
    for frame in look(camera):
        seen = frame.depth_m[~np.isnan(frame.depth_m)]
        assert seen.size > 0.5 * frame.depth_m.size
        assert seen.min() > 0.05
        assert seen.max() < 16.4
        assert frame.confidence.max() <= 15


def test_numbers_and_timestamps_rise_together(camera: Camera) -> None:
    for one, next_one in pairwise(look(camera)):
        assert next_one.frame_number > one.frame_number
        frames_later = (next_one.timestamp_s - one.timestamp_s) * 30
        assert frames_later == pytest.approx(next_one.frame_number - one.frame_number, abs=0.5)


def test_settings_are_those_read_back(camera: Camera) -> None:
    frame = look(camera)[0]
    assert frame.settings["depth_units"] == pytest.approx(0.00025)


def test_frames_are_the_bits_that_the_world_exposed(uri: str, camera: Camera) -> None:
    world = world_of(uri)
    if world is None:
        pytest.skip("only a simulated world is known to the bit")
    for frame in look(camera):
        images = world.images(frame.frame_number)
        depth_z16 = np.nan_to_num(frame.depth_m / np.float32(0.00025)).round()
        np.testing.assert_array_equal(depth_z16, images.depth_z16)
        np.testing.assert_array_equal(frame.ir, images.ir)
        np.testing.assert_array_equal(frame.confidence, images.confidence)


def test_identity_names_the_device(camera: Camera) -> None:
    assert {"name", "serial"} <= set(camera.identity)
    assert all(camera.identity.values())


def test_frames_hold_the_truth_where_it_is_known(uri: str, camera: Camera) -> None:
    frame = look(camera)[0]
    if uri != "sim":
        assert frame.truth_depth_m is None
    else:
        np.testing.assert_array_equal(frame.truth_depth_m, open_world("").truth_depth_m(frame.frame_number))
        assert frame.truth_depth_m.shape == (64, 64)


def test_camera_can_be_entered_again(camera: Camera) -> None:
    assert len(look(camera)) == len(look(camera)) == SEEN


def test_sets_are_complete_and_gaps_are_counted(camera: Camera) -> None:
    numbers = [frame.frame_number for frame in look(camera)]
    assert camera.incomplete == 0
    assert camera.dropped >= numbers[-1] - numbers[0] + 1 - len(numbers)


def test_iterating_before_entering_is_an_error(camera: Camera) -> None:
    with pytest.raises(CameraError, match=camera.uri):
        next(iter(camera))


def test_leaving_ends_an_iteration(camera: Camera) -> None:
    with camera:
        frames = iter(camera)
        next(frames)
    assert list(frames) == []


def test_error_inside_leaves_the_camera_stopped(camera: Camera) -> None:
    with pytest.raises(ZeroDivisionError), camera:
        _ = 1 // 0
    assert len(look(camera)) == SEEN


@pytest.mark.slow
def test_process_that_used_a_camera_ends_cleanly(opens: dict[str, Any]) -> None:
    if opens["uri"] == FAKE_L515:
        pytest.skip("the fake SDK is in this process only")
    ended = subprocess.run(  # noqa: PLW1510  the code is what is tested
        [sys.executable, "-c", ENDS_CLEANLY, json.dumps(opens)], capture_output=True, text=True, timeout=120
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "3\n", "")


def test_recording_is_complete_on_every_stream(bag: Path) -> None:
    found = verify(bag)
    assert found.streams == dict.fromkeys(("depth", "infrared", "confidence"), RECORDED)
    assert found.frames == RECORDED


@pytest.mark.slow
@pytest.mark.parametrize("readers", [("plain", "plain"), ("sdk", "sdk"), ("plain", "sdk")])
def test_recording_gives_same_bits_each_time_on_both_readers(bag: Path, readers: tuple[Any, Any]) -> None:
    first, second = (look(open_camera(f"bag:{bag}", reader=reader), RECORDED + 1) for reader in readers)
    assert len(first) == len(second) == RECORDED
    for one, other in zip(first, second, strict=True):
        assert (one.frame_number, one.timestamp_s) == (other.frame_number, other.timestamp_s)
        for images in ("depth_m", "ir", "confidence"):
            np.testing.assert_array_equal(getattr(one, images), getattr(other, images))


@pytest.mark.parametrize("reader", READERS.values())
def test_recording_cannot_be_recorded(bag: Path, tmp_path: Path, reader: Any) -> None:
    with pytest.raises(NlosCamError, match=bag.name):
        open_camera(f"bag:{bag}", recording=Recording(tmp_path / "copy.bag"), reader=reader)
