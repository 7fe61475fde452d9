import numpy as np
import pytest
import torch
from nlos_calibration.rig import Occluder, load_rig

from nlos_cam.objects.depth_map import cell_centres_m, object_box
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.backend_reference import legs as exact_legs
from nlos_cam.render.backend_torch import Optics, Surface, Wall, legs, scattered
from nlos_cam.render.brdf_table import scattered as scattered_on_arrays
from nlos_cam.render.geometry import softened
from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import phong
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene

CPU = torch.device("cpu")
RIG = load_rig("paper-rig")
SMALL = Accuracy("small", relay_columns=12, relay_rows=10)


def _job(nearest_m: float = 0.2, occluder_x_m: float = 0.2, radiometry: str = "paper") -> TransportJob:
    depth = np.full((12, 12), np.nan, np.float32)
    depth[2:9, 2:9] = nearest_m + 0.01 * np.arange(7) + 0.005 * np.arange(7)[:, None]
    rig = RIG.model_copy(update={"occluder": Occluder(x_m=occluder_x_m, z_min_m=0.1)})
    effects = {"direct", "three-bounce", "occluder", "tilt"}
    job = Prepared.of(Scene(rig, depth, radiometry=radiometry), SMALL, effects).job()
    assert job is not None
    return job


def _optics(job: TransportJob) -> Optics:
    return Optics(job.edge_m, True, job.near_m**2, job.soft_wall_m2, job.lambertian, None, 1 << 18)


def _relay(job: TransportJob) -> Wall:
    relay = job.relay
    return Wall.of(relay.x_m, relay.y_m, relay.length_m, job.relay_weight, device=CPU)


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("nearest_m", [0.2, 0.003])
def test_a_free_leg_weighs_what_s2_says(radiometry: str, nearest_m: float) -> None:
    job = _job(nearest_m, radiometry=radiometry)
    p = job.patches
    weight, length = legs(Surface.of([job], CPU), None, _relay(job), _optics(job), outgoing=True)
    way = np.stack([job.relay.x_m, job.relay.y_m, 0 * job.relay.x_m], 1) - p.point_m[:, None]
    d3 = np.linalg.norm(way, axis=-1)
    np.testing.assert_allclose(length.numpy(), d3, rtol=1e-6)
    expected = job.relay_weight * p.point_m[:, 2:] / d3 / softened(d3**2, job.soft_wall_m2, job.near_m)
    if job.lambertian:
        expected *= (way * p.normal[:, None]).sum(-1) / d3
    free = weight.numpy() > 0
    assert free.any()
    np.testing.assert_allclose(weight.numpy()[free], expected[free], rtol=2e-4)


@pytest.mark.parametrize("occluder_x_m", [0.2, 0.43, 1.0, float(cell_centres_m(object_box(RIG), 12)[0][5])])
def test_occluder_and_lit_side_are_those_of_the_reference(occluder_x_m: float) -> None:
    """The edge before, in the middle of, and behind the object; and right through a column of its patches."""
    job = _job(occluder_x_m=occluder_x_m)
    p, relay = job.patches, job.relay
    exact = exact_legs(p.point_m, p.normal, p.row, p.column, relay.x_m, relay.y_m, *job.edge_m, job.field)
    weight, _ = legs(Surface.of([job], CPU), None, _relay(job), _optics(job), outgoing=True)
    assert exact.any()
    assert not exact.all()
    assert np.array_equal(weight.numpy() > 0, exact)


def test_a_brdf_scatters_on_tensors_as_on_arrays() -> None:
    job, foot, brdf = _job(), np.array([0.6, 0.1, 0.0]), phong(0.5, 0.5, 8.0)
    p, relay = job.patches, job.relay
    found = scattered(brdf, foot, Surface.of([job], CPU), _relay(job)).numpy()
    out = np.stack([relay.x_m, relay.y_m, 0 * relay.x_m], 1)
    for s in (0, 20, 48):
        same = (np.broadcast_to(column, out.shape) for column in (foot, p.point_m[s], p.normal[s]))
        expected = scattered_on_arrays(brdf, *same, out)
        np.testing.assert_allclose(found[s], expected, rtol=1e-3, atol=1e-5)


def test_a_brdf_that_is_a_number_scatters_it_everywhere() -> None:
    job = _job()
    found = scattered(lambda *_: 0.25, np.array([0.6, 0.1, 0.0]), Surface.of([job], CPU), _relay(job))
    assert found.shape == (len(job.patches.beta), len(job.relay.x_m))
    assert set(np.unique(found.numpy())) == {0.25}
