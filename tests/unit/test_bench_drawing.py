import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.view.drawing import _light_path, bench_parts

RIG = load_rig("paper-rig")
BOX = RIG.object_box
PARTS = dict(bench_parts(RIG))


def corners(path: str) -> np.ndarray:
    return np.array(PARTS[path].vertex_positions.as_arrow_array().to_pylist())


def test_everything_on_the_bench_is_there() -> None:
    names = {"wall", "occluder", "box", "light", "lidar", "lidar/view", "lidar/body"}
    assert set(PARTS) == {f"bench/{name}" for name in names}
    assert "bench/occluder" not in dict(bench_parts(RIG.model_copy(update={"occluder": None})))


def test_wall_and_occluder_stand_where_the_rig_says() -> None:
    assert (corners("bench/wall")[:, 2] == 0.0).all()
    np.testing.assert_allclose(corners("bench/occluder")[:, 0], RIG.occluder.x_m, rtol=1e-6)
    assert corners("bench/occluder")[:, 2].min() == pytest.approx(RIG.occluder.z_min_m)


def test_the_light_goes_from_the_lidar_by_the_wall_to_the_object_and_back() -> None:
    assert BOX is not None
    path = _light_path(RIG, BOX)
    eye = RIG.wall_from_lidar[:3, 3]
    np.testing.assert_array_equal(path[[0, 4]], [eye, eye])
    assert (path[[1, 3], 2] == 0.0).all()
    x, y, z = path[2]
    assert BOX.x_min_m < x < BOX.x_max_m
    assert BOX.y_min_m < y < BOX.y_max_m
    assert BOX.z_near_m <= z <= BOX.z_far_m


def test_a_rig_that_hides_nothing_cannot_be_drawn() -> None:
    with pytest.raises(SceneError, match="object_box"):
        dict(bench_parts(load_rig("bare-wall")))
