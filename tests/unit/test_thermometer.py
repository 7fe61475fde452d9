from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_wall import SMALL, wall_frame

from nlos_cam.frames import Frame
from nlos_cam.live.telemetry import Telemetry, telemetry_of
from nlos_cam.recording.sidecar import Sidecar, Temperatures, sidecar_path

FRAMES = [wall_frame(number) for number in range(1, 100, 10)]
"""A third of a second apart."""


class Asked:
    """Warmer by a degree each time it is asked."""

    def __init__(self) -> None:
        self.times_s: list[float] = []

    def __call__(self, time_s: float) -> Mapping[str, float]:
        self.times_s.append(time_s)
        return {"ldd_temperature": 40.0 + len(self.times_s)}


def test_it_is_asked_from_time_to_time_by_the_frames_own_clock() -> None:
    asked = Asked()
    assert list(Telemetry(asked, every_s=1.0).watch(FRAMES)) == FRAMES
    assert asked.times_s == pytest.approx([0.0, 1.0, 2.0, 3.0])


def test_a_reading_is_told_once_with_the_frame_it_was_made_at() -> None:
    thermometer = Telemetry(Asked(), every_s=1.0)
    told = [thermometer.at(frame) for frame in thermometer.watch(FRAMES)]
    assert [bool(celsius) for celsius in told] == [number % 3 == 0 for number in range(10)]
    assert told[3] == {"ldd_temperature": 42.0}


def test_a_reader_that_is_ahead_does_not_change_what_a_frame_is_told() -> None:
    thermometer = Telemetry(Asked(), every_s=1.0)
    ahead = list(thermometer.watch(FRAMES))
    assert thermometer.at(ahead[2]) == {"ldd_temperature": 41.0}
    assert thermometer.at(ahead[2]) is None
    assert thermometer.at(ahead[9]) == {"ldd_temperature": 44.0}  # frames between were dropped


def camera(uri: str, **told: float) -> Any:
    def telemetry(ending: str) -> Mapping[str, float]:
        return {name: value for name, value in told.items() if name.endswith(ending)}

    return SimpleNamespace(uri=uri, telemetry=telemetry)


def all_told(thermometer: Telemetry, frames: list[Frame]) -> list[Mapping[str, float] | None]:
    return [thermometer.at(frame) for frame in thermometer.watch(frames)]


def test_a_device_is_asked_for_its_temperatures_alone() -> None:
    thermometer = telemetry_of(camera("l515", ldd_temperature=41.0, laser_power=40.0))
    assert all_told(thermometer, FRAMES[:1]) == [{"ldd_temperature": 41.0}]


def test_a_device_that_has_none_tells_none() -> None:
    assert all_told(telemetry_of(camera("sim")), FRAMES[:2]) == [None, None]


def write_sidecar(path: Path) -> None:
    series = [Temperatures(time_s=10.0 * k, celsius={"ldd_temperature": 40.0 + k}) for k in range(4)]
    sidecar = Sidecar(
        label=None,
        camera="l515",
        state="complete",
        started=datetime(2026, 1, 2, tzinfo=UTC),
        device={},
        versions={},
        intrinsics=vars(SMALL),
        settings={},
        temperatures=series,
    )
    path.write_text(sidecar.model_dump_json())


def test_a_recordings_are_read_from_its_sidecar_as_time_passes(tmp_path: Path) -> None:
    bag = tmp_path / "wall.bag"
    write_sidecar(sidecar_path(bag))
    thermometer = telemetry_of(camera(f"bag:{bag}", ldd_temperature=99.0))
    frames = [wall_frame(300 * k) for k in range(5)]  # 10 s apart
    told = [celsius and celsius["ldd_temperature"] for celsius in all_told(thermometer, frames)]
    assert told == [40.0, 41.0, 42.0, 43.0, 43.0]


def test_a_recording_without_a_sidecar_tells_what_it_has_in_it(tmp_path: Path) -> None:
    thermometer = telemetry_of(camera(f"bag:{tmp_path}/wall.bag", ldd_temperature=39.0))
    assert all_told(thermometer, FRAMES[:1]) == [{"ldd_temperature": 39.0}]


def test_a_broken_sidecar_is_told_and_done_without(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = tmp_path / "wall.bag"
    sidecar_path(bag).write_text("{")
    assert all_told(telemetry_of(camera(f"bag:{bag}", ldd_temperature=39.0)), FRAMES[:2]) == [None, None]
    assert "wall.json is not a sidecar" in caplog.text
