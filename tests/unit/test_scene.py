"""One instant: what is refused, and the patches of surfaces whose slope is known."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.scene import CLEARANCE_M, JUMP_M, Patches, Scene

RIG = load_rig("paper-rig")
BOX = RIG.object_box
PITCH = 0.25 / 64


def _depth(z_m: float = 0.25) -> np.ndarray:
    depth = np.full((64, 64), np.nan, np.float32)
    depth[10:30, 20:50] = z_m
    return depth


def _patches(depth: np.ndarray) -> Patches:
    patches = Scene(RIG, depth).patches
    assert patches is not None
    return patches


@pytest.mark.parametrize("z_m", [0.0, -0.1, CLEARANCE_M - 1e-3, np.inf, -np.inf])
def test_depths_that_cannot_be_are_refused_with_their_range(z_m: float) -> None:
    depth = _depth()
    depth[12, 22] = z_m
    with pytest.raises(SceneError, match=r"runs from .* to .* m: .*NaN for background"):
        Scene(RIG, depth)


@pytest.mark.parametrize("shape", [(63, 64), (64,), (1, 64, 64), (0, 0)])
def test_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(SceneError, match=r"shape .*must be \(64, 64\)"):
        Scene(RIG, np.full(shape, 0.3, np.float32))


def test_an_object_needs_a_box() -> None:
    bare = load_rig("bare-wall")
    with pytest.raises(SceneError, match="object_box"):
        Scene(bare, _depth())
    with pytest.raises(SceneError, match="object_box"):
        _ = Scene(bare).box
    assert Scene(bare).patches is None


def test_nothing_hidden_has_no_patches() -> None:
    assert Scene(RIG).patches is None
    assert Scene(RIG, np.full((64, 64), np.nan, np.float32)).patches is None


def test_there_is_one_patch_per_surface_cell_at_its_centre() -> None:
    patches = _patches(_depth())
    assert len(patches.beta) == 20 * 30
    np.testing.assert_allclose(patches.point_m[:, 0], BOX.x_min_m + (patches.column + 0.5) * PITCH)
    np.testing.assert_allclose(patches.point_m[:, 1], BOX.y_max_m - (patches.row + 0.5) * PITCH)
    np.testing.assert_allclose(patches.point_m[:, 2], 0.25)
    assert patches.cell_m2 == pytest.approx(PITCH**2)


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.7, 0.0), (0.0, -0.4), (0.3, 0.5)])
def test_a_plane_has_its_own_normal_and_area_to_the_last_row_and_column(slope_x: float, slope_y: float) -> None:
    rows, columns = np.mgrid[0:64, 0:64]
    depth = np.where(np.isnan(_depth()), np.nan, 0.25 + slope_x * PITCH * columns - slope_y * PITCH * rows)
    patches = _patches((depth - 0.05).astype(np.float32))
    beta = np.sqrt(1 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(patches.beta, beta, rtol=1e-4)
    expected = np.broadcast_to(np.array([slope_x, slope_y, -1]) / beta, patches.normal.shape)
    np.testing.assert_allclose(patches.normal, expected, atol=1e-4)


def test_normals_are_unit_and_face_the_wall() -> None:
    generator = np.random.default_rng(0)
    patches = _patches((0.25 + 0.01 * generator.random((64, 64))).astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(patches.normal, axis=1), 1)
    assert (patches.normal[:, 2] < 0).all()
    assert (patches.beta >= 1).all()
    np.testing.assert_allclose(-1 / patches.normal[:, 2], patches.beta)


@pytest.mark.parametrize(("step_m", "joined"), [(0.9 * JUMP_M, True), (1.1 * JUMP_M, False)])
def test_a_step_is_one_surface_up_to_the_jump(step_m: float, joined: bool) -> None:
    depth = _depth()
    depth[:, 35:] += np.float32(step_m)
    assert (_patches(depth).beta.max() > 2) == joined


def test_a_lone_cell_is_level() -> None:
    depth = np.full((64, 64), np.nan, np.float32)
    depth[63, 63] = 0.3
    patches = _patches(depth)
    assert patches.beta.tolist() == [1.0]
    assert patches.normal.tolist() == [[0.0, 0.0, -1.0]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_every_float_and_layout_gives_the_same_patches(dtype: type[np.floating]) -> None:
    expected, found = _patches(_depth()), _patches(np.asfortranarray(_depth().astype(dtype)))
    np.testing.assert_allclose(found.point_m, expected.point_m, rtol=1e-3)
    np.testing.assert_array_equal(found.row, expected.row)
