"""A plan carried out: what each effect that is left out takes away from beams, wall and jobs."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.effects import EFFECTS
from nlos_cam.render.geometry import NEAR_DIAGONALS, NO_OCCLUDER
from nlos_cam.render.job import TransportJob, near_legs
from nlos_cam.render.material import Surface, phong
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Radiometry, Scene

RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
DEPTH = (0.25 + 0.01 * np.arange(8) * np.ones((8, 1))).astype(np.float32)
SCENE = Scene(RIG, DEPTH, Surface(np.array([0.9, 0.6, 0.3]), phong(0.5, 0.5, 3)))


def _without(*names: str) -> Prepared:
    return Prepared.of(SCENE, COARSE, set(EFFECTS) - set(names))


def _job(ready: Prepared) -> TransportJob:
    job = ready.job()
    assert job is not None
    return job


def test_with_every_effect_nothing_is_missing() -> None:
    ready = _without()
    job = _job(ready)
    assert ready.channels == 3
    assert job.more_bounces
    assert job.field.shades
    assert job.brdf is SCENE.surface.brdf
    assert job.patches.beta.max() > 1
    assert job.edge_m == (0.2, 0.1)
    assert job.relay.x_m.max() < 0.4


def test_each_effect_left_out_leaves_its_mark() -> None:
    assert not _without("direct").beams.direct.any()
    assert _without("three-bounce").job() is None
    assert _without("colour").channels == 1
    assert _job(_without("tilt")).patches.beta.max() == 1
    assert not _job(_without("self-occlusion")).field.shades
    open_job = _job(_without("occluder"))
    assert open_job.edge_m == NO_OCCLUDER
    assert len(open_job.relay.x_m) == 48
    assert len(open_job.foot_m) > len(_job(_without()).foot_m)
    short = _job(_without("inter-reflection"))
    assert not short.more_bounces
    assert short.bins < _job(_without()).bins
    dull = _job(_without("brdf"))
    assert dull.brdf is None
    assert dull.patches.albedo.mean() == pytest.approx(0.6 * (0.5 + 0.5 + 0.5 * 2.5) / 2)  # the middle of its range


def test_channels_have_their_own_albedo() -> None:
    ready = _without("brdf", "inter-reflection")
    white = [ready.job(channel) for channel in (0, 2)]
    assert white[0] is not None
    assert white[1] is not None
    np.testing.assert_allclose(white[0].strength, 3 * white[1].strength)


def test_rows_keep_their_beams_and_the_bins_of_the_whole_map() -> None:
    whole, part = _job(_without()), Prepared.of(SCENE, COARSE, EFFECTS, rows=(10, 12))
    job = _job(part)
    assert part.beams.shape == (2, 80)
    assert job.bins == whole.bins
    assert len(job.foot_m) == part.beams.on_wall.sum()
    np.testing.assert_array_equal(job.foot_m, part.beams.foot_m[part.beams.on_wall])
    assert len(job.map_foot_m) == len(whole.foot_m)


def test_histograms_that_do_not_fit_are_refused_before_they_are_tried() -> None:
    device = RIG.device.model_copy(update={"bin_m": 1e-6})
    scene = Scene(RIG.model_copy(update={"device": device}), DEPTH)
    with pytest.raises(SceneError, match=r"beams of \d+ bins need .* GiB, at most 4: lower beams_per_cell \(1\)"):
        Prepared.of(scene, COARSE, "auto").job()


def test_near_legs_are_those_shorter_than_some_diagonals() -> None:
    job = _job(_without())
    assert job.near_m == NEAR_DIAGONALS * max(job.patches.diagonal_m, job.relay.diagonal_m)
    points = job.patches.point_m[:, None]
    cells = np.stack([job.relay.x_m, job.relay.y_m, np.zeros_like(job.relay.x_m)], 1)
    expected = sum((np.linalg.norm(points - ends, axis=-1) < job.near_m).sum() for ends in (job.foot_m, cells))
    assert near_legs(job) == expected > 0


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
def test_a_jobs_weights_are_the_factors_of_s2(radiometry: Radiometry) -> None:
    job = _job(Prepared.of(Scene(RIG, DEPTH, Surface(0.5), radiometry), COARSE, "auto"))
    relay, solid = job.relay, np.pi if radiometry == "lambertian" else 2 * np.pi
    np.testing.assert_allclose(job.strength, 0.5 * job.patches.beta * job.patches.cell_m2)
    far = relay.length_m > job.near_m
    expected = relay.cell_m2 / (solid**2 * relay.length_m**2)
    if radiometry == "lambertian":
        expected = expected * job.receiver_cell_m2 * relay.cos_lidar
        np.testing.assert_allclose(job.beam_weight, 1 / solid)
    else:
        np.testing.assert_allclose(job.beam_weight, job.cos_incidence / solid)
    np.testing.assert_allclose(job.relay_weight[far], expected[far])
    assert (job.relay_weight <= expected * (1 + 1e-12)).all()
