"""Sensor on a rig: model, gain, dead pixels, bias and texture (formulas:
tests/laws/test_sensor.py).
"""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.rig import Occluder, load_rig
from numpy.random import default_rng
from pydantic import ValidationError

from nlos_cam.errors import SceneError
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects.placement import object_depth
from nlos_cam.render import (
    QUIET,
    STOPS,
    MultiBounce,
    Radiometry,
    Scene,
    Sensor,
    cast,
    render,
    sensor_effects,
)
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S
from nlos_cam.render.sensor.bias import DepthBias, ripples, smooth_patches, texture
from nlos_cam.render.sensor.cells import QUANTILES, draw_deviates, normal_quantiles
from nlos_cam.render.sensor.model import STEADY_CELSIUS, SensorModel, WarmUp
from nlos_cam.render.sensor.sensor import cell_of_pixels

RIG = load_rig("paper-rig")
BARE = load_rig("bare-wall")
DARK = np.zeros((64, 80), np.float32)
NO_ECHO = MultiBounce(DARK, DARK, np.full_like(DARK, np.nan))


@pytest.mark.parametrize("counts", [48.0, 100.0])
def test_gain_puts_the_brightest_return_at_its_counts(counts: float) -> None:
    model = QUIET.model_copy(update={"bare_wall_counts": counts})
    for rig in (RIG, BARE):
        assert (
            Sensor(rig, model)
            .expose(
                NO_ECHO,
                default_rng(0),
            )
            .ir.max()
            == counts
        )


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("pulse_ns", [0.0, 1.0])
def test_gain_holds_for_any_pulse_and_radiometry(radiometry: Radiometry, pulse_ns: float) -> None:
    scene = Scene(BARE, None, radiometry=radiometry, pulse_ns=pulse_ns)
    model = QUIET.model_copy(update={"pulse_ns": pulse_ns})
    images = Sensor(BARE, model, radiometry).expose(
        render(scene, "draft").multi,
        default_rng(0),
    )

    assert images.ir.max() == pytest.approx(48, abs=2)


def test_gain_does_not_depend_on_the_occluder() -> None:
    near = RIG.model_copy(update={"occluder": Occluder(x_m=0.1, z_min_m=0.05)})
    images, free = (
        Sensor(rig, QUIET).expose(
            NO_ECHO,
            default_rng(0),
        )
        for rig in (near, BARE)
    )
    on_wall = cast(near, near.pinhole).on_wall.reshape(images.ir.shape)

    assert 0 < on_wall.sum() < on_wall.size
    np.testing.assert_array_equal(images.ir[on_wall], free.ir[on_wall])


def test_dead_pixels_stay_from_frame_to_frame() -> None:
    model = QUIET.model_copy(update={"dead_share": 0.05})
    first = Sensor(BARE, model)
    second = Sensor(BARE, model)
    dead = first.expose(NO_ECHO, default_rng(0)).depth_z16 == 0
    for sensor, seed in ((first, 1), (second, 2)):
        np.testing.assert_array_equal(
            sensor.expose(NO_ECHO, default_rng(seed)).depth_z16 == 0, dead
        )
    whole = Sensor(BARE, QUIET).expose(NO_ECHO, default_rng(0))

    np.testing.assert_array_equal(
        first.expose(NO_ECHO, default_rng(0)).ir,
        whole.ir,
    )

    alive = whole.depth_z16 > 0

    assert (dead & alive).sum() / alive.sum() == pytest.approx(0.05, abs=0.003)


def test_sensor_with_a_short_gate_gives_black_images() -> None:
    device = BARE.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    images = Sensor(
        BARE.model_copy(update={"device": device}),
        SensorModel(),
    ).expose(NO_ECHO, default_rng(0))

    assert not images.depth_z16.any()
    assert not images.ir.any()
    assert not images.confidence.any()


@pytest.mark.parametrize("k", [1, 2, 5])
def test_cell_of_pixels_takes_the_beam_at_the_pixel_center(k: int) -> None:
    rows = 64 * k
    columns = 80 * k
    cell = cell_of_pixels(
        (480, 640),
        (rows, columns),
    ).reshape(480, 640)
    row, column = np.divmod(cell, columns)
    centre_row = (np.arange(480) + 0.5) / 480
    centre_column = (np.arange(640) + 0.5) / 640

    assert (np.abs(centre_row[:, None] - (row + 0.5) / rows) <= 0.5 / rows + 1e-12).all()
    assert (np.abs(centre_column - (column + 0.5) / columns) <= 0.5 / columns + 1e-12).all()
    np.testing.assert_array_equal(
        cell_of_pixels(
            (rows, columns),
            (rows, columns),
        ),
        np.arange(rows * columns),
    )


@pytest.mark.parametrize(
    "shape",
    [
        (64, 81),
        (128, 80),
        (32, 40),
        (80, 64),
        (96, 120),
        (0, 0),
    ],
)
def test_sensor_refuses_maps_of_another_shape(shape: tuple[int, int]) -> None:
    empty = np.zeros(shape, np.float32)
    with pytest.raises(SceneError, match=re.escape(str(shape))):
        Sensor(BARE, QUIET).expose(
            MultiBounce(empty, empty, empty),
            default_rng(0),
        )


def test_included_direct_return_does_not_compete_again() -> None:
    sensor = Sensor(BARE, QUIET)
    faint = replace(
        NO_ECHO,
        peak=np.full_like(DARK, 1e-9),
        path_m=np.ones_like(DARK),
    )

    assert sensor.expose(faint, default_rng(0)).ir.max() == 48

    for echo in (NO_ECHO, faint):
        assert not sensor.expose(
            replace(echo, direct_included=True),
            default_rng(0),
        ).ir.any()
    strong = replace(faint, peak=np.ones_like(DARK))
    apart, mixed = (
        sensor.expose(replace(strong, direct_included=mixed), default_rng(0))
        for mixed in (False, True)
    )

    np.testing.assert_array_equal(apart.depth_z16, mixed.depth_z16)
    assert (mixed.confidence >= apart.confidence).all()


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("shot_noise", (-1e-8, 256.0, float("nan"), float("inf"))),
        ("ambient_counts", (255.0, float("nan"))),
        ("warm_up", ({"from_celsius": 45, "to_celsius": 45, "time_constant_s": 600},)),
    ],
)
def test_sensor_model_refuses_values_out_of_range_by_field(
    field: str, values: tuple[object, ...]
) -> None:
    for value in values:
        with pytest.raises(ValidationError, match=field):
            SensorModel.model_validate({field: value})


@given(st.floats(0, 1e5), st.floats(0, 1e5))
def test_celsius_at_approaches_the_end_of_the_warm_up(one_s: float, other_s: float) -> None:
    model = SensorModel(warm_up=WarmUp(from_celsius=25, to_celsius=45, time_constant_s=600))

    assert SensorModel().celsius_at(one_s) == STEADY_CELSIUS

    earlier, later = (model.celsius_at(seconds) for seconds in sorted((one_s, other_s)))

    assert 25 <= earlier <= later <= 45
    # the remaining difference shrinks to 1/e in each time constant
    assert 45 - model.celsius_at(one_s + 600) == pytest.approx(
        (45 - model.celsius_at(one_s)) / 2.718281828, abs=1e-6
    )


SHAPE = 120, 160
WARM_UP = WarmUp(from_celsius=25, to_celsius=45, time_constant_s=600)


def _bias_m(celsius: float | None, **fields: float | WarmUp) -> np.ndarray:
    model = SensorModel.model_validate(fields)
    return DepthBias(SHAPE, model, sensor_effects(model)).at_m(celsius)


def test_bias_is_empty_by_default_and_drifts_when_not_warm() -> None:
    for celsius in (None, 0.0, 100.0):
        assert _bias_m(celsius).size == _bias_m(celsius, warm_up=WARM_UP).size == 0
    for celsius, shift_m in (
        (45.0, 0.0),
        (None, 0.0),
        (35.0, -0.002),
        (25.0, -0.004),
    ):
        drift_m = _bias_m(celsius, drift_m_per_celsius=0.0002, warm_up=WARM_UP)
        np.testing.assert_allclose(drift_m, shift_m, rtol=1e-6)


def test_ripples_are_a_wave_with_five_periods_of_any_direction() -> None:
    wave_m = _bias_m(None, ripple_m=0.002).reshape(SHAPE)

    assert np.abs(wave_m).max() == pytest.approx(0.002, rel=0.01)
    assert abs(wave_m.mean()) < 0.1 * 0.002

    power = np.abs(np.fft.rfft2(wave_m)) ** 2
    rows, columns = np.divmod(
        int(power.argmax()),
        power.shape[1],
    )
    periods = np.hypot(
        min(rows, SHAPE[0] - rows) * SHAPE[1] / SHAPE[0],
        columns,
    )

    assert periods == pytest.approx(5.0, abs=1.0)

    waves = [ripples(SHAPE, 4.0, default_rng(seed)) for seed in range(8)]
    alike = np.corrcoef([wave.ravel() for wave in waves]) - np.eye(8)

    assert np.abs(alike).max() < 0.9


def test_patches_are_smooth_and_of_unit_spread() -> None:
    pattern = smooth_patches(SHAPE, default_rng(0))

    assert pattern.std() == pytest.approx(1.0)
    assert np.abs(np.diff(pattern)).max() < 0.5

    few, many = (
        smooth_patches(
            SHAPE,
            default_rng(0),
            across,
        )
        for across in (4, 24)
    )

    assert np.diff(few).std() < np.diff(many).std() / 2


def test_patch_drift_grows_in_place_as_the_device_warms() -> None:
    cold, half, warm = (
        _bias_m(celsius, patch_drift_m=0.001, warm_up=WARM_UP) for celsius in (25.0, 35.0, 45.0)
    )

    assert not cold.any()
    assert warm.std() == pytest.approx(0.001, rel=1e-4)
    assert warm.mean() == pytest.approx(0.0, abs=1e-7)  # a shift of the whole view is the drift
    np.testing.assert_allclose(half, warm / 2, rtol=1e-5)
    np.testing.assert_array_equal(_bias_m(None, patch_drift_m=0.001), warm)


WALL = 240, 320


@pytest.mark.parametrize("strength", [0.01, 0.2, 1.0])
def test_texture_has_mean_1_and_its_strength_as_log_spread(strength: float) -> None:
    factor = texture(WALL, strength)

    assert factor.shape == (WALL[0] * WALL[1],)
    assert factor.min() > 0
    assert factor.mean() == pytest.approx(1, rel=1e-5)
    assert np.log(factor).std() == pytest.approx(strength, rel=1e-4)
    np.testing.assert_array_equal(texture(WALL, strength), factor)

    half = np.log(texture(WALL, strength / 2))

    np.testing.assert_allclose(
        2 * np.ptp(half),
        np.ptp(np.log(factor)),
        rtol=1e-4,
    )
    assert texture(WALL, 0.0).size == 0


def test_texture_has_stains_and_grain_of_a_cell() -> None:
    pattern = np.log(texture(WALL, 0.2)).reshape(WALL)
    stains = cv2.GaussianBlur(pattern, (0, 0), 8)

    assert 0.3 < (stains.std() / pattern.std()) ** 2 < 0.7

    grain = pattern - stains
    cell = WALL[1] // 80
    near, far = (
        np.corrcoef(
            grain[:, :-by].ravel(),
            grain[:, by:].ravel(),
        )[0, 1]
        for by in (1, 2 * cell)
    )

    assert near > 0.8  # no finer than a pixel
    assert abs(far) < 0.2


BIASED = {"dead_share": 0.1, "ripple_m": 0.003}
BRIGHT = {"ambient_counts": 60.0, "bare_wall_counts": 200.0}


@pytest.mark.parametrize(
    "change",
    [{}, BIASED, BRIGHT, {"wall_texture": 0.2}],
)
@pytest.mark.parametrize("beams", [1, 2])
def test_maps_without_noise_are_those_of_the_images_bit_for_bit(
    change: dict[str, float], beams: int
) -> None:
    scene = Scene(RIG, object_depth(3, RIG.object_box)[1])
    multi = render(scene, replace(STOPS["draft"], beams_per_cell=beams)).multi
    sensor = Sensor(RIG, QUIET.model_copy(update=change))
    for echoes in (multi, replace(multi, direct_included=True)):
        found = sensor.maps(echoes, default_rng(0))
        expected = maps_from_frame(sensor.expose(echoes, default_rng(0)).frame(RIG.pinhole))
        for name in ("depth_m", "intensity", "valid"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_maps_have_the_noise_of_the_images() -> None:
    echoes = render(
        Scene(
            RIG,
            object_depth(3, RIG.object_box)[1],
        )
    ).multi
    sensor = Sensor(RIG, SensorModel())
    frames = 40
    exposed = [sensor.expose(echoes, default_rng(k)).frame(RIG.pinhole) for k in range(frames)]
    drawn = [sensor.maps(echoes, default_rng(k)) for k in range(frames)]
    for name in ("depth_m", "intensity"):
        one, other = (
            np.stack([getattr(m, name) for m in maps])
            for maps in (drawn, map(maps_from_frame, exposed))
        )
        variance = (one.var(0) + other.var(0)) / 2
        noisy = np.isfinite(variance) & (variance > 1e-12)
        assert noisy.mean() > 0.5
        apart = ((one.mean(0) - other.mean(0)) / np.sqrt(2 * variance / (frames - 1)))[noisy]
        assert abs(apart.mean()) < 4 / np.sqrt(apart.size)
        assert apart.std() == pytest.approx(1, abs=0.06)
        with np.errstate(divide="ignore"):
            ratio = np.log(one.var(0) / other.var(0))[noisy]
        assert abs(np.median(ratio)) < 0.03
        # Two-sample Kolmogorov-Smirnov on the residuals of all cells together.
        middle = (one.mean(0) + other.mean(0)) / 2
        spread = np.sqrt(variance)
        with np.errstate(divide="ignore", invalid="ignore"):
            residuals = [
                np.sort(((maps - middle) / spread)[:, noisy].ravel()) for maps in (one, other)
            ]
        every = np.concatenate(residuals)
        shares = [np.searchsorted(part, every, "right") / part.size for part in residuals]
        assert np.abs(shares[0] - shares[1]).max() < 1.95 * np.sqrt(2 / residuals[0].size)


def test_deviates_are_normal_and_follow_the_seed() -> None:
    quantiles = normal_quantiles()

    assert quantiles.size == QUANTILES
    assert quantiles.astype(float).std() == pytest.approx(1, abs=1e-6)

    light, ranges, again = np.empty((3, 200_000), np.float32)
    draw_deviates(np.uint64(7), 0, light.size, quantiles, light, ranges)
    draw_deviates(np.uint64(7), 0, light.size, quantiles, again, ranges)

    np.testing.assert_array_equal(light, again)

    for values in (light, ranges):
        assert abs(values.mean()) < 0.01
        assert values.var() == pytest.approx(1, abs=0.015)
        assert abs((values[1:] * values[:-1]).mean()) < 0.01
        assert (np.abs(values) > 3).mean() == pytest.approx(0.0027, abs=5e-4)

    assert abs((light * ranges).mean()) < 0.01


@pytest.mark.parametrize("change", [{}, {"wall_texture": 0.2}])
@pytest.mark.parametrize("beams", [1, 2])
def test_sensor_sees_an_object_that_stops_its_beams(change: dict[str, float], beams: int) -> None:
    rig = BARE.model_copy(update={"object_box": RIG.object_box})
    accuracy = replace(STOPS["draft"], beams_per_cell=beams)
    scene = Scene(rig, np.full((8, 8), 0.06, np.float32))
    rendering = render(scene, accuracy)
    empty = render(Scene(rig), accuracy)
    sensor = Sensor(rig, QUIET.model_copy(update=change))
    found = sensor.maps(rendering.multi, default_rng(0))
    images = sensor.expose(rendering.multi, default_rng(0))
    nearer = rendering.depth_m < empty.depth_m - 0.05
    counts = rendering.intensity * 48 / empty.intensity.max()

    assert nearer.sum() > 100
    # Pixels of a cell at the object's rim may see it from its front and from its side.
    assert np.median(np.abs(found.depth_m - rendering.depth_m)[nearer]) < 0.001
    assert np.quantile(np.abs(found.depth_m - rendering.depth_m)[nearer], 0.9) < 0.01
    assert np.median(np.abs(found.intensity - counts)[nearer]) < 0.6
    np.testing.assert_array_equal(found.depth_m, maps_from_frame(images.frame(rig.pinhole)).depth_m)


def test_rendering_without_an_object_in_sight_stops_no_beam() -> None:
    hidden = Scene(RIG, object_depth(3, RIG.object_box)[1])

    assert render(hidden, "draft").multi.stopped is None
    assert render(Scene(BARE), "draft").multi.stopped is None


@pytest.mark.parametrize("size", [(20, 20), (33, 31), (64, 48)])
def test_maps_of_few_pixels_are_those_of_the_images(size: tuple[int, int]) -> None:
    """The last map cells have no pixel of their own."""
    width, height = size
    pixels = {"width": width, "height": height, "ppx": width / 2 - 0.5, "ppy": height / 2 - 0.5}
    scales = {"fx": 457 * width / 640, "fy": 461 * height / 480}
    few = RIG.intrinsics.model_copy(update=pixels | scales)
    rig = RIG.model_copy(update={"intrinsics": few})
    echoes = render(Scene(rig), "draft").multi
    sensor = Sensor(rig, QUIET)
    found = sensor.maps(echoes, default_rng(0))
    images = sensor.expose(echoes, default_rng(0)).frame(rig.pinhole)

    assert found.valid.any()
    np.testing.assert_array_equal(found.depth_m, maps_from_frame(images).depth_m)
