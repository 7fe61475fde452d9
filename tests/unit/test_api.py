"""The package from Python: the same frames as the commands, late imports, and a start and an end that are kept."""

import doctest
import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import RIG, SERIAL, WallCamera, bare_wall, write_wall
from nlos_calibration.errors import RecordFileError
from nlos_models.errors import CheckpointError

import nlos_cam
from nlos_cam import api
from nlos_cam.camera.protocol import Camera
from nlos_cam.errors import CameraNotFoundError, NlosCamError

RECORD = SimpleNamespace(rig_name=RIG.name, rig_checksum=RIG.checksum, input="raw maps")


class HalfSurface:
    """Says that the left half of the box is surface, at v 0.5."""

    runtime, record = "nothing at all", RECORD

    def __call__(self, *_: np.ndarray) -> np.ndarray:
        image = np.zeros((1, 64, 64), np.float32)
        image[..., :32] = 0.5
        return image


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[..., api.Stream]:
    """The stream of a camera that is given, by networks that need no time."""
    monkeypatch.setattr(api, "load_networks", lambda *_: HalfSurface())
    monkeypatch.setattr(api, "load_doubt", lambda *_: FakeDoubter())

    def make(camera: Camera, uri: str = "bag:fake.bag", **options: Any) -> api.Stream:
        monkeypatch.setattr(api, "open_camera", lambda *_, **__: camera)
        return nlos_cam.open(uri, **options)

    return make


def test_the_doctest_runs_on_a_recording(
    recorded: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path / "run.bag", 3)
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(api)
    assert result.attempted > 0
    assert result.failed == 0


LATE = """
import json, sys
sys.modules["pyrealsense2"] = None
import nlos_cam
before = sorted(sys.modules)
with nlos_cam.open("bag:" + sys.argv[1]) as stream:
    frames = sum(1 for seen in stream)
print(json.dumps([before, frames]))
"""


def test_the_import_is_cheap_and_a_recording_needs_no_sdk(noise_bag: Path) -> None:
    run = [sys.executable, "-c", LATE, str(noise_bag)]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=250, check=True)
    before, frames = json.loads(ended.stdout)
    assert not {"numpy", "torch", "cv2", "nlos_cam.api"} & set(before)
    assert frames == 20


def test_a_recording_gives_every_frame_and_what_replay_makes_of_it(opened: Callable[..., api.Stream]) -> None:
    with opened(WallCamera(9)) as stream:
        seen = list(stream)
    assert [one.frame_number for one in seen] == list(range(9))
    assert [one.timestamp_s for one in seen] == [number / 30 for number in range(9)]
    assert (stream.dropped, stream.notes) == (0, ())
    assert all(one.maps is one.step.maps and one.verdict is one.step.verdict for one in seen)


def test_points_are_the_surface_in_the_wall_frame(opened: Callable[..., api.Stream]) -> None:
    with opened(WallCamera(1)) as stream:
        seen = next(stream)
    box = stream.rig.object_box
    assert box is not None
    assert seen.points_m.shape == (64 * 32, 3)
    assert seen.points_m.dtype == np.float32
    middle_x_m, pitch_y_m = (box.x_min_m + box.x_max_m) / 2, (box.y_max_m - box.y_min_m) / 64
    assert seen.points_m[:, 0].min() > box.x_min_m
    assert seen.points_m[:, 0].max() < middle_x_m
    np.testing.assert_allclose(seen.points_m[[0, -1], 1], [box.y_max_m - pitch_y_m / 2, box.y_min_m + pitch_y_m / 2])
    np.testing.assert_array_equal(seen.points_m[:, 2], seen.depth_m[np.isfinite(seen.depth_m)])


def test_a_loop_that_is_left_goes_on_with_the_next_frame(opened: Callable[..., api.Stream]) -> None:
    with opened(WallCamera(5)) as stream:
        for seen in stream:
            if seen.frame_number == 1:
                break
        assert [seen.frame_number for seen in stream] == [2, 3, 4]


class EndlessCamera(WallCamera):
    """Gives frames as fast as they are read until it is left."""

    def __init__(self) -> None:
        super().__init__(10**9)
        self.left = threading.Event()

    def __exit__(self, *_: object) -> None:
        self.left.set()


def test_an_error_in_the_loop_stops_the_camera(opened: Callable[..., api.Stream]) -> None:
    camera = EndlessCamera()

    def fail_inside() -> None:
        with opened(camera, "sim") as stream:
            next(stream)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_inside()
    assert camera.left.is_set()


class PatientCamera(EndlessCamera):
    """Tells when it has given so many frames."""

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._frames, self.given = frames, threading.Event()

    def __iter__(self) -> Any:
        yield from WallCamera(self._frames)
        self.given.set()


def test_a_live_camera_is_not_held_up_and_what_is_lost_is_counted(opened: Callable[..., api.Stream]) -> None:
    camera = PatientCamera(20)
    with opened(camera, "sim") as stream:
        assert camera.given.wait(30.0)
        taken = [seen.frame_number for seen in stream]
    assert taken == [17, 18, 19]
    assert stream.dropped == 17


def test_a_wall_and_an_average_are_passed_on(opened: Callable[..., api.Stream], tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall())
    camera = WallCamera(80, moved=range(40, 80))
    assert camera.identity["serial"] == SERIAL
    with opened(camera, wall=str(wall), average=4) as stream:
        seen = list(stream)
    assert stream.rig.name == "measured"
    assert seen[0].difference is not None
    assert seen[-1].warnings
    assert not seen[20].warnings
    single = np.nanstd(seen[0].difference.depth_m)
    assert seen[30].difference is not None
    assert np.nanstd(seen[30].difference.depth_m) < 0.75 * single


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"uri": "l616"}, CameraNotFoundError),
        ({"uri": "bag:noise", "wall": "none.toml"}, RecordFileError),
        ({"uri": "bag:noise", "weights": "none"}, CheckpointError),
    ],
)
def test_what_is_not_there_is_an_error_of_its_tree(noise_bag: Path, arguments: dict[str, str], error: type) -> None:
    uri = arguments.pop("uri").replace("noise", str(noise_bag))
    with pytest.raises(error):
        nlos_cam.open(uri, **arguments)


def test_a_camera_that_was_not_started_says_so(opened: Callable[..., api.Stream]) -> None:
    with pytest.raises(NlosCamError, match="has not been started"):
        next(opened(WallCamera(1)))


def test_the_package_has_these_names_and_no_others() -> None:
    assert {name: getattr(nlos_cam, name) for name in ("Glimpse", "Stream", "open")} == {
        "Glimpse": api.Glimpse,
        "Stream": api.Stream,
        "open": api.open_stream,
    }
    with pytest.raises(AttributeError, match="no attribute 'close'"):
        nlos_cam.close  # type: ignore[attr-defined]  # noqa: B018  looked up, which is what raises
