"""The solids have the sizes and the axes that they say."""

import numpy as np
import pytest

from nlos_cam.objects.solids import Mesh, at, box, ellipsoid, joined, lathe, ring, slab, turned


def _extents(mesh: Mesh) -> list[float]:
    return pytest.approx(np.ptp(mesh.vertices, axis=0).tolist(), rel=0.02)


def test_sizes_are_along_the_axes_named() -> None:
    assert _extents(box(0.1, 0.2, 0.3)) == [0.1, 0.2, 0.3]
    assert _extents(ellipsoid(0.1, 0.2, 0.3)) == [0.2, 0.4, 0.6]
    assert _extents(ring(0.2, 0.05)) == [0.5, 0.5, 0.1]
    assert _extents(slab([(0, 0), (0.4, 0), (0.4, 0.3), (0, 0.3)], 0.1)) == [0.4, 0.3, 0.1]


def test_solids_are_centred_where_they_should_be() -> None:
    for solid in (box(0.1, 0.2, 0.3), ellipsoid(0.1, 0.2, 0.3), ring(0.2, 0.05)):
        np.testing.assert_allclose(solid.bounds.sum(0), 0, atol=1e-3)
    flat = slab([(0, 0), (0.4, 0), (0.4, 0.3)], 0.1)
    np.testing.assert_allclose(flat.bounds, [[0, 0, -0.05], [0.4, 0.3, 0.05]])


def test_a_lathe_turns_its_profile_about_y() -> None:
    mesh = lathe([(0, -0.2), (0.3, -0.2), (0.1, 0.5), (0, 0.5)])
    x, y, z = mesh.vertices.T
    assert (y.min(), y.max()) == (pytest.approx(-0.2), pytest.approx(0.5))
    radius = np.hypot(x, z)
    assert radius[np.isclose(y, -0.2)].max() == pytest.approx(0.3)
    assert radius[np.isclose(y, 0.5)].max() == pytest.approx(0.1)


def test_a_slab_is_closed() -> None:
    mesh = slab([(0, 0), (0.4, 0), (0.5, 0.2), (0.4, 0.3), (0, 0.3)], 0.1)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    assert (times == 2).all()
    assert mesh.area == pytest.approx(2 * 0.135 + 0.1 * (1.1 + np.hypot(0.1, 0.2) + np.hypot(0.1, 0.1)))


def test_moving_and_turning() -> None:
    np.testing.assert_allclose(at(box(1, 1, 1), 1, 2, 3).bounds.mean(0), [1, 2, 3])
    np.testing.assert_allclose(turned(at(box(1, 1, 1), x=2), (0, 0, 1), 90).bounds.mean(0), [0, 2, 0], atol=1e-12)
    there_and_back = turned(turned(box(1, 2, 3), (1, 0, 0), 35), (1, 0, 0), -35)
    np.testing.assert_allclose(there_and_back.vertices, box(1, 2, 3).vertices, atol=1e-12)


def test_joining_keeps_every_triangle() -> None:
    parts = box(1, 1, 1), at(ellipsoid(1, 1, 1), 5), ring(1, 0.1)
    mesh = joined(*parts)
    assert len(mesh.faces) == sum(len(part.faces) for part in parts)
    assert mesh.bounds[1, 0] == pytest.approx(6, abs=0.01)
