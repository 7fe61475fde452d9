"""The wall's texture: a factor of the light that stays, and that moves no depth."""

import cv2
import numpy as np
import pytest
from nlos_calibration.rig import Rig, load_rig

from nlos_cam.render.renderer import MultiBounce
from nlos_cam.render.sensor.bias import texture
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import SensedImages, Sensor

SHAPE = 240, 320
QUIET = SensorModel(range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0)


def _rig() -> Rig:
    rig = load_rig("paper-rig")
    small = rig.pinhole.scaled(SHAPE[1], SHAPE[0])
    return rig.model_copy(update={"intrinsics": rig.intrinsics.model_copy(update=vars(small))})


def _seen(strength: float, brightness: float = 1.0) -> SensedImages:
    """A scene in which direct returns and three bounces compete, `brightness` times as bright."""
    generator, sensor = np.random.default_rng(5), Sensor(_rig(), QUIET.model_copy(update={"wall_texture": strength}))
    brightest = sensor._optics.direct.max() * brightness
    peak = (brightest * generator.uniform(0, 1.5, (64, 80))).astype(np.float32)
    path_m = generator.uniform(0.5, 3.0, (64, 80)).astype(np.float32)
    return sensor.expose(MultiBounce(peak, peak / 3, path_m, direct_included=False), generator)


def test_an_even_wall_has_no_factor() -> None:
    assert texture(SHAPE, 0.0).size == 0


@pytest.mark.parametrize("strength", [0.01, 0.2, 1.0])
def test_its_mean_is_1_and_its_logarithm_spreads_as_told(strength: float) -> None:
    factor = texture(SHAPE, strength)
    assert factor.shape == (SHAPE[0] * SHAPE[1],)
    assert factor.min() > 0
    assert factor.mean() == pytest.approx(1, rel=1e-5)
    assert np.log(factor).std() == pytest.approx(strength, rel=1e-4)


def test_a_wall_stays_as_it_is() -> None:
    np.testing.assert_array_equal(texture(SHAPE, 0.2), texture(SHAPE, 0.2))
    np.testing.assert_allclose(2 * np.ptp(np.log(texture(SHAPE, 0.1))), np.ptp(np.log(texture(SHAPE, 0.2))), rtol=1e-4)


def test_it_is_of_stains_and_of_grain_as_small_as_a_cell() -> None:
    pattern = np.log(texture(SHAPE, 0.2)).reshape(SHAPE)
    stains = cv2.GaussianBlur(pattern, (0, 0), 8)
    assert 0.3 < (stains.std() / pattern.std()) ** 2 < 0.7
    grain, cell = pattern - stains, SHAPE[1] // 80
    near, far = (np.corrcoef(grain[:, :-by].ravel(), grain[:, by:].ravel())[0, 1] for by in (1, 2 * cell))
    assert near > 0.8  # no finer than a pixel
    assert abs(far) < 0.2


def test_the_light_is_what_an_even_wall_gives_times_the_factor() -> None:
    rough, even = (_seen(strength).ir.astype(float) for strength in (0.2, 0.0))
    factor = texture(SHAPE, 0.2).reshape(SHAPE)
    assert even.max() < 200
    assert np.abs(rough - factor * even).max() <= 0.5 + factor.max() / 2


def test_no_depth_moves_and_where_the_wall_is_darker_the_lidar_is_less_sure() -> None:
    rough, even = (_seen(strength, brightness=0.05) for strength in (0.5, 0.0))
    both = (rough.depth_z16 > 0) & (even.depth_z16 > 0)
    assert both.mean() > 0.3
    np.testing.assert_array_equal(rough.depth_z16[both], even.depth_z16[both])
    darker = texture(SHAPE, 0.5).reshape(SHAPE) < 1
    apart = rough.confidence.astype(int) - even.confidence
    assert (apart[darker] <= 0).all()
    assert (apart[~darker] >= 0).all()
    assert (apart[darker] < 0).any()
    assert (apart[~darker] > 0).any()
