from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import ObjectBox, load_rig
from nlos_models import BLACK_V
from nlos_models.pipeline import KEPT_SHARE

from nlos_cam.objects import (
    TEXTURES,
    cell_centers_m,
    depth_from_image,
    image_from_albedo,
    object_depth,
    paint,
)
from nlos_cam.objects.depth_map import image_from_depth, orthographic_depth, share_outside
from nlos_cam.render import Surface

BOX = ObjectBox(
    x_min_m=0.0,
    x_max_m=0.64,
    y_min_m=-0.32,
    y_max_m=0.32,
    z_near_m=0.1,
    z_far_m=0.6,
)
X, Y = np.meshgrid(*cell_centers_m(BOX))


def _quad(
    z: tuple[float, float, float, float],
    low: float = -1.0,
    high: float = 1.0,
) -> np.ndarray:
    """Two triangles over a square; z at (low, low), (high, low), (high, high), (low, high)."""
    a, b, c, d = (
        (x, y, k)
        for (x, y), k in zip(
            [
                (low, low),
                (high, low),
                (high, high),
                (low, high),
            ],
            z,
            strict=True,
        )
    )
    return np.array([[a, b, c], [a, c, d]])


def _triangles(
    mesh: trimesh.Trimesh,
    centre: tuple[float, float, float],
) -> np.ndarray:
    return np.asarray(mesh.triangles, float) + centre


def test_tilted_plane_has_its_depth_at_every_cell_center() -> None:
    depth = orthographic_depth(_quad((0.25, 0.45, 0.35, 0.15)), BOX)
    np.testing.assert_allclose(depth, 0.3 + 0.1 * X - 0.05 * Y, rtol=1e-6)


@pytest.mark.parametrize("corner", [0.0, 0.1, 1 / 3, 0.123456789])
def test_triangles_sharing_an_edge_leave_no_hole(corner: float) -> None:
    """The shared edge runs through the centres of many cells."""
    middle_x = X[31, 31] + corner * 0.01
    middle_y = Y[31, 31]
    ring = [
        (-3, -3),
        (3, -3),
        (3, 3),
        (-3, 3),
        (-3, -3),
    ]
    fan = [
        [
            (middle_x, middle_y, 0.3),
            (*a, 0.3),
            (*b, 0.3),
        ]
        for a, b in pairwise(ring)
    ]

    assert np.isfinite(
        orthographic_depth(
            np.array(fan, float),
            BOX,
        )
    ).all()


def test_sphere_and_box_show_their_near_side_in_their_cells() -> None:
    radius = 0.2
    centre = (0.3, 0.05, 0.4)
    depth = orthographic_depth(_triangles(trimesh.creation.icosphere(5, radius), centre), BOX)
    from_axis = np.hypot(X - centre[0], Y - centre[1])

    assert np.isnan(depth[from_axis > radius]).all()

    inside = from_axis < 0.95 * radius

    np.testing.assert_allclose(
        depth[inside], centre[2] - np.sqrt(radius**2 - from_axis[inside] ** 2), atol=1e-3
    )

    solid = trimesh.creation.box(extents=(0.2, 0.1, 0.08))
    depth = orthographic_depth(_triangles(solid, (0.32, 0.1, 0.3)), BOX)
    inside = (np.abs(X - 0.32) < 0.1) & (np.abs(Y - 0.1) < 0.05)

    np.testing.assert_allclose(depth[inside], 0.26, rtol=1e-6)
    assert np.isnan(depth[~inside]).all()


def test_edge_on_distant_or_no_triangles_leave_no_depth() -> None:
    edge_on = np.array(
        [
            [
                (0.3, -1, 0.2),
                (0.3, 1, 0.2),
                (0.3, 0, 0.5),
            ]
        ]
    )
    elsewhere = np.array(
        [
            [
                (2.0, 0, 0.3),
                (3.0, 0, 0.3),
                (2.5, 1, 0.3),
            ]
        ]
    )
    for triangles in (edge_on, elsewhere, np.empty((0, 3, 3))):
        assert np.isnan(orthographic_depth(triangles, BOX)).all()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize(
    "side",
    [
        (1, 0),
        (-1, 0),
        (0, 1),
        (0, -1),
    ],
)
def test_share_outside_is_the_part_of_a_plate_beyond_the_box(
    share: float, side: tuple[int, int]
) -> None:
    plate = trimesh.creation.box(extents=(0.1, 0.1, 0.01))
    x, y = (s * (0.32 - 0.05 + 0.1 * share) for s in side)

    assert share_outside(
        _triangles(plate, (0.32 + x, y, 0.3)),
        BOX,
    ) == pytest.approx(share, abs=0.01)


def test_share_outside_counts_the_silhouette_once_and_no_edges() -> None:
    inside = _quad((0.3, 0.3, 0.3, 0.3), 0.1, 0.2)
    outside = _quad((0.3, 0.3, 0.3, 0.3), 0.65, 0.75)
    layers = [outside + np.array((0, 0, 0.1 * k)) for k in range(4)]

    assert share_outside(
        np.concatenate([inside, *layers]),
        BOX,
    ) == pytest.approx(0.5)

    edge_on = (3.0, -1, 0.2), (3.0, 1, 0.2), (3.0, 0, 0.5)
    sliver = (3.0, -1, 0.2), (3.5, 0.37, 0.2), (3.5, 0.37 + 1e-9, 0.5)
    speck = (4.0, 1, 0.2), (4.0 - 1e-6, 1, 0.2), (4, 1 - 1e-6, 0.2)
    exact = (
        (0.0, -0.32, 0.2),
        (0.64, -0.32, 0.2),
        (
            0.64,
            0.32 + 1e-12,
            0.2,
        ),
    )
    thin = [edge_on], [sliver, speck], [exact]

    assert [
        share_outside(
            np.array(triangles),
            BOX,
        )
        for triangles in thin
    ] == [0, 0, 0]


PAPER = load_rig("paper-rig").object_box


def test_image_maps_near_to_1_far_to_a_tenth_and_background_to_0() -> None:
    near = PAPER.z_near_m
    far = PAPER.z_far_m
    depth = np.array(
        [
            near,
            far,
            (near + far) / 2,
            np.nan,
            near - 0.05,
            far + 1,
            np.inf,
        ]
    )

    np.testing.assert_allclose(
        image_from_depth(depth, PAPER),
        [
            1.0,
            0.1,
            0.55,
            0.0,
            1.0,
            0.1,
            0.1,
        ],
        rtol=1e-6,
    )

    depth = depth_from_image(np.array([0.0, 0.049, 0.051, 0.1]), PAPER)

    assert np.isnan(depth).tolist() == [True, True, False, False]
    np.testing.assert_allclose(depth[2:], PAPER.z_far_m, rtol=1e-6)


@settings(max_examples=20, derandomize=True, deadline=None)
@given(
    near=st.floats(0.05, 0.5),
    deep=st.floats(0.01, 2),
    seed=st.integers(0, 1000),
)
def test_depth_survives_the_image_and_back(near: float, deep: float, seed: int) -> None:
    box = PAPER.model_copy(update={"z_near_m": near, "z_far_m": near + deep})
    generator = np.random.default_rng(seed)
    depth = generator.uniform(
        near,
        near + deep,
        (64, 64),
    ).astype(np.float32)
    depth[generator.random(depth.shape) < 0.5] = np.nan
    back = depth_from_image(image_from_depth(depth, box), box)

    np.testing.assert_allclose(back, depth, atol=1e-6 * (1 + deep))


def test_image_survives_the_depth_map_and_back_in_float16() -> None:
    image = np.linspace(
        0.1,
        1,
        4096,
        dtype=np.float32,
    ).reshape(64, 64)
    image[:10] = 0

    np.testing.assert_allclose(
        image_from_depth(depth_from_image(image, PAPER), PAPER), image, atol=1e-6
    )

    half = image.astype(np.float16)

    np.testing.assert_allclose(
        image_from_depth(depth_from_image(half, PAPER), PAPER), half, atol=2e-3
    )


def test_cell_centers_grow_with_wall_x_and_against_wall_y() -> None:
    x_m, y_m = cell_centers_m(PAPER)
    pitch = (PAPER.x_max_m - PAPER.x_min_m) / 64

    np.testing.assert_allclose(np.diff(x_m), pitch)
    np.testing.assert_allclose(np.diff(y_m), -pitch)
    np.testing.assert_allclose(
        [x_m[0], x_m[-1]],
        [
            PAPER.x_min_m + pitch / 2,
            PAPER.x_max_m - pitch / 2,
        ],
    )
    np.testing.assert_allclose(
        [y_m[0], y_m[-1]],
        [
            PAPER.y_max_m - pitch / 2,
            PAPER.y_min_m + pitch / 2,
        ],
    )


THING = object_depth(1, PAPER)[1]


def test_painted_depends_on_the_seed_and_draws_every_texture() -> None:
    one, again, other = (
        paint(
            seed,
            THING,
            [*TEXTURES],
        )
        for seed in (5, 5, 6)
    )

    np.testing.assert_array_equal(one.albedo, again.albedo)
    assert one.texture == again.texture
    assert not np.array_equal(one.albedo, other.albedo)
    assert paint(5, THING, ["stripes"]).texture == "stripes"
    assert {
        paint(
            seed,
            THING,
            [*TEXTURES],
        ).texture
        for seed in range(40)
    } == set(TEXTURES)


@pytest.mark.parametrize("name", TEXTURES)
def test_texture_is_an_albedo_that_keeps_the_silhouette(name: str) -> None:
    for seed in range(20):
        albedo = TEXTURES[name](np.random.default_rng(seed), THING)
        assert Surface(albedo).over((64, 64)).shape == (64, 64, 3)
        bright = image_from_albedo(albedo, THING).max(0)[~np.isnan(THING)]
        assert bright.min() > KEPT_SHARE * bright.max()


def test_textures_have_the_colors_of_their_names() -> None:
    made = {
        name: make(
            np.random.default_rng(3),
            THING,
        )
        for name, make in TEXTURES.items()
    }
    colours = {
        name: len(
            np.unique(
                albedo.reshape(-1, 3),
                axis=0,
            )
        )
        for name, albedo in made.items()
    }

    assert colours["plain"] == 1
    assert colours["stripes"] == colours["layers"] == 2
    assert 2 <= colours["patches"] <= 4
    assert colours["gradient"] > 100

    near = made["layers"][np.nanmin(THING) == THING]

    assert (near == near[0]).all()

    albedo = TEXTURES["layers"](
        np.random.default_rng(0),
        np.full((64, 64), np.nan, np.float32),
    )

    assert np.isfinite(albedo).all()


def test_image_is_the_albedo_on_the_surface_and_0_beside_it() -> None:
    albedo = paint(2, THING, [*TEXTURES]).albedo
    image = image_from_albedo(albedo, THING)
    hidden = np.isnan(THING)

    assert image.shape == (3, 64, 64)

    black = image_from_albedo(
        np.zeros((64, 64, 3)),
        np.full((64, 64), 0.2),
    )

    np.testing.assert_allclose(black, BLACK_V, atol=1e-6)  # no background
    assert (image[:, hidden] == 0).all()
    np.testing.assert_allclose(
        image[:, ~hidden].T, BLACK_V + (1 - BLACK_V) * albedo[~hidden], atol=1e-6
    )
