"""Self-occlusion: the walk against scenes that a ruler can settle, and the bounds of tables against the walk."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_map import cell_centres_m
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.visibility import FACES, HeightField, blocked, height_field, horizon_table, occluded, visible
from nlos_cam.render.visibility import segment_blocked as between

RIG = load_rig("paper-rig")
BOX = RIG.object_box
assert BOX is not None
X_M, Y_M = cell_centres_m(BOX)
ROW = 32


def _field(depth: np.ndarray, *, shades: bool = True) -> HeightField:
    return height_field(depth, BOX, shades=shades)


def _ridge(front_m: float = 0.15) -> np.ndarray:
    """A surface at 0.35 m with a ridge of one column at `front_m`."""
    depth = np.full((64, 64), 0.35)
    depth[:, 40] = front_m
    return depth


def _seen(field: HeightField, column: int, x: float, y: float, row: int = ROW) -> bool:
    point = np.array([X_M[column], Y_M[row], field.depth_m[row, column]])
    return visible(field, row, column, point, x, y)


def test_a_ridge_shades_up_to_the_line_over_its_top() -> None:
    """Similar triangles tell where the line over the ridge's top, less the bias, meets the wall."""
    field = _field(_ridge())
    reach = (X_M[40] - X_M[10]) * 0.35 / (0.35 - 0.15 - 0.25 * field.pitch_x_m)
    assert _seen(field, 10, X_M[10] + 0.999 * reach, Y_M[ROW])
    assert not _seen(field, 10, X_M[10] + 1.001 * reach, Y_M[ROW])


def test_it_shades_in_its_own_direction_only() -> None:
    field = _field(_ridge())
    for x, y in ((X_M[10] - 2, Y_M[ROW]), (X_M[10], Y_M[ROW] + 2), (X_M[10], Y_M[ROW])):
        assert _seen(field, 10, x, y)


def test_a_patch_on_the_ridge_sees_everything() -> None:
    field = _field(_ridge())
    for angle in np.linspace(0, 2 * np.pi, 33):
        assert _seen(field, 40, X_M[40] + 3 * np.cos(angle), Y_M[ROW] + 3 * np.sin(angle))


@pytest.mark.parametrize("slope", [0.0, 1.0, -1.0])
def test_a_plane_does_not_shade_its_lit_side(slope: float) -> None:
    columns, rows = np.meshgrid(X_M - X_M[32], Y_M - Y_M[32])
    field = _field(0.4 + slope * (columns + 0.5 * rows))
    for row, column in [(0, 0), (32, 32), (63, 10)]:
        for angle in np.linspace(0, 2 * np.pi, 33):
            dx, dy = np.cos(angle), np.sin(angle)
            lit = slope * (dx + 0.5 * dy) * 10 + field.depth_m[row, column] > 0
            assert _seen(field, column, X_M[column] + 10 * dx, Y_M[row] + 10 * dy, row) or not lit


def test_background_neither_shades_nor_ends_the_walk() -> None:
    depth, far = _ridge(), X_M[10] + 3
    depth[:, 11:40] = np.nan
    assert not _seen(_field(depth), 10, far, Y_M[ROW])
    depth[:, 40] = np.nan
    assert _seen(_field(depth), 10, far, Y_M[ROW])


def test_a_field_that_does_not_shade_is_not_walked() -> None:
    assert _seen(_field(_ridge(), shades=False), 10, X_M[10] + 3, Y_M[ROW])


def test_an_empty_field_is_laid_out_too() -> None:
    assert _field(np.full((4, 4), np.nan)).nearest_m == np.inf


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_field_is_its_own_copy_in_one_layout(order: str) -> None:
    depth = np.asarray(_ridge(), np.float32, order=order)  # pyright: ignore[reportCallIssue, reportArgumentType]
    field = _field(depth)
    assert field.depth_m.flags.c_contiguous
    assert field.depth_m.flags.writeable
    assert not np.shares_memory(field.depth_m, depth)


def test_two_cells_see_each_other_unless_something_stands_between() -> None:
    field = _field(_ridge())
    assert between(field, ROW, 10, 0.35, ROW, 60, 0.35)
    assert not between(field, ROW, 10, 0.35, ROW, 30, 0.35)
    assert not between(field, ROW, 10, 0.35, 10, 10, 0.35)
    assert not between(field, ROW, 10, 0.35, ROW, 40, 0.15)
    for one, other in ((10, 60), (60, 10), (10, 39)):
        assert between(field, ROW, one, 0.35, 40, other, 0.35) == between(field, 40, other, 0.35, ROW, one, 0.35)


def test_the_occluder_cuts_what_crosses_its_plane_above_its_edge() -> None:
    assert occluded(0.0, 0.2, 0.4, 0.2, 0.2, 0.1)
    assert not occluded(0.0, 0.2, 0.4, -0.2, 0.2, 0.1)  # below the edge
    assert not occluded(0.0, 0.2, 0.1, 0.2, 0.2, 0.1)  # on one side
    assert not occluded(0.2, 0.2, 0.4, 0.2, 0.2, 0.1)  # from its own plane


@pytest.mark.parametrize("sectors", [1, 8, 13])
@pytest.mark.parametrize("seed", [0, 5])
def test_the_tables_bounds_hold_for_the_walk_on_every_leg(seed: int, sectors: int) -> None:
    field = _field(object_depth(seed, BOX)[1])
    rows, columns = np.nonzero(~np.isnan(field.depth_m))
    rows, columns = rows[::40], columns[::40]
    z = field.depth_m[rows, columns]
    low, high = horizon_table(field, rows, columns, z, np.full(len(rows), 400.0), sectors)
    assert low.shape == high.shape == (len(rows), FACES * sectors)
    generator, sure = np.random.default_rng(seed), 0
    for s, row in enumerate(rows):
        for u, v in generator.uniform(-300, 300, (60, 2)):
            along = abs(u) >= abs(v)
            major, minor = (u, v) if along else (v, u)
            face = (0 if along else 2) + (0 if major >= 0 else 1)
            k = face * sectors + min(int((minor / abs(major) + 1) * sectors / 2), sectors - 1)
            shaded = blocked(field, row, columns[s], z[s], u, v)
            if z[s] >= abs(major) * high[s, k]:
                assert not shaded
                sure += 1
            elif z[s] < abs(major) * low[s, k]:
                assert shaded
                sure += 1
    assert sure > 0
