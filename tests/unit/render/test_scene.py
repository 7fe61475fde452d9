"""Scenes, materials and patches (depths out of range: tests/laws/test_hard_cases.py)."""

from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.render.material import (
    Brdf,
    Material,
    Surface,
    brdf_range,
    phong,
    retroreflective,
)
from nlos_cam.render.patches import JUMP_M, Patches, clustered, coarser, make_patches
from nlos_cam.render.scene import FINEST_GRID, Scene

RIG = load_rig("paper-rig")


def _depth(z_m: float = 0.25, cells: int = 8) -> np.ndarray:
    depth = np.full((cells, cells), np.nan, np.float32)
    depth[1:4, 2:6] = z_m
    return depth


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        *[
            ({"object_depth_m": np.full(shape, 0.3, np.float32)}, "256")
            for shape in (
                (7, 8),
                (8,),
                (1, 8, 8),
                (0, 0),
                (FINEST_GRID + 1, FINEST_GRID + 1),
            )
        ],
        *[
            ({"object_depth_m": np.ones((8, 8), kind)}, kind)
            for kind in ("int64", "bool", "complex128")
        ],
        *[
            ({name: value}, name)
            for name in ("jump_m", "pulse_ns")
            for value in (-1e-9, np.inf, np.nan)
        ],
        ({"radiometry": "gothic"}, "gothic"),
        ({"object_depth_m": [[0.2] * 8] * 8}, "list"),
        (
            {
                "object_depth_m": _depth(),
                "surface": Surface(np.ones((5, 5))),
            },
            "5",
        ),
        ({"object_depth_m": _depth(), "rig": load_rig("bare-wall")}, "object_box"),
    ],
)
def test_scene_refuses_values_that_cannot_be(fields: dict[str, Any], word: str) -> None:
    with pytest.raises(SceneError, match=word):
        Scene(**{"rig": RIG} | fields)


def test_scenes_are_equal_to_themselves_alone() -> None:
    scene = Scene(RIG, _depth())

    assert scene == scene  # noqa: PLR0124  arrays have no single truth value
    assert scene != Scene(RIG, _depth())
    assert len({scene, scene}) == 1


def test_scene_has_patches_where_an_object_is() -> None:
    for empty in (
        Scene(RIG),
        Scene(load_rig("bare-wall")),
        Scene(
            RIG,
            np.full((8, 8), np.nan, np.float32),
        ),
    ):
        assert empty.patches is None
    touching = Scene(RIG, _depth(0.0)).patches

    assert len(touching.beta) == 12


@pytest.mark.parametrize(
    "albedo",
    [
        -0.1,
        1.1,
        np.nan,
        np.inf,
        np.array([0.5, 2.0, 0.5]),
        "white",
        np.ones(2),
        np.ones((4, 4, 2)),
        np.ones((1, 4, 4, 3)),
    ],
)
def test_surface_refuses_albedos_out_of_range_or_shape(albedo: float | np.ndarray) -> None:
    with pytest.raises(SceneError, match="albedo"):
        Surface(albedo)


@pytest.mark.parametrize(
    ("shape", "channels"),
    [
        ((), 1),
        ((3,), 3),
        ((5, 5), 1),
        ((5, 5, 3), 3),
    ],
)
def test_surface_spreads_its_albedo_over_every_cell(shape: tuple[int, ...], channels: int) -> None:
    surface = Surface(np.full(shape, 0.5))

    assert surface.colored == (channels == 3)
    np.testing.assert_array_equal(
        surface.over((5, 5)),
        np.full((5, 5, channels), 0.5),
    )


def test_material_makes_the_brdf_of_its_kind() -> None:
    assert Material().surface.brdf is None
    for kind, make in (("phong", phong), ("retroreflective", retroreflective)):
        material = Material(
            kind=kind,
            specular=0.3,
            exponent=7,
            albedo=(0.1, 0.2, 0.3),
        )
        assert material.surface.colored
        assert material.brdf(0.6, 0.7, 0.8) == pytest.approx(make(0.7, 0.3, 7)(0.6, 0.7, 0.8))


@pytest.mark.parametrize(
    "brdf",
    [
        phong(0.6, 0.6, 20),
        phong(-0.1, 0.5, 20),
        retroreflective(0.5, np.nan, 20),
        phong(0.5, 0.5, -3),
        retroreflective(0.5, 0.5, np.inf),
    ],
)
def test_surface_refuses_brdfs_that_give_back_too_much(brdf: Brdf) -> None:
    with pytest.raises(SceneError, match="a BRDF"):
        Surface(1.0, brdf)


@pytest.mark.parametrize("albedo", [(0.5, 0.6), 1.5, (0.1, 0.2, -1.0), "white", True, (0.5,)])
def test_material_says_what_an_albedo_may_be(albedo: Any) -> None:
    with pytest.raises(ValidationError, match="one number from 0 to 1, or three") as refused:
        Material(albedo=albedo)

    assert [error["loc"] for error in refused.value.errors()] == [("albedo",)]


def test_brdf_range_holds_the_lobe() -> None:
    assert brdf_range(phong(0.25, 0.0, 20)) == (0.25, 0.25)
    for kind in (phong, retroreflective):
        low, high = brdf_range(kind(0.5, 0.5, 20))
        assert (low, high) == pytest.approx((0.5, 0.5 + 0.5 * 11))


BOX = load_rig("paper-rig").object_box
PITCH = 0.25 / 64


def _patches_depth(z_m: float = 0.25) -> np.ndarray:
    depth = np.full((64, 64), np.nan)
    depth[10:30, 20:50] = z_m
    return depth


def _patches(depth: np.ndarray, albedo: float = 1.0) -> Patches:
    return make_patches(depth, BOX, np.full(depth.shape, albedo))


def test_patches_lie_at_the_centers_of_surface_cells() -> None:
    patches = _patches(_patches_depth())

    assert len(patches.beta) == 20 * 30
    np.testing.assert_allclose(
        patches.point_m[:, 0],
        BOX.x_min_m + (patches.column + 0.5) * PITCH,
    )
    np.testing.assert_allclose(
        patches.point_m[:, 1],
        BOX.y_max_m - (patches.row + 0.5) * PITCH,
    )
    np.testing.assert_allclose(patches.point_m[:, 2], 0.25)
    assert patches.cell_m2 == pytest.approx(PITCH**2)
    assert patches.diagonal_m == pytest.approx(PITCH * np.sqrt(2))


@pytest.mark.parametrize(
    ("slope_x", "slope_y"),
    [
        (0.0, 0.0),
        (0.7, 0.0),
        (0.0, -0.4),
        (0.3, 0.5),
    ],
)
def test_patches_of_a_plane_have_its_normal_and_area(slope_x: float, slope_y: float) -> None:
    rows, columns = np.mgrid[0:64, 0:64]
    patches = _patches(_patches_depth(0.2) + slope_x * PITCH * columns - slope_y * PITCH * rows)
    beta = np.sqrt(1 + slope_x**2 + slope_y**2)

    np.testing.assert_allclose(patches.beta, beta)
    np.testing.assert_allclose(patches.area_m2, beta * PITCH**2)
    np.testing.assert_allclose(
        patches.slope,
        np.broadcast_to(
            [slope_x, slope_y],
            patches.slope.shape,
        ),
        atol=1e-9,
    )

    expected = np.broadcast_to(
        np.array([slope_x, slope_y, -1]) / beta,
        patches.normal.shape,
    )

    np.testing.assert_allclose(patches.normal, expected, atol=1e-9)

    level = patches.level()

    assert (level.beta == 1).all()
    assert (level.normal == [0, 0, -1]).all()


@pytest.mark.parametrize(
    ("step_m", "joined"),
    [(0.9 * JUMP_M, True), (1.1 * JUMP_M, False)],
)
def test_patches_join_steps_up_to_the_jump(step_m: float, joined: bool) -> None:
    depth = _patches_depth()
    depth[:, 35:] += step_m

    assert (_patches(depth).beta.max() > 2) == joined


@pytest.mark.parametrize("stride", [2, 4])
def test_clustered_keeps_area_albedo_and_tilt(stride: int) -> None:
    generator = np.random.default_rng(1)
    depth = 0.25 + 0.002 * generator.random((16, 16))
    depth[:5, :7] = np.nan
    patches = make_patches(depth, BOX, generator.random((16, 16)))
    blocks = clustered(patches, stride, 16 // stride)
    for part in (patches, blocks):
        assert (part.beta > 0).all()
    given = [(p.albedo * p.area_m2)[:, None] * p.normal for p in (patches, blocks)]

    np.testing.assert_allclose(
        given[1].sum(0),
        given[0].sum(0),
    )
    np.testing.assert_allclose(
        np.linalg.norm(blocks.normal, axis=1),
        1,
    )
    assert blocks.cell_m2 == pytest.approx(stride**2 * patches.cell_m2)
    np.testing.assert_allclose(
        blocks.point_m[:, 2], coarser(depth, stride)[blocks.row, blocks.column]
    )

    black = clustered(_patches(_patches_depth(), 0.0), 2, 32)

    assert (black.albedo == 0).all()
    assert np.isfinite(black.normal).all()
    assert np.isfinite(black.beta).all()


def test_coarser_map_is_the_mean_of_the_surface() -> None:
    depth = np.full((4, 4), np.nan)
    depth[0, 0] = 1.0
    depth[0, 1] = 2.0
    depth[3, 3] = 5.0

    np.testing.assert_array_equal(
        coarser(depth, 2),
        [[1.5, np.nan], [np.nan, 5.0]],
    )
