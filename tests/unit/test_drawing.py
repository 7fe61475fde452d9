import dataclasses

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.frames import Frame
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


def drawn(moments: list[Moment], *, with_lidar: bool = False) -> list[bytes]:
    drawing = Drawing(RIG, moments[0])
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
