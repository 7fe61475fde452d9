"""Line of sight: rays from the lidar against objects whose place a ruler tells."""

import numpy as np
import pytest
from nlos_calibration.rig import ObjectBox, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.line_of_sight import first_hits
from nlos_cam.render.material import Surface
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts
from nlos_cam.render.visibility import height_field

PAPER = load_rig("paper-rig")
OPEN = load_rig("bare-wall").model_copy(update={"object_box": PAPER.object_box})
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
BOX = ObjectBox(x_min_m=0, x_max_m=1, y_min_m=0, y_max_m=1, z_near_m=0.1, z_far_m=1)


def _hit(depth: np.ndarray, start: list[float], towards: list[float]) -> tuple[float, float, int, int]:
    ray = np.array(towards) - start
    length = float(np.linalg.norm(ray))
    slope = np.zeros((2, *depth.shape))
    found = first_hits(
        height_field(depth, BOX, shades=True), slope, np.array(start), ray[None] / length, np.array([length])
    )
    return float(found[0][0]) / length, float(found[1][0]), int(found[2][0]), int(found[3][0])


def test_a_ray_meets_a_column_by_its_front_or_by_its_side() -> None:
    depth = np.full((4, 4), np.nan)
    depth[1, 2] = 0.5  # x in 0.5 to 0.75, y in 0.5 to 0.75
    share, cosine, row, column = _hit(depth, [0.6, 0.6, 0.0], [0.6, 0.6, 1.0])
    assert (share, cosine, row, column) == pytest.approx((0.5, 1.0, 1, 2))
    share, cosine, row, column = _hit(depth, [0.0, 0.6, 0.8], [1.0, 0.6, 0.8])
    assert (share, cosine, row, column) == pytest.approx((0.5, 1.0, 1, 2))
    assert _hit(depth, [0.0, 0.6, 0.3], [1.0, 0.6, 0.3])[0] == np.inf  # between the object and the wall
    assert _hit(depth, [0.0, 0.2, 0.8], [1.0, 0.2, 0.8])[0] == np.inf  # past it
    assert _hit(depth, [0.0, 0.6, 0.8], [0.4, 0.6, 0.8])[0] == np.inf  # not so far


def test_the_papers_rig_sees_nothing_of_its_box() -> None:
    assert SceneFacts(Scene(PAPER, np.full((8, 8), 0.12, np.float32)), COARSE).sight is None


def test_what_is_in_sight_stops_beams_before_the_wall_and_hides_relay_cells_behind_it() -> None:
    depth = np.full((8, 8), 0.06, np.float32)
    stage = SceneFacts(Scene(OPEN, depth, Surface(0.5)), COARSE)
    sight, beams = stage.sight, stage.beams()
    assert sight is not None
    assert sight.beam.size
    assert sight.hidden.any()
    free = np.nan_to_num(beams.length_m[sight.beam], nan=np.inf)
    assert (sight.length_m < free).all()
    point = beams.lidar_m + sight.length_m[:, None] * beams.direction[sight.beam]
    assert (point[:, 2] >= 0.06 - 1e-9).all()
    assert (stage.relay.x_m[sight.hidden] > 0.3).all()
    ready = Prepared.of(stage.scene, COARSE, "auto")
    np.testing.assert_allclose(ready.beams.length_m[sight.beam], sight.length_m)
    assert not ready.beams.on_wall[sight.beam].any()
    assert len(ready.relay.x_m) == (~sight.hidden).sum()
    white = Prepared.of(Scene(OPEN, depth), COARSE, "auto").beams.direct[sight.beam]
    np.testing.assert_allclose(ready.beams.direct[sight.beam], 0.5 * white)


def test_a_lidar_inside_the_object_is_refused() -> None:
    box = ObjectBox(x_min_m=-0.1, x_max_m=0.1, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.05, z_far_m=0.4)
    around = OPEN.model_copy(update={"object_box": box})
    with pytest.raises(SceneError, match=r"surrounds the lidar, 0.2 m off the wall: move it or the lidar"):
        _ = SceneFacts(Scene(around, np.full((8, 8), 0.1, np.float32)), COARSE).sight
