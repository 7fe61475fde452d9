"""Python API: the frames of the commands, late imports, and cameras that are started and
stopped.
"""

import doctest
import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import made_benches
import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from fake_wall import SERIAL, WallCamera, bare_wall, measured_wall, write_wall
from nlos_calibration.errors import RecordFileError
from nlos_models.errors import CheckpointError
from small_frames import SheetNetwork

import nlos_cam
from nlos_cam import api
from nlos_cam.api import Stream
from nlos_cam.bench import TEST_IOU, ForecastRecord, edit_bench, load_bench
from nlos_cam.camera.protocol import Camera
from nlos_cam.errors import CameraNotFoundError, NlosCamError
from nlos_cam.forecast import FORECAST_VERSION
from nlos_cam.live import BackgroundPhysicsCheck
from nlos_cam.reconstruct import FrameResult, PeriodicPhysicsCheck

LATE = """
import json, sys
sys.modules["pyrealsense2"] = None
import nlos_cam
before = sorted(sys.modules)
with nlos_cam.open("bag:" + sys.argv[1]) as stream:
    frames = sum(1 for seen in stream)
print(json.dumps([before, frames]))
"""
Open = Callable[..., Stream]


class HalfSurface(SheetNetwork):
    """Network that sees surface in the left half of the box alone."""

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        return super().__call__(depth_m, intensity) * (np.arange(64) < 32)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Open:
    """Open the stream of a given camera with networks that take no time."""
    monkeypatch.setattr(api.reconstruct, "load_networks", lambda *_: HalfSurface())
    monkeypatch.setattr(api.reconstruct, "load_uncertainty", lambda *_: FakeUncertainty())

    def make(camera: Camera, uri: str = "bag:fake.bag", **options: Any) -> Stream:
        monkeypatch.setattr(api, "open_camera", lambda *_, **__: camera)
        return nlos_cam.open(uri, **options)

    return make


@pytest.mark.slow
def test_doctest_of_api_runs_on_recording(
    recorded: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path / "run.bag", 3)
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(api)

    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.slow
def test_import_is_cheap_and_recording_needs_no_sdk(noise_bag: Path) -> None:
    run = [sys.executable, "-c", LATE, str(noise_bag)]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=250, check=True)
    before, frames = json.loads(ended.stdout)

    assert not {"numpy", "torch", "cv2", "nlos_cam.api"} & set(before)
    assert frames == 20


@pytest.mark.parametrize("average", [0, -1, 1001])
def test_average_out_of_range_is_refused(average: int) -> None:
    with pytest.raises(NlosCamError, match=f"average is {average}"):
        api.open_stream("bag:sample", average=average)


def test_stream_of_recording_resumes_after_a_break(opened: Open) -> None:
    with opened(WallCamera(9)) as stream:
        seen = [next(stream), next(stream)]
        for one in stream:
            seen.append(one)
            if one.frame_number == 4:
                break
        seen += list(stream)

    assert [one.frame_number for one in seen] == list(range(9))
    assert [one.timestamp_s for one in seen] == [number / 30 for number in range(9)]
    assert stream.dropped == 0
    (note,) = stream.notes
    assert "no wall was measured" in note


def test_notes_say_that_a_benchs_own_weights_fall_short(
    opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nlos_cam.calibrate.files.report_html", lambda *_: "report")
        made_benches.write_wall(tmp_path / "bench", measured_wall(tmp_path))
    rig_checksum = load_bench(tmp_path / "bench").rig.checksum
    with edit_bench(tmp_path / "bench") as edit:
        edit.set_forecast(
            "main",
            ForecastRecord(version=FORECAST_VERSION, rig_checksum=rig_checksum, expected_iou=0.64),
        )
    own = HalfSurface()
    own.record.rig_checksum = rig_checksum
    own.record.figures = {TEST_IOU: 0.45}
    stream = opened(WallCamera(1), bench=tmp_path / "bench")
    fine = stream.notes
    monkeypatch.setattr(api.reconstruct, "load_networks", lambda *_: own)

    stream = opened(WallCamera(1), bench=tmp_path / "bench")

    assert stream.notes != fine
    assert any("0.45" in note and "where 0.64 is expected" in note for note in stream.notes)


def test_lost_weights_of_a_bench_do_not_matter_beside_others(
    opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def load(folder: Path, *, weights: bool) -> Any:
        asked.append(weights)
        raise RecordFileError(f"{folder}: seen")

    monkeypatch.setattr(api, "load_bench", load)
    for chosen in (None, "any"):
        with pytest.raises(RecordFileError, match="seen"):
            opened(WallCamera(1), bench=tmp_path / "bench", weights=chosen)

    assert asked == [True, False]


@pytest.mark.parametrize(
    ("uri", "kind"), [("bag:fake.bag", PeriodicPhysicsCheck), ("sim", BackgroundPhysicsCheck)]
)
def test_stream_checks_its_pictures_as_commands_do(
    opened: Open, monkeypatch: pytest.MonkeyPatch, uri: str, kind: type
) -> None:
    entered: list[object] = []
    monkeypatch.setattr(kind, "__enter__", lambda self: entered.append(self) or self)
    monkeypatch.setattr(kind, "__exit__", lambda *_: None)
    with opened(WallCamera(3), uri) as stream:
        next(stream)

    assert len(entered) == 1


def test_recorded_picture_has_its_own_check(opened: Open) -> None:
    with opened(WallCamera(2)) as stream:
        seen = next(stream)

    assert seen.check is not None
    assert seen.check.frame_number == seen.frame_number


def test_points_are_surface_in_wall_frame(opened: Open) -> None:
    with opened(WallCamera(1)) as stream:
        seen = next(stream)
    box = stream.rig.object_box

    assert seen.points_m.shape == (64 * 32, 3)
    assert seen.points_m.dtype == np.float32

    middle_x_m = (box.x_min_m + box.x_max_m) / 2
    pitch_y_m = (box.y_max_m - box.y_min_m) / 64

    assert seen.points_m[:, 0].min() > box.x_min_m
    assert seen.points_m[:, 0].max() < middle_x_m
    np.testing.assert_allclose(
        seen.points_m[[0, -1], 1], [box.y_max_m - pitch_y_m / 2, box.y_min_m + pitch_y_m / 2]
    )
    np.testing.assert_array_equal(seen.points_m[:, 2], seen.depth_m[np.isfinite(seen.depth_m)])
    assert {*map(tuple, seen.points_m)} <= {
        *map(tuple, seen.to_mesh().vertices_m.astype(np.float32))
    }


class WatchedCamera(WallCamera):
    """Camera that reports when its frames are delivered."""

    def __init__(self, frames: int) -> None:
        super().__init__(frames)
        self.given = threading.Event()

    def __iter__(self) -> Iterator[Any]:
        yield from super().__iter__()
        self.given.set()


def test_stream_stops_camera_after_error_and_needs_a_start(opened: Open) -> None:
    camera = WallCamera(10**9)
    stream = opened(camera, "sim")
    with pytest.raises(NlosCamError, match="started"):
        next(stream)
    with pytest.raises(ZeroDivisionError), stream:
        next(stream).frame_number // 0

    assert camera.closed.is_set()
    with pytest.raises(NlosCamError, match="start another"), stream:
        pytest.fail("its checks have ended")


def test_stream_that_cannot_start_leaves_its_camera(
    opened: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = WallCamera(10**9)
    stream = opened(camera, "sim")
    monkeypatch.setattr(threading.Thread, "start", Mock(side_effect=RuntimeError("no thread")))

    with pytest.raises(RuntimeError, match="no thread"), stream:
        pass

    assert camera.closed.is_set()


def test_stream_of_live_camera_drops_and_counts_old_frames(opened: Open) -> None:
    camera = WatchedCamera(20)
    with opened(camera, "sim") as stream:
        assert camera.given.wait(30.0)
        taken = [seen.frame_number for seen in stream]

    assert taken == [17, 18, 19]
    assert stream.dropped == 17


def test_stream_applies_wall_and_average(opened: Open, tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall())
    camera = WallCamera(80, moved=range(40, 80))

    assert camera.identity["serial"] == SERIAL

    with opened(camera, wall=str(wall), average=4) as stream:
        seen = list(stream)

    assert stream.rig.name == "measured"
    new = [[text for text in seen[at].warnings if text not in stream.notes] for at in (20, -1)]

    assert [bool(warnings) for warnings in new] == [False, True]

    single, mean = (
        np.nanstd(one.difference.depth_m) for one in (seen[0], seen[30]) if one.difference
    )

    assert mean < 0.75 * single


@pytest.mark.parametrize(
    ("uri", "options", "error"),
    [
        ("l616", {}, CameraNotFoundError),
        ("bag:noise", {"wall": "none.toml"}, RecordFileError),
        ("bag:noise", {"weights": "none"}, CheckpointError),
    ],
)
def test_open_raises_package_errors(
    noise_bag: Path, uri: str, options: dict[str, str], error: type
) -> None:
    with pytest.raises(error):
        nlos_cam.open(uri.replace("noise", str(noise_bag)), **options)


def test_package_exports_result_stream_and_open() -> None:
    assert nlos_cam.FrameResult is FrameResult
    assert nlos_cam.Stream is Stream
    assert nlos_cam.open is api.open_stream


def test_package_has_no_other_names() -> None:
    with pytest.raises(AttributeError, match="close"):
        nlos_cam.close  # type: ignore[attr-defined]  # noqa: B018  looked up, which is what raises
