import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeSdk
from fake_lidar import COLOUR_FROM_DEPTH, LENS, FakeLidar
from nlos_calibration.board import Corners
from nlos_calibration.board_wall import BoardView, CameraErrors, undistorted
from nlos_calibration.geometry import Intrinsics
from software_colour import SoftwareColour, record_with_colour

from nlos_cam.calibrate.color_view import GREY, SETTLES, look_in_colour
from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.simulated import SoftwareLidar
from nlos_cam.errors import (
    CameraError,
    CameraLostError,
    CameraNotFoundError,
    NlosCamError,
    RecordingError,
    StreamMissingError,
)
from nlos_cam.recording.bag_reader import BagFile
from nlos_cam.render.sensor.sensor import SensedImages

SMALL = Intrinsics(64, 48, 60.0, 61.0, 33.0, 22.0)
FLAT = SensedImages(np.full((48, 64), 800, np.uint16), np.full((48, 64), 48, np.uint8), np.full((48, 64), 15, np.uint8))


def small(form: str = "rgb8", lens: list[float] = LENS) -> tuple[SoftwareLidar, SoftwareColour]:
    lidar = SoftwareLidar(SMALL, load_sdk())
    pose = np.linalg.inv(np.vstack([COLOUR_FROM_DEPTH, [0.0, 0.0, 0.0, 1.0]]))
    return lidar, SoftwareColour(lidar, replace(SMALL, width=32, height=24), np.array(lens), pose, form)


def recorded(path: Path, greys: list[int], form: str = "rgb8") -> Path:
    pair = small(form)
    depth = 3 if form in {"rgb8", "bgr8"} else 2 if form in {"yuyv", "uyvy"} else 4
    return record_with_colour(path, *pair, [FLAT], [np.full((24, 32, depth), grey, np.uint8) for grey in greys])


def test_the_last_frames_of_a_recording_are_taken(tmp_path: Path) -> None:
    path, told = recorded(tmp_path / "a.bag", [0, 10, 20, 40]), list[int]()
    view = look_in_colour(f"bag:{path}", 2, on_frame=lambda: told.append(1))
    np.testing.assert_array_equal(view.image, np.full((24, 32), 30.0))
    assert len(told) == 2
    np.testing.assert_array_equal(look_in_colour(f"bag:{path}", 99).image, np.full((24, 32), 17.5))


def held_against_the_sdk(path: Path) -> None:
    view = look_in_colour(f"bag:{path}", 1)
    sensors = load_sdk().context().load_device(str(path)).as_playback().query_sensors()
    profiles = {profile.stream_type().name: profile for s in sensors for profile in s.get_stream_profiles()}
    told = profiles["color"].as_video_stream_profile().get_intrinsics()
    np.testing.assert_allclose(view.distortion, told.coeffs)
    assert (view.intrinsics.fx, view.intrinsics.ppy) == (told.fx, told.ppy)
    extrinsics = profiles["color"].get_extrinsics_to(profiles["depth"])
    np.testing.assert_allclose(view.lidar_from_camera[:3, :3], np.reshape(extrinsics.rotation, (3, 3)).T, atol=1e-6)
    np.testing.assert_allclose(view.lidar_from_camera[:3, 3], extrinsics.translation, atol=1e-7)
    assert (view.light, view.errors) == ("colour", CameraErrors())


def test_a_recordings_lens_and_pose_are_those_that_the_sdk_tells(tmp_path: Path) -> None:
    held_against_the_sdk(recorded(tmp_path / "a.bag", [5]))


def test_so_are_those_of_a_real_cameras_recording(real_bag: Path) -> None:
    held_against_the_sdk(real_bag)
    rgb = BagFile(real_bag).sample("color", 0).pixels
    grey = look_in_colour(f"bag:{real_bag}", 1).image
    np.testing.assert_allclose(grey, rgb @ [0.299, 0.587, 0.114], atol=1.0)


def test_lenses_are_undone_as_the_sdk_undoes_them() -> None:
    """librealsense projects through this lens; the model and the order of the coefficients are the same."""
    sdk = load_sdk()
    made = sdk.intrinsics()
    made.width, made.height, made.fx, made.fy, made.ppx, made.ppy = 1280, 720, 907.0, 908.0, 660.0, 367.0
    made.model, made.coeffs = sdk.distortion.brown_conrady, LENS
    rays = np.random.default_rng(0).uniform([-0.65, -0.38], [0.65, 0.38], (50, 2))
    seen = np.array([sdk.rs2_project_point_to_pixel(made, [x, y, 1.0]) for x, y in rays])
    view = BoardView(np.zeros((720, 1280)), Intrinsics(1280, 720, 907.0, 908.0, 660.0, 367.0), np.array(LENS))
    straight = undistorted(Corners(np.arange(50), seen), view).pixels
    np.testing.assert_allclose(straight, rays * [907.0, 908.0] + [660.0, 367.0], atol=1e-3)
    assert np.abs(seen - straight).max() > 1.0


@pytest.mark.parametrize("form", GREY)
def test_every_format_becomes_grey(tmp_path: Path, form: str) -> None:
    np.testing.assert_array_equal(
        look_in_colour(f"bag:{recorded(tmp_path / 'a.bag', [77], form)}", 1).image, np.full((24, 32), 77.0)
    )


def test_each_colour_counts_as_the_eye_sees_it() -> None:
    pixel = np.array([[[200, 100, 50, 255]]], np.uint8)
    expected = 0.299 * 200 + 0.587 * 100 + 0.114 * 50
    for form, order in {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2, 3], "bgra8": [2, 1, 0, 3]}.items():
        assert GREY[form](np.ascontiguousarray(pixel[..., order]))[0, 0] == pytest.approx(expected, abs=0.6)
    luma = np.array([[91, 7]], np.uint8).view("<u2")
    assert (GREY["yuyv"](luma)[0, 0], GREY["uyvy"](luma)[0, 0]) == (91, 7)


def test_a_recording_without_colour_is_told(noise_bag: Path) -> None:
    with pytest.raises(StreamMissingError, match=r"no color stream \(it has confidence, depth, infrared\)"):
        look_in_colour(f"bag:{noise_bag}", 5)


def test_a_recording_that_does_not_tell_where_colour_is_seen_from_is_refused(rewritten: Any, tmp_path: Path) -> None:
    source = recorded(tmp_path / "a.bag", [5])
    path = rewritten(lambda topic, time, raw: [] if "Color_0/tf" in topic else [(time, raw)], source=source)
    with pytest.raises(RecordingError, match="does not tell where color is seen from"):
        look_in_colour(f"bag:{path}", 1)


def test_images_of_another_size_than_the_lens_is_told_for_are_refused(rewritten: Any, tmp_path: Path) -> None:
    def narrower(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        if topic.endswith("Color_0/image/data"):
            raw = raw.replace(struct.pack("<II", 24, 32), struct.pack("<II", 48, 16), 1)
            raw = raw.replace(b"rgb8\0" + struct.pack("<I", 96), b"rgb8\0" + struct.pack("<I", 48), 1)
        return [(time_ns, raw)]

    path = rewritten(narrower, source=recorded(tmp_path / "a.bag", [5]))
    with pytest.raises(RecordingError, match="colour images of 16 x 48 rgb8, which we cannot use"):
        look_in_colour(f"bag:{path}", 1)


@pytest.mark.parametrize("uri", ["sim", "sim:bare-wall"])
def test_the_simulated_lidar_has_no_colour(uri: str) -> None:
    with pytest.raises(CameraError, match=f"{uri}: the simulated lidar has no colour camera: look in infrared"):
        look_in_colour(uri, 5)


@pytest.mark.parametrize("uri", ["bag:", "kinect"])
def test_an_unknown_camera_is_told(uri: str) -> None:
    with pytest.raises(CameraNotFoundError, match="no camera is called"):
        look_in_colour(uri, 5)


def fake(brightness: Callable[[int], int] = lambda _: 100, **how: Any) -> FakeLidar:
    lidar = FakeLidar(**({"runs": (200,)} | how))
    lidar.colour = brightness
    return lidar


def test_a_live_camera_is_looked_through_once_its_exposure_has_settled() -> None:
    lidar = fake(lambda number: 100 if number >= SETTLES else 200)
    view = look_in_colour("l515", 3, sdk=FakeSdk(lidar))
    np.testing.assert_array_equal(view.image, np.full((720, 1280), 100.0))
    np.testing.assert_array_equal(view.distortion, LENS)
    np.testing.assert_allclose(
        view.lidar_from_camera, np.linalg.inv(np.vstack([COLOUR_FROM_DEPTH, [0.0, 0.0, 0.0, 1.0]])), atol=1e-12
    )
    assert lidar.did == ["start", "stop", "close"]


def test_on_usb_2_the_size_that_is_offered_is_taken() -> None:
    view = look_in_colour("l515:f0246262", 1, sdk=FakeSdk(fake(usb="2.1")))
    assert (view.intrinsics.width, view.intrinsics.height) == (640, 480)


def test_a_camera_that_is_not_there_is_told() -> None:
    with pytest.raises(CameraNotFoundError, match="no L515 with serial x"):
        look_in_colour("l515:x", 1, sdk=FakeSdk(fake()))


def test_a_camera_without_colour_is_told() -> None:
    with pytest.raises(CameraError, match="offers no colour"):
        look_in_colour("l515", 1, sdk=FakeSdk(FakeLidar()))


def test_a_camera_that_falls_silent_is_told_and_let_go() -> None:
    lidar = fake(runs=(SETTLES + 1,))
    with pytest.raises(CameraLostError, match=r"gave no colour frame for 0\.2 s"):
        look_in_colour("l515", 2, sdk=FakeSdk(lidar), silence_s=0.2)
    assert lidar.did[-2:] == ["stop", "close"]


def test_a_camera_that_does_not_start_is_told_and_let_go() -> None:
    lidar = fake()
    lidar.start_error = RuntimeError("busy")
    with pytest.raises(CameraError, match=r"cannot be looked through in colour \(busy\)"):
        look_in_colour("l515", 2, sdk=FakeSdk(lidar))
    assert lidar.did[-1] == "close"


def test_a_lens_of_another_model_is_refused() -> None:
    lidar = fake()
    lidar.lens_model = "inverse_brown_conrady"
    with pytest.raises(NlosCamError, match=r"inverse_brown_conrady .* cannot undo"):
        look_in_colour("l515", 2, sdk=FakeSdk(lidar))
