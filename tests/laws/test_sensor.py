"""Laws of the sensor: fast equals slow, moments of the noise, ambient light, and hard inputs."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import Rig, load_rig
from numpy.random import default_rng

from nlos_cam.frames import SATURATED
from nlos_cam.objects import object_depth
from nlos_cam.render import QUIET, MultiBounce, Rendering, Scene, SensedImages, Sensor, cast, render
from nlos_cam.render.sensor.bias import (
    PATCHES_SEED,
    RIPPLES_SEED,
    WAVES,
    ripples,
    smooth_patches,
    texture,
)
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, MAX_CONFIDENCE, SensorModel, WarmUp

RICH = SensorModel(ambient_counts=40, read_noise_counts=1.5, dead_share=0)
BIAS: dict[str, object] = {
    "warm_up": WarmUp(
        from_celsius=25,
        to_celsius=45,
        time_constant_s=600,
    )
}
BIAS |= {
    "range_offset_m": 0.0045,
    "ripple_m": 0.002,
    "patch_drift_m": 0.001,
    "drift_m_per_celsius": 0.0002,
}
BIASED = RICH.model_copy(update=BIAS)
CELSIUS = 30.0
ROUGH = BIASED.model_copy(update={"wall_texture": 0.3})
FRAMES = 100


def _at_map_size(rig: Rig) -> Rig:
    """The same rig with one pixel for each map cell."""
    cells = rig.intrinsics.model_copy(update=vars(rig.pinhole.scaled(80, 64)))
    return rig.model_copy(update={"intrinsics": cells})


RIG = _at_map_size(load_rig("paper-rig"))
BARE = _at_map_size(load_rig("bare-wall"))
BRIGHTEST = float(cast(BARE, BARE.pinhole).direct.max())


def _echo(
    counts: np.ndarray | float,
    path_m: np.ndarray | float = 1.0,
) -> MultiBounce:
    """Echoes of these counts without a direct return."""
    peak = np.broadcast_to(
        np.asarray(counts) * BRIGHTEST / 48,
        (64, 80),
    ).astype(np.float32)
    path = np.broadcast_to(path_m, (64, 80)).astype(np.float32)
    return MultiBounce(
        peak,
        np.zeros((64, 80), np.float32),
        path,
        direct_included=True,
    )


def _frames(model: SensorModel, echo: MultiBounce) -> list[SensedImages]:
    sensor = Sensor(BARE, model)
    generator = default_rng(1)
    return [sensor.expose(echo, generator) for _ in range(FRAMES)]


@pytest.fixture(scope="module")
def rendering() -> Rendering:
    scene = Scene(load_rig("paper-rig"))
    return render(Scene(scene.rig, object_depth(3, scene.box)[1]))


def test_quiet_sensor_reports_the_rendering_within_rounding(rendering: Rendering) -> None:
    images = Sensor(RIG, QUIET).expose(rendering.multi, default_rng(0))
    returned = images.depth_z16 > 0

    assert returned.mean() > 0.5
    assert not (returned & np.isnan(rendering.depth_m)).any()

    error = images.depth_z16[returned] * DEPTH_UNIT_M - rendering.depth_m[returned]

    assert np.abs(error).max() <= DEPTH_UNIT_M / 2 + 1e-6

    counts = np.minimum(48 / BRIGHTEST * rendering.intensity, SATURATED)

    assert np.abs(images.ir - counts).max() <= 0.5 + 1e-3


def _bias_m(model: SensorModel) -> np.ndarray:
    """At CELSIUS, a quarter of the way from cold to warm."""
    wave = ripples((64, 80), WAVES, default_rng(RIPPLES_SEED)).ravel()
    pattern = smooth_patches((64, 80), default_rng(PATCHES_SEED)).ravel()
    drift_m = (
        0.25 * model.patch_drift_m * (pattern - pattern.mean()) - 15 * model.drift_m_per_celsius
    )
    return model.ripple_m * wave - model.range_offset_m + drift_m


@pytest.mark.parametrize(
    "model",
    [SensorModel(), RICH, BIASED, ROUGH, QUIET],
    ids=["default", "rich", "biased", "rough", "quiet"],
)
def test_sensor_equals_plain_float64_array_steps(rendering: Rendering, model: SensorModel) -> None:
    """The same chain written as plain array steps, in float64."""
    fast = Sensor(RIG, model).expose(
        rendering.multi,
        default_rng(3),
        celsius=CELSIUS,
    )
    multi = rendering.multi
    beams = cast(RIG, RIG.pinhole)
    generator = default_rng(3)
    peak, runner_up, path = (
        each.ravel().astype(float)
        for each in (
            multi.peak,
            multi.runner_up,
            multi.path_m,
        )
    )
    one, other = (
        generator.standard_normal(peak.size, np.float32) if model != QUIET else 0 for _ in range(2)
    )
    intensity = np.maximum(peak, beams.direct)
    second = np.maximum(np.minimum(peak, beams.direct), runner_up)
    counts = (
        48
        / BRIGHTEST
        * intensity
        * (texture((64, 80), model.wall_texture) if model.wall_texture else 1)
    )
    read = model.read_noise_counts**2
    shot = model.shot_noise**2
    alone, noise = (
        np.sqrt(read + shot * (counts + light))
        for light in (
            0,
            model.ambient_counts,
        )
    )
    seen = np.minimum(counts + model.ambient_counts + one * noise, SATURATED) - model.ambient_counts
    certain = counts * (alone / noise if model.ambient_counts else 1)
    confidence = (
        15 * (1 - np.exp(-certain / 6)) * (1 - 0.5 * second / np.maximum(intensity, 1e-30)) + 0.5
    )
    depth = (
        np.where(
            peak > beams.direct,
            path / 2,
            beams.length_m,
        )
        * beams.cos_axis
    )
    depth += _bias_m(model)
    depth += other * (model.range_noise_m + model.range_noise_per_m * depth)
    dead = default_rng(0).random(peak.size) < model.dead_share
    kept = (intensity > 0) & (confidence >= 1) & ~dead
    z16 = np.where(kept, np.nan_to_num(depth) / DEPTH_UNIT_M + 0.5, 0)
    ir = np.where(
        intensity > 0,
        np.clip(seen + 0.5, 0, SATURATED),
        0,
    )
    pairs = (
        (fast.depth_z16, z16),
        (fast.ir, ir),
        (fast.confidence, np.where(intensity > 0, confidence, 0)),
    )
    for image, slow in pairs:
        apart = np.abs(image.ravel() - np.floor(slow))
        assert (apart == 0).mean() > 0.999  # float32 against float64 falls to either side of a tie
        assert apart.max() <= 1


@pytest.mark.parametrize("path_m", [0.4, 1.0, 3.0])
def test_bias_is_the_same_for_near_and_far_returns(path_m: float) -> None:
    plain = QUIET.model_copy(update=BIAS)
    echo = _echo(60.0, path_m)
    free = Sensor(BARE, QUIET)
    apart = [
        sensor.expose(echo, default_rng(1), celsius=CELSIUS).depth_z16.astype(float)
        - free.expose(echo, default_rng(2)).depth_z16
        for sensor in [Sensor(BARE, plain)] * 2
    ]

    np.testing.assert_array_equal(*apart)
    assert np.abs(apart[0].ravel() * DEPTH_UNIT_M - _bias_m(plain)).max() <= DEPTH_UNIT_M + 1e-6


@pytest.mark.parametrize("counts", [15.0, 60.3, 120.0])
@pytest.mark.parametrize("ambient", [0.0, 40.0, 90.0])
def test_variance_is_that_of_read_shot_and_ambient_noise(counts: float, ambient: float) -> None:
    frames = _frames(
        RICH.model_copy(update={"ambient_counts": ambient}),
        echo := _echo(counts),
    )
    variance = 1.5**2 + 0.3**2 * (counts + ambient) + 1 / 12  # the last: rounding to whole counts

    assert np.var([f.ir for f in frames]) == pytest.approx(variance, rel=0.01)
    assert np.mean([f.ir for f in frames]) == pytest.approx(counts, abs=0.03)

    truth = Sensor(BARE, QUIET).expose(echo, default_rng(0)).depth_z16.astype(float)

    assert (
        np.mean(
            [f.depth_z16 for f in frames],
            axis=0,
        )
        - truth
    ).mean() == pytest.approx(0, abs=0.1)


def test_noise_is_white_and_independent_of_range_noise() -> None:
    echo = _echo(60.0)
    truth = Sensor(BARE, QUIET).expose(echo, default_rng(0)).depth_z16.astype(float)
    frames = _frames(RICH, echo)
    ir = np.array([f.ir - 60.0 for f in frames])
    depth = np.array([(f.depth_z16 - truth) / truth for f in frames])
    neighbours = (
        (
            ir[:, :, 1:],
            ir[:, :, :-1],
        ),
        (ir[:, 1:], ir[:, :-1]),
    )
    for one, other in (
        *neighbours,
        (ir[1:], ir[:-1]),
        (ir, depth),
        (depth[1:], depth[:-1]),
    ):
        assert (
            abs(
                np.corrcoef(
                    one.ravel(),
                    other.ravel(),
                )[0, 1]
            )
            < 0.01
        )


@pytest.mark.parametrize("ambient", [0.0, 40.0, 254.0])
def test_ir_rises_with_intensity_and_saturates(ambient: float) -> None:
    counts = np.geomspace(1e-3, 1e3, 5120).reshape(64, 80)
    model = QUIET.model_copy(update={"ambient_counts": ambient})
    ir = (
        Sensor(BARE, model)
        .expose(
            _echo(counts),
            default_rng(0),
        )
        .ir.astype(float)
    )

    assert (np.diff(ir.ravel()) >= 0).all()
    assert ir.max() == SATURATED - ambient
    assert (
        np.abs(
            ir
            - np.minimum(
                counts,
                SATURATED - ambient,
            )
        ).max()
        <= 0.5 + 1e-3
    )


@pytest.mark.parametrize(
    "model",
    [SensorModel(), QUIET],
    ids=["default", "quiet"],
)
def test_confidence_never_rises_with_ambient_light(
    rendering: Rendering, model: SensorModel
) -> None:
    images = [
        Sensor(RIG, model.model_copy(update={"ambient_counts": ambient})).expose(
            rendering.multi, default_rng(0)
        )
        for ambient in (0.0, 1e-9, 5.0, 40.0, 150.0, 254.9)
    ]
    for darker, brighter in pairwise(images):
        assert (brighter.confidence <= darker.confidence).all()
    # light without shot noise hides nothing
    assert (images[-1].confidence.sum() < images[0].confidence.sum()) == (model.shot_noise > 0)


def test_more_ambient_light_leaves_fewer_depths() -> None:
    faint = _echo(np.geomspace(0.1, 10, 5120).reshape(64, 80))
    models = [SensorModel(ambient_counts=ambient) for ambient in (0.0, 20.0, 200.0)]
    depths = [
        (Sensor(BARE, model).expose(faint, default_rng(0)).depth_z16 > 0).sum() for model in models
    ]

    assert depths[0] > depths[1] > depths[2] > 0


ODD = np.array(
    [
        0,
        -0.0,
        -1,
        1e-38,
        1e-6,
        1e-3,
        1,
        1e6,
        1e38,
        np.nan,
        np.inf,
        -np.inf,
    ],
    np.float32,
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32),
    included=st.booleans(),
    model=st.builds(
        SensorModel,
        bare_wall_counts=st.sampled_from([1e-300, 48.0, 1e6]),
        wall_texture=st.sampled_from([0.0, 5e-324, 1.0]),
        ambient_counts=st.sampled_from([0.0, 5e-324, 40.0, 254.9]),
        shot_noise=st.sampled_from([0.0, 1e-200, 0.3, 255.0]),
        read_noise_counts=st.sampled_from([0.0, 1e-200, 0.7, 255.0]),
        range_noise_per_m=st.sampled_from([0.0, 0.002, 1.0]),
        dead_share=st.sampled_from([0.0, 0.5]),
        range_offset_m=st.sampled_from([0.0, -1.0, 1.0]),
        ripple_m=st.sampled_from([0.0, 1e-200, 1.0]),
        drift_m_per_celsius=st.sampled_from([0.0, -1.0, 1.0]),
        warm_up=st.sampled_from([None, BIASED.warm_up]),
    ),
)
def test_any_input_gives_a_possible_image(seed: int, included: bool, model: SensorModel) -> None:
    generator = default_rng(seed)
    spread = (10 ** generator.uniform(-9, 3, 5120)).astype(np.float32)
    peak, runner_up, path = (
        np.where(
            generator.random(5120) < 0.5,
            spread,
            generator.choice(ODD, 5120),
        ).reshape(64, 80)
        for _ in range(3)
    )
    multi = MultiBounce(peak, runner_up, path, direct_included=included)
    one, same = (
        Sensor(RIG, model).expose(
            multi,
            default_rng(seed),
            celsius=CELSIUS,
        )
        for _ in range(2)
    )
    for name in ("depth_z16", "ir", "confidence"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))

    assert one.confidence.max() <= MAX_CONFIDENCE
    assert not one.depth_z16[one.confidence == 0].any()

    if included:
        assert not one.depth_z16[np.isnan(path)].any()
        nothing = ~((peak > 0) & (peak < np.inf))
        assert not one.ir[nothing].any()
        assert not one.confidence[nothing].any()

    assert not np.isinf(one.frame(RIG.pinhole).depth_m).any()
