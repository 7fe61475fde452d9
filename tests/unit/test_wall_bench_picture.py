from collections.abc import Callable

import cv2
import numpy as np
import pytest
from nlos_calibration.rig_check import footprint, on_plane
from nlos_calibration.wall_record import MeasuredWall, OccluderRecord, WallRecord

from nlos_cam.calibrate.report_drawings import X, Y, Z, _corner_rays, _facing, _reached, bench_picture, drawn_limits

Measured = Callable[..., MeasuredWall]
ENTERED = OccluderRecord(source="entered", x_m=0.2, gap_m=0.1)


def pixels(record: WallRecord) -> np.ndarray:
    """The picture (height, width, 3), blue first."""
    drawn = bench_picture(record).png
    assert drawn is not None
    return cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR).astype(int)


def share_like(image: np.ndarray, blue: int, green: int, red: int) -> float:
    return float((np.abs(image - (blue, green, red)).max(axis=-1) < 25).mean())


@pytest.mark.parametrize(
    ("distance_m", "yaw_deg", "pitch_deg"), [(0.2, 45, 0), (0.35, 80, 5), (0.15, -60, -12), (1, 1, 0)]
)
def test_all_that_the_bench_has_is_in_the_picture(
    measured: Measured, distance_m: float, yaw_deg: float, pitch_deg: float
) -> None:
    rig = measured(distance_m, yaw_deg, pitch_deg).record.rig
    limits, box = drawn_limits(rig), rig.object_box
    assert box is not None
    near, far = (box.x_min_m, box.y_min_m, box.z_near_m), (box.x_max_m, box.y_max_m, box.z_far_m)
    for axis, (low, high) in enumerate(limits):
        assert low < min(near[axis], 0.0, rig.wall_from_lidar[axis, 3])
        assert high > max(far[axis], rig.wall_from_lidar[axis, 3])
        assert high - low < 1.6
    assert pixels(measured(distance_m, yaw_deg, pitch_deg).record).std() > 10.0


def test_the_optical_axis_ends_on_the_wall_where_there_is_room(measured: Measured) -> None:
    rig = measured(0.2, 45.0, 5.0).record.rig
    meets = on_plane(rig.wall_from_lidar, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(_reached(rig), [*meets, 0.0], atol=1e-9)
    oblique = _reached(measured(0.35, 80.0).record.rig)
    assert oblique[Z] > 0.0
    assert 0.5 < np.hypot(oblique[X], oblique[Y]) < 1.0


def test_the_views_corners_are_the_footprints(measured: Measured) -> None:
    rig = measured(0.2, 30.0, 4.0).record.rig
    corners_m = footprint(rig.wall_from_lidar, rig.pinhole, rig.wall).corners_m
    np.testing.assert_allclose(on_plane(rig.wall_from_lidar, _corner_rays(rig)), corners_m)


def test_an_occluder_that_nobody_measured_is_only_outlined(measured: Measured) -> None:
    record = measured().record
    known = record.model_copy(update={"occluder": ENTERED})
    assert "nobody has measured it" in bench_picture(record).caption
    assert "The occluder was entered." in bench_picture(known).caption
    black_if_known, black_if_not = (share_like(pixels(each), 0, 0, 0) for each in (known, record))
    assert black_if_known > 1.15 * black_if_not


def test_a_rig_without_occluder_and_box_is_drawn_without(measured: Measured) -> None:
    record = measured().record
    bare = record.model_copy(update={"rig": record.rig.model_copy(update={"occluder": None, "object_box": None})})
    orange = 0, 95, 217
    assert "no occluder" in bench_picture(bare).caption
    assert share_like(pixels(record), *orange) > 0.0
    assert share_like(pixels(bare), *orange) == 0.0


def test_the_yaw_is_told_where_it_is_not_all_of_the_facing_angle(measured: Measured) -> None:
    assert _facing(measured(0.2, -45.0, 0.0).record) == "45.0°"
    assert _facing(measured(0.2, 30.0, 10.0).record) == "31.5°\n(yaw +30.0°)"
