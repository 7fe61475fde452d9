from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float64

from nlos_cam.errors import SceneError
from nlos_cam.render import (
    Accuracy,
    Scene,
    SensorModel,
    Surface,
    backend_reference,
    paper_scene,
    phong,
    prepare,
)
from nlos_cam.render.gradients import (
    Gradients,
    SceneVector,
    depth_bound,
    fit_pose,
    intensity_noise,
    moved,
)

ECHOES = {"three-bounce", "tilt"}
COARSE = Accuracy("coarse", 24, 24, sub_bins=64)


def bent_plate(bin_m: float = 10.0, radiometry: Any = "paper", cells: int = 6) -> Scene:
    """Return a gently bent plate with a missing corner, far from every boundary of visibility."""
    rig = load_rig("paper-rig")
    device = rig.device.model_copy(update={"bin_m": bin_m})
    y, x = np.mgrid[:cells, :cells] / cells
    depth = 0.25 + 0.01 * np.sin(3 * x) * np.cos(2 * y)
    depth[0, :2] = np.nan
    albedo = 0.4 + 0.5 * x
    return Scene(
        rig.model_copy(update={"device": device, "occluder": None}),
        depth,
        Surface(albedo),
        radiometry,
    )


@cache
def gradients(bin_m: float = 10.0, radiometry: str = "paper") -> Gradients:
    return Gradients(bent_plate(bin_m, radiometry), COARSE, ECHOES)


def reference(problem: Any, beams: Any) -> Float64:
    """Return the reference's histograms (k, bins) of chosen beams, in float64."""
    lit = np.cumsum(problem.beams.on_wall) - 1
    return backend_reference.histograms(problem.job.select(lit[beams]))


def spread_beams(found: Gradients, count: int = 8) -> Any:
    wins = np.flatnonzero(found.three_bounce)
    return wins[:: len(wins) // count][:count]


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("body", ["lidar", "wall"])
def test_pose_derivatives_are_the_differences_of_the_reference(radiometry: str, body: str) -> None:
    # One bin of 10 m holds all light: only the weights of the paths change, and differences have no
    # noise of binning.
    found = gradients(radiometry=radiometry)
    beams = spread_beams(found)
    change = np.random.default_rng(1).normal(size=6)
    ahead, behind = (
        reference(moved(found.problem, **{body: sign * 1e-4 * change}), beams)[:, 0]
        for sign in (1, -1)
    )
    light, _ = found.push(SceneVector(**{body: change}))

    np.testing.assert_allclose(light.ravel()[beams], (ahead - behind) / 2e-4, rtol=2e-5)


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
def test_depth_derivatives_are_the_differences_of_the_reference(radiometry: Any) -> None:
    scene = bent_plate(radiometry=radiometry)
    found = gradients(radiometry=radiometry)
    depth = scene.object_depth_m
    beams = spread_beams(found)
    change = np.random.default_rng(2).normal(size=depth.shape)
    ahead, behind = (
        reference(
            prepare(replace(scene, object_depth_m=depth + sign * 1e-5 * change), COARSE, ECHOES),
            beams,
        )[:, 0]
        for sign in (1, -1)
    )
    light, _ = found.push(SceneVector(depth_m=change))
    difference = (ahead - behind) / 2e-5

    np.testing.assert_allclose(
        light.ravel()[beams], difference, atol=1e-4 * np.abs(difference).max()
    )


@pytest.mark.slow
def test_derivative_over_a_path_is_the_difference_across_bins() -> None:
    # Light crosses the edges of 5 cm bins while the plate recedes by 4 cm: the mean derivative is
    # the difference. The strongest bin changes on the way, and its intensity is continuous there.
    scene = bent_plate(0.05, cells=12)
    accuracy = replace(COARSE, relay_columns=96, relay_rows=96)
    steps = np.linspace(-0.02, 0.02, 9)
    problems = [
        prepare(replace(scene, object_depth_m=scene.object_depth_m + s), accuracy, ECHOES)
        for s in steps
    ]
    beams = spread_beams(Gradients(problems[4]), 24)
    change = SceneVector(depth_m=np.ones(scene.object_depth_m.shape))
    rates = [Gradients(problem).push(change)[0].ravel()[beams] for problem in problems]
    ends = [reference(problem, beams).max(1) for problem in (problems[0], problems[-1])]
    difference = ends[1] - ends[0]
    error = np.trapezoid(rates, steps, axis=0) - difference

    assert np.linalg.norm(error) < 0.06 * np.linalg.norm(
        difference
    )  # relay cells that cross an edge one by one


@pytest.mark.slow
def test_albedo_times_its_derivative_is_the_intensity() -> None:
    found = Gradients(paper_scene().scene_at(0))
    sum_of_beams = found.pull(found.three_bounce.astype(np.float64))
    share = sum_of_beams.albedo * found.image(found.echo_job.patches.albedo)

    assert share.sum() == pytest.approx(found.intensity[found.three_bounce].sum(), rel=1e-3)
    assert (share >= 0).all()


@pytest.mark.parametrize("brdf", [None, phong(0.5, 0.5, 20)])
def test_light_is_of_first_degree_in_the_albedo(brdf: Any) -> None:
    """Also where a BRDF is left out, and its mean is a factor of the albedo. The sum over relay
    cells is smoothed for derivatives, which costs two percent on a grid this coarse.
    """
    scene = replace(bent_plate(0.01), surface=Surface(0.6, brdf))
    found = Gradients(scene, COARSE, sorted(ECHOES))
    wins = found.three_bounce.astype(np.float64)
    whole = found.intensity[found.three_bounce].sum()
    everywhere = np.full(scene.object_depth_m.shape, 0.6)

    assert 0.6 * np.nansum(found.pull(wins).albedo) == pytest.approx(whole, rel=0.03)
    assert (wins * found.push(SceneVector(albedo=everywhere))[0]).sum() == pytest.approx(
        whole, rel=0.03
    )
    assert 0.6 * found.jacobian("albedo")[0].sum() == pytest.approx(whole, rel=0.03)


def test_derivatives_are_finite_where_object_and_wall_touch() -> None:
    depth = bent_plate(0.01).object_depth_m.copy()
    depth[2, 2] = 0.0
    scene = replace(bent_plate(0.01), object_depth_m=depth, jump_m=0.5)
    found = Gradients(scene, COARSE, sorted(ECHOES))
    pulled = found.pull(np.ones(found.intensity.shape), np.ones(found.intensity.shape))

    assert found.three_bounce.any()
    for vector in (pulled.depth_m, pulled.albedo, pulled.lidar, pulled.wall):
        assert np.isfinite(vector).all()
    for parameters in ("depth", "lidar", "wall"):
        for part in found.jacobian(parameters):
            assert np.isfinite(part).all()


@pytest.mark.parametrize("bin_m", [10.0, 0.01])
def test_pull_is_the_transpose_of_push(bin_m: float) -> None:
    found = gradients(bin_m)
    draw = np.random.default_rng(3).normal
    shape = found.echo_job.field.depth_m.shape
    points = (len(found.echo_job.patches.beta), 3)
    change = SceneVector(*(draw(size=size) for size in (shape, shape, points, 6, 6)))
    weights = draw(size=found.intensity.shape), 1e-3 * draw(size=found.intensity.shape)
    forward = sum(
        float((w * rate).sum()) for w, rate in zip(weights, found.push(change), strict=True)
    )
    pulled = found.pull(*weights)
    backward = sum(
        float((getattr(pulled, name) * getattr(change, name)).sum()) for name in vars(change)
    )

    assert backward == pytest.approx(forward, rel=1e-4)


def test_jacobian_sums_to_push() -> None:
    found = gradients(0.01)
    for name in ("depth", "albedo"):
        matrix = found.jacobian(name)
        whole = SceneVector(**{{"depth": "depth_m"}.get(name, name): np.ones((6, 6))})
        for part, rates in zip(matrix, found.push(whole), strict=True):
            limit = 1e-5 * np.abs(part).max()
            np.testing.assert_allclose(
                part.sum(1), rates[found.three_bounce], rtol=1e-3, atol=limit
            )


def test_path_of_a_receding_lidar_grows_by_both_legs() -> None:
    # A lidar that recedes from the wall along its normal: a direct return's path grows at 2 / cos
    # t1.
    found = Gradients(replace(bent_plate(0.01), object_depth_m=None))
    _, path = found.push(SceneVector(lidar=np.array([0, 0, 1.0, 0, 0, 0])))
    cosine = found.problem.beams.cos_incidence.reshape(path.shape)

    np.testing.assert_allclose(path[found.direct], 2 / cosine[found.direct])


def test_path_of_three_bounces_follows_their_lengths() -> None:
    # All paths lead over one relay cell and one patch: the derivative of their length is known.
    scene = replace(bent_plate(), object_depth_m=np.full((1, 1), 0.3), surface=Surface())
    found = Gradients(scene, Accuracy("one", 1, 1, sub_bins=64), {"three-bounce"})
    job = found.echo_job
    change = np.array([0.3, -0.2, 0.5])
    _, path = found.push(SceneVector(point_m=change[None]))
    point = job.patches.point_m[0]
    cell = np.array([job.relay.x_m[0], job.relay.y_m[0], 0])
    units = [
        (point - end) / np.linalg.norm(point - end, axis=-1, keepdims=True)
        for end in (job.laser_spot_m, cell)
    ]

    np.testing.assert_allclose(
        path[found.three_bounce], (units[0] + units[1]) @ change, rtol=1e-4, atol=1e-5
    )


def test_bound_falls_with_frames_and_is_below_the_prior() -> None:
    found = Gradients(bent_plate(0.01), COARSE, ECHOES)
    noise = [intensity_noise(found, SensorModel(), frames) for frames in (1, 100)]
    few, many = (depth_bound(found, each, prior_m=0.05) for each in noise)
    surface = ~np.isnan(few.bound_m)

    assert (few.bound_m[surface] <= 0.05 + 1e-9).all()
    assert (many.bound_m[surface] <= few.bound_m[surface] + 1e-9).all()
    np.testing.assert_allclose(many.alone_m[surface], few.alone_m[surface] / 10, rtol=1e-6)
    assert many.determined > few.determined


@pytest.mark.slow
def test_fit_finds_the_pose_of_a_displaced_lidar() -> None:
    problem = prepare(bent_plate(0.01, cells=12), COARSE, ECHOES)
    truth = np.array([0.003, -0.002, 0.002, 0.003, -0.004, 0.002])
    measured = Gradients(moved(problem, lidar=truth))
    noise = intensity_noise(measured, SensorModel(), 100)
    fit = fit_pose(problem, measured.intensity.astype(np.float64), noise, model_error=0.001)

    assert np.linalg.norm(fit.motion - truth) < 0.2 * np.linalg.norm(truth)

    used = measured.three_bounce & np.isfinite(noise)
    before, after = (
        np.square((measured.intensity - Gradients(at).intensity)[used] / noise[used]).mean()
        for at in (problem, fit.problem)
    )

    assert after < 0.01 * before
    assert fit.cost[1] < fit.cost[0]


def test_gradients_refuse_uncovered_effects_and_joined_cells() -> None:
    with pytest.raises(SceneError, match="pulse"):
        Gradients(replace(bent_plate(0.01), pulse_ns=1.0))
    with pytest.raises(SceneError, match="draft"):
        Gradients(bent_plate(0.01, cells=8), "draft")


def test_scene_without_echoes_has_no_object_gradients() -> None:
    found = Gradients(replace(bent_plate(0.01), object_depth_m=None))

    assert not found.three_bounce.any()
    assert found.jacobian("depth")[0].shape == (0, 0)

    with pytest.raises(SceneError, match="no beam"):
        _ = found.echo_job


def test_noise_is_infinite_where_nothing_of_the_wall_returns() -> None:
    rig = load_rig("paper-rig")
    device = rig.device.model_copy(update={"gate_s": 1e-12})
    dark = Gradients(Scene(rig.model_copy(update={"device": device})))

    assert np.isinf(intensity_noise(dark, SensorModel())).all()
