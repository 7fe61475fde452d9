"""Behavior that only a real L515 can show.

Bench: one L515 (firmware 1.5.8.1) on USB 3, 0.2 m from a bare matt white wall, turned 45 degrees to
it, nothing else within 1 m; no other program using it. A person pulls the cable when a test asks
(run with `-s` and NLOS_CAM_AT_THE_BENCH=1); one test needs a second L515, one
NLOS_CAM_TEN_MINUTES=1 and 20 GB. Run with `pytest -m hardware`; tests skip where something they
need is missing.
"""

import os
from collections.abc import Callable
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.camera import Camera, Recording, connected, load_sdk, open_camera, shared_context
from nlos_cam.camera.l515 import NEAR_WALL, L515Camera
from nlos_cam.recording.playback import ReplayCamera, verify

pytestmark = pytest.mark.hardware
SECONDS = 5


def serials() -> list[str]:
    found = connected(load_sdk(), shared_context(load_sdk()))
    return [info.serial for _, info in found if "L515" in info.name]


@pytest.fixture
def camera() -> Camera:
    if not serials():
        pytest.skip("no L515 is connected")
    return open_camera(f"l515:{serials()[0]}")


@pytest.fixture
def at_the_bench(camera: Camera, capsys: pytest.CaptureFixture[str]) -> Callable[[str], None]:
    """Ask the person at the bench for something."""
    assert camera
    if not os.environ.get("NLOS_CAM_AT_THE_BENCH"):
        pytest.skip("nobody is at the bench (NLOS_CAM_AT_THE_BENCH=1)")

    def ask(what: str) -> None:
        with capsys.disabled():
            print(f"\n>>> {what}", flush=True)  # noqa: T201  it is for the person

    return ask


def test_camera_runs_five_seconds_without_a_gap(camera: Camera) -> None:
    with camera:
        frames = list(islice(camera, 30 * SECONDS))

    assert camera.dropped == 0
    assert camera.incomplete == 0
    assert not camera.counts
    assert frames[-1].timestamp_s - frames[0].timestamp_s == pytest.approx(SECONDS, abs=0.1)


def test_near_wall_settings_take(camera: Camera) -> None:
    assert isinstance(camera, L515Camera)

    with camera:
        settings = next(iter(camera)).settings

    assert camera.differences == {}
    assert {name: settings[name] for name in NEAR_WALL} == NEAR_WALL


def test_wall_is_near_and_unsaturated(camera: Camera) -> None:
    """The laser is turned down as far as needed, and not off."""
    with camera:
        frame = list(islice(camera, 30))[-1]

    assert 0.1 < np.nanmedian(frame.depth_m) < 1.5
    assert np.count_nonzero(~np.isnan(frame.depth_m)) > 0.5 * frame.depth_m.size
    assert np.count_nonzero(frame.ir == 255) < 0.001 * frame.ir.size
    assert frame.settings["laser_power"] > 0


def test_temperatures_are_reported_after_five_seconds(camera: Camera) -> None:
    with camera:
        assert next(iter(camera)).settings.get("apd_temperature", 20.0) > -100
        list(islice(camera, 30 * 6))
        telemetry = camera.telemetry()
    for name in ("ldd_temperature", "mc_temperature", "ma_temperature", "apd_temperature"):
        assert 0 < telemetry[name] < 100

    assert camera.telemetry() == {}


def test_recording_holds_every_frame_and_its_settings(camera: Camera, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "wall.bag", seconds=SECONDS)
    with open_camera(camera.uri, recording=recording) as source:
        seen = list(source)
    found = verify(recording.path)

    assert found.frames >= recording.sets == len(seen)
    assert found.dropped == 0

    with ReplayCamera(recording.path) as replayed:
        settings = next(iter(replayed)).settings

    assert {name: settings[name] for name in (*NEAR_WALL, "laser_power")} == {
        name: seen[0].settings[name] for name in (*NEAR_WALL, "laser_power")
    }


def test_camera_survives_a_pulled_cable(
    camera: Camera, at_the_bench: Callable[[str], None]
) -> None:
    with camera:
        before = list(islice(camera, 30))
        at_the_bench("pull the L515's cable, wait 10 s, plug it into the same port")
        after: list[float] = []
        frames = [before[-1]]
        while not camera.counts["replugged"] or len(after) < 30:
            frames.append(next(iter(camera)))
            after += [frames[-1].timestamp_s] if camera.counts["replugged"] else []

    assert camera.counts["replugged"] == 1
    assert all(one.frame_number < next_one.frame_number for one, next_one in pairwise(frames))
    assert all(one.timestamp_s < next_one.timestamp_s for one, next_one in pairwise(frames))
    assert camera.dropped > 5 * 30
    assert frames[-1].settings == pytest.approx(
        before[-1].settings, abs=10.0
    )  # temperatures and noise drift


def test_recording_of_a_pulled_cable_can_be_read(
    camera: Camera, at_the_bench: Callable[[str], None], tmp_path: Path
) -> None:
    recording = Recording(tmp_path / "pulled.bag", optional=True)
    with open_camera(camera.uri, recording=recording) as source:
        list(islice(source, 90))
        at_the_bench("pull the L515's cable, wait 10 s, plug it in again")
        while not source.counts["replugged"]:
            next(iter(source))
        assert verify(recording.path).frames >= 90


def test_two_cameras_run_at_once() -> None:
    found = serials()
    if len(found) < 2:
        pytest.skip("two L515s are needed")
    with open_camera(f"l515:{found[0]}") as one, open_camera(f"l515:{found[1]}") as other:
        for camera, serial in ((one, found[0]), (other, found[1])):
            assert camera.identity["serial"] == serial
            assert len(list(islice(camera, 30 * SECONDS))) == 30 * SECONDS
            assert camera.incomplete == 0


@pytest.mark.timeout(900)
def test_ten_minutes_are_recorded_without_a_gap(camera: Camera, tmp_path: Path) -> None:
    if not os.environ.get("NLOS_CAM_TEN_MINUTES"):
        pytest.skip("it takes ten minutes and 20 GB (NLOS_CAM_TEN_MINUTES=1)")
    recording = Recording(tmp_path / "long.bag", seconds=600)
    with open_camera(camera.uri, recording=recording) as source:
        frames = sum(1 for _ in source)
        assert (source.dropped, source.incomplete, source.counts) == (0, 0, {})

    assert frames == 18_000
    assert verify(recording.path).dropped == 0
