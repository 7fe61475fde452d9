"""The relay wall: its cells add up, and an occluder hides those that the lidar cannot see."""

import numpy as np
import pytest
from nlos_calibration.rig import Occluder, load_rig

from nlos_cam.render.geometry import NO_OCCLUDER, behind, occluder_edge, relay_cells

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
    assert relay.diagonal_m**2 >= 2 * relay.cell_m2 - 1e-15


def test_the_last_leg_ends_at_the_lidar_at_its_cosine() -> None:
    relay = relay_cells(BARE, LIDAR_M, 16, 12)
    points = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], axis=-1)
    np.testing.assert_allclose(relay.length_m, np.linalg.norm(points - LIDAR_M, axis=1))
    np.testing.assert_allclose(relay.cos_lidar * relay.length_m, 0.2)


def test_the_papers_occluder_hides_what_lies_beyond_its_shadows_edge() -> None:
    """From (0, 0.2) over the edge at (0.2, 0.1) the line of sight meets the wall at x = 0.4."""
    relay = relay_cells(PAPER, LIDAR_M, 80, 64)
    assert occluder_edge(PAPER) == (0.2, 0.1)
    hidden = relay.behind(occluder_edge(PAPER), LIDAR_M)
    np.testing.assert_array_equal(hidden, relay.x_m > 0.4)
    kept = relay.kept(~hidden)
    assert len(kept.x_m) == len(kept.y_m) == len(kept.cos_lidar) == 64 * 64
    assert (kept.cell_m2, kept.diagonal_m) == (relay.cell_m2, relay.diagonal_m)


def test_an_occluder_that_hangs_high_hides_nothing_and_a_low_one_all_beyond_it() -> None:
    def seen(z_min_m: float) -> np.ndarray:
        rig = BARE.model_copy(update={"occluder": Occluder(x_m=0.2, z_min_m=z_min_m)})
        relay = relay_cells(rig, LIDAR_M, 80, 64)
        return relay.kept(~relay.behind(occluder_edge(rig), LIDAR_M)).x_m

    assert len(seen(0.25)) == 80 * 64
    assert seen(1e-6).max() < 0.2


def test_no_occluder_is_an_edge_that_blocks_nothing() -> None:
    assert occluder_edge(BARE) == NO_OCCLUDER
    x = np.linspace(-5, 5, 11)
    assert not behind(NO_OCCLUDER, x, np.zeros(11), LIDAR_M).any()


def test_a_point_off_the_wall_is_hidden_where_the_edge_cuts_its_way_to_the_lidar() -> None:
    x, z = np.array([0.4, 0.4, 0.1, 0.0]), np.array([0.3, -0.1, 0.3, 0.3])
    np.testing.assert_array_equal(behind((0.2, 0.1), x, z, LIDAR_M), [True, False, False, False])
