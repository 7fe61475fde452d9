"""The software device looks to the SDK as an L515 does: names, streams, formats, unit, geometry."""

from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import read_settings
from nlos_cam.camera.simulated import SoftwareLidar
from nlos_cam.camera.streams import intrinsics_of, is_needed, stream_name

PINHOLE = load_rig("paper-rig").pinhole
CELSIUS = {"ldd_temperature": 41.5, "apd_temperature": 36.25}


@pytest.fixture(scope="module")
def lidar() -> SoftwareLidar:
    return SoftwareLidar(PINHOLE, load_sdk(), celsius=CELSIUS)


@pytest.fixture(scope="module")
def profiles(lidar: SoftwareLidar) -> dict[str, Any]:
    [sensor] = lidar.device.query_sensors()
    return {stream_name(profile): profile for profile in sensor.get_stream_profiles()}


def test_it_is_named_as_simulated(lidar: SoftwareLidar) -> None:
    info = load_sdk().camera_info
    told = [lidar.device.get_info(key) for key in (info.name, info.serial_number, info.product_line)]
    assert told == ["Simulated L515", "simulated", "L500"]


def test_it_has_the_l515s_depth_sensor_and_unit(lidar: SoftwareLidar) -> None:
    [sensor] = lidar.device.query_sensors()
    assert sensor.get_info(load_sdk().camera_info.name) == "L500 Depth Sensor"
    assert sensor.as_depth_sensor().get_depth_scale() == pytest.approx(0.00025)


def test_it_tells_the_temperatures_that_it_is_given(lidar: SoftwareLidar) -> None:
    [sensor] = lidar.device.query_sensors()
    assert read_settings(sensor, "_temperature") == CELSIUS
    [cold] = SoftwareLidar(PINHOLE, load_sdk()).device.query_sensors()
    assert read_settings(cold, "_temperature") == {}


def test_it_has_the_three_streams_in_the_formats_we_read(profiles: dict[str, Any]) -> None:
    assert set(profiles) == {"depth", "infrared", "confidence"}
    assert all(is_needed(profile) and profile.fps() == 30 for profile in profiles.values())


def test_every_stream_has_the_rigs_intrinsics(profiles: dict[str, Any]) -> None:
    for profile in profiles.values():
        np.testing.assert_allclose(astuple(intrinsics_of(profile)), astuple(PINHOLE), rtol=1e-6)


def test_all_streams_are_seen_from_one_place(profiles: dict[str, Any]) -> None:
    for stream in ("infrared", "confidence"):
        same = profiles["depth"].get_extrinsics_to(profiles[stream])
        np.testing.assert_array_equal(np.reshape(same.rotation, (3, 3)), np.eye(3))
        np.testing.assert_array_equal(same.translation, np.zeros(3))


@pytest.mark.parametrize(("other", "sizes"), [(False, [(640, 480)]), (True, [(640, 480), (320, 240)])])
def test_it_has_another_size_only_where_it_is_asked_for(other: bool, sizes: list[tuple[int, int]]) -> None:
    [sensor] = SoftwareLidar(PINHOLE, load_sdk(), has_other_size=other).device.query_sensors()
    videos = [profile.as_video_stream_profile() for profile in sensor.get_stream_profiles()]
    assert sorted({(video.width(), video.height()) for video in videos}) == sorted(sizes)
    assert len(videos) == 3 * len(sizes)
    assert {(v.width(), v.height()) for v in videos if v.is_default()} == {(640, 480)}
