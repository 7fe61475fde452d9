"""Primitive solids: sizes, axes, areas, and that they are closed."""

import numpy as np
import pytest
from nlos_calibration.arrays import Float64

from nlos_cam.objects import primitives as solids


def _middle(solid: Float64) -> np.ndarray:
    points = solid.reshape(-1, 3)
    return (points.min(0) + points.max(0)) / 2


def _area(solid: Float64) -> float:
    return float(np.linalg.norm(np.cross(solid[:, 1] - solid[:, 0], solid[:, 2] - solid[:, 0]), axis=1).sum() / 2)


@pytest.mark.parametrize(
    ("solid", "extents"),
    [
        (solids.box(0.1, 0.2, 0.3), [0.1, 0.2, 0.3]),
        (solids.ellipsoid(0.1, 0.2, 0.3), [0.2, 0.4, 0.6]),
        (solids.knob(0.1, 0.3), [0.2, 0.2, 0.6]),
        (solids.ring(0.2, 0.05), [0.5, 0.5, 0.1]),
        (solids.disc(0.2, 0.05), [0.4, 0.4, 0.05]),
        (solids.frame(0.5, 0.4, 0.1, 0.05), [0.5, 0.4, 0.05]),
        (solids.pierced(0.5, 0.4, 0.1, 0.05), [0.5, 0.4, 0.05]),
        (solids.at(solids.slab([(0, 0), (0.4, 0), (0.4, 0.3), (0, 0.3)], 0.1), -0.2, -0.15), [0.4, 0.3, 0.1]),
    ],
)
def test_solid_has_its_size_and_is_centered(solid: Float64, extents: list[float]) -> None:
    assert np.ptp(solid.reshape(-1, 3), axis=0).tolist() == pytest.approx(extents, rel=0.02)
    np.testing.assert_allclose(_middle(solid), 0, atol=1e-3)


def test_lathe_turns_about_y_and_frame_is_open() -> None:
    x, y, z = solids.lathe([(0, -0.2), (0.3, -0.2), (0.1, 0.5), (0, 0.5)]).reshape(-1, 3).T
    assert (y.min(), y.max()) == (pytest.approx(-0.2), pytest.approx(0.5))
    radius = np.hypot(x, z)
    assert radius[np.isclose(y, -0.2)].max() == pytest.approx(0.3)
    assert radius[np.isclose(y, 0.5)].max() == pytest.approx(0.1)
    x, y, _ = solids.frame(0.6, 0.4, 0.1, 0.2).reshape(-1, 3).T
    assert ((np.abs(x) > 0.2 - 1e-9) | (np.abs(y) > 0.1 - 1e-9)).all()


@pytest.mark.parametrize("angle", [90.0, 180.0, 270.0])
def test_arch_is_part_of_a_ring_from_the_x_axis_on(angle: float) -> None:
    part = solids.arch(0.4, 0.05, angle)
    assert _area(part) == pytest.approx(_area(solids.ring(0.4, 0.05)) * angle / 360, rel=0.01)
    assert part[..., 0].max() == pytest.approx(0.45)
    assert solids.arch(0.4, 0.05, 180)[..., 1].min() == pytest.approx(0, abs=1e-9)
    x, y, z = part.reshape(-1, 3).T
    np.testing.assert_allclose(np.hypot(np.hypot(x, y) - 0.4, z), 0.05)


@pytest.mark.parametrize(
    "solid",
    [
        solids.box(1, 2, 3),
        solids.ellipsoid(0.1, 0.2, 0.3),
        solids.ring(0.3, 0.1),
        solids.disc(0.3, 0.1),
        solids.pierced(0.5, 0.4, 0.1, 0.05),
        solids.slab([(0, 0), (0.4, 0), (0.5, 0.2), (0.4, 0.3), (0, 0.3)], 0.1),
        solids.lathe([(0, 0), (0.3, 0), (0.2, 0.5), (0, 0.5)]),
        solids.bar((0, 0), (1, 1), 0.1, 0.2),
    ],
)
def test_solid_is_closed(solid: Float64) -> None:
    """Every edge belongs to two triangles, except edges that collapse to a point on a lathe's axis."""
    corners, index = np.unique(np.round(solid.reshape(-1, 3), 9), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    assert len(corners) > 4
    assert (times == 2).all()


def test_solids_move_turn_tip_and_join() -> None:
    np.testing.assert_allclose(_middle(solids.at(solids.box(1, 1, 1), 1, 2, 3)), [1, 2, 3])
    np.testing.assert_allclose(_middle(solids.bar((0.1, 0.2), (0.4, 0.6), 0.06, 0.1)), [0.25, 0.4, 0], atol=1e-12)
    np.testing.assert_allclose(
        _middle(solids.turned(solids.at(solids.box(1, 1, 1), x=2), (0, 0, 1), 90)), [0, 2, 0], atol=1e-12
    )
    there_and_back = solids.turned(solids.turned(solids.box(1, 2, 3), (1, 0, 0), 35), (1, 0, 0), -35)
    np.testing.assert_allclose(there_and_back, solids.box(1, 2, 3), atol=1e-12)
    top = solids.tipped(solids.at(solids.box(0.1, 0.1, 0.1), y=1), 30)  # the top tips towards the wall
    np.testing.assert_allclose(_middle(top), [0, np.cos(np.radians(30)), -0.5], atol=1e-12)
    parts = solids.box(1, 1, 1), solids.at(solids.ellipsoid(1, 1, 1), 5), solids.ring(1, 0.1)
    solid = solids.joined(*parts)
    assert len(solid) == sum(len(part) for part in parts)
    assert solid[..., 0].max() == pytest.approx(6, abs=0.01)
