from collections import Counter
from collections.abc import Callable
from itertools import islice, pairwise
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from fake_librealsense import CUSTOM
from fake_lidar import FakeLidar, NapClock

from nlos_cam.camera import Recording, SimulatedCamera
from nlos_cam.camera.l515 import NEAR_WALL, L515Camera
from nlos_cam.camera.protocol import WallClock
from nlos_cam.camera.recovery import BACK_OFF_S, Hooks, Recovery
from nlos_cam.errors import CameraError, CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.recording import verify
from nlos_cam.render import Fault

Make = Callable[..., Any]
ENDLESS = 10**6


def impatient(camera: L515Camera, silence_s: float = 0.3) -> L515Camera:
    camera.silence_s = silence_s
    return camera


def rises(frames: list[Frame]) -> bool:
    steps = [
        (next_one.frame_number - one.frame_number, next_one.timestamp_s - one.timestamp_s)
        for one, next_one in pairwise(frames)
    ]
    return all(
        count > 0 and seconds * 30 == pytest.approx(count, abs=0.5) for count, seconds in steps
    )


def holes(frames: list[Frame]) -> int:
    return frames[-1].frame_number - frames[0].frame_number + 1 - len(frames)


def test_frames_are_in_metres_and_levels_and_none_is_early(fake_camera: Make) -> None:
    device = FakeLidar()
    with fake_camera(device) as camera:
        device.deliver(range(5, 8))
        frames = list(islice(camera, 3))

    assert device.did[-2:] == ["stop", "close"]
    assert [frame.frame_number for frame in frames] == [5, 6, 7]  # none from before the settings
    np.testing.assert_allclose(frames[0].depth_m, 240 * 0.00025, rtol=1e-6)
    assert (frames[0].ir == 240).all()
    assert (frames[0].confidence == 15).all()
    assert frames[0].truth_depth_m is None


def test_device_without_stream_unit_or_start_is_an_error(
    fake_camera: Make,
) -> None:
    with pytest.raises(CameraError, match=r"confidence.*640 x 480"):
        fake_camera(FakeLidar(streams=("depth", "infrared")))
    device = FakeLidar()
    vanishing = FakeLidar()
    device.start_error = RuntimeError("failed to set power state")
    with pytest.raises(CameraError, match="failed to set power state"):
        fake_camera(device).__enter__()

    assert device.did == ["stop", "close"]

    with pytest.raises(CameraError, match="vanished"):
        fake_camera(vanishing, clock=NapClock(lambda _: vanishing.unplug())).__enter__()
    del device.options["depth_units"]
    with pytest.raises(CameraError, match="depth unit"):
        fake_camera(device)


@pytest.mark.parametrize(
    ("runs", "counts"),
    [
        ((30, ENDLESS), {"restarted": 1}),
        ((30, 0, 0, 0, ENDLESS), {"restarted": 3, "reset": 1}),
        ((30, 30, 30, 30, 30, ENDLESS), {"restarted": 5}),  # each silence starts with a restart
        ((30, ENDLESS), {"replugged": 1}),
        pytest.param((30, ENDLESS), {"replugged": 20}, marks=pytest.mark.slow),
    ],
    ids=["restart", "reset", "restarts", "replug", "replugs"],
)
def test_silent_device_delivers_again_as_set(
    fake_camera: Make, runs: tuple[int, ...], counts: dict[str, int]
) -> None:
    lidar = FakeLidar(usb="2.1", runs=runs)
    lidar.flaps = flaps = counts.get("replugged", 0)
    with impatient(fake_camera(lidar)) as camera:
        frames = list(islice(camera, 30 * max(flaps, len(runs) - 1) + 20))
        # In twenty replugs a busy machine may be silent for long enough to be restarted, too.
        assert camera.counts == counts or (flaps == 20 == camera.counts["replugged"])

    assert rises(frames)
    assert lidar.did.count("unplugged") - lidar.did.count("reset") == flaps
    assert camera.dropped + camera.incomplete == holes(frames) > 0
    assert lidar.did.count("reset") == counts.get("reset", 0)
    # options set after the preset make it a custom one
    near_wall = NEAR_WALL | {"visual_preset": CUSTOM}
    assert {name: lidar.options[name] for name in near_wall} == near_wall
    assert frames[-1].settings["min_distance"] == 0.0


def test_device_that_nothing_helps_is_lost_with_counts(fake_camera: Make) -> None:
    lidar = FakeLidar(usb="2.1", runs=(30,))
    with (
        impatient(fake_camera(lidar)) as camera,
        pytest.raises(
            CameraLostError, match=r"(\d+) depth, \1 infrared, \1 confidence.*3 restarts"
        ),
    ):
        list(camera)

    assert lidar.did[-1] == "close"


def test_frames_of_some_streams_count_as_incomplete(fake_camera: Make) -> None:
    lidar = FakeLidar()
    with impatient(fake_camera(lidar)) as camera:
        frames = iter(camera)
        lidar.deliver(range(1, 3))
        seen = [next(frames), next(frames)]
        lidar.deliver(range(3, 103), streams=("depth",))
        lidar.runs = [ENDLESS]
        seen.append(next(frames))
        assert camera.incomplete == 70  # the youngest 30 may yet have become sets
        assert camera.incomplete + camera.dropped >= holes(seen)

    assert rises(seen)


def test_device_that_stays_away_or_is_slow_is_lost(
    fake_camera: Make, caplog: pytest.LogCaptureFixture
) -> None:
    lidar = FakeLidar("f1")
    other = FakeLidar("f2")
    with impatient(fake_camera(lidar, other, serial="f1")) as camera:
        lidar.unplug()
        with pytest.raises(CameraLostError, match="60 s"):
            list(camera)
        assert camera.telemetry() == {}

    assert caplog.text.count("60 s") == 1
    assert not other.did

    lidar = FakeLidar()
    with impatient(fake_camera(lidar)) as camera:
        lidar.unplug()
        lidar.info["usb_type_descriptor"] = "2.1"
        lidar.plug_in()
        with pytest.raises(CameraLostError, match="640 x 480"):
            list(camera)


def test_lost_calibration_is_cured_by_one_reset_or_an_error(fake_camera: Make) -> None:
    cured = FakeLidar()
    broken = FakeLidar()
    cured.uncalibrated = broken.uncalibrated = True
    camera = fake_camera(cured)

    assert camera.counts == {"reset": 1}
    assert camera.intrinsics.width == 640

    broken.reset_takes = 0
    with pytest.raises(CameraError, match="doesn't exist"):
        fake_camera(broken)


def test_leaving_ends_a_recovery_and_may_be_repeated(fake_camera: Make) -> None:
    lidar = FakeLidar()
    waits = Event()

    class RealPace(WallClock):
        def wait(self, stop: Event, seconds: float) -> bool:
            if not lidar.plugged:
                waits.set()
            return super().wait(stop, seconds)

    with impatient(fake_camera(lidar, clock=RealPace()), 0.05) as camera:
        lidar.unplug()
        thread = Thread(target=lambda: list(camera))  # pytest fails a test whose thread raises
        thread.start()
        assert waits.wait(30.0)  # of the 60 s in which it may come back
        assert thread.is_alive()
        camera.__exit__(None, None, None)
        thread.join(30.0)
        assert not thread.is_alive()
    lidar = FakeLidar()
    with fake_camera(lidar) as camera:
        camera.__exit__(None, None, None)

    assert lidar.did.count("stop") == lidar.did.count("close") == 1


@pytest.mark.parametrize("optional", [True, False])
@pytest.mark.parametrize("kind", ["unplug", "stall"])
def test_recording_of_a_lost_device_ends_whole(
    noise_world: Make, hurried_clock: Any, kind: Any, optional: bool, tmp_path: Path, caplog: Any
) -> None:
    class Impatient(hurried_clock):
        """Waits for the next frame of its world only; any longer wait lasts until the fault is
        over.
        """

        def wait(self, stop: Event, seconds: float) -> bool:
            return super().wait(stop, seconds if seconds < 0.2 else 100.0)

    recording = Recording(tmp_path / "run.bag", optional=optional)
    fault = Fault(kind=kind, at_frame=15, frames=2000)
    simulated = SimulatedCamera(
        "sim", noise_world(), clock=Impatient(), recording=recording, faults=[fault]
    )
    simulated.silence_s = 0.5
    simulated.replug_s = 1000.0
    if optional:  # the camera goes on
        with simulated as camera:
            numbers = [frame.frame_number for frame in islice(camera, 40)]
            assert camera.counts["replugged"] + camera.counts["restarted"] > 0
            found = verify(recording.path)  # while the camera goes on
        assert all(one < next_one for one, next_one in pairwise(numbers))
        assert f"{recording.sets} frames" in caplog.text
    else:
        with pytest.raises(CameraLostError, match="whole"), simulated as camera:
            list(camera)
        assert not camera.counts["replugged"]
        found = verify(recording.path)

    assert found.frames == recording.sets > 0
    assert found.dropped == 0


def test_recording_without_a_frame_restarts_with_the_streams(
    fake_camera: Make, tmp_path: Path
) -> None:
    lidar = FakeLidar(usb="2.1", runs=(0, 0, ENDLESS))
    recording = Recording(tmp_path / "run.bag", frames=5)
    with impatient(fake_camera(lidar, recording=recording)) as camera:
        assert len(list(camera)) == recording.sets == 5
        assert camera.counts == {"restarted": 2}
        assert camera.dropped == camera.incomplete == 0

    assert [did for did in lidar.did if did in {"start", "record", "stop"}] == [
        "start",
        "record",
        "stop",
    ] * 3


class Device:
    def __init__(
        self, there: Callable[[float], bool] = lambda _: True, failing: tuple[str, ...] = ()
    ) -> None:
        self.clock = NapClock()
        self.left = Event()
        self.counts = Counter[str]()
        self.did = list[str]()
        self.zero_s = self.clock.now()
        self.there = there
        self.failing = list(failing)

        def stop() -> None:
            self.did.append("stop")

        def reset() -> None:
            self.did.append("reset")

        hooks = Hooks(
            self.start,
            stop,
            self.is_connected,
            lambda: "device" if self.is_connected() else None,
            reset,
        )
        self.recovery = Recovery("l515", hooks, self.clock, self.left, self.counts)

    @property
    def passed_s(self) -> float:
        return self.clock.now() - self.zero_s

    def is_connected(self) -> bool:
        return self.there(self.passed_s)

    def start(self, device: Any) -> None:
        assert device == "device"
        if self.failing:
            raise RuntimeError(self.failing.pop(0))
        self.did.append("start")

    def recover(self, times: int = 1) -> None:
        for _ in range(times):
            self.recovery.recover("l515 gave no whole frame", replug_s=60.0)


def test_recovery_restarts_with_back_off_then_resets_then_ends() -> None:
    device = Device()
    device.recover(4)
    with pytest.raises(CameraLostError, match=r"3 restarts.*reset"):
        device.recover()

    assert device.did == ["stop", "start"] * 3 + ["stop", "stop", "reset", "start", "stop"]
    assert tuple(nap for nap in device.clock.naps if nap >= 0.5) == BACK_OFF_S
    assert device.counts == {"restarted": 3, "reset": 1}


def test_lost_intrinsics_lead_to_a_reset_at_once() -> None:
    device = Device(failing=("busy", "busy"))
    device.recover()

    assert device.counts == {"restarted": 3}
    assert device.did == ["stop", "start"]

    with pytest.raises(CameraLostError, match="failed to set power state"):
        Device(failing=("failed to set power state",) * 200).recover()
    device = Device(failing=("intrinsics for resolution 640,480 doesn't exist",))
    device.recover()

    assert device.counts == {"restarted": 1, "reset": 1}


def test_reset_waits_until_the_device_was_gone_and_is_back() -> None:
    """An L515 is still listed for a moment, and needs about 12 s."""
    device = Device(there=lambda now_s: not 1.0 < now_s < 12.0)

    assert device.recovery.reset()
    assert device.did == ["stop", "reset", "start"]
    assert 12.0 <= device.passed_s < 12.5

    gone = Device(there=lambda now_s: now_s < 5.0)
    with pytest.raises(CameraLostError):
        gone.recover(4)

    assert gone.counts["reset"] == 1


@pytest.mark.parametrize(("back_s", "failing"), [(40.0, ()), (2.0, ("not yet", "not yet"))])
def test_unplugged_device_is_started_when_it_is_back(
    back_s: float, failing: tuple[str, ...]
) -> None:
    device = Device(there=lambda now_s: now_s > back_s, failing=failing)
    device.recover()

    assert device.counts == {"replugged": 1}
    assert device.did.count("start") == 1
    assert failing or device.passed_s == pytest.approx(back_s, abs=0.5)


def test_bus_that_cannot_be_listed_counts_as_unplugged(caplog: pytest.LogCaptureFixture) -> None:
    listings = [CameraError("librealsense cannot list its devices")]

    def there(_: float) -> bool:
        if listings:
            raise listings.pop()
        return True

    device = Device(there)
    device.recover()

    assert device.counts == {"replugged": 1}
    assert "60 s" in caplog.text
