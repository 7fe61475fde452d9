from collections.abc import Callable

import cv2
import numpy as np
from nlos_calibration.rig import Extent, Rig
from nlos_calibration.wall_record import MeasuredWall, WallRecord

from nlos_cam.calibrate.report_drawings import _holds, footprint_picture

Measured = Callable[..., MeasuredWall]


def blue_share(record: WallRecord) -> float:
    """How much of the picture is seen by the lidar."""
    drawn = footprint_picture(record).png
    assert drawn is not None
    image = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR).astype(int)
    return float((image[..., 0] - image[..., 2] > 20).mean())


def with_rig(record: WallRecord, **changes: object) -> WallRecord:
    rig: Rig = record.rig.model_copy(update=changes)
    return record.model_copy(update={"rig": rig})


def test_the_nearer_the_lidar_the_less_it_sees(measured: Measured) -> None:
    seen = [blue_share(measured(distance_m, 1.0, 0.0).record) for distance_m in (0.10, 0.2, 0.3)]
    assert 0.0 < seen[0] < seen[1] < seen[2]


def test_the_caption_tells_how_many_cells_meet_the_wall(measured: Measured) -> None:
    record = measured(0.2, 1.0, 0.0).record
    assert " 100 % of the cells meet the wall" in footprint_picture(record).caption
    as_far_as_the_axis = Extent(x_min_m=-1.0, x_max_m=0.2 * np.tan(np.radians(1.0)), y_min_m=-1.0, y_max_m=1.0)
    assert " 50 % of the cells meet the wall" in footprint_picture(with_rig(record, wall=as_far_as_the_axis)).caption


def test_a_view_part_of_which_never_meets_the_wall_is_drawn(measured: Measured) -> None:
    assert blue_share(measured(0.2, 70.0, 8.0).record) > 0.05


def test_a_rig_without_occluder_and_box_is_drawn(measured: Measured) -> None:
    record = with_rig(measured().record, occluder=None, object_box=None)
    assert footprint_picture(record).png != footprint_picture(measured().record).png


def test_the_walls_edge_is_drawn_only_where_it_is_in_the_picture() -> None:
    outer = Extent(x_min_m=-1.0, x_max_m=2.0, y_min_m=-1.5, y_max_m=1.5)
    for side in ("x_min_m", "y_min_m"):
        assert not _holds(outer, outer.model_copy(update={side: -3.0}))
    for side in ("x_max_m", "y_max_m"):
        assert not _holds(outer, outer.model_copy(update={side: 3.0}))
    assert _holds(outer, outer.model_copy(update={"x_min_m": -0.5}))
