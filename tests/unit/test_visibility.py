"""Self-occlusion: the exact walk against scenes that a ruler can settle, and the table against the walk."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.depth_image import cell_centres_m
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.scene import Scene
from nlos_cam.render.visibility import (
    DIRECTIONS,
    NOTHING,
    HeightField,
    height_field,
    horizon,
    horizon_table,
    sector,
    visible,
)

RIG = load_rig("paper-rig")
BOX = RIG.object_box
X_M, Y_M = cell_centres_m(BOX)
ROW = 32


def _field(depth: np.ndarray, *, shades: bool = True) -> HeightField:
    return height_field(depth.astype(np.float32), BOX, shades=shades)


def _wall_and_floor(front_m: float = 0.15) -> np.ndarray:
    """A surface at 0.35 m with a ridge of one column at `front_m`."""
    depth = np.full((64, 64), 0.35)
    depth[:, 40] = front_m
    return depth


def _point(column: int, depth_m: float, row: int = ROW) -> np.ndarray:
    return np.array([X_M[column], Y_M[row], depth_m])


def test_a_ridge_shades_up_to_the_line_over_its_top() -> None:
    """The line from the patch over the ridge's top meets the wall at a distance that similar triangles give."""
    field, point = _field(_wall_and_floor()), _point(10, 0.35)
    run = X_M[40] - X_M[10]
    reach = run * 0.35 / (0.35 - 0.15)
    assert visible(field, point, X_M[10] + 0.97 * reach, Y_M[ROW])
    assert not visible(field, point, X_M[10] + 1.03 * reach, Y_M[ROW])


def test_it_shades_in_its_own_direction_only() -> None:
    field, point = _field(_wall_and_floor()), _point(10, 0.35)
    assert visible(field, point, X_M[10] - 2, Y_M[ROW])
    assert visible(field, point, X_M[10], Y_M[ROW] + 2)
    assert visible(field, point, X_M[10], Y_M[ROW])


def test_a_patch_on_the_ridge_sees_everything() -> None:
    field = _field(_wall_and_floor())
    for angle in np.linspace(0, 2 * np.pi, 33):
        assert visible(field, _point(40, 0.15), X_M[40] + 3 * np.cos(angle), Y_M[ROW] + 3 * np.sin(angle))


@pytest.mark.parametrize("slope", [0.0, 1.0, -1.0])
def test_a_plane_does_not_shade_itself(slope: float) -> None:
    columns, rows = np.meshgrid(X_M - X_M[32], Y_M - Y_M[32])
    field = _field(0.4 + slope * (columns + 0.5 * rows))
    for row, column in [(0, 0), (32, 32), (63, 10)]:
        point = _point(column, field.depth_m[row, column], row)
        for angle in np.linspace(0, 2 * np.pi, 33):
            dx, dy = np.cos(angle), np.sin(angle)
            lit = slope * (dx + 0.5 * dy) * 10 + point[2] > 0  # n . (wall point - patch), n = (slopes, -1)
            assert visible(field, point, X_M[column] + 10 * dx, Y_M[row] + 10 * dy) or not lit


def test_background_neither_shades_nor_ends_the_walk() -> None:
    depth = _wall_and_floor()
    depth[:, 11:40] = np.nan
    point, far = _point(10, 0.35), X_M[10] + 3
    assert not visible(_field(depth), point, far, Y_M[ROW])
    depth[:, 40] = np.nan
    assert visible(_field(depth), point, far, Y_M[ROW])


def test_a_field_that_does_not_shade_is_not_walked() -> None:
    field = _field(_wall_and_floor(), shades=False)
    assert visible(field, _point(10, 0.35), X_M[10] + 3, Y_M[ROW])
    assert (horizon_table(field, _point(10, 0.35)[None]) == NOTHING).all()


def test_roughness_within_the_bias_shades_nothing() -> None:
    pitch = X_M[1] - X_M[0]
    depth = 0.3 - 0.2 * pitch * np.random.default_rng(0).random((64, 64))
    field = _field(depth)
    for column in (5, 32, 60):
        point = _point(column, depth[ROW, column])
        assert all(horizon(field, point, dx, dy) <= 0 for dx, dy in [(1, 0), (0, 1), (-1, 0), (0.3, -0.7)])


def test_sectors_wrap_and_are_next_to_their_direction() -> None:
    found = [sector(np.cos(a), np.sin(a)) for a in np.linspace(-np.pi / 2, 1.5 * np.pi, 4001)]
    assert set(found) == set(range(DIRECTIONS))
    steps = np.diff(found)
    assert set(steps.tolist()) <= {0, 1, 1 - DIRECTIONS}
    assert sector(2.0, 6.0) == sector(1.0, 3.0)


def test_the_table_holds_the_horizon_of_each_sectors_own_direction() -> None:
    field, point = _field(_wall_and_floor()), _point(10, 0.35)
    table = horizon_table(field, point[None])[0]
    assert table.shape == (DIRECTIONS,)
    for turn in np.linspace(0, 2 * np.pi, 50):
        dx, dy = np.cos(turn), np.sin(turn)
        exact = [horizon(field, point, np.cos(turn + d), np.sin(turn + d)) for d in np.linspace(-0.03, 0.03, 13)]
        assert min(exact) - 1e-3 <= table[sector(dx, dy)] <= max(exact) + 1e-3


@pytest.mark.parametrize("seed", [0, 5])
def test_the_table_agrees_with_the_walk_on_nearly_every_leg(seed: int) -> None:
    scene = Scene(RIG, object_depth(seed, BOX)[1])
    assert scene.patches is not None
    assert scene.object_depth_m is not None
    points = scene.patches.point_m[::40]
    field = height_field(scene.object_depth_m, BOX, shades=True)
    table, generator = horizon_table(field, points), np.random.default_rng(seed)
    agreed, total = 0, 0
    for point, horizons in zip(points, table, strict=True):
        for x, y in generator.uniform((0.0, -0.25), (0.5, 0.25), (40, 2)):
            rho = np.hypot(x - point[0], y - point[1])
            looked_up = point[2] >= rho * horizons[sector(x - point[0], y - point[1])]
            agreed += looked_up == visible(field, point, x, y)
            total += 1
    assert agreed / total > 0.98
