from collections.abc import Callable
from itertools import islice, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_librealsense import CUSTOM, FakeSdk, FakeSensor
from fake_lidar import FakeLidar, NapClock

from nlos_cam.camera.l515 import NEAR_WALL, L515Camera, Options, connected
from nlos_cam.camera.laser_power import STRIDES, PowerLimits, turn_down, weaker
from nlos_cam.camera.streams import FORMATS
from nlos_cam.errors import CameraError, CameraNotFoundError
from nlos_cam.frames import MAX_SATURATED

Make = Callable[..., Any]
ENDLESS = (10**6,)


@pytest.mark.parametrize(
    ("lidars", "serial", "words"),
    [
        ([], "", "USB 3"),
        ([FakeLidar("123", name="Intel RealSense D435")], "", "Intel RealSense D435 123"),
        ([FakeLidar("f1"), FakeLidar("f2")], "", "l515:f1, l515:f2"),
        ([FakeLidar("f1")], "f9", "f9"),
    ],
)
def test_camera_that_is_not_found_lists_what_is(
    fake_camera: Make, lidars: list[FakeLidar], serial: str, words: str
) -> None:
    with pytest.raises(CameraNotFoundError, match=words):
        fake_camera(*lidars, serial=serial)


def test_serial_may_be_written_as_on_the_label(fake_camera: Make) -> None:
    camera = fake_camera(FakeLidar("f0246262"), FakeLidar("f1"), serial="00000000F0246262")

    assert camera.identity["serial"] == "f0246262"


@pytest.mark.parametrize(("usb", "size"), [("3.2", (640, 480)), ("2.1", (320, 240))])
def test_usb_link_decides_the_resolution(
    fake_camera: Make, caplog: pytest.LogCaptureFixture, usb: str, size: tuple[int, int]
) -> None:
    device = FakeLidar(usb=usb)
    with fake_camera(device) as camera:
        assert (camera.intrinsics.width, camera.intrinsics.height) == size
        assert [(profile.stream, profile.size) for profile in device.opened] == [
            (one, size) for one in FORMATS
        ]

    assert ("USB 2.1" in caplog.text) == (usb == "2.1")
    assert usb == "2.1" or not caplog.records  # settings that take are not logged


def test_settings_that_do_not_take_are_logged_once(
    fake_camera: Make, caplog: pytest.LogCaptureFixture
) -> None:
    lidar = FakeLidar()
    lidar.stubborn = {"min_distance"}
    lidar.refused = {"noise_filtering"}
    del lidar.options["invalidation_bypass"]
    camera = fake_camera(lidar)
    for _ in range(2):
        with camera:
            assert set(camera.differences) == {
                "min_distance",
                "noise_filtering",
                "invalidation_bypass",
            }
            lidar.deliver(range(1, 2))
            frame = next(iter(camera))
            assert frame.settings == lidar.options  # as read back
            assert frame.settings["min_distance"] == 9.0
    for name, word in (
        ("min_distance", "9"),
        ("noise_filtering", "out of range"),
        ("invalidation_bypass", ""),
    ):
        [record] = [record for record in caplog.records if name in record.message]
        assert word in record.message


def test_unreadable_device_is_reported_and_hides_no_other() -> None:
    def fail(_: str) -> bool:
        raise RuntimeError("no such luck")

    sdk = FakeSdk(FakeLidar("f1"), FakeLidar("f2"))
    broken, other = sdk.context().query_devices()
    broken.supports = fail
    [(_, info)] = connected(sdk, SimpleNamespace(query_devices=lambda: [broken, other]))

    assert info.serial == "f2"

    with pytest.raises(CameraError, match="no such luck"):
        connected(sdk, SimpleNamespace(query_devices=lambda: [broken]))


def test_setting_that_takes_late_is_set_once_more(fake_camera: Make) -> None:
    lidar = FakeLidar()
    clock = NapClock(lambda naps: lidar.stubborn.clear() if naps == 1 else None)
    lidar.stubborn = {"min_distance"}
    with fake_camera(lidar, clock=clock) as camera:
        assert camera.differences == {}

    assert clock.naps == [0.5, 0.5]
    assert lidar.did.count("min_distance") == 2
    assert lidar.did.count("noise_filtering") == 1


@pytest.mark.parametrize(
    ("name", "nap", "wanted"), [("visual_preset", 0, CUSTOM), ("min_distance", 1, 0.0)]
)
def test_setting_that_the_start_resets_is_set_again(
    fake_camera: Make, name: str, nap: int, wanted: float
) -> None:
    lidar = FakeLidar()
    reset = {name: lidar.factory[name]}
    with fake_camera(
        lidar, clock=NapClock(lambda naps: lidar.options.update(reset if naps == nap else {}))
    ) as camera:
        assert camera.differences == {}

    assert lidar.did.count(name) == 2
    assert lidar.options[name] == wanted  # options set after the preset make it a custom one


def test_modes_that_alter_infrared_are_turned_off(fake_camera: Make) -> None:
    lidar = FakeLidar()
    lidar.options |= {"alternate_ir": 1.0, "enable_max_usable_range": 0.0}
    with fake_camera(lidar):
        assert lidar.options["alternate_ir"] == 0.0
        assert not {"enable_max_usable_range", "enable_ir_reflectivity"} & set(lidar.did)


@pytest.mark.parametrize(
    ("threshold", "found"), [(100.0, 93.0), (60.0, 53.0), (53.0, 53.0), (20.0, 13.0), (-1.0, 1.0)]
)
def test_laser_is_turned_down_until_little_saturates(
    fake_camera: Make, caplog: pytest.LogCaptureFixture, threshold: float, found: float
) -> None:
    lidar = FakeLidar(usb="2.1", runs=ENDLESS, laser_power=93.0)
    lidar.saturated_share = lambda power: 0.02 if power > threshold else 0.0005
    with fake_camera(lidar) as camera:
        frame = next(iter(camera))

    assert frame.settings["laser_power"] == found

    if found > 1.0:
        assert (
            np.count_nonzero(frame.ir == 255) <= 0.001 * frame.ir.size
        )  # none from before it was found

    assert (
        ("laser power 1:" in caplog.text) == ("2.0 %" in caplog.text) == (found == 1.0)
    )  # with advice
    assert ("lowered" in caplog.text) == (found < 93.0)


def test_laser_power_is_kept_when_a_device_comes_back(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(100, 10**6), laser_power=93.0)
    lidar.saturated_share = lambda power: 0.3 if power > 60.0 else 0.0
    lidar.flaps = 1
    with fake_camera(lidar) as camera:
        camera.silence_s = 0.3
        frames = iter(camera)
        while not camera.counts["replugged"]:
            found = next(frames)
        assert found.settings["laser_power"] == 53.0

    assert lidar.did[lidar.did.index("unplugged") :].count("laser_power") == 1


BY_HAND = {
    "digital_gain": 2.0,
    "receiver_gain": 14.0,
    "noise_filtering": 4.0,
    "laser_power": 70.0,
}


def fall_silent(lidar: FakeLidar) -> None:
    lidar.stop()
    lidar.options = dict(lidar.factory)


def vanish_for_a_while(lidar: FakeLidar) -> None:
    lidar.unplug()
    lidar.back_after = 2


@pytest.mark.parametrize(
    ("fail", "event"), [(fall_silent, "restarted"), (vanish_for_a_while, "replugged")]
)
def test_options_set_by_hand_hold_after_a_recovery(
    fake_camera: Make, fail: Callable[[FakeLidar], None], event: str
) -> None:
    gains = {"digital_gain": 0.0, "receiver_gain": 9.0}
    lidar = FakeLidar(usb="2.1", runs=ENDLESS * 2, laser_power=93.0, **gains)
    lidar.saturated_share = lambda power: 0.3 if power > 60.0 else 0.0
    with fake_camera(lidar) as camera:
        camera.silence_s = 0.3
        frames = iter(camera)
        next(frames)
        for name, value in BY_HAND.items():
            camera.set_option(name, value)
        fail(lidar)
        while not camera.counts[event]:
            found = next(frames)

    assert {name: found.settings[name] for name in BY_HAND} == BY_HAND


def test_options_set_by_hand_end_with_the_run(fake_camera: Make) -> None:
    lidar = FakeLidar(laser_power=93.0)
    camera = fake_camera(lidar)
    with camera:
        camera.set_option("noise_filtering", 4.0)
    with camera:
        assert lidar.options["noise_filtering"] == NEAR_WALL["noise_filtering"]


def test_two_cameras_share_a_context_and_keep_their_devices() -> None:
    sdk = FakeSdk(*(FakeLidar(serial, usb="2.1", runs=ENDLESS) for serial in ("f1", "f2")))
    made = [
        L515Camera(f"l515:{serial}", serial, sdk=sdk, clock=NapClock()) for serial in ("f1", "f2")
    ]
    with made[0] as first, made[1] as second:
        for camera, serial in ((first, "f1"), (second, "f2")):
            assert camera.identity["serial"] == serial
            assert len(list(islice(camera, 5))) == 5

    assert sdk.contexts == 1


def test_identity_and_telemetry_omit_unreported_values(
    fake_camera: Make,
) -> None:
    lidar = FakeLidar(apd_temperature=-9999.0, ldd_temperature=41.5)
    del lidar.info["usb_type_descriptor"]
    camera = fake_camera(lidar)
    named = {"name": "Intel RealSense L515", "serial": "f0246262", "firmware": "01.05.08.01"}

    assert camera.identity == named
    assert camera.telemetry() == {}

    with camera:
        assert camera.telemetry()["ldd_temperature"] == 41.5
        assert "apd_temperature" not in camera.telemetry()
        lidar.options["apd_temperature"] = 38.0
        assert camera.telemetry()["apd_temperature"] == 38.0
        assert set(camera.telemetry("_temperature")) == {"ldd_temperature", "apd_temperature"}
        lidar.unplug()
        assert camera.telemetry() == {}

    assert camera.telemetry() == {}


@pytest.mark.parametrize(
    ("wanted", "value"),
    [(0.0, 190.0), (194.0, 190.0), (197.0, 200.0), (9000.0, 6000.0), (200.0, 200.0)],
)
def test_option_is_set_to_the_nearest_value_in_range(wanted: float, value: float) -> None:
    lidar = FakeLidar(laser_power=93.0)
    options = Options(FakeSensor(lidar, 0), FakeSdk())
    lidar.ranges["min_distance"] = (190.0, 6000.0, 10.0)
    difference = options.put("min_distance", wanted)

    assert bool(difference) == (wanted != value)
    assert not difference or (f"{wanted:g}" in difference and f"{value:g}" in difference)
    assert lidar.options["min_distance"] == options.get("min_distance") == value


def test_options_are_changed_while_the_camera_runs(fake_camera: Make) -> None:
    lidar = FakeLidar(laser_power=40.0)
    lidar.ranges["laser_power"] = (0.0, 100.0, 1.0)
    camera = fake_camera(lidar)

    assert camera.adjustable() == []

    with pytest.raises(CameraError, match="not running"):
        camera.set_option("laser_power", 20.0)
    with camera:
        offered = {each["name"]: each for each in camera.adjustable()}
        assert {"laser_power", *NEAR_WALL} == set(offered)
        limits = offered["laser_power"]
        assert limits["min"] < limits["max"]
        assert "laser_power is" in camera.set_option(
            "laser_power", limits["min"] + 2 * limits["step"]
        )
        assert lidar.options["laser_power"] == limits["min"] + 2 * limits["step"]
        assert "nearest" in camera.set_option("laser_power", 1e6)
        assert lidar.options["laser_power"] == limits["max"]
        assert camera._session.settings["laser_power"] == limits["max"]
        lidar.refused = {"noise_filtering"}
        with pytest.raises(CameraError, match=r"noise_filtering: .*out of range"):
            camera.set_option("noise_filtering", 1.0)
        with pytest.raises(CameraError, match="choose from"):
            camera.set_option("visual_preset", 1.0)


@pytest.mark.parametrize("range_", [(0, 100, 1), (5, 95, 5), (0, 100, 30), (1, 3, 1), (0, 1, 0.01)])
@pytest.mark.parametrize("part", [0.0, 0.15, 0.5, 0.77, 1.0, 2.0])
def test_turn_down_falls_above_darkness_as_far_as_needed(
    range_: tuple[float, float, float], part: float
) -> None:
    limits = PowerLimits(*range_)
    threshold = limits.min + part * (limits.max - limits.min)
    tried = [limits.max]
    settled = turn_down(
        limits.max,
        limits,
        lambda: 0.5 if tried[-1] > threshold else 0.0,
        lambda power: not tried.append(power),
    )

    assert settled.power == tried[-1]
    assert len(tried) <= STRIDES + 2
    assert all(lower < higher for higher, lower in pairwise(tried))
    assert min(tried) >= max(limits.min, min(limits.step, limits.max))
    assert min(tried) > 0
    assert all(power > threshold for power in tried[:-1])
    assert settled.saturated == (0.5 if settled.power > threshold else 0.0)
    assert settled.power <= threshold or not list(weaker(settled.power, limits))


@pytest.mark.parametrize(
    ("share", "tried"), [(0.0, []), (MAX_SATURATED, []), (None, []), (0.5, [83])]
)
def test_turn_down_ends_at_good_or_no_image_or_a_stuck_power(
    share: float | None, tried: list[float]
) -> None:
    put: list[float] = []
    settled = turn_down(93, PowerLimits(0, 100, 1), lambda: share, put.append)

    assert settled.power == 93
    assert settled.saturated == share
    assert put == tried
