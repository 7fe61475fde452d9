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
    """Telemetry that is warmer by a degree each time it is read."""

    def __init__(self) -> None:
        self.times_s: list[float] = []

    def __call__(self, time_s: float) -> Mapping[str, float]:
        self.times_s.append(time_s)
        return {"ldd_temperature": 40.0 + len(self.times_s)}


def camera(uri: str, **values: float) -> Any:
    return SimpleNamespace(uri=uri, telemetry=lambda end: {name: values[name] for name in values if name.endswith(end)})


def readings(telemetry: Telemetry, frames: list[Frame]) -> list[Mapping[str, float] | None]:
    return [telemetry.at(frame) for frame in telemetry.watch(frames)]


def test_telemetry_reads_periodically_by_the_frames_clock() -> None:
    asked = Asked()
    assert list(Telemetry(asked, every_s=1.0).watch(FRAMES)) == FRAMES
    assert asked.times_s == pytest.approx([0.0, 1.0, 2.0, 3.0])
    given = readings(Telemetry(Asked(), every_s=1.0), FRAMES)
    assert [bool(celsius) for celsius in given] == [number % 3 == 0 for number in range(10)], "each reading once"
    assert given[3] == {"ldd_temperature": 42.0}
    late = Telemetry(Asked(), every_s=1.0)
    ahead = list(late.watch(FRAMES))
    assert [late.at(ahead[number]) for number in (2, 2, 9)] == [
        {"ldd_temperature": 41.0},
        None,
        {"ldd_temperature": 44.0},  # frames between were dropped
    ]


@pytest.mark.parametrize(
    ("uri", "values", "celsius"),
    [
        ("l515", {"ldd_temperature": 41.0, "laser_power": 40.0}, {"ldd_temperature": 41.0}),
        ("sim", {}, None),
        ("bag:no-sidecar.bag", {"ldd_temperature": 39.0}, {"ldd_temperature": 39.0}),
    ],
)
def test_telemetry_of_a_camera_reads_temperatures_only(
    uri: str, values: dict[str, float], celsius: dict[str, float] | None
) -> None:
    assert readings(telemetry_of(camera(uri, **values)), FRAMES[:1]) == [celsius]


def write_sidecar(path: Path) -> None:
    series = [Temperatures(time_s=10.0 * k, celsius={"ldd_temperature": 40.0 + k}) for k in range(4)]
    facts: dict[str, Any] = {"label": None, "camera": "l515", "state": "complete", "intrinsics": vars(SMALL)}
    facts |= {"device": {}, "versions": {}, "settings": {}, "started": datetime(2026, 1, 2, tzinfo=UTC)}
    sidecar = Sidecar(**facts, temperatures=series)
    path.write_text(sidecar.model_dump_json())


def test_telemetry_of_a_recording_reads_its_sidecar(tmp_path: Path) -> None:
    bag = tmp_path / "wall.bag"
    write_sidecar(sidecar_path(bag))
    telemetry = telemetry_of(camera(f"bag:{bag}", ldd_temperature=99.0))
    frames = [wall_frame(300 * k) for k in range(5)]  # 10 s apart
    given = [celsius and celsius["ldd_temperature"] for celsius in readings(telemetry, frames)]
    assert given == [40.0, 41.0, 42.0, 43.0, 43.0]


def test_telemetry_warns_of_a_broken_sidecar(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = tmp_path / "wall.bag"
    sidecar_path(bag).write_text("{")
    assert readings(telemetry_of(camera(f"bag:{bag}", ldd_temperature=39.0)), FRAMES[:2]) == [None, None]
    assert "wall.json" in caplog.text
