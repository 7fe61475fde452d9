"""The relay wall: its cells add up, and the occluder takes away those that the lidar cannot see."""

import numpy as np
import pytest
from nlos_calibration.rig import Occluder, load_rig

from nlos_cam.render.relay import NO_OCCLUDER, occluder_edge, relay_cells

BARE, PAPER = load_rig("bare-wall"), load_rig("paper-rig")
LIDAR_M = np.array([0.0, 0.0, 0.2])


@pytest.mark.parametrize(("columns", "rows"), [(80, 64), (40, 32), (1, 1), (7, 3)])
def test_cells_cover_the_relay_wall_exactly(columns: int, rows: int) -> None:
    relay, wall = relay_cells(BARE, LIDAR_M, columns, rows), BARE.relay
    assert len(relay.x_m) == len(relay.y_m) == len(relay.length_m) == columns * rows
    area = (wall.x_max_m - wall.x_min_m) * (wall.y_max_m - wall.y_min_m)
    assert relay.cell_m2 * columns * rows == pytest.approx(area)
    assert relay.x_m.mean() == pytest.approx((wall.x_min_m + wall.x_max_m) / 2)
    assert relay.y_m.mean() == pytest.approx((wall.y_min_m + wall.y_max_m) / 2)
    assert len(set(zip(relay.x_m, relay.y_m, strict=True))) == columns * rows


def test_the_last_leg_ends_at_the_lidar() -> None:
    relay = relay_cells(BARE, LIDAR_M, 16, 12)
    points = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], axis=-1)
    np.testing.assert_allclose(relay.length_m, np.linalg.norm(points - LIDAR_M, axis=1))


def test_the_papers_occluder_hides_what_lies_beyond_its_shadows_edge() -> None:
    """From (0, 0.2) over the edge at (0.2, 0.1) the line of sight meets the wall at x = 0.4."""
    relay = relay_cells(PAPER, LIDAR_M, 80, 64)
    assert occluder_edge(PAPER) == (0.2, 0.1)
    assert relay.x_m.max() == pytest.approx(0.4, abs=0.5 / 80)
    assert len(relay.x_m) == 64 * 64


def test_an_occluder_that_hangs_high_hides_nothing_and_a_low_one_all_beyond_it() -> None:
    def seen(z_min_m: float) -> np.ndarray:
        rig = BARE.model_copy(update={"occluder": Occluder(x_m=0.2, z_min_m=z_min_m)})
        return relay_cells(rig, LIDAR_M, 80, 64).x_m

    assert len(seen(0.25)) == 80 * 64
    assert seen(1e-6).max() < 0.2


def test_no_occluder_is_an_edge_that_blocks_nothing() -> None:
    assert occluder_edge(BARE) == NO_OCCLUDER
    assert len(relay_cells(BARE, LIDAR_M, 8, 8).x_m) == 64
