import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import Intrinsics, MeasuredWall, Rig, dump_toml, load_rig
from nlos_calibration.errors import RecordFileError

from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording import (
    SidecarFile,
    VerifyResult,
    load_sidecar,
    recorded_wall,
    sidecar_path,
)
from nlos_cam.recording.quality import MIN_PAIRS, Quality, QualityMeter
from nlos_cam.recording.sidecar import (
    TEMPERATURE_INTERVAL_S,
    load_measured_wall,
    summary_of,
    versions,
)

PINHOLE = Intrinsics(64, 48, 46.0, 46.0, 32.0, 24.0)
DARK = np.zeros((48, 64), np.uint8)
WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
SEEN = Quality(9, 0.25, 0.5, 7.0, 1.5, 0.1)
READ = VerifyResult(
    frames=9, dropped=2, seconds=0.5, streams={"depth": 9, "infrared": 9, "confidence": 9}
)


def test_sidecar_is_named_like_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "bench1.5m"
    folder.mkdir()
    monkeypatch.chdir(folder)

    assert sidecar_path(Path("a.bag")) == Path("a.json")
    assert sidecar_path(folder) == sidecar_path(Path()) == tmp_path / "bench1.5m.json"
    assert not sidecar_path(Path("sample")).is_relative_to(tmp_path)  # in the package


@dataclass
class Warm:
    uri: str = "l515"
    intrinsics: Intrinsics = PINHOLE
    rig: Rig | None = None
    identity: Mapping[str, str] = field(
        default_factory=lambda: {"name": "L515", "serial": "f0246262"}
    )
    counts: Counter[str] = field(default_factory=Counter[str])
    celsius: float = 30.0

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        self.celsius += 1.0
        fields = {
            "laser_power": 40.0,
            "ldd_temperature": self.celsius,
            "broken_temperature": float("nan"),
        }
        return {name: value for name, value in fields.items() if name.endswith(ending)}


def frame(timestamp_s: float, **settings: float) -> Frame:
    return Frame(np.zeros((48, 64), np.float32), DARK, DARK, timestamp_s, 0, PINHOLE, settings)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.json"


def test_sidecar_exists_from_the_start_of_a_recording(path: Path) -> None:
    SidecarFile(path, Warm(), label="a cup", started=WHEN)
    found = load_sidecar(path)
    fields = json.loads(path.read_text())

    assert (found.label, found.camera, found.state, found.summary) == (
        "a cup",
        "l515",
        "recording",
        None,
    )
    assert found.device == {"name": "L515", "serial": "f0246262"}
    assert found.started == WHEN
    assert found.intrinsics.fx == 46.0
    assert found.settings["laser_power"] == 40.0
    assert fields["label"] == "a cup"
    assert fields["camera"] == "l515"
    assert fields["started"][-1] == "Z"


def test_sidecar_samples_temperatures_over_device_time(path: Path) -> None:
    sidecar = SidecarFile(path, Warm())
    for number in range(900):
        sidecar.on_frame(frame(1e9 + number / 30))
    series = load_sidecar(path).temperatures

    assert [look.time_s for look in series] == pytest.approx(
        [0.0, TEMPERATURE_INTERVAL_S, 2 * TEMPERATURE_INTERVAL_S], abs=0.05
    )

    celsius = [look.celsius["ldd_temperature"] for look in series]

    assert celsius == sorted(celsius)
    assert set(series[0].celsius) == {"ldd_temperature"}

    camera = Warm()
    camera.telemetry = lambda ending="": {} if ending else {"laser_power": 40.0}
    SidecarFile(path, camera).on_frame(frame(0.0))

    assert load_sidecar(path).temperatures == []


def test_sidecar_goes_on_after_a_clock_that_went_back(path: Path) -> None:
    sidecar = SidecarFile(path, Warm())
    for time_s in (1e9, 1e9 - 3600.0, 1e9 - 3599.0, 1e9 - 3600.0 + TEMPERATURE_INTERVAL_S):
        sidecar.on_frame(frame(time_s))

    assert [look.time_s for look in load_sidecar(path).temperatures] == [
        0.0,
        -3600.0,
        -3600.0 + TEMPERATURE_INTERVAL_S,
    ]


def test_sidecar_thins_a_long_series_evenly(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.recording.sidecar.MAX_TEMPERATURES", 10)
    sidecar = SidecarFile(path, Warm())
    for number in range(100):
        sidecar.on_frame(frame(number * TEMPERATURE_INTERVAL_S))
    times = [look.time_s for look in load_sidecar(path).temperatures]

    assert 5 <= len(times) <= 10
    assert times[0] == 0.0
    assert times[-1] >= 900.0
    assert len(set(np.diff(times).tolist())) == 1


def test_sidecar_ends_with_settings_state_and_summary(path: Path) -> None:
    sidecar = SidecarFile(path, Warm())
    sidecar.on_frame(frame(5.0, laser_power=31.0))
    sidecar.on_frame(frame(5.1, laser_power=99.0))
    sidecar.finish("lost", expected := summary_of(READ, SEEN, {"restarted": 1}))
    found = load_sidecar(path)

    assert found.state == "lost"
    assert found.summary == expected
    assert found.settings == {"laser_power": 31.0}
    assert expected.frames == 9
    assert expected.dropped == 2
    assert expected.frames_per_s == 16.0
    assert (expected.saturated_share, expected.temporal_noise_mm, expected.events) == (
        0.25,
        1.5,
        {"restarted": 1},
    )


def test_summary_writes_unknown_values_as_null(path: Path) -> None:
    SidecarFile(path, Warm()).finish("disk full", expected := summary_of(None, Quality(), {}))

    assert "NaN" not in path.read_text()

    summary = json.loads(path.read_text())["summary"]

    assert summary["frames"] is summary["temporal_noise_mm"] is summary["saturated_share"] is None
    assert load_sidecar(path).summary == expected
    assert summary_of(VerifyResult(1, 0, 0.0, {"depth": 1}), Quality(), {}).frames_per_s is None


def test_sidecar_stays_whole_on_a_full_disk(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sidecar = SidecarFile(path, Warm())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("nlos_cam.files.atomic.os.fsync", full)
    sidecar.on_frame(frame(0.0))  # goes on: the end of the recording raises
    with pytest.raises(DiskFullError, match=r"a\.json.*No space left on device"):
        sidecar.finish("complete", summary_of(READ, SEEN, {}))

    assert [entry.name for entry in path.parent.iterdir()] == ["a.json"]
    assert path.read_bytes() == before


def test_sidecar_prefers_the_rig_of_a_measured_wall(
    path: Path, tmp_path: Path, measured: Callable[..., MeasuredWall]
) -> None:
    bench = load_rig("bare-wall")
    record = measured().record
    wall_toml = tmp_path / "wall.toml"
    wall_toml.write_text(dump_toml(record))
    SidecarFile(path, Warm(rig=bench))

    assert load_sidecar(path).rig == bench

    rig, wall = load_measured_wall(wall_toml)
    SidecarFile(path, Warm(rig=bench), wall=(rig, wall))
    found = load_sidecar(path)

    assert found.rig == rig == record.rig != bench
    assert found.wall.sha256 == hashlib.sha256(wall_toml.read_bytes()).hexdigest()
    assert recorded_wall(path.with_suffix(".bag")) == wall
    assert recorded_wall(tmp_path / "none.bag") is None

    with pytest.raises(RecordFileError):
        load_measured_wall(tmp_path / "none.toml")


def test_versions_name_the_program_and_no_machine() -> None:
    found = versions()

    assert {"nlos-cam", "python", "platform"} <= set(found)
    assert set(found) <= {"nlos-cam", "commit", "pyrealsense2", "python", "platform"}
    assert found["platform"].count(" ") == 1


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"colour": "red"}, "colour"),
        ({"schema_version": 2}, "schema_version"),
        ({"label": ...}, "label"),
    ],
)
def test_load_sidecar_names_the_wrong_field_in_one_line(
    path: Path, changed: dict[str, Any], key: str
) -> None:
    SidecarFile(path, Warm())
    fields = json.loads(path.read_text()) | changed
    path.write_text(json.dumps({name: value for name, value in fields.items() if value is not ...}))
    with pytest.raises(RecordingError, match=rf"a\.json .*{key}") as raised:
        load_sidecar(path)

    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", None])
def test_load_sidecar_refuses_other_files_in_one_line(path: Path, content: bytes | None) -> None:
    assert sidecar_path(path.with_suffix(".bag")) == path

    if content is not None:
        path.write_bytes(content)
    for other in (path, path.parent):
        with pytest.raises(RecordingError, match=other.name) as raised:
            load_sidecar(other)
        assert "\n" not in str(raised.value)


FRAMES = 60


def noisy(sigma_mm: float = 1.0, count: int = FRAMES, seed: int = 0) -> list[Frame]:
    """Make frames of a flat scene at 0.3 m with Gaussian noise in depth."""
    generator = np.random.default_rng(seed)
    depth_m = (0.3 + generator.normal(0.0, sigma_mm / 1e3, (count, 48, 64))).astype(np.float32)
    return [
        Frame(depth_m[number], DARK, DARK, 1e9 + number / 30, number, PINHOLE)
        for number in range(count)
    ]


def quality_of(frames: list[Frame]) -> Quality:
    meter = QualityMeter()
    for frame in frames:
        meter.add(frame)
    return meter.quality()


@pytest.mark.parametrize("sigma_mm", [0.0, 0.3, 1.0, 8.0])
def test_noise_is_the_known_standard_deviation(sigma_mm: float) -> None:
    assert quality_of(noisy(sigma_mm)).temporal_noise_mm == pytest.approx(
        sigma_mm, rel=0.04, abs=0.0
    )


@pytest.mark.parametrize(
    ("spoil", "tolerance"), [("push", 0.02), ("drift", 0.02), ("moves", 0.1), ("invalid", 0.02)]
)
def test_noise_ignores_a_push_a_drift_moving_and_invalid_parts(
    spoil: str, tolerance: float
) -> None:
    frames = noisy()
    for number, frame in enumerate(frames):
        if spoil in {"push", "drift"}:
            frame.depth_m[:] += np.float32(
                0.1 * (number > 30) if spoil == "push" else 0.0005 * number
            )
        elif spoil == "moves":
            frame.depth_m[:, : 4 * (1 + number % 2)] += np.float32(0.2)
        else:
            frame.depth_m[:10] = frame.depth_m[10 + number % 2] = (
                np.nan
            )  # never valid; never twice in a row

    assert quality_of(frames).temporal_noise_mm == pytest.approx(
        quality_of(noisy()).temporal_noise_mm, rel=tolerance
    )


@pytest.mark.parametrize("spoil", ["too few", "all invalid", "nothing twice"])
def test_noise_is_none_where_too_little_is_valid(spoil: str) -> None:
    frames = noisy(count=MIN_PAIRS if spoil == "too few" else FRAMES)
    for frame in frames:
        if spoil == "all invalid" or (spoil == "nothing twice" and frame.frame_number % 2):
            frame.depth_m[:] = np.nan

    assert quality_of(frames).temporal_noise_mm is None


def test_jitter_is_the_spread_of_intervals() -> None:
    on_time = [frame for frame in noisy() if frame.frame_number % 7]  # some are missing

    assert quality_of(on_time).jitter_ms == pytest.approx(0.0, abs=1e-3)

    late = [
        replace(frame, timestamp_s=frame.timestamp_s + 0.002 * (frame.frame_number % 2))
        for frame in noisy()
    ]

    assert quality_of(late).jitter_ms == pytest.approx(2.0, rel=0.01)


def test_quality_of_no_frame_and_of_one_has_no_spread() -> None:
    assert astuple(quality_of([])) == (0, None, None, None, None, None)

    found = quality_of(noisy(count=1))

    assert found.frames_seen == 1
    assert found.saturated_share == 0.0
    assert found.invalid_share == 0.0
    assert found.temporal_noise_mm is None
    assert found.jitter_ms is None
