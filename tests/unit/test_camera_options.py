import pytest
from fake_librealsense import FakeSdk, FakeSensor
from fake_lidar import FakeLidar

from nlos_cam.camera.l515 import NOT_OFFERED, Options


@pytest.fixture
def lidar() -> FakeLidar:
    return FakeLidar(laser_power=93.0)


@pytest.fixture
def options(lidar: FakeLidar) -> Options:
    return Options(FakeSensor(lidar, 0), FakeSdk())


def test_an_option_is_set_and_reads_back_as_wanted(lidar: FakeLidar, options: Options) -> None:
    assert options.put("laser_power", 50.0) == ""
    assert lidar.options["laser_power"] == options.get("laser_power") == 50.0


@pytest.mark.parametrize(("wanted", "set_to"), [(0.0, 190.0), (194.0, 190.0), (197.0, 200.0), (9000.0, 6000.0)])
def test_what_a_range_does_not_allow_is_set_as_near_as_it_does_and_told(
    lidar: FakeLidar, options: Options, wanted: float, set_to: float
) -> None:
    lidar.ranges["min_distance"] = (190.0, 6000.0, 10.0)
    assert options.put("min_distance", wanted) == f"{wanted:g} was wanted, {set_to:g} is read back"
    assert lidar.options["min_distance"] == set_to


def test_an_option_that_is_not_there_is_told_and_not_set(lidar: FakeLidar, options: Options) -> None:
    assert options.put("alternate_ir", 1.0) == NOT_OFFERED
    assert options.get("alternate_ir") is None
    assert options.limits("alternate_ir") is None
    assert "alternate_ir" not in lidar.did


def test_a_refusal_is_told(lidar: FakeLidar, options: Options) -> None:
    lidar.refused = {"laser_power"}
    assert options.put("laser_power", 50.0) == "50 was refused (out of range)"


def test_all_are_set_in_order_and_only_differences_are_told(lidar: FakeLidar, options: Options) -> None:
    lidar.stubborn = {"noise_filtering"}
    told = options.put_all({"min_distance": 0.0, "noise_filtering": 2.0, "laser_power": 40.0})
    assert told == {"noise_filtering": "2 was wanted, 9 is read back"}
    assert lidar.did == ["min_distance", "noise_filtering", "laser_power"]


def test_a_device_that_vanishes_raises_nothing(lidar: FakeLidar, options: Options) -> None:
    lidar.unplug()
    assert options.limits("laser_power") is None
    assert options.get("laser_power") is None
    assert options.put("laser_power", 50.0) == "50 was refused (failed to set power state)"
