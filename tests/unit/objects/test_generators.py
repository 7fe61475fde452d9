import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from depth_maps import inside
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.objects import (
    category_triangles,
    generators,
    object_box,
    orthographic_depth,
    place,
    random_pose,
    unseen,
)
from nlos_cam.objects import primitives as solids
from nlos_cam.objects.generators import CATEGORIES, Category, Setting, category
from nlos_cam.objects.generic import FAMILIES, MIN_PIXELS, generic_depth
from nlos_cam.objects.placement import Pose
from nlos_cam.objects.polygons import is_convex, newell_normal
from nlos_cam.objects.primitives import box, slab
from nlos_cam.render import paper_scene

BOX = object_box(load_rig("paper-rig"))
SEEDS = (*range(47), 10_000_000, 20_000_000, 2**31 - 1)


def straight_view(kind: Category, **changed: float) -> NDArray[np.float32]:
    """Return the depth map of a category that fills the paper's box, its settings in the middle but
    for those given.
    """
    drawn = kind.draw([0.5] * len(kind.settings)) | changed
    return orthographic_depth(
        place(
            kind.make(**drawn),
            Pose(size_m=0.24, front_m=0.0),
            BOX,
        ),
        BOX,
    )


def _runs(line: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(np.diff(np.pad(line.astype(int), 1)) == 1))


@pytest.mark.parametrize("shelves", [2, 3, 4])
def test_cupboard_shows_its_shelves_beside_the_open_door(shelves: int) -> None:
    """Between the boards the depth is that of the back."""
    depth = straight_view(
        CATEGORIES["cupboard"],
        shelves=float(shelves),
        ajar=95.0,
        tip=0.0,
    )
    columns = np.flatnonzero(np.isfinite(depth).sum(axis=0) > 40)
    inside = depth[:, columns[0] + (columns[-1] - columns[0]) // 3]

    assert _runs(inside > np.nanmin(depth[:, columns[-6]]) + 0.03) == shelves


@pytest.mark.parametrize("knobs", [3, 4, 5])
def test_oven_has_its_knobs_in_a_row_and_a_recessed_window(knobs: int) -> None:
    depth = straight_view(CATEGORIES["oven"], knobs=float(knobs), tip=18.0)
    found = [_runs(row < np.nanmedian(row) - 0.01) for row in depth if np.isfinite(row).sum() > 20]

    assert knobs in found

    rows, columns = (np.flatnonzero(np.isfinite(depth).any(axis=axis)) for axis in (1, 0))
    window = depth[rows[len(rows) * 3 // 4]]

    assert window[32] > window[columns[4]] + 0.015


@pytest.mark.parametrize(
    "kind",
    ["baskets", "bell", "bowl", "hat", "lamp", "airplane", "rocket"],
)
def test_symmetric_kind_is_the_same_on_both_sides(kind: str) -> None:
    surface = np.isfinite(straight_view(CATEGORIES[kind]))
    assert (surface != surface[:, ::-1]).mean() < 0.01


@pytest.mark.parametrize("kind", ["baskets", "bowl"])
def test_hollow_is_deeper_than_its_rim(kind: str) -> None:
    column = straight_view(CATEGORIES[kind])[:, 32]
    column = column[np.isfinite(column)]

    assert column.max() - column.min() > 0.05
    assert np.abs(np.diff(column)).max() > 0.02


@pytest.mark.parametrize("category", CATEGORIES)
def test_category_makes_an_object_per_seed_that_fits_its_box(
    category: str,
) -> None:
    meshes = {seed: category_triangles(category, seed) for seed in SEEDS}

    np.testing.assert_array_equal(
        category_triangles(category, SEEDS[-1]),
        meshes[SEEDS[-1]],
    )
    assert len({mesh.tobytes() for mesh in meshes.values()}) == len(SEEDS)

    for seed, mesh in meshes.items():
        assert (
            0.5
            < np.ptp(
                mesh.reshape(-1, 3),
                axis=0,
            ).max()
            < 1.5
        )
        placed = place(mesh, random_pose(np.random.default_rng(seed), BOX), BOX)
        assert inside(placed, BOX)
        surface = np.isfinite(orthographic_depth(placed, BOX))
        assert 0.03 < surface.mean() < 0.6
        assert not (surface[0].any() and surface[-1].any()), "it touches the top and the bottom"
        assert not (surface[:, 0].any() and surface[:, -1].any()), "it touches both sides"


@pytest.mark.parametrize("category", CATEGORIES)
def test_category_settings_all_change_the_depth_map(category: str) -> None:
    """No setting changes only a part that is hidden behind another."""
    kind = CATEGORIES[category]
    pose = random_pose(np.random.default_rng(4), BOX)
    pose = replace(pose, size_m=0.2, x_m=0, y_m=0)
    middle = [0.5] * len(kind.settings)
    picture = orthographic_depth(
        place(kind.make(**kind.draw(middle)), pose, BOX),
        BOX,
    )
    for n in range(len(middle)):
        units = [*middle[:n], 0.95, *middle[n + 1 :]]
        other = orthographic_depth(
            place(kind.make(**kind.draw(units)), pose, BOX),
            BOX,
        )
        assert not np.allclose(
            other,
            picture,
            atol=1e-4,
            equal_nan=True,
        ), list(kind.settings)[n]


def test_only_the_motorcycles_seat_is_a_concave_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    """`slab` fills the notch of a concave outline; the seat's is a part of every dataset."""
    outlines: list[Float64] = []

    def noting(corners: Sequence[tuple[float, float]], thickness: float) -> Float64:
        outlines.append(np.pad(np.asarray(corners, float), [(0, 0), (0, 1)]))
        return slab(corners, thickness)

    for module in (generators, unseen):
        monkeypatch.setattr(module, "slab", noting)
    kinds = {name: partial(category_triangles, name) for name in CATEGORIES} | unseen.KINDS
    concave: set[str] = set()
    for name, make in kinds.items():
        outlines.clear()
        make(0)
        if not all(is_convex(each, newell_normal(each)) for each in outlines):
            concave.add(name)

    assert concave == {"motorcycle"}


NAMES = """
airplane baskets bell birdhouse boat bowl car computer cup cupboard hat lamp motorcycle oven rocket soundbox table tower
"""
DIGESTS = """
ccf22abf 05632ec4 fda477c2 5a445fee 4e22a452 f9a4b7a7 7c73d173 b40a3603 de419b3a 99239899 290fb1ea e5ea9141
e9436516 1007c23a d80bea10 f102da95 de848140 c5348870
"""
"""SHA-256 of each category's mesh for seed 0, vertices rounded to 9 decimals."""


def test_categories_and_seeds_make_the_same_objects_as_ever() -> None:
    """Datasets name their objects by seeds: a changed shape, or another order, would make others of
    them.
    """

    assert list(CATEGORIES) == [kind.name for kind in CATEGORIES.values()] == NAMES.split()

    meshes = [
        np.round(
            category_triangles(name, 0),
            9,
        )
        + 0.0
        for name in CATEGORIES
    ]
    found = [hashlib.sha256(mesh.tobytes()).hexdigest()[:8] for mesh in meshes]

    assert dict(zip(CATEGORIES, found, strict=True)) == dict(
        zip(CATEGORIES, DIGESTS.split(), strict=True)
    )

    hidden = np.round(paper_scene().hidden.triangles, 9)

    assert hashlib.sha256(hidden.tobytes()).hexdigest()[:16] == "1ab023dab17e054a", (
        "the README's airplane"
    )


UNIT = st.floats(0, 1)
ENDS = st.integers(-500, 500).map(lambda tenths: tenths / 10)


@st.composite
def _settings(draw: st.DrawFn) -> Setting:
    """Ranges with an interval held out inside, across an end, or beside."""
    low, high = sorted(
        draw(
            st.lists(
                ENDS,
                min_size=2,
                max_size=2,
                unique=True,
            )
        )
    )
    gap = sorted(
        draw(
            st.lists(
                ENDS,
                min_size=2,
                max_size=2,
                unique=True,
            )
        )
    )
    if gap[0] <= low and high <= gap[1]:
        return Setting(low, high)
    return Setting(low, high, (gap[0], gap[1]))


@settings(deadline=None)
@given(_settings(), UNIT)
def test_setting_never_draws_held_out_values(setting: Setting, unit: float) -> None:
    value = setting.draw(unit)

    assert any(low - 1e-12 <= value <= high + 1e-12 for low, high in setting.training_intervals)

    if (
        setting.held_out
        and setting.low < setting.held_out[0]
        and setting.held_out[1] < setting.high
    ):
        low, high = setting.held_out
        assert not low < value < high


@settings(max_examples=50, deadline=None)
@given(_settings())
def test_setting_draws_grow_evenly_from_end_to_end(setting: Setting) -> None:
    lows, highs = zip(*setting.training_intervals, strict=True)

    assert setting.draw(0) == pytest.approx(min(lows), abs=1e-9)
    assert setting.draw(1) == pytest.approx(max(highs), abs=1e-9)

    total = sum(high - low for low, high in setting.training_intervals)
    steps = np.diff([setting.draw(u) for u in np.linspace(0, 1, 20)])

    assert (steps >= -1e-12).all()
    assert np.sort(steps)[:-1] == pytest.approx(total / 19, abs=1e-9), (
        "all but the step over the gap"
    )


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(ENDS, ENDS),
    st.integers(0, 2**32),
)
def test_setting_without_a_gap_draws_what_numpy_draws(ends: tuple[float, float], seed: int) -> None:
    low, high = sorted(ends)
    drawn = Setting(low, high).draw(np.random.default_rng(seed).random())

    assert drawn == np.random.default_rng(seed).uniform(low, high)


@pytest.mark.parametrize("kind", CATEGORIES.values(), ids=CATEGORIES)
def test_category_holds_out_enough_and_trains_on_most(kind: Category) -> None:
    held = {name: s for name, s in kind.settings.items() if s.held_out}

    assert len(held) >= 2

    for setting in held.values():
        low, high = setting.held_out or (0, 0)
        trained = sum(b - a for a, b in setting.training_intervals)
        assert 0.1 < (high - low) / trained < 0.5


def test_category_decorator_keeps_name_and_setting_order() -> None:
    @category(
        width=Setting(1, 2),
        height=Setting(3, 5, held_out=(3.5, 4)),
    )
    def crate(width: float, height: float) -> Float64:
        return box(width, height, 1)

    assert crate.name == "crate"
    assert crate.draw([0.5, 1.0]) == {"width": 1.5, "height": 5}
    assert crate.draw_held_out([0.5, 0.5]) == {"width": 1.5, "height": 3.75}
    assert np.ptp(crate.make(**crate.draw([0.5, 1.0]))[..., 1]) == 5

    with pytest.raises(ValueError, match="shorter"):
        crate.draw([0.5])


def test_generic_shapes_follow_the_seed_and_the_families_shares() -> None:
    shapes = [generic_depth(seed, BOX) for seed in range(400)]
    for seed in (3, 90):
        np.testing.assert_array_equal(
            generic_depth(seed, BOX)[1],
            shapes[seed][1],
        )
    for name, depth_m in shapes:
        surface = depth_m[np.isfinite(depth_m)]
        assert surface.size >= MIN_PIXELS, name
        assert surface.min() >= BOX.z_near_m - 1e-6, name
        assert surface.max() <= BOX.z_far_m + 1e-6, name

    assert len({depth_m.tobytes() for _, depth_m in shapes}) == len(shapes)

    names = [name for name, _ in shapes]

    assert {name for name in names if " " not in name} == FAMILIES.keys()
    assert 0.1 < np.mean([name.startswith("carved") for name in names]) < 0.3
    assert 0.06 < np.mean([" and " in name for name in names]) < 0.2


def _middle(solid: Float64) -> np.ndarray:
    points = solid.reshape(-1, 3)
    return (points.min(0) + points.max(0)) / 2


def _area(solid: Float64) -> float:
    return float(
        np.linalg.norm(
            np.cross(
                solid[:, 1] - solid[:, 0],
                solid[:, 2] - solid[:, 0],
            ),
            axis=1,
        ).sum()
        / 2
    )


SOLIDS = [
    (solids.box(0.1, 0.2, 0.3), [0.1, 0.2, 0.3]),
    (solids.ellipsoid(0.1, 0.2, 0.3), [0.2, 0.4, 0.6]),
    (solids.knob(0.1, 0.3), [0.2, 0.2, 0.6]),
    (solids.ring(0.2, 0.05), [0.5, 0.5, 0.1]),
    (solids.disc(0.2, 0.05), [0.4, 0.4, 0.05]),
    (
        solids.pierced(0.5, 0.4, 0.1, 0.05),
        [0.5, 0.4, 0.05],
    ),
    (
        solids.at(
            solids.slab(
                [
                    (0, 0),
                    (0.4, 0),
                    (0.4, 0.3),
                    (0, 0.3),
                ],
                0.1,
            ),
            -0.2,
            -0.15,
        ),
        [0.4, 0.3, 0.1],
    ),
]


@pytest.mark.parametrize(
    ("solid", "extents"),
    [
        *SOLIDS,
        (
            solids.frame(0.5, 0.4, 0.1, 0.05),
            [0.5, 0.4, 0.05],
        ),
    ],
)
def test_solid_has_its_size_and_is_centered(solid: Float64, extents: list[float]) -> None:
    assert np.ptp(
        solid.reshape(-1, 3),
        axis=0,
    ).tolist() == pytest.approx(extents, rel=0.02)
    np.testing.assert_allclose(_middle(solid), 0, atol=1e-3)


def test_lathe_turns_about_y_and_frame_is_open() -> None:
    x, y, z = (
        solids.lathe(
            [
                (0, -0.2),
                (0.3, -0.2),
                (0.1, 0.5),
                (0, 0.5),
            ]
        )
        .reshape(-1, 3)
        .T
    )

    assert y.min() == pytest.approx(-0.2)
    assert y.max() == pytest.approx(0.5)

    radius = np.hypot(x, z)

    assert radius[np.isclose(y, -0.2)].max() == pytest.approx(0.3)
    assert radius[np.isclose(y, 0.5)].max() == pytest.approx(0.1)

    x, y, _ = solids.frame(0.6, 0.4, 0.1, 0.2).reshape(-1, 3).T

    assert ((np.abs(x) > 0.2 - 1e-9) | (np.abs(y) > 0.1 - 1e-9)).all()


@pytest.mark.parametrize("angle", [90.0, 180.0, 270.0])
def test_arch_is_part_of_a_ring_from_the_x_axis_on(angle: float) -> None:
    part = solids.arch(0.4, 0.05, angle)

    assert _area(part) == pytest.approx(
        _area(solids.ring(0.4, 0.05)) * angle / 360,
        rel=0.01,
    )
    assert part[..., 0].max() == pytest.approx(0.45)
    assert solids.arch(0.4, 0.05, 180)[..., 1].min() == pytest.approx(0, abs=1e-9)

    x, y, z = part.reshape(-1, 3).T

    np.testing.assert_allclose(
        np.hypot(np.hypot(x, y) - 0.4, z),
        0.05,
    )


@pytest.mark.parametrize(
    "solid",
    [
        *(solid for solid, _ in SOLIDS),
        solids.slab(
            [
                (0, 0),
                (0.4, 0),
                (0.5, 0.2),
                (0.4, 0.3),
                (0, 0.3),
            ],
            0.1,
        ),
        solids.lathe(
            [
                (0, 0),
                (0.3, 0),
                (0.2, 0.5),
                (0, 0.5),
            ]
        ),
        solids.bar((0, 0), (1, 1), 0.1, 0.2),
    ],
)
def test_solid_is_closed(solid: Float64) -> None:
    """Every edge belongs to two triangles, except edges that collapse to a point on a lathe's
    axis.
    """
    corners, index = np.unique(
        np.round(solid.reshape(-1, 3), 9),
        axis=0,
        return_inverse=True,
    )
    faces = index.reshape(-1, 3)
    faces = faces[
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    ]
    edges = np.sort(
        np.concatenate(
            [
                faces[:, [0, 1]],
                faces[:, [1, 2]],
                faces[:, [2, 0]],
            ]
        ),
        axis=1,
    )
    _, times = np.unique(edges, axis=0, return_counts=True)

    assert len(corners) > 4
    assert (times == 2).all()


MOVED = [
    (
        solids.at(solids.box(1, 1, 1), 1, 2, 3),
        [1, 2, 3],
    ),
    (
        solids.bar((0.1, 0.2), (0.4, 0.6), 0.06, 0.1),
        [0.25, 0.4, 0],
    ),
    (
        solids.turned(
            solids.at(solids.box(1, 1, 1), x=2),
            (0, 0, 1),
            90,
        ),
        [0, 2, 0],
    ),
    (
        solids.tipped(
            solids.at(solids.box(0.1, 0.1, 0.1), y=1),
            30,
        ),
        [0, np.sqrt(3) / 2, -0.5],
    ),  # towards the wall
    (
        solids.joined(
            solids.box(1, 1, 1),
            solids.at(solids.box(1, 1, 1), 5),
        ),
        [2.5, 0, 0],
    ),
]


@pytest.mark.parametrize(
    ("solid", "middle"), MOVED, ids=["at", "bar", "turned", "tipped", "joined"]
)
def test_solid_is_moved_to_its_place(solid: Float64, middle: list[float]) -> None:
    np.testing.assert_allclose(_middle(solid), middle, atol=1e-12)


@pytest.mark.parametrize("taper", [0.0, 0.5, 1.0])
def test_prism_has_the_volume_of_its_frustum(taper: float) -> None:
    """By the divergence theorem; side faces point one way, so the sign is that of the outline's
    turn.
    """
    angle = np.linspace(0, 2 * np.pi, 5)[:-1]
    a, b, c = np.moveaxis(
        solids.prism(
            np.column_stack([np.cos(angle), np.sin(angle)]),
            3.0,
            taper,
        ),
        1,
        0,
    )
    area_z = 0.5 * np.abs(np.cross(b - a, c - a)[:, 2])
    # Base, front, and sides seen along z.
    assert area_z.sum() == pytest.approx(2 + 2 * taper**2 + 2 * (1 - taper**2))
