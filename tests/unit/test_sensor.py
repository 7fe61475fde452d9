"""The sensor chain: truth within quantisation when noise is off, and each step of it when it is on."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration.rig import Occluder, Rig, load_rig
from pydantic import ValidationError

from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, cast
from nlos_cam.render.renderer import MultiBounce, Rendering, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import DEPTH_UNIT_M, MOST_CONFIDENT, SATURATED, SensedImages, Sensor, SensorModel

RIG, BARE = load_rig("paper-rig"), load_rig("bare-wall")
QUIET = SensorModel(
    range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0, bare_wall_counts=48
)
NO_ECHO = MultiBounce(
    np.zeros((64, 80), np.float32), np.zeros((64, 80), np.float32), np.full((64, 80), np.nan, np.float32)
)


def _at_map_size(rig: Rig) -> Rig:
    """The same rig with one pixel for each map cell."""
    cells = rig.pinhole.scaled(80, 64)
    intrinsics = rig.intrinsics.model_copy(
        update={name: getattr(cells, name) for name in ("width", "height", "fx", "fy", "ppx", "ppy")}
    )
    return rig.model_copy(update={"intrinsics": intrinsics})


def _generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def rendering() -> Rendering:
    assert RIG.object_box is not None
    return render(Scene(RIG, object_depth(3, RIG.object_box)[1]))


@pytest.fixture(scope="module")
def quiet(rendering: Rendering) -> SensedImages:
    return Sensor(_at_map_size(RIG), QUIET).expose(rendering.multi, _generator())


def test_without_noise_it_reports_the_renderers_winner_within_quantisation(
    rendering: Rendering, quiet: SensedImages
) -> None:
    returned = quiet.depth_z16 > 0
    assert returned.mean() > 0.5
    assert not (returned & np.isnan(rendering.depth_m)).any()
    error = quiet.depth_z16[returned] * DEPTH_UNIT_M - rendering.depth_m[returned]
    assert np.abs(error).max() <= DEPTH_UNIT_M / 2 + 1e-6


def test_without_noise_ir_is_linear_in_intensity_and_saturates(rendering: Rendering, quiet: SensedImages) -> None:
    bare = _at_map_size(BARE)
    gain = 48 / render(Scene(bare)).intensity.max()
    counts = np.minimum(gain * rendering.intensity, SATURATED)
    assert np.abs(quiet.ir - counts).max() <= 0.5 + 1e-3


def test_the_frame_is_the_same_in_si_units(quiet: SensedImages) -> None:
    frame = quiet.frame(_at_map_size(RIG).pinhole)
    np.testing.assert_array_equal(np.isnan(frame.depth_m), quiet.depth_z16 == 0)
    np.testing.assert_allclose(np.nan_to_num(frame.depth_m), quiet.depth_z16 * DEPTH_UNIT_M, rtol=1e-6)
    np.testing.assert_array_equal(frame.ir, quiet.ir)
    np.testing.assert_array_equal(frame.confidence, quiet.confidence)


@pytest.mark.parametrize("counts", [48.0, 100.0])
def test_the_gain_puts_the_brightest_bare_wall_return_at_its_counts(counts: float) -> None:
    model = QUIET.model_copy(update={"bare_wall_counts": counts})
    for rig in (RIG, BARE):
        assert Sensor(rig, model).expose(NO_ECHO, _generator()).ir.max() == counts


def test_the_gain_does_not_depend_on_what_stands_before_the_wall() -> None:
    near = RIG.model_copy(update={"occluder": Occluder(x_m=0.1, z_min_m=0.05)})
    images, free = (Sensor(rig, QUIET).expose(NO_ECHO, _generator()) for rig in (near, BARE))
    on_wall = cast(near, near.pinhole).on_wall.reshape(images.ir.shape)
    assert 0 < on_wall.sum() < on_wall.size
    np.testing.assert_array_equal(images.ir[on_wall], free.ir[on_wall])


def test_a_strong_echo_saturates_at_255() -> None:
    flood = replace(NO_ECHO, peak=np.full((64, 80), 1e6, np.float32), path_m=np.full((64, 80), 1.0, np.float32))
    images = Sensor(RIG, SensorModel()).expose(flood, _generator())
    assert (images.ir == SATURATED).all()
    assert images.confidence.max() == MOST_CONFIDENT


def test_dead_pixels_are_a_matter_of_the_sensor_not_of_the_frame() -> None:
    model = QUIET.model_copy(update={"dead_share": 0.05})
    first, second = Sensor(BARE, model), Sensor(BARE, model)
    dead = first.expose(NO_ECHO, _generator()).depth_z16 == 0
    for sensor, seed in ((first, 1), (second, 2)):
        np.testing.assert_array_equal(sensor.expose(NO_ECHO, _generator(seed)).depth_z16 == 0, dead)
    alive = Sensor(BARE, QUIET).expose(NO_ECHO, _generator()).depth_z16 > 0
    assert (dead & alive).sum() / alive.sum() == pytest.approx(0.05, abs=0.003)


def test_a_dead_pixel_still_gives_ir() -> None:
    model = QUIET.model_copy(update={"dead_share": 0.9})
    images = Sensor(BARE, model).expose(NO_ECHO, _generator())
    np.testing.assert_array_equal(images.ir, Sensor(BARE, QUIET).expose(NO_ECHO, _generator()).ir)


def test_no_confidence_gives_no_depth(rendering: Rendering) -> None:
    images = Sensor(RIG, SensorModel(bare_wall_counts=0.3)).expose(rendering.multi, _generator())
    assert (images.confidence == 0).any()
    assert (images.depth_z16[images.confidence == 0] == 0).all()
    assert images.confidence.max() <= MOST_CONFIDENT


def test_confidence_grows_with_the_margin() -> None:
    sensor, previous = Sensor(BARE, QUIET), np.zeros((480, 640))
    peak, path = np.full((64, 80), 1e-3, np.float32), np.full((64, 80), 1.0, np.float32)
    for share in (1.0, 0.8, 0.5, 0.2, 0.0):
        echo = MultiBounce(peak, (share * peak).astype(np.float32), path)
        confidence = sensor.expose(echo, _generator()).confidence
        assert (confidence >= previous).all()
        previous = confidence
    assert previous.max() > sensor.expose(MultiBounce(peak, peak, path), _generator()).confidence.max()


def test_confidence_grows_with_the_intensity() -> None:
    images = [
        Sensor(BARE, QUIET.model_copy(update={"bare_wall_counts": counts})).expose(NO_ECHO, _generator())
        for counts in (1.0, 8.0, 48.0, 200.0)
    ]
    for fainter, brighter in pairwise(images):
        assert (brighter.confidence >= fainter.confidence).all()
        assert brighter.confidence.sum() > fainter.confidence.sum()


def test_the_generators_seed_repeats_the_frame(rendering: Rendering) -> None:
    sensor = Sensor(RIG, SensorModel())
    first, again, other = (sensor.expose(rendering.multi, _generator(seed)) for seed in (5, 5, 6))
    for name in ("depth_z16", "ir", "confidence"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert (first.depth_z16 != other.depth_z16).any()
    np.testing.assert_array_equal(first.confidence, other.confidence)


def test_range_noise_has_the_spread_that_the_model_says() -> None:
    model = QUIET.model_copy(update={"range_noise_m": 0.002, "range_noise_per_m": 0.01})
    truth = Sensor(BARE, QUIET).expose(NO_ECHO, _generator()).depth_z16
    noisy = Sensor(BARE, model).expose(NO_ECHO, _generator(1)).depth_z16
    both = (truth > 0) & (noisy > 0)
    depth_m = truth[both] * DEPTH_UNIT_M
    in_sigmas = (noisy[both] * DEPTH_UNIT_M - depth_m) / (0.002 + 0.01 * depth_m)
    assert in_sigmas.mean() == pytest.approx(0, abs=0.02)
    assert in_sigmas.std() == pytest.approx(1, abs=0.02)


def test_read_and_shot_noise_add_in_squares() -> None:
    flat = replace(NO_ECHO, peak=np.full((64, 80), 1e-3, np.float32), path_m=np.full((64, 80), 1.0, np.float32))
    counts = float(Sensor(BARE, QUIET).expose(flat, _generator()).ir[240, 600])
    model = QUIET.model_copy(update={"read_noise_counts": 3.0, "shot_noise": 0.5})
    noisy = Sensor(BARE, model).expose(flat, _generator(1)).ir[:, 500:].astype(float)
    assert 30 < counts < SATURATED - 30
    assert noisy.mean() == pytest.approx(counts, abs=0.5)
    assert noisy.std() == pytest.approx(np.sqrt(9 + 0.25 * counts), rel=0.02)


def test_a_gate_shorter_than_every_path_leaves_black_images() -> None:
    device = BARE.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    images = Sensor(BARE.model_copy(update={"device": device}), SensorModel()).expose(NO_ECHO, _generator())
    assert not images.depth_z16.any()
    assert not images.ir.any()
    assert not images.confidence.any()


@pytest.mark.parametrize(
    ("field", "value"), [("bare_wall_counts", 0), ("shot_noise", -1), ("dead_share", 1.0), ("gain", 2)]
)
def test_a_model_that_cannot_be_names_its_field(field: str, value: float) -> None:
    with pytest.raises(ValidationError, match=field):
        SensorModel.model_validate({field: value})
