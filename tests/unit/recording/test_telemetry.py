from collections.abc import Mapping
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from fake_wall import wall_frame, write_sidecar

from nlos_cam.frames import Frame
from nlos_cam.recording.sidecar import Temperatures, sidecar_path
from nlos_cam.recording.telemetry import Telemetry, telemetry_of

FRAMES = [wall_frame(number) for number in range(1, 100, 10)]
"""A third of a second apart."""
WARM = {"ldd_temperature": 41.0}


def warming() -> Mock:
    """Telemetry that is warmer by a degree each time it is read."""
    return Mock(side_effect=({"ldd_temperature": 40.0 + read} for read in count_up(1)))


def camera(uri: str, **values: float) -> Any:
    def telemetry(ending: str) -> dict[str, float]:
        return {name: value for name, value in values.items() if name.endswith(ending)}

    return SimpleNamespace(uri=uri, telemetry=telemetry)


def readings(telemetry: Telemetry, frames: list[Frame]) -> list[Mapping[str, float] | None]:
    return [telemetry.at(frame) for frame in telemetry.watch(frames)]


def test_each_reading_is_given_once() -> None:
    given = readings(Telemetry(warming(), every_s=1.0), FRAMES)

    assert [bool(celsius) for celsius in given] == [number % 3 == 0 for number in range(10)]
    assert given[3] == {"ldd_temperature": 42.0}


def test_telemetry_is_read_periodically_by_the_frames_clock() -> None:
    read = warming()
    telemetry = Telemetry(read, every_s=1.0)

    assert list(telemetry.watch(FRAMES)) == FRAMES
    assert [call.args[0] for call in read.call_args_list] == pytest.approx([0.0, 1.0, 2.0, 3.0])


def test_a_clock_that_goes_back_does_not_stop_the_readings() -> None:
    telemetry = Telemetry(warming(), every_s=1.0)
    later = [replace(frame, timestamp_s=frame.timestamp_s + 3600.0) for frame in FRAMES[:2]]

    given = readings(telemetry, [*later, *FRAMES[2:]])

    assert [bool(celsius) for celsius in given][:6] == [True, False, True, False, False, True]


def test_readings_of_dropped_frames_are_superseded() -> None:
    telemetry = Telemetry(warming(), every_s=1.0)
    list(telemetry.watch(FRAMES))

    assert telemetry.at(FRAMES[2]) == {"ldd_temperature": 41.0}
    assert telemetry.at(FRAMES[2]) is None
    assert telemetry.at(FRAMES[9]) == {"ldd_temperature": 44.0}


def test_telemetry_of_a_camera_reads_temperatures_only() -> None:
    assert readings(telemetry_of(camera("l515", laser_power=40.0, **WARM)), FRAMES[:1]) == [WARM]
    assert readings(telemetry_of(camera("sim")), FRAMES[:1]) == [None]


def test_recording_without_sidecar_is_read_like_a_camera() -> None:
    assert readings(telemetry_of(camera("bag:no-sidecar.bag", **WARM)), FRAMES[:1]) == [WARM]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Recording whose sidecar has a temperature every 10 s, from 40 to 43 degrees."""
    series = [
        Temperatures(time_s=10.0 * k, celsius={"ldd_temperature": 40.0 + k}) for k in range(4)
    ]
    path = tmp_path / "wall.bag"
    write_sidecar(path, series)
    return path


def test_telemetry_of_a_recording_reads_its_sidecar(bag: Path) -> None:
    telemetry = telemetry_of(camera(f"bag:{bag}", ldd_temperature=99.0))
    frames = [wall_frame(300 * k) for k in range(5)]  # 10 s apart
    given = [celsius and celsius["ldd_temperature"] for celsius in readings(telemetry, frames)]

    assert given == [40.0, 41.0, 42.0, 43.0, 43.0]


def test_broken_sidecar_is_a_warning(bag: Path, caplog: pytest.LogCaptureFixture) -> None:
    sidecar_path(bag).write_text("{")
    telemetry = telemetry_of(camera(f"bag:{bag}", ldd_temperature=39.0))

    assert readings(telemetry, FRAMES[:2]) == [None, None]
    assert "wall.json" in caplog.text
