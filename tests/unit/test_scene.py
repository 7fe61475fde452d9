"""One instant: what is refused, in one line, and what a scene tells of itself."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.material import Surface
from nlos_cam.render.scene import FINEST_GRID, Scene

RIG = load_rig("paper-rig")


def _depth(z_m: float = 0.25, cells: int = 8) -> np.ndarray:
    depth = np.full((cells, cells), np.nan, np.float32)
    depth[1:4, 2:6] = z_m
    return depth


@pytest.mark.parametrize("z_m", [-0.1, -1e-6, np.inf, -np.inf])
def test_depths_that_cannot_be_are_refused_with_their_range(z_m: float) -> None:
    depth = _depth()
    depth[2, 3] = z_m
    with pytest.raises(SceneError, match=r"runs from .* to .* m, (behind the wall|not finite): .*NaN for background"):
        Scene(RIG, depth)


def test_touching_the_wall_is_no_error() -> None:
    patches = Scene(RIG, _depth(0.0)).patches
    assert patches is not None
    assert len(patches.beta) == 12


@pytest.mark.parametrize("shape", [(7, 8), (8,), (1, 8, 8), (0, 0), (FINEST_GRID + 1, FINEST_GRID + 1)])
def test_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(SceneError, match=r"shape .*must be \(n, n\), n of 1 to 256"):
        Scene(RIG, np.full(shape, 0.3, np.float32))


@pytest.mark.parametrize("dtype", [np.int64, np.bool_, np.complex128])
def test_what_has_no_nan_is_refused(dtype: type) -> None:
    with pytest.raises(SceneError, match=r"of (int64|bool|complex128): it must be of floating point"):
        Scene(RIG, np.ones((8, 8), dtype))


@pytest.mark.parametrize("field", ["jump_m", "pulse_ns"])
@pytest.mark.parametrize("value", [-1e-9, np.inf, np.nan])
def test_a_number_out_of_range_is_refused_by_its_name(field: str, value: float) -> None:
    with pytest.raises(SceneError, match=f"{field} is .*finite number, not negative"):
        Scene(RIG, **{field: value})


def test_another_radiometry_is_refused() -> None:
    with pytest.raises(SceneError, match="no radiometry 'gothic': choose one of paper, lambertian"):
        Scene(RIG, radiometry="gothic")  # pyright: ignore[reportArgumentType]


def test_an_object_needs_a_box() -> None:
    bare = load_rig("bare-wall")
    with pytest.raises(SceneError, match="object_box"):
        Scene(bare, _depth())
    assert Scene(bare).patches is None


def test_an_albedo_of_other_cells_is_refused() -> None:
    with pytest.raises(SceneError, match=r"\(5, 5\) cells, the depth map of \(8, 8\)"):
        Scene(RIG, _depth(), Surface(np.ones((5, 5))))


def test_nothing_hidden_has_no_patches() -> None:
    assert Scene(RIG).patches is None
    assert Scene(RIG, np.full((8, 8), np.nan, np.float32)).patches is None


def test_patches_take_one_channel_of_the_albedo_or_the_mean() -> None:
    scene = Scene(RIG, _depth(), Surface(np.array([0.9, 0.6, 0.0])))
    for channel, albedo in ((None, 0.5), (0, 0.9), (2, 0.0)):
        patches = scene.patches_of(channel)
        assert patches is not None
        np.testing.assert_allclose(patches.albedo, albedo)


def test_beams_are_spread_evenly_over_the_cells() -> None:
    scene = Scene(RIG)
    one, two = scene.cell_intrinsics, scene.intrinsics(2)
    assert (one.width, one.height, two.width, two.height) == (80, 64, 160, 128)
    pairs = two.rays()[::2, ::2] + two.rays()[1::2, 1::2]
    np.testing.assert_allclose(pairs / 2, one.rays(), atol=1e-9)
