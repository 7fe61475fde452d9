"""Patches of surfaces whose slope and area are known, and blocks of them."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.patches import JUMP_M, Patches, clustered, coarser, make_patches, slope_along

BOX = load_rig("paper-rig").object_box
assert BOX is not None
PITCH = 0.25 / 64


def _depth(z_m: float = 0.25) -> np.ndarray:
    depth = np.full((64, 64), np.nan)
    depth[10:30, 20:50] = z_m
    return depth


def _patches(depth: np.ndarray, albedo: float = 1.0) -> Patches:
    return make_patches(depth, BOX, np.full(depth.shape, albedo))


def test_there_is_one_patch_per_surface_cell_at_its_centre() -> None:
    patches = _patches(_depth())
    assert len(patches.beta) == 20 * 30
    np.testing.assert_allclose(patches.point_m[:, 0], BOX.x_min_m + (patches.column + 0.5) * PITCH)
    np.testing.assert_allclose(patches.point_m[:, 1], BOX.y_max_m - (patches.row + 0.5) * PITCH)
    np.testing.assert_allclose(patches.point_m[:, 2], 0.25)
    assert patches.cell_m2 == pytest.approx(PITCH**2)
    assert patches.diagonal_m == pytest.approx(PITCH * np.sqrt(2))


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.7, 0.0), (0.0, -0.4), (0.3, 0.5)])
def test_a_plane_has_its_own_normal_and_area_to_the_last_row_and_column(slope_x: float, slope_y: float) -> None:
    rows, columns = np.mgrid[0:64, 0:64]
    patches = _patches(_depth(0.2) + slope_x * PITCH * columns - slope_y * PITCH * rows)
    beta = np.sqrt(1 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(patches.beta, beta)
    np.testing.assert_allclose(patches.area_m2, beta * PITCH**2)
    np.testing.assert_allclose(patches.slope, np.broadcast_to([slope_x, slope_y], patches.slope.shape), atol=1e-9)
    expected = np.broadcast_to(np.array([slope_x, slope_y, -1]) / beta, patches.normal.shape)
    np.testing.assert_allclose(patches.normal, expected, atol=1e-9)
    level = patches.level()
    assert (level.beta == 1).all()
    assert (level.normal == [0, 0, -1]).all()


def test_normals_are_unit_and_face_the_wall() -> None:
    patches = _patches(0.25 + 0.01 * np.random.default_rng(0).random((64, 64)))
    np.testing.assert_allclose(np.linalg.norm(patches.normal, axis=1), 1)
    assert (patches.normal[:, 2] < 0).all()
    np.testing.assert_allclose(-1 / patches.normal[:, 2], patches.beta)


@pytest.mark.parametrize(("step_m", "joined"), [(0.9 * JUMP_M, True), (1.1 * JUMP_M, False)])
def test_a_step_is_one_surface_up_to_the_jump(step_m: float, joined: bool) -> None:
    depth = _depth()
    depth[:, 35:] += step_m
    assert (_patches(depth).beta.max() > 2) == joined


def test_a_lone_cell_is_level() -> None:
    depth = np.full((64, 64), np.nan)
    depth[63, 63] = 0.3
    patches = _patches(depth)
    assert patches.beta.tolist() == [1.0]
    assert patches.normal.tolist() == [[0.0, 0.0, -1.0]]


def test_a_difference_is_forward_and_backward_at_the_end() -> None:
    row = np.array([[1.0, 1.01, 1.015, np.nan, 1.0, 2.0]])
    np.testing.assert_allclose(slope_along(row, 1, 0.5)[0], [0.02, 0.01, 0.01, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(slope_along(row.T, 0, 0.5)[:, 0], slope_along(row, 1, 0.5)[0])


@pytest.mark.parametrize("stride", [2, 4])
def test_blocks_hold_as_much_area_albedo_and_tilt_as_their_cells(stride: int) -> None:
    generator = np.random.default_rng(1)
    depth = 0.25 + 0.002 * generator.random((16, 16))
    depth[:5, :7] = np.nan
    patches = make_patches(depth, BOX, generator.random((16, 16)))
    blocks = clustered(patches, stride, 16 // stride)
    for part in (patches, blocks):
        assert (part.beta > 0).all()
    given = [(p.albedo * p.area_m2)[:, None] * p.normal for p in (patches, blocks)]
    np.testing.assert_allclose(given[1].sum(0), given[0].sum(0))
    np.testing.assert_allclose(np.linalg.norm(blocks.normal, axis=1), 1)
    assert blocks.cell_m2 == pytest.approx(stride**2 * patches.cell_m2)
    np.testing.assert_allclose(blocks.point_m[:, 2], coarser(depth, stride)[blocks.row, blocks.column])


def test_a_black_block_is_a_level_patch_without_albedo() -> None:
    blocks = clustered(_patches(_depth(), 0.0), 2, 32)
    assert (blocks.albedo == 0).all()
    assert np.isfinite(blocks.normal).all()
    assert np.isfinite(blocks.beta).all()


def test_a_coarser_map_is_the_mean_of_what_is_there() -> None:
    depth = np.full((4, 4), np.nan)
    depth[0, 0], depth[0, 1], depth[3, 3] = 1.0, 2.0, 5.0
    np.testing.assert_array_equal(coarser(depth, 2), [[1.5, np.nan], [np.nan, 5.0]])
