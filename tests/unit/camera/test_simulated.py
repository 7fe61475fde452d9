import time
from collections.abc import Callable
from dataclasses import astuple
from itertools import islice
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration import load_rig

from nlos_cam.camera import FORMATS, Recording, load_sdk
from nlos_cam.camera.fault_injection import Delivery, FaultyDevice
from nlos_cam.camera.protocol import WallClock
from nlos_cam.camera.session import read_settings
from nlos_cam.camera.simulated import (
    MAX_LATE_FRAMES,
    MIN_LEAD_S,
    SimulatedCamera,
    SoftwareLidar,
)
from nlos_cam.camera.streams import intrinsics_of, is_needed, stream_name
from nlos_cam.recording import ReplayCamera
from nlos_cam.render import Fault, SensedImages

Timed = Callable[..., tuple[SimulatedCamera, dict[int, float]]]


@pytest.fixture
def timed(noise_world: Any, hurried_clock: Any) -> Timed:
    """Make a camera whose world takes a time by frame number, and the times at which its exposures
    start.
    """

    def make(
        takes_s: Callable[[int], float], **options: Any
    ) -> tuple[SimulatedCamera, dict[int, float]]:
        clock = hurried_clock(0.0)
        start_s = dict[int, float]()

        class World(noise_world):
            def images(self, number: int) -> Any:
                start_s[number] = clock.now()
                clock.time_s += takes_s(number)
                return super().images(number)

        return SimulatedCamera("sim", World(), clock=clock, **options), start_s

    return make


@pytest.mark.parametrize(("takes_s", "lead_s"), [(0.001, MIN_LEAD_S), (0.012, 0.024)])
def test_frames_are_exposed_late_but_in_time(timed: Timed, takes_s: float, lead_s: float) -> None:
    camera, start_s = timed(lambda _: takes_s)
    with camera:
        assert len(list(islice(camera, 6))) == 6
    for number in range(2, 6):
        assert takes_s + number / 30 - start_s[number] == pytest.approx(
            lead_s, abs=1e-6
        )  # compiling took once more


@pytest.mark.parametrize(
    ("late_frames", "dropped"), [(0.9 * MAX_LATE_FRAMES, 0), (3 * MAX_LATE_FRAMES, 1)]
)
def test_late_world_catches_up_or_drops_numbers(
    timed: Timed, tmp_path: Path, late_frames: float, dropped: int
) -> None:
    recording = Recording(tmp_path / "late.bag", frames=40)
    with timed(lambda number: late_frames / 30 if number == 3 else 0.0, recording=recording)[
        0
    ] as camera:
        assert list(camera)
    with ReplayCamera(recording.path) as replayed:
        gaps = np.diff([-1, *(frame.frame_number for frame in replayed)]) - 1

    assert gaps.size == 40
    assert np.count_nonzero(gaps) == dropped
    assert gaps.max() == pytest.approx(dropped * 2 * MAX_LATE_FRAMES, abs=3 * dropped)


class SetClock(WallClock):
    """A clock that stands until it is set."""

    time_s = 0.0

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        due_s = self.time_s + seconds
        while self.time_s < due_s and not stop.wait(0.001):
            pass
        return stop.is_set()


def test_telemetry_holds_the_temperatures_of_the_instant(noise_world: Any, noise_bag: Path) -> None:
    clock = SetClock()
    with SimulatedCamera("sim", noise_world(), clock=clock) as camera:
        assert next(iter(camera)).settings["ldd_temperature"] == 20.0  # as it started
        for instant in (0, 30, 45):
            clock.time_s = (instant + 0.5) / 30
            assert camera.telemetry("_temperature") == {"ldd_temperature": 20.0 + instant}
        assert set(camera.telemetry()) >= {"depth_units", "ldd_temperature"}

    assert camera.telemetry() == camera.telemetry("_temperature") == {}

    with ReplayCamera(noise_bag) as replayed:  # a recording holds the first
        assert next(iter(replayed)).settings["ldd_temperature"] == 20.0
        assert replayed.telemetry("_temperature") == {"ldd_temperature": 20.0}


@pytest.mark.skipif(
    not Path("/proc/self/task").is_dir(), reason="counts native threads, as Linux lists them"
)
def test_native_threads_do_not_pile_up(noise_world: Any, hurried_clock: Any) -> None:
    def run() -> int:
        with SimulatedCamera("sim", noise_world(), clock=hurried_clock()) as camera:
            next(iter(camera))
        return len(list(Path("/proc/self/task").iterdir()))

    before = run()

    assert [run() for _ in range(20)][-1] < before + 10


def test_software_lidar_looks_like_an_l515() -> None:
    sdk = load_sdk()
    pinhole = load_rig("paper-rig").pinhole
    celsius = {"ldd_temperature": 41.5, "apd_temperature": 36.25}
    info = sdk.camera_info
    lidar = SoftwareLidar(pinhole, sdk, celsius=celsius)
    names = [
        lidar.device.get_info(key) for key in (info.name, info.serial_number, info.product_line)
    ]

    assert names == ["Simulated L515", "simulated", "L500"]

    [sensor] = lidar.device.query_sensors()

    assert sensor.get_info(info.name) == "L500 Depth Sensor"
    assert sensor.as_depth_sensor().get_depth_scale() == pytest.approx(0.00025)
    assert read_settings(sensor, "_temperature") == celsius

    [cold] = SoftwareLidar(pinhole, sdk).device.query_sensors()

    assert read_settings(cold, "_temperature") == {}

    profiles = {stream_name(profile): profile for profile in sensor.get_stream_profiles()}

    assert set(profiles) == {"depth", "infrared", "confidence"}

    for profile in profiles.values():
        assert is_needed(profile)
        assert profile.fps() == 30
        np.testing.assert_allclose(astuple(intrinsics_of(profile)), astuple(pinhole), rtol=1e-6)
        same = profiles["depth"].get_extrinsics_to(profile)
        np.testing.assert_array_equal(np.reshape(same.rotation, (3, 3)), np.eye(3))
        np.testing.assert_array_equal(same.translation, np.zeros(3))


def test_wall_clock_never_goes_back_and_waits_until_stopped() -> None:
    clock = WallClock()
    stop = Event()
    before = time.time()
    times = [clock.now() for _ in range(100)]

    assert times == sorted(times)
    assert before - 1.0 < times[0] < time.time() + 1.0
    assert not clock.wait(stop, -1.0)

    stop.set()

    assert clock.wait(stop, 60.0)


def images(instant: int) -> SensedImages:
    """Make images of 4 x 6 pixels that hold their instant."""
    return SensedImages(
        np.full((4, 6), 1000 + instant, np.uint16),
        np.full((4, 6), 100, np.uint8),
        np.full((4, 6), 9, np.uint8),
    )


def handed(*faults: Fault, until: int) -> list[Delivery]:
    device = FaultyDevice(faults)
    return [
        found for instant in range(until) for found in device.deliver(instant, 1e9, images(instant))
    ]


@given(st.integers(0, 1000))
def test_device_without_faults_changes_nothing(instant: int) -> None:
    seen = images(instant)
    [delivery] = FaultyDevice().deliver(instant, 1e9, seen)

    assert delivery.images is seen
    assert delivery.number == instant
    assert delivery.instant == instant
    assert delivery.timestamp_s == 1e9
    assert delivery.streams == tuple(FORMATS)


def test_image_faults_spoil_images_as_named_and_add_up() -> None:
    def spoiled(*kinds: Any) -> SensedImages:
        return handed(*(Fault(kind=kind, at_frame=0) for kind in kinds), until=1)[0].images

    black = spoiled("all_zero")

    assert not any(image.any() for image in (black.depth_z16, black.ir, black.confidence))
    assert (spoiled("saturated").ir == 255).all()
    assert np.count_nonzero(spoiled("half_invalid").depth_z16) == 12
    assert spoiled("wrong_size").depth_z16.shape == spoiled("wrong_size").ir.shape == (2, 3)
    assert [
        each.images.ir.max() for each in handed(Fault(kind="saturated", at_frame=1), until=3)
    ] == [100, 255, 100]

    both = spoiled("half_invalid", "saturated")

    assert np.count_nonzero(both.depth_z16) == 12
    assert both.ir.min() == 255
