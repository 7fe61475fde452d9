"""The sensor on a rig: gain, dead pixels, confidence, range noise, beams per cell, repeatable frames."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration.rig import Occluder, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.frames import SATURATED
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, cast
from nlos_cam.render.renderer import MultiBounce, Rendering, render
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor.model import DEPTH_UNIT_M, MAX_CONFIDENCE, SensorModel
from nlos_cam.render.sensor.sensor import SensedImages, Sensor, cell_of_pixels

RIG, BARE = load_rig("paper-rig"), load_rig("bare-wall")
QUIET = SensorModel(range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0)
NO_ECHO = MultiBounce(
    np.zeros((64, 80), np.float32), np.zeros((64, 80), np.float32), np.full((64, 80), np.nan, np.float32)
)


def _generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def rendering() -> Rendering:
    assert RIG.object_box is not None
    return render(Scene(RIG, object_depth(3, RIG.object_box)[1]))


@pytest.fixture(scope="module")
def quiet(rendering: Rendering) -> SensedImages:
    return Sensor(RIG, QUIET).expose(rendering.multi, _generator())


def test_the_frame_is_the_same_in_si_units(quiet: SensedImages) -> None:
    frame = quiet.frame(RIG.pinhole)
    np.testing.assert_array_equal(np.isnan(frame.depth_m), quiet.depth_z16 == 0)
    np.testing.assert_allclose(np.nan_to_num(frame.depth_m), quiet.depth_z16 * DEPTH_UNIT_M, rtol=1e-6)
    np.testing.assert_array_equal(frame.ir, quiet.ir)
    np.testing.assert_array_equal(frame.confidence, quiet.confidence)


@pytest.mark.parametrize("counts", [48.0, 100.0])
def test_the_gain_puts_the_brightest_bare_wall_return_at_its_counts(counts: float) -> None:
    model = QUIET.model_copy(update={"bare_wall_counts": counts})
    for rig in (RIG, BARE):
        assert Sensor(rig, model).expose(NO_ECHO, _generator()).ir.max() == counts


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("pulse_ns", [0.0, 1.0])
def test_the_gain_holds_for_any_pulse_and_radiometry(radiometry: Radiometry, pulse_ns: float) -> None:
    scene = Scene(BARE, None, radiometry=radiometry, pulse_ns=pulse_ns)
    model = QUIET.model_copy(update={"pulse_ns": pulse_ns})
    images = Sensor(BARE, model, radiometry).expose(render(scene, "draft").multi, _generator())
    assert images.ir.max() == pytest.approx(48, abs=2)


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
    assert images.confidence.max() == MAX_CONFIDENCE


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
    assert images.confidence.max() <= MAX_CONFIDENCE


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


def test_a_gate_shorter_than_every_path_leaves_black_images() -> None:
    device = BARE.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    images = Sensor(BARE.model_copy(update={"device": device}), SensorModel()).expose(NO_ECHO, _generator())
    assert not images.depth_z16.any()
    assert not images.ir.any()
    assert not images.confidence.any()


def _finer(multi: MultiBounce, k: int) -> MultiBounce:
    """The same echoes from k x k equal beams in each cell."""
    maps = (np.repeat(np.repeat(m, k, 0), k, 1) for m in (multi.peak, multi.runner_up, multi.path_m))
    return MultiBounce(*maps)


@pytest.mark.parametrize("k", [2, 3, 8])
def test_equal_beams_in_a_cell_are_one_beam(rendering: Rendering, k: int) -> None:
    sensor = Sensor(RIG, SensorModel())
    one, many = (sensor.expose(multi, _generator()) for multi in (rendering.multi, _finer(rendering.multi, k)))
    for name in ("depth_z16", "ir", "confidence"):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


@pytest.mark.parametrize("k", [1, 2, 5])
def test_a_pixel_takes_the_beam_whose_part_of_the_cell_holds_its_centre(k: int) -> None:
    rows, columns = 64 * k, 80 * k
    cell = cell_of_pixels((480, 640), (rows, columns)).reshape(480, 640)
    row, column = np.divmod(cell, columns)
    centre_row, centre_column = (np.arange(480) + 0.5) / 480, (np.arange(640) + 0.5) / 640
    assert (np.abs(centre_row[:, None] - (row + 0.5) / rows) <= 0.5 / rows + 1e-12).all()
    assert (np.abs(centre_column - (column + 0.5) / columns) <= 0.5 / columns + 1e-12).all()
    np.testing.assert_array_equal(cell_of_pixels((rows, columns), (rows, columns)), np.arange(rows * columns))


@pytest.mark.parametrize("shape", [(64, 81), (128, 80), (32, 40), (80, 64), (96, 120), (0, 0)])
def test_maps_of_another_shape_are_refused(shape: tuple[int, int]) -> None:
    empty = np.zeros(shape, np.float32)
    with pytest.raises(SceneError, match=r"shape \(\d+, \d+\): give \(64 k, 80 k\)"):
        Sensor(BARE, QUIET).expose(MultiBounce(empty, empty, empty), _generator())


def test_a_direct_return_among_the_echoes_does_not_compete_again() -> None:
    sensor = Sensor(BARE, QUIET)
    faint = replace(NO_ECHO, peak=np.full((64, 80), 1e-9, np.float32), path_m=np.full((64, 80), 1.0, np.float32))
    assert sensor.expose(faint, _generator()).ir.max() == 48
    for echo in (NO_ECHO, faint):
        assert not sensor.expose(replace(echo, direct_included=True), _generator()).ir.any()
    strong = replace(faint, peak=np.full((64, 80), 1.0, np.float32))
    apart, mixed = (sensor.expose(replace(strong, direct_included=mixed), _generator()) for mixed in (False, True))
    np.testing.assert_array_equal(apart.depth_z16, mixed.depth_z16)
    assert (mixed.confidence >= apart.confidence).all()
