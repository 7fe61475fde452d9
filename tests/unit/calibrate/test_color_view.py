import struct
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_librealsense import FakeSdk
from fake_lidar import COLOUR_FROM_DEPTH, LENS, FakeLidar
from nlos_calibration import Corners, Intrinsics
from nlos_calibration.board_wall import BoardView, CameraErrors, undistorted
from software_colour import BYTES_PER_PIXEL, SoftwareColour, SoftwareSdk, record_with_colour

from nlos_cam import errors
from nlos_cam.calibrate.color_view import SETTLING_FRAMES, TO_GRAY, capture_color_view
from nlos_cam.camera import SoftwareLidar, load_sdk
from nlos_cam.errors import CameraError, CameraNotFoundError, RecordingError
from nlos_cam.render import SensedImages

SMALL = Intrinsics(64, 48, 60.0, 61.0, 33.0, 22.0)
FLAT = SensedImages(
    np.full((48, 64), 800, np.uint16),
    np.full((48, 64), 48, np.uint8),
    np.full((48, 64), 15, np.uint8),
)
LIDAR_FROM_COLOUR = np.linalg.inv(np.vstack([COLOUR_FROM_DEPTH, [0.0, 0.0, 0.0, 1.0]]))
FRAMES = 4


class StreamingColour(SoftwareSdk):
    """An L515 with a color camera that streams in a thread."""

    def __init__(self) -> None:
        super().__init__(SMALL)
        self.colour = SoftwareColour(self.lidar, SMALL, np.array(LENS), LIDAR_FROM_COLOUR)
        self.plug_in()
        self.delivered = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._deliver, name="colour")
        self._thread.start()

    def _deliver(self) -> None:
        number = 0
        while not self._stop.wait(0.005):
            if self.colour.sensor.get_active_streams():
                self.colour.push(number, np.full((48, 64, 3), 90, np.uint8))
                number += 1

    def on_frame(self) -> None:
        """End the delivery with the last frame: a stopped software device must get none."""
        self.delivered += 1
        if self.delivered == FRAMES:
            self.end()

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5.0)


def recorded(path: Path, greys: list[int], form: str = "rgb8") -> Path:
    lidar = SoftwareLidar(SMALL, load_sdk())
    colour = SoftwareColour(
        lidar, replace(SMALL, width=32, height=24), np.array(LENS), LIDAR_FROM_COLOUR, form
    )
    seen = [np.full((24, 32, BYTES_PER_PIXEL[form]), grey, np.uint8) for grey in greys]
    return record_with_colour(path, lidar, colour, [FLAT], seen)


def test_color_view_averages_the_last_frames_and_holds_lens_and_pose(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.bag", [0, 10, 20, 40])
    calls = list[int]()
    view = capture_color_view(f"bag:{path}", 2, on_frame=lambda: calls.append(1))
    np.testing.assert_array_equal(view.image, np.full((24, 32), 30.0))
    np.testing.assert_allclose(view.distortion, LENS, rtol=1e-6)
    np.testing.assert_allclose(view.lidar_from_camera, LIDAR_FROM_COLOUR, atol=1e-6)
    assert (view.intrinsics, view.light, view.errors) == (
        replace(SMALL, width=32, height=24),
        "colour",
        CameraErrors(),
    )
    assert len(calls) == 2
    np.testing.assert_array_equal(
        capture_color_view(f"bag:{path}", 99).image, np.full((24, 32), 17.5)
    )


def test_undistorted_inverts_the_sdks_lens() -> None:
    sdk = load_sdk()
    made = sdk.intrinsics()
    made.width = 1280
    made.height = 720
    made.fx = 907.0
    made.fy = 908.0
    made.ppx = 660.0
    made.ppy = 367.0
    made.model = sdk.distortion.brown_conrady
    made.coeffs = LENS
    rays = np.random.default_rng(0).uniform([-0.65, -0.38], [0.65, 0.38], (50, 2))
    seen = np.array([sdk.rs2_project_point_to_pixel(made, [x, y, 1.0]) for x, y in rays])
    view = BoardView(
        np.zeros((720, 1280)), Intrinsics(1280, 720, 907.0, 908.0, 660.0, 367.0), np.array(LENS)
    )
    straight = undistorted(Corners(np.arange(50), seen), view).pixels
    np.testing.assert_allclose(straight, rays * [907.0, 908.0] + [660.0, 367.0], atol=1e-3)
    assert np.abs(seen - straight).max() > 1.0


@pytest.mark.parametrize("form", TO_GRAY)
def test_color_view_converts_every_format_to_gray(tmp_path: Path, form: str) -> None:
    image = capture_color_view(f"bag:{recorded(tmp_path / 'a.bag', [77], form)}", 1).image
    np.testing.assert_array_equal(image, np.full((24, 32), 77.0))


def test_gray_weighs_each_channel_by_its_luminance() -> None:
    pixel = np.array([[[200, 100, 50, 255]]], np.uint8)
    expected = 0.299 * 200 + 0.587 * 100 + 0.114 * 50
    for form, order in {
        "rgb8": [0, 1, 2],
        "bgr8": [2, 1, 0],
        "rgba8": [0, 1, 2, 3],
        "bgra8": [2, 1, 0, 3],
    }.items():
        assert TO_GRAY[form](np.ascontiguousarray(pixel[..., order]))[0, 0] == pytest.approx(
            expected, abs=0.6
        )
    luma = np.array([[91, 7]], np.uint8).view("<u2")
    assert (TO_GRAY["yuyv"](luma)[0, 0], TO_GRAY["uyvy"](luma)[0, 0]) == (91, 7)


def test_color_view_refuses_unusable_recordings(
    noise_bag: Path, rewritten: Any, tmp_path: Path
) -> None:
    def narrower(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        if topic.endswith("Color_0/image/data"):
            raw = raw.replace(struct.pack("<II", 24, 32), struct.pack("<II", 48, 16), 1)
            raw = raw.replace(
                b"rgb8\0" + struct.pack("<I", 96), b"rgb8\0" + struct.pack("<I", 48), 1
            )
        return [(time_ns, raw)]

    with pytest.raises(errors.StreamMissingError, match=r"noise\.bag.*color"):
        capture_color_view(f"bag:{noise_bag}", 5)
    source = recorded(tmp_path / "a.bag", [5])
    path = rewritten(
        lambda topic, time, raw: [] if "Color_0/tf" in topic else [(time, raw)], source=source
    )
    with pytest.raises(RecordingError, match="color"):
        capture_color_view(f"bag:{path}", 1)
    path.unlink()
    with pytest.raises(RecordingError, match="16 x 48 rgb8"):
        capture_color_view(f"bag:{rewritten(narrower, source=source)}", 1)


@pytest.mark.parametrize("uri", ["sim", "sim:bare-wall", "bag:", "kinect", "l515:x"])
def test_color_view_refuses_a_camera_that_is_not_there(uri: str) -> None:
    with pytest.raises(
        CameraError if uri.startswith("sim") else CameraNotFoundError,
        match=uri.removeprefix("l515:"),
    ):
        capture_color_view(uri, 5, sdk=FakeSdk(fake()))


def fake(brightness: Callable[[int], int] = lambda _: 100, **how: Any) -> FakeLidar:
    lidar = FakeLidar(**({"runs": (200,)} | how))
    lidar.colour = brightness
    return lidar


def test_color_view_waits_for_a_live_cameras_exposure_and_takes_the_size_that_usb_offers() -> None:
    lidar = fake(lambda number: 100 if number >= SETTLING_FRAMES else 200)
    view = capture_color_view("l515", 3, sdk=FakeSdk(lidar))
    np.testing.assert_array_equal(view.image, np.full((720, 1280), 100.0))
    np.testing.assert_array_equal(view.distortion, LENS)
    np.testing.assert_allclose(view.lidar_from_camera, LIDAR_FROM_COLOUR, atol=1e-12)
    assert lidar.did == ["start", "stop", "close"]
    view = capture_color_view("l515:f0246262", 1, sdk=FakeSdk(fake(usb="2.1")))
    assert (view.intrinsics.width, view.intrinsics.height) == (640, 480)


def test_color_view_closes_a_camera_it_refuses_or_that_fails() -> None:
    silent = fake(runs=(SETTLING_FRAMES + 1,))
    busy = fake()
    lens = fake()
    busy.start_error = RuntimeError("busy")
    lens.lens_model = "inverse_brown_conrady"
    for lidar, error, word in (
        (FakeLidar(), CameraError, "colour"),
        (lens, errors.NlosCamError, "inverse_brown_conrady"),
        (silent, errors.CameraLostError, r"0\.2 s"),
        (busy, CameraError, "busy"),
    ):
        with pytest.raises(error, match=word):
            capture_color_view("l515", 2, sdk=FakeSdk(lidar), silence_s=0.2)
    assert silent.did[-2:] == ["stop", "close"]
    assert busy.did[-1] == "close"


def test_color_view_works_on_librealsense_itself() -> None:
    sdk = StreamingColour()
    try:
        view = capture_color_view("l515", FRAMES, sdk=sdk, on_frame=sdk.on_frame)
    finally:
        sdk.end()
    np.testing.assert_array_equal(view.image, np.full((48, 64), 90.0))
    np.testing.assert_allclose(view.distortion, LENS, rtol=1e-6)
    np.testing.assert_allclose(view.lidar_from_camera, LIDAR_FROM_COLOUR, atol=1e-6)
    assert view.intrinsics == SMALL
