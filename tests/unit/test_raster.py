"""The rasteriser against planes, boxes and spheres whose depth is known."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import ObjectBox

from nlos_cam.objects.depth_map import cell_centres_m, orthographic_depth, share_outside

BOX = ObjectBox(x_min_m=0.0, x_max_m=0.64, y_min_m=-0.32, y_max_m=0.32, z_near_m=0.1, z_far_m=0.6)
X, Y = np.meshgrid(*cell_centres_m(BOX))


def _quad(z: tuple[float, float, float, float], low: float = -1.0, high: float = 1.0) -> np.ndarray:
    """Two triangles over a square; z at (low, low), (high, low), (high, high), (low, high)."""
    a, b, c, d = ((x, y, k) for (x, y), k in zip([(low, low), (high, low), (high, high), (low, high)], z, strict=True))
    return np.array([[a, b, c], [a, c, d]])


def _triangles(mesh: trimesh.Trimesh, centre: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(mesh.triangles, float) + centre


def test_a_level_plane_fills_every_cell_with_its_depth() -> None:
    np.testing.assert_allclose(orthographic_depth(_quad((0.3, 0.3, 0.3, 0.3)), BOX), 0.3, rtol=1e-6)


def test_a_tilted_plane_has_the_planes_depth_at_every_centre() -> None:
    def plane(x: float, y: float) -> float:
        return 0.3 + 0.1 * x - 0.05 * y

    corners = plane(-1, -1), plane(1, -1), plane(1, 1), plane(-1, 1)
    np.testing.assert_allclose(orthographic_depth(_quad(corners), BOX), plane(X, Y), rtol=1e-6)


@pytest.mark.parametrize("corner", [0.0, 0.1, 1 / 3, 0.123456789])
def test_triangles_that_share_an_edge_leave_no_hole(corner: float) -> None:
    """The shared edge runs through the centres of many cells."""
    middle_x, middle_y = X[31, 31] + corner * 0.01, Y[31, 31]
    ring = [(-3, -3), (3, -3), (3, 3), (-3, 3), (-3, -3)]
    fan = [[(middle_x, middle_y, 0.3), (*a, 0.3), (*b, 0.3)] for a, b in pairwise(ring)]
    assert np.isfinite(orthographic_depth(np.array(fan, float), BOX)).all()


def test_the_diagonal_of_a_square_leaves_no_hole() -> None:
    for low, high in [(-0.32, 0.64), (X[0, 0] - 0.64, X[0, 0] + 0.64), (-1.0, 1.3), (-0.7, 0.9)]:
        square = _quad((0.3, 0.3, 0.3, 0.3), low, high)
        inside = (low < X) & (high > X) & (low < Y) & (high > Y)
        assert np.isfinite(orthographic_depth(square, BOX)[inside]).all()


def test_a_sphere_shows_its_near_half() -> None:
    radius, centre = 0.2, (0.3, 0.05, 0.4)
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    depth = orthographic_depth(_triangles(sphere, centre), BOX)
    from_axis = np.hypot(X - centre[0], Y - centre[1])
    assert np.isnan(depth[from_axis > radius]).all()
    inside = from_axis < 0.95 * radius
    np.testing.assert_allclose(depth[inside], centre[2] - np.sqrt(radius**2 - from_axis[inside] ** 2), atol=1e-3)


def test_a_box_shows_its_front_in_the_cells_it_covers() -> None:
    solid = trimesh.creation.box(extents=(0.2, 0.1, 0.08))
    depth = orthographic_depth(_triangles(solid, (0.32, 0.1, 0.3)), BOX)
    inside = (np.abs(X - 0.32) < 0.1) & (np.abs(Y - 0.1) < 0.05)
    np.testing.assert_allclose(depth[inside], 0.26, rtol=1e-6)
    assert np.isnan(depth[~inside]).all()


def test_row_0_is_at_the_top_and_column_0_at_the_least_x() -> None:
    small = trimesh.creation.box(extents=(0.05, 0.05, 0.05))
    depth = orthographic_depth(_triangles(small, (0.05, 0.28, 0.3)), BOX)
    rows, columns = np.nonzero(~np.isnan(depth))
    assert rows.max() < 10
    assert columns.max() < 10


def test_neither_the_order_nor_the_winding_of_triangles_matters() -> None:
    generator = np.random.default_rng(0)
    soup = generator.uniform((-0.1, -0.4, 0.1), (0.7, 0.4, 0.6), (60, 3, 3))
    depth = orthographic_depth(soup, BOX)
    np.testing.assert_array_equal(orthographic_depth(generator.permutation(soup), BOX), depth)
    np.testing.assert_allclose(orthographic_depth(soup[:, ::-1], BOX), depth, atol=1e-6)


def test_the_nearest_surface_wins() -> None:
    both = np.concatenate([_quad((0.5, 0.5, 0.5, 0.5)), _quad((0.2, 0.2, 0.2, 0.2), 0.0, 0.3)])
    depth = orthographic_depth(both, BOX)
    front = (X > 0) & (X < 0.3) & (Y > 0) & (Y < 0.3)
    np.testing.assert_allclose(depth[front], 0.2, rtol=1e-6)
    np.testing.assert_allclose(depth[~front], 0.5, rtol=1e-6)


def test_what_is_seen_edge_on_lies_elsewhere_or_is_not_there_leaves_nothing() -> None:
    edge_on = np.array([[(0.3, -1, 0.2), (0.3, 1, 0.2), (0.3, 0, 0.5)]])
    elsewhere = np.array([[(2.0, 0, 0.3), (3.0, 0, 0.3), (2.5, 1, 0.3)]])
    for triangles in (edge_on, elsewhere, np.empty((0, 3, 3))):
        assert np.isnan(orthographic_depth(triangles, BOX)).all()


def test_every_dtype_and_layout_gives_the_same() -> None:
    square = _quad((0.3, 0.3, 0.4, 0.4))
    depth = orthographic_depth(square, BOX)
    np.testing.assert_array_equal(orthographic_depth(np.asfortranarray(square), BOX), depth)
    np.testing.assert_allclose(orthographic_depth(square.astype(np.float32), BOX), depth, rtol=1e-6)


def test_it_works_at_other_resolutions() -> None:
    assert orthographic_depth(_quad((0.3, 0.3, 0.3, 0.3)), BOX, pixels=17).shape == (17, 17)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("side", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_the_share_of_a_plate_beside_the_box_is_what_sticks_out(share: float, side: tuple[int, int]) -> None:
    plate = trimesh.creation.box(extents=(0.1, 0.1, 0.01))
    x, y = (s * (0.32 - 0.05 + 0.1 * share) for s in side)
    assert share_outside(_triangles(plate, (0.32 + x, y, 0.3)), BOX) == pytest.approx(share, abs=0.01)


def test_the_share_counts_the_silhouette_not_the_layers() -> None:
    inside, outside = _quad((0.3, 0.3, 0.3, 0.3), 0.1, 0.2), _quad((0.3, 0.3, 0.3, 0.3), 0.65, 0.75)
    layers = [outside + np.array((0, 0, 0.1 * k)) for k in range(4)]
    assert share_outside(np.concatenate([inside, *layers]), BOX) == pytest.approx(0.5)


def test_nothing_is_outside_of_what_fits_or_is_seen_edge_on() -> None:
    edge_on = np.array([[(3.0, -1, 0.2), (3.0, 1, 0.2), (3.0, 0, 0.5)]])
    sliver = np.array(
        [
            [(3.0, -1, 0.2), (3.5, 0.37, 0.2), (3.5, 0.37 + 1e-9, 0.5)],
            [(4.0, 1, 0.2), (4.0 - 1e-6, 1, 0.2), (4, 1 - 1e-6, 0.2)],
        ]
    )
    exact = np.array([[(0.0, -0.32, 0.2), (0.64, -0.32, 0.2), (0.64, 0.32 + 1e-12, 0.2)]])
    assert [share_outside(triangles, BOX) for triangles in (edge_on, sliver, exact)] == [0, 0, 0]
