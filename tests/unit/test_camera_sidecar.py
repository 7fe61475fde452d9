import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import Rig, dump_toml, load_rig

from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.playback import Verified
from nlos_cam.recording.quality import Quality
from nlos_cam.recording.sidecar import (
    LOOK_S,
    MAX_LOOKS,
    SidecarFile,
    load_sidecar,
    sidecar_path,
    summary_of,
    versions,
    wall_of,
)

PINHOLE = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)
DARK = np.zeros((48, 64), np.uint8)
WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
SEEN = Quality(9, 0.25, 0.5, 7.0, 1.5, 0.1)
READ = Verified(frames=9, dropped=2, seconds=0.5, streams={"depth": 9, "infrared": 9, "confidence": 9})


@dataclass
class Warm:
    """A camera that gets warmer by a degree each time it is asked."""

    uri: str = "l515"
    intrinsics: Intrinsics = PINHOLE
    rig: Rig | None = None
    identity: Mapping[str, str] = field(default_factory=lambda: {"name": "L515", "serial": "f0246262"})
    counts: Counter[str] = field(default_factory=Counter[str])
    celsius: float = 30.0

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        self.celsius += 1.0
        told = {"laser_power": 40.0, "ldd_temperature": self.celsius, "broken_temperature": float("nan")}
        return {name: value for name, value in told.items() if name.endswith(ending)}


def frame(timestamp_s: float, **settings: float) -> Frame:
    return Frame(np.zeros((48, 64), np.float32), DARK, DARK, timestamp_s, 0, PINHOLE, settings)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.json"


def test_it_is_there_from_the_start_and_says_that_it_records(path: Path) -> None:
    SidecarFile(path, Warm(), label="a cup", started=WHEN)
    found = load_sidecar(path)
    assert (found.label, found.camera, found.state, found.summary) == ("a cup", "l515", "recording", None)
    assert found.started == WHEN
    assert found.device == {"name": "L515", "serial": "f0246262"}
    assert (found.intrinsics.fx, found.intrinsics.width) == (46.0, 64)
    assert found.settings["laser_power"] == 40.0


def test_label_and_camera_stay_where_scripts_look_for_them(path: Path) -> None:
    SidecarFile(path, Warm(), label="a cup")
    told = json.loads(path.read_text())
    assert (told["label"], told["camera"], told["started"][-1]) == ("a cup", "l515", "Z")


def test_settings_are_those_that_the_frames_were_taken_with(path: Path) -> None:
    sidecar = SidecarFile(path, Warm())
    sidecar.on_frame(frame(5.0, laser_power=31.0))
    sidecar.on_frame(frame(5.1, laser_power=99.0))
    sidecar.finish("complete", summary_of(READ, SEEN, {}))
    assert load_sidecar(path).settings == {"laser_power": 31.0}


def test_temperatures_are_a_series_over_the_devices_time(path: Path) -> None:
    sidecar = SidecarFile(path, Warm())
    for number in range(900):
        sidecar.on_frame(frame(1e9 + number / 30))
    series = load_sidecar(path).temperatures
    assert [look.time_s for look in series] == pytest.approx([0.0, LOOK_S, 2 * LOOK_S], abs=0.05)
    celsius = [look.celsius["ldd_temperature"] for look in series]
    assert celsius == sorted(celsius)
    assert set(series[0].celsius) == {"ldd_temperature"}


def test_a_camera_without_thermometers_has_no_series(path: Path) -> None:
    camera = Warm()
    camera.telemetry = lambda ending="": {} if ending else {"laser_power": 40.0}
    SidecarFile(path, camera).on_frame(frame(0.0))
    assert load_sidecar(path).temperatures == []


def test_a_long_series_is_thinned_and_still_spans_the_recording(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.recording.sidecar.MAX_LOOKS", 10)
    assert MAX_LOOKS > 10
    sidecar = SidecarFile(path, Warm())
    for number in range(100):
        sidecar.on_frame(frame(number * LOOK_S))
    times = [look.time_s for look in load_sidecar(path).temperatures]
    assert 5 <= len(times) <= 10
    assert times[0] == 0.0
    assert times[-1] >= 900.0
    assert len(set(np.diff(times).tolist())) == 1


def test_it_ends_with_a_state_and_a_summary(path: Path) -> None:
    SidecarFile(path, Warm()).finish("lost", summary_of(READ, SEEN, {"restarted": 1}))
    found = load_sidecar(path)
    assert found.state == "lost"
    assert found.summary
    assert (found.summary.frames, found.summary.dropped, found.summary.frames_per_s) == (9, 2, 16.0)
    assert (found.summary.saturated_share, found.summary.temporal_noise_mm) == (0.25, 1.5)
    assert found.summary.events == {"restarted": 1}


def test_nothing_known_is_null_and_not_nan(path: Path) -> None:
    SidecarFile(path, Warm()).finish("disk full", summary_of(None, Quality(), {}))
    assert "NaN" not in path.read_text()
    summary = json.loads(path.read_text())["summary"]
    assert summary["frames"] is summary["temporal_noise_mm"] is summary["saturated_share"] is None
    assert load_sidecar(path).summary == summary_of(None, Quality(), {})


def test_one_frame_has_no_rate() -> None:
    assert summary_of(Verified(1, 0, 0.0, {"depth": 1}), Quality(), {}).frames_per_s is None


def test_the_file_is_whole_at_any_time(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = SidecarFile(path, Warm())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("nlos_cam.recording.sidecar.os.fsync", full)
    sidecar.on_frame(frame(0.0))  # goes on: the recording's own end tells
    with pytest.raises(DiskFullError, match=r"a\.json cannot be written \(No space left on device\)"):
        sidecar.finish("complete", summary_of(READ, SEEN, {}))
    assert [entry.name for entry in path.parent.iterdir()] == ["a.json"]
    assert path.read_bytes() == before


def test_the_rig_is_the_cameras_unless_a_wall_was_measured(path: Path, wall_toml: Path) -> None:
    bench = load_rig("bare-wall")
    SidecarFile(path, Warm(rig=bench))
    assert load_sidecar(path).rig == bench
    measured, wall = wall_of(wall_toml)
    SidecarFile(path, Warm(rig=bench), wall=(measured, wall))
    found = load_sidecar(path)
    assert found.rig == measured != bench
    assert found.wall
    assert found.wall.sha256 == hashlib.sha256(wall_toml.read_bytes()).hexdigest()


@pytest.fixture
def wall_toml(tmp_path: Path) -> Path:
    from nlos_calibration.wall_record import WallRecord

    rig = load_rig("paper-rig").model_copy(update={"name": "measured"})
    record = WallRecord(
        created=date(2026, 1, 2),
        camera="sim",
        frames=30,
        distance_m=rig.lidar.distance_m,
        facing_deg=45.0,
        yaw_deg=rig.lidar.yaw_deg,
        pitch_deg=rig.lidar.pitch_deg,
        wall_from_lidar=tuple(map(tuple, rig.wall_from_lidar.tolist())),
        residual_m=0.001,
        inlier_fraction=0.99,
        verdict="good",
        advice="",
        rig=rig,
    )
    path = tmp_path / "wall.toml"
    path.write_text(dump_toml(record))
    return path


def test_a_wall_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordFileError):
        wall_of(tmp_path / "none.toml")


def test_versions_name_the_program_and_no_machine() -> None:
    found = versions()
    assert set(found) <= {"nlos-cam", "pyrealsense2", "python", "platform"}
    assert found["platform"].count(" ") == 1


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda told: told | {"colour": "red"}, "colour"),
        (lambda told: told | {"state": "asleep"}, "state"),
        (lambda told: told | {"schema_version": 2}, "schema_version"),
        (lambda told: told | {"intrinsics": "wide"}, "intrinsics"),
        (lambda told: told | {"settings": {"laser_power": "40"}}, "laser_power"),
        (lambda told: {key: told[key] for key in ("label", "camera")}, "state"),
    ],
)
def test_what_is_no_sidecar_is_told_in_one_line(path: Path, spoil: Any, told: str) -> None:
    SidecarFile(path, Warm())
    path.write_text(json.dumps(spoil(json.loads(path.read_text()))))
    with pytest.raises(RecordingError, match=rf"a\.json is not a sidecar: .*{told}") as raised:
        load_sidecar(path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]"])
def test_what_is_no_json_is_told_in_one_line(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="is not a sidecar") as raised:
        load_sidecar(path)
    assert "\n" not in str(raised.value)


def test_a_missing_sidecar_is_told(tmp_path: Path) -> None:
    assert sidecar_path(tmp_path / "a.bag") == tmp_path / "a.json"
    with pytest.raises(RecordingError, match=r"no sidecar .*a\.json"):
        load_sidecar(tmp_path / "a.json")
    with pytest.raises(RecordingError, match="cannot be read"):
        load_sidecar(tmp_path)
