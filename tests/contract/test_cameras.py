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
from small_frames import assert_exposed

from nlos_cam.camera import (
    Camera,
    Recording,
    connected,
    load_sdk,
    open_camera,
    open_world,
    shared_context,
)
from nlos_cam.errors import CameraError, NlosCamError
from nlos_cam.frames import Frame

FAKE_L515 = "l515:fake"
RECORDED = 12
SEEN = 5
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
    params=[
        "sim",
        "sim:bare-wall",
        "bag",
        FAKE_L515,
        pytest.param("l515", marks=pytest.mark.hardware),
    ]
)
def opens(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments of `open_camera`."""
    if request.param == FAKE_L515:
        sdk = FakeSdk(FakeLidar("fake", runs=(10**6,) * 3, laser_power=93.0))
        monkeypatch.setattr("nlos_cam.camera.l515.load_sdk", lambda: sdk)
    found = connected(load_sdk(), shared_context(load_sdk())) if request.param == "l515" else []
    if request.param == "l515" and not any("L515" in info.name for _, info in found):
        pytest.skip("no L515 is connected")
    if request.param == "bag":
        return {"uri": f"bag:{request.getfixturevalue('bag')}"}
    return {"uri": request.param}


@pytest.fixture
def camera(opens: dict[str, Any]) -> Camera:
    return open_camera(**opens)


def look(camera: Camera) -> list[Frame]:
    with camera:
        frames = list(islice(camera, SEEN))
    assert len(frames) == SEEN
    return frames


def test_frames_have_the_shapes_and_types_of_the_protocol(camera: Camera) -> None:
    shape = camera.intrinsics.height, camera.intrinsics.width
    for frame in look(camera):
        assert frame.depth_m.shape == frame.ir.shape == frame.confidence.shape == shape
        assert (frame.depth_m.dtype, frame.ir.dtype, frame.confidence.dtype) == (
            np.float32,
            np.uint8,
            np.uint8,
        )


def test_frames_have_the_units_and_settings_of_the_protocol(camera: Camera) -> None:
    for frame in look(camera):
        assert frame.intrinsics == camera.intrinsics
        seen = frame.depth_m[~np.isnan(frame.depth_m)]
        assert seen.size > 0.5 * frame.depth_m.size
        assert seen.min() > 0.05
        assert seen.max() < 16.4
        assert frame.confidence.max() <= 15
        assert frame.settings["depth_units"] == pytest.approx(0.00025)


def test_frame_numbers_and_timestamps_rise_together(camera: Camera) -> None:
    frames = look(camera)
    for one, next_one in pairwise(frames):
        assert next_one.frame_number > one.frame_number
        frames_later = (next_one.timestamp_s - one.timestamp_s) * 30
        assert frames_later == pytest.approx(next_one.frame_number - one.frame_number, abs=0.5)


def test_gaps_in_frame_numbers_are_counted_as_dropped(camera: Camera) -> None:
    frames = look(camera)

    assert camera.incomplete == 0
    assert camera.dropped >= frames[-1].frame_number - frames[0].frame_number + 1 - len(frames)


def test_frames_are_the_bits_that_the_world_exposed(camera: Camera) -> None:
    if camera.uri.startswith("l515"):
        pytest.skip("only a simulated world is known to the bit")
    world = open_world("" if camera.uri == "sim" else "bare-wall")
    for frame in look(camera):
        assert_exposed(frame, world.images(frame.frame_number))


def test_identity_names_the_device(camera: Camera) -> None:
    assert {"name", "serial"} <= set(camera.identity)
    assert all(camera.identity.values())


def test_frames_hold_the_truth_where_it_is_known(camera: Camera) -> None:
    frame = look(camera)[0]
    if camera.uri != "sim":
        assert frame.truth_depth_m is None
    else:
        np.testing.assert_array_equal(
            frame.truth_depth_m, open_world("").truth_depth_m(frame.frame_number)
        )
        assert frame.truth_depth_m.shape == (64, 64)


def test_camera_can_be_entered_again_after_an_error_too(camera: Camera) -> None:
    with pytest.raises(ZeroDivisionError), camera:
        _ = 1 // 0
    for _ in range(2):
        assert look(camera)


def test_iterating_before_entering_is_an_error(camera: Camera) -> None:
    with pytest.raises(CameraError, match=camera.uri):
        next(iter(camera))


def test_leaving_a_camera_ends_its_frames(camera: Camera) -> None:
    with camera:
        frames = iter(camera)
        next(frames)
    assert list(frames) == []


@pytest.mark.slow
def test_process_that_used_a_camera_ends_cleanly(opens: dict[str, Any]) -> None:
    if opens["uri"] == FAKE_L515:
        pytest.skip("the fake SDK is in this process only")
    ended = subprocess.run(  # noqa: PLW1510  the code is what is tested
        [sys.executable, "-c", ENDS_CLEANLY, json.dumps(opens)],
        capture_output=True,
        text=True,
        timeout=120,
    )

    assert ended.returncode == 0
    assert ended.stdout == "3\n"
    assert ended.stderr == ""


def test_recording_cannot_be_recorded(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(NlosCamError, match=bag.name):
        open_camera(f"bag:{bag}", recording=Recording(tmp_path / "copy.bag"))
