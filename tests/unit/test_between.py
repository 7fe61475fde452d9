"""Form factors between patches and wall: what leaves is what arrives, and no more."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.interreflection import (
    WALL_CELLS,
    form_factor,
    patch_to_patch,
    wall_cell_m2,
    wall_cells,
    wall_factors,
)
from nlos_cam.render.job import TransportJob
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
UP, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def job() -> TransportJob:
    at = np.linspace(-1, 1, 6)
    depth = (0.2 - 0.06 * (at[:, None] ** 2 + at**2)).astype(np.float32)
    scene = Scene(RIG, depth, radiometry="lambertian", jump_m=0.5)
    job = Prepared.of(scene, Accuracy("coarse", 8, 6), ["three-bounce", "tilt", "inter-reflection"]).job()
    assert job is not None
    return job


@pytest.mark.parametrize("lambertian", [True, False])
def test_two_squares_face_to_face_see_each_other_as_s2_says(lambertian: bool) -> None:
    a, b = np.zeros(3), np.array([0.3, 0.0, 0.4])
    found = form_factor(a, UP, b, DOWN, 1e-4, 1.0, 0.1, lambertian)
    expected = 1e-4 * 0.8 / 0.25 / ((np.pi / 0.8) if lambertian else 2 * np.pi)
    assert found == pytest.approx(expected)
    for back in ((a, DOWN, b, DOWN), (a, UP, b, UP)):
        assert form_factor(*back, 1e-4, 1.0, 0.1, lambertian) == 0


def test_patches_of_a_bowl_see_each_other_alike_both_ways_and_give_less_than_all(job: TransportJob) -> None:
    p = job.patches
    surface = p.point_m, p.normal, job.strength, job.soft_patch_m2, p.row, p.column
    table = patch_to_patch(*surface, job.field, 1e-9, True)  # beyond near contact
    assert (table > 0).any()
    assert not np.diag(table).any()
    given = table / job.strength
    np.testing.assert_allclose(given, given.T, atol=1e-9 * given.max())
    near = patch_to_patch(*surface, job.field, job.near_m, True)
    assert near.sum(1).max() <= 1


def test_the_wall_about_the_object_takes_less_than_all(job: TransportJob) -> None:
    cells = wall_cells(job)
    assert len(cells) == WALL_CELLS**2
    extent = np.ptp(cells[:, :2], axis=0) * WALL_CELLS / (WALL_CELLS - 1)
    assert wall_cell_m2(job) * len(cells) == pytest.approx(extent.prod())
    there, back = wall_factors(job, cells)
    assert 0.5 < there.sum(1).max() <= 1
    assert back.sum(0).max() <= 1
