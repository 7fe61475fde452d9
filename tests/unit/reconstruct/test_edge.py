"""Laws of the cells at the occluder's edge: what a bench that is a little off can change."""

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig

from nlos_cam.reconstruct import edge_cells
from nlos_cam.render import Scene, render

HOME = load_rig("paper-rig")


def off_record(*, distance_m: float = 0.0, yaw_deg: float = 0.0) -> Rig:
    """Return the home bench with its lidar elsewhere."""
    lidar = HOME.lidar
    moved = {"distance_m": lidar.distance_m + distance_m, "yaw_deg": lidar.yaw_deg + yaw_deg}
    return HOME.model_copy(update={"lidar": lidar.model_copy(update=moved)})


@pytest.mark.parametrize("off", [{"distance_m": -0.002}, {"yaw_deg": -0.5}, {"yaw_deg": 0.5}])
def test_other_cells_see_the_same_surface_within_it(off: dict[str, float]) -> None:
    hidden = edge_cells(HOME, 0.002, 0.5)
    on_record, elsewhere = (render(Scene(rig)).depth_m for rig in (HOME, off_record(**off)))
    changed = np.abs(on_record - elsewhere) > 0.02  # from the wall to the occluder it is 0.1 m

    assert changed.any()
    assert not (changed & ~hidden).any()


def test_larger_deviations_hide_more_cells() -> None:
    sizes = [edge_cells(HOME, mm / 1e3, mm / 4).sum() for mm in (0.5, 2, 5)]

    assert sizes == sorted(sizes)
    assert 0 < sizes[0] < sizes[-1] < 64 * 80 / 4


def test_bench_without_an_occluder_hides_none() -> None:
    assert not edge_cells(HOME.model_copy(update={"occluder": None}), 0.01, 2.0).any()
