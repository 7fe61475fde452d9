import dataclasses
from typing import Any

import numpy as np
import pytest
import rerun as rr
from measured_walls import exact_wall
from nlos_calibration.measured_wall import MeasuredWall
from nlos_calibration.rig import load_rig

from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.objects.depth_image import object_box
from nlos_cam.reconstruct import Reconstruction, pose_of
from nlos_cam.view.drawing import Drawing
from nlos_cam.view.viewer import Moment

RIG = load_rig("paper-rig")
NOTHING = np.full((64, 64), np.nan, np.float32)
SHEET = np.full((64, 64), 0.2, np.float32)


def moment(number: int, hidden_m: np.ndarray, truth_m: np.ndarray | None = None) -> Moment:
    depth_m = np.random.default_rng(number).uniform(0.2, 1.0, (480, 640)).astype(np.float32)
    ir = np.full((480, 640), 40, np.uint8)
    frame = Frame(depth_m, ir, ir, number / 30, number, RIG.pinhole, truth_depth_m=truth_m)
    return Moment(frame, Reconstruction(hidden_m, pose_of(object_box(RIG)), None, {}), number / 30, 0.02)


def drawn(moments: list[Moment], *, with_lidar: bool = False, measured: MeasuredWall | None = None) -> list[bytes]:
    drawing = Drawing(RIG, moments[0], measured)
    try:
        return [drawing.draw(each, with_lidar=with_lidar) for each in moments]
    finally:
        drawing.close()


def test_each_browsers_bytes_begin_a_recording_of_their_own() -> None:
    for _ in range(2):
        first, second = drawn([moment(0, SHEET), moment(1, SHEET)])
        assert first.startswith(b"RRF2")
        assert len(first) > len(second) > 0  # layout and bench are sent once


@pytest.mark.parametrize("path", ["reconstruction", "truth", "bench/hidden", "latency/milliseconds", "bench/occluder"])
def test_what_a_newcomer_should_see_is_in_the_recording(path: str) -> None:
    (content,) = drawn([moment(0, SHEET, SHEET)])
    assert path.encode() in content


def test_lidar_pictures_go_out_when_asked_for_and_only_then() -> None:
    (without,), (with_lidar,) = drawn([moment(0, SHEET)]), drawn([moment(0, SHEET)], with_lidar=True)
    assert len(with_lidar) > len(without) + 50_000


def test_no_truth_and_no_surface_are_drawn_too() -> None:
    assert all(drawn([moment(0, SHEET), moment(1, NOTHING), moment(2, SHEET, NOTHING)]))


def test_a_rig_without_an_occluder_is_drawn() -> None:
    drawing = Drawing(RIG.model_copy(update={"occluder": None}), moment(0, SHEET))
    assert b"bench/occluder" not in drawing.draw(moment(0, SHEET), with_lidar=False)
    drawing.close()


def test_an_odd_frame_size_is_drawn() -> None:
    odd = moment(0, SHEET)
    small = dataclasses.replace(odd.frame, depth_m=odd.frame.depth_m[:241, :321], ir=odd.frame.ir[:241, :321])
    assert drawn([dataclasses.replace(odd, frame=small)], with_lidar=True)[0]


PATHS = {
    "bench/box",
    "bench/hidden",
    "bench/lidar",
    "bench/lidar/body",
    "bench/lidar/view",
    "bench/light",
    "bench/occluder",
    "bench/wall",
    "latency/milliseconds",
    "lidar/depth",
    "lidar/infrared",
    "reconstruction",
    "truth",
}
POSE = {f"bench/measured/{name}" for name in ("footprint", "distance", "distance/end", "axis", "axis/end", "frame")}
REFERENCE = {"bench/measured/points", "wall/residual", "wall/noise", "wall/saturated"}


def ignore(*things: object) -> None:
    del things


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The paths that are logged, in their order; the layout, which goes another way, is left out."""
    paths: list[str] = []
    log = rr.RecordingStream.log

    def noted(self: rr.RecordingStream, path: str, *things: Any, **options: bool) -> None:
        paths.append(path)
        log(self, path, *things, **options)

    monkeypatch.setattr(rr.RecordingStream, "log", noted)
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", ignore)
    return paths


def differing(number: int, *warnings: str) -> Moment:
    off_m = np.full((64, 80), 0.2, np.float32)
    off_m[0] = np.nan
    difference = LidarMaps(off_m, off_m, np.isfinite(off_m))
    return dataclasses.replace(moment(number, SHEET, SHEET), difference=difference, warnings=warnings)


def test_without_a_measured_wall_nothing_of_one_is_sent(logged: list[str]) -> None:
    drawn([moment(0, SHEET, SHEET)], with_lidar=True)
    assert set(logged) == PATHS
    del logged[:]
    drawn([differing(0, "it has drifted")], with_lidar=True)
    assert set(logged) == PATHS


def test_a_measured_wall_is_drawn_once_and_its_difference_with_the_lidars_pictures(logged: list[str]) -> None:
    drawn([differing(0), differing(1), differing(2)], with_lidar=True, measured=exact_wall())
    assert set(logged) == PATHS | POSE | REFERENCE | {"calibration", "lidar/difference"}
    assert {path for path in POSE | REFERENCE if logged.count(path) != 1} == set()
    assert logged.count("lidar/difference") == 3


def test_a_wall_without_a_reference_shows_pose_and_text(logged: list[str]) -> None:
    assert drawn([moment(0, SHEET, SHEET)], with_lidar=True, measured=exact_wall(reference=None))[0]
    assert set(logged) == PATHS | POSE | {"calibration"}


def test_the_text_is_sent_again_only_when_it_says_something_else(logged: list[str]) -> None:
    moments = [differing(0), differing(1), differing(2, "drifted"), differing(3, "drifted"), differing(4)]
    texts = drawn(moments, measured=exact_wall())
    assert logged.count("calibration") == 3
    assert [b"**Now**" in text for text in texts] == [True, False, False, False, True]


def test_what_is_sent_of_a_moment_grows_by_the_difference_only() -> None:
    plain, measured = (drawn([differing(0), differing(1)], measured=wall)[1] for wall in (None, exact_wall()))
    assert len(measured) == pytest.approx(len(plain), abs=200)
