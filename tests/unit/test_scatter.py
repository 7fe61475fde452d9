"""A BRDF on legs: compiled and plain agree, and the nodes of its tables add up to every beam."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.brdf_table import MAX_NODES, node_count, nodes, scattered, scattering
from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import Brdf, Surface, phong
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene

BRDF = phong(0.4, 0.6, 10)
COARSE = Accuracy("coarse", relay_columns=4, relay_rows=3)


@pytest.fixture(scope="module")
def job() -> TransportJob:
    depth = np.random.default_rng(0).uniform(0.1, 0.3, (4, 4)).astype(np.float32)
    job = Prepared.of(Scene(load_rig("paper-rig"), depth, Surface(1.0, BRDF), jump_m=0.5), COARSE, "auto").job()
    assert job is not None
    return job


def test_compiled_and_plain_agree_leg_by_leg(job: TransportJob) -> None:
    patches, relay, foot = job.patches, job.relay, job.foot_m[1000]
    table = scattering(BRDF)(foot, patches.point_m, patches.normal, relay.x_m, relay.y_m)
    out = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], 1)
    for s in range(len(patches.beta)):
        same = (np.broadcast_to(column, out.shape) for column in (foot, patches.point_m[s], patches.normal[s]))
        np.testing.assert_allclose(table[s], scattered(BRDF, *same, out), rtol=1e-9)
    assert table.min() >= 0.4
    assert table.max() > 0.5


def test_nodes_share_every_beam_out_and_a_line_between_them_is_exact(job: TransportJob) -> None:
    made = list(nodes(job, BRDF))
    share = np.stack([part for _, part in made])
    feet = np.stack([foot for foot, _ in made])
    np.testing.assert_allclose(share.sum(0), 1)
    np.testing.assert_allclose(share.T @ feet, job.foot_m, atol=1e-9)


def test_nodes_do_not_depend_on_the_beams_that_are_rendered(job: TransportJob) -> None:
    few = job.some(np.array([5, 900]))
    whole = {tuple(foot): share[[5, 900]] for foot, share in nodes(job, BRDF)}
    for foot, share in nodes(few, BRDF):
        np.testing.assert_array_equal(whole[tuple(foot)], share)


def test_a_smaller_error_takes_more_nodes_and_a_plain_surface_the_fewest(job: TransportJob) -> None:
    def count(error: float, brdf: Brdf = BRDF) -> int:
        return node_count(replace(job, accuracy=replace(COARSE, scatter_error=error)), brdf)

    assert count(0.5) == 4
    assert 4 < count(5e-3) <= count(1e-4) <= MAX_NODES
    assert count(1e-4, phong(0.5, 0.0, 10)) == 4
