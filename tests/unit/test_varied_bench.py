import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.outliers import SLIGHT, WIDE, Spread, moved, varied, varied_empty
from nlos_cam.render.sensor.model import SensorModel

RIG, SENSOR = load_rig("paper-rig"), SensorModel()
NONE = Spread(*(0.0,) * len(SLIGHT))


def test_a_lidar_is_moved_by_what_is_said_and_the_rest_of_the_rig_stays() -> None:
    other = moved(RIG, 0.01, 2.0, -3.0)
    assert other.lidar.distance_m == pytest.approx(RIG.lidar.distance_m + 0.01)
    assert other.facing_deg == pytest.approx(47.0, abs=0.2)
    assert other.model_copy(update={"lidar": RIG.lidar}) == RIG


def test_without_a_spread_the_bench_is_the_given_one() -> None:
    assert varied(RIG, SENSOR, NONE, np.random.default_rng(0)) == (RIG, SENSOR)


@pytest.mark.parametrize("spread", [SLIGHT, WIDE])
def test_every_bench_lies_within_its_spread(spread: Spread) -> None:
    for seed in range(50):
        rig, sensor = varied(RIG, SENSOR, spread, np.random.default_rng(seed))
        assert abs(rig.lidar.distance_m - RIG.lidar.distance_m) <= spread.place_m
        assert max(abs(rig.lidar.yaw_deg - 45.0), abs(rig.lidar.pitch_deg)) <= spread.angle_deg
        assert abs(np.log(sensor.bare_wall_counts / SENSOR.bare_wall_counts)) <= spread.gain + 1e-9
        assert sensor.ambient_counts <= spread.ambient_counts
        assert sensor.ripple_m <= spread.ripple_m


def test_empty_benches_are_plain_ones_wide_ones_and_some_without_an_occluder() -> None:
    benches = [varied_empty(RIG, SENSOR, np.random.default_rng(seed)) for seed in range(200)]
    assert any(sensor == SENSOR for _, sensor in benches)
    assert any(abs(rig.lidar.distance_m - 0.2) > SLIGHT.place_m for rig, _ in benches)
    without = sum(rig.occluder is None for rig, _ in benches)
    assert 5 < without < 50
