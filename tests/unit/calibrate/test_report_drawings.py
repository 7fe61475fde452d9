from collections.abc import Callable

import numpy as np
import pytest
from nlos_calibration import Extent, MeasuredWall, OccluderRecord, WallRecord
from page_reader import decoded

from nlos_cam.calibrate.report_drawings import (
    _facing,
    bench_picture,
    drawn_limits,
    footprint_picture,
)
from nlos_cam.report import Picture

pytestmark = pytest.mark.slow
Measured = Callable[..., MeasuredWall]
ENTERED = OccluderRecord(source="entered", x_m=0.2, gap_m=0.1)


def share_like(picture: Picture, red: int, green: int, blue: int) -> float:
    return float((np.abs(decoded(picture.png) - (red, green, blue)).max(axis=-1) < 25).mean())


def blue_share(record: WallRecord) -> float:
    image = decoded(footprint_picture(record).png)
    return float((image[..., 2] - image[..., 0] > 20).mean())


def with_rig(record: WallRecord, **changes: object) -> WallRecord:
    return record.model_copy(update={"rig": record.rig.model_copy(update=changes)})


@pytest.mark.parametrize(
    ("distance_m", "yaw_deg", "pitch_deg"),
    [(0.2, 45, 0), (0.35, 80, 5), (0.15, -60, -12), (1, 1, 0)],
)
def test_picture_holds_the_whole_bench(
    measured: Measured, distance_m: float, yaw_deg: float, pitch_deg: float
) -> None:
    rig = measured(distance_m, yaw_deg, pitch_deg).record.rig
    limits = drawn_limits(rig)
    box = rig.object_box
    near = (box.x_min_m, box.y_min_m, box.z_near_m)
    far = (box.x_max_m, box.y_max_m, box.z_far_m)
    for axis, (low, high) in enumerate(limits):
        assert low < min(near[axis], 0.0, rig.wall_from_lidar[axis, 3])
        assert high > max(far[axis], rig.wall_from_lidar[axis, 3])
        assert high - low < 1.6

    assert decoded(bench_picture(measured(distance_m, yaw_deg, pitch_deg).record).png).std() > 10.0


def test_bench_picture_only_outlines_an_assumed_occluder(measured: Measured) -> None:
    record = measured().record
    assumed, known = (
        bench_picture(record.model_copy(update={"occluder": each})) for each in (None, ENTERED)
    )

    assert "entered" in known.caption
    assert "entered" not in assumed.caption
    assert share_like(known, 0, 0, 0) > 1.15 * share_like(assumed, 0, 0, 0)


def test_bench_picture_without_occluder_and_box_has_none(measured: Measured) -> None:
    record = measured().record
    orange = (217, 95, 0)
    bare = bench_picture(with_rig(record, occluder=None, object_box=None))

    assert "no occluder" in bare.caption
    assert share_like(bench_picture(record), *orange) > 0.0
    assert share_like(bare, *orange) == 0.0


def test_bench_picture_names_the_yaw_beside_the_facing_angle(measured: Measured) -> None:
    assert _facing(measured(0.2, -45.0, 0.0).record) == "45.0°"
    assert _facing(measured(0.2, 30.0, 10.0).record) == "31.5°\n(yaw +30.0°)"


def test_footprint_picture_grows_with_the_distance(measured: Measured) -> None:
    seen = [blue_share(measured(distance_m, 1.0, 0.0).record) for distance_m in (0.10, 0.2, 0.3)]

    assert 0.0 < seen[0] < seen[1] < seen[2]
    assert blue_share(measured(0.2, 70.0, 8.0).record) > 0.05


def test_footprint_picture_tells_the_share_on_the_wall(measured: Measured) -> None:
    record = measured(0.2, 1.0, 0.0).record

    assert " 100 % " in footprint_picture(record).caption

    as_far_as_the_axis = Extent(
        x_min_m=-1.0, x_max_m=0.2 * np.tan(np.radians(1.0)), y_min_m=-1.0, y_max_m=1.0
    )

    assert " 50 % " in footprint_picture(with_rig(record, wall=as_far_as_the_axis)).caption

    bare = footprint_picture(with_rig(record, occluder=None, object_box=None))

    assert bare.png != footprint_picture(record).png
