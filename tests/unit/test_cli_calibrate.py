import json
from collections.abc import Callable, Iterator
from datetime import datetime
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pytest
import typer
from nlos_calibration.errors import CalibrationError, WallRefusedError
from nlos_calibration.rig import Occluder, OccluderRecord, load_rig
from nlos_calibration.wall import wall_depth
from nlos_calibration.wall_record import load_measured, load_wall

from nlos_cam.cli import calibrate
from nlos_cam.cli.main import main
from nlos_cam.errors import OutputExistsError
from nlos_cam.frames import Frame

RIG = load_rig("bare-wall")
Call = Callable[..., Any]


class FakeCamera:
    """A camera of 10 frames of the bare wall; `scale` moves the wall, `patch` puts part of the view behind it."""

    def __init__(self, uri: str, scale: float, patch: float, frames: int) -> None:
        self.uri, self.intrinsics = uri, RIG.pinhole.scaled(160, 120)
        self.identity = {"name": "L515", "serial": "f0246262", "firmware": "1.5.8.1"}
        self.incomplete = self.dropped = self.taken = 0
        self.frames = frames
        depth_m = scale * wall_depth(RIG.wall_from_lidar, self.intrinsics)
        depth_m[40:80, 40:100] *= patch
        self.depth_m = depth_m.astype(np.float32)

    def telemetry(self, ending: str = "") -> dict[str, float]:
        return {"ldd_temperature": 40.0} if "ldd_temperature".endswith(ending) else {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def __iter__(self) -> Iterator[Frame]:
        counts = np.zeros(self.depth_m.shape, np.uint8)
        for number in range(self.frames):
            self.taken += 1
            yield Frame(self.depth_m, counts, counts, number / 30.0, number, self.intrinsics, {"laser_power": 80.0})


@pytest.fixture
def pressed_enter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", StringIO("\n"))


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Call:
    """Run `nlos-cam calibrate` on a fake camera; returns that camera."""

    def run(*arguments: str, scale: float = 1.0, patch: float = 1.0, frames: int = 10) -> FakeCamera | None:
        opened: list[FakeCamera] = []

        def open_fake(uri: str, *, on_progress: Callable[[int, int], None]) -> FakeCamera:
            on_progress(1, 1)
            opened.append(FakeCamera(uri, scale, patch, frames))
            return opened[0]

        monkeypatch.setattr(calibrate, "open_camera", open_fake)
        app = typer.Typer()
        calibrate.register(app)
        app(list(arguments), standalone_mode=False)
        return opened[0] if opened else None

    return run


def test_the_record_and_the_json_say_the_same(call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "wall.toml"
    call("--wall", "--camera", "sim:bare-wall", "--out", str(out), "--json")
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    record = load_wall(out)
    assert result.pop("out") == str(out)
    assert result.pop("report") == str(tmp_path / "wall.html")
    assert result == record.model_dump(mode="json", include=set(result))
    assert set(result) >= {"distance_m", "facing_deg", "residual_m", "inlier_fraction", "verdict", "advice", "frames"}
    assert set(result) >= {"distance_std_m", "facing_std_deg", "yaw_std_deg", "pitch_std_deg", "range_offset_m"}
    assert (result["distance_m"], result["facing_deg"]) == pytest.approx((0.2, 45.0), abs=1e-6)
    assert (record.camera, record.frames, record.verdict) == ("sim:bare-wall", 10, "good")
    assert abs((record.created - datetime.now().astimezone().date()).days) <= 1


def test_no_more_frames_are_taken_than_asked_for(call: Call, tmp_path: Path) -> None:
    camera = call("--wall", "--camera", "sim", "--frames", "3", "--out", str(tmp_path / "wall.toml"))
    assert camera.taken == load_wall(tmp_path / "wall.toml").frames == 3


def test_a_recording_is_opened_by_its_path(call: Call, tmp_path: Path) -> None:
    assert call("--wall", "--bag", "run.bag", "--out", str(tmp_path / "wall.toml")).uri == "bag:run.bag"


def test_a_person_is_told_distance_angle_residual_and_verdict(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call("--wall", "--camera", "sim:bare-wall", "--out", str(tmp_path / "w.toml"))
    told = capsys.readouterr().out
    for part in ("0.2000 m ± ", "45.00 ± ", "mm RMS", "good", "w.toml"):
        assert part in told


def test_the_device_is_in_the_record(call: Call, tmp_path: Path) -> None:
    call("--wall", "--camera", "l515", "--out", str(tmp_path / "w.toml"))
    record = load_wall(tmp_path / "w.toml")
    assert (record.serial, record.firmware, record.settings) == ("f0246262", "1.5.8.1", {"laser_power": 80.0})
    assert record.temperatures_c == {"ldd_temperature": 40.0}


def test_the_bare_wall_lies_beside_its_record(call: Call, tmp_path: Path) -> None:
    camera = call("--wall", "--camera", "l515", "--out", str(tmp_path / "w.toml"))
    measured = load_measured(tmp_path / "w.toml")
    assert measured.record.reference == "w.npz"
    assert measured.reference is not None
    assert (measured.reference.frames, measured.reference.settings) == (10, {"laser_power": 80.0})
    np.testing.assert_allclose(measured.reference.depth_m, camera.depth_m, rtol=1e-6)
    assert measured.reference.inliers.mean() == pytest.approx(measured.record.inlier_fraction)
    assert measured.record.footprint_share == 1.0


def test_an_occluder_that_was_entered_is_the_rigs(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "w.toml"
    call("--wall", "--camera", "sim", "--occluder-x-m", "0.25", "--occluder-gap-m", "0.08", "--out", str(out))
    record = load_wall(out)
    assert record.rig.occluder == Occluder(x_m=0.25, z_min_m=0.08)
    assert record.occluder == OccluderRecord(source="entered", x_m=0.25, gap_m=0.08)
    assert "0.250 m from the foot, 0.080 m off the wall (entered)" in capsys.readouterr().out


def test_an_occluder_is_found_once_the_wall_is_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wall, bench, scene = tmp_path / "wall.toml", tmp_path / "bench.toml", tmp_path / "empty.toml"
    scene.write_text('name = "empty bench"\nrig = "paper-rig"\n', encoding="utf-8")
    assert main(["calibrate", "--wall", "--camera", "sim:bare-wall", "--frames", "20", "--out", str(wall)]) == 0
    run = ["calibrate", "--occluder", str(wall), "--camera", f"sim:{scene}", "--frames", "20", "--out", str(bench)]
    assert main([*run, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["occluder"]["source"] == "detected"
    assert (told["occluder"]["x_m"], told["occluder"]["gap_m"]) == pytest.approx((0.2, 0.1), abs=0.001)
    before, after = load_measured(wall), load_measured(bench)
    assert (after.record.distance_m, told["reference"]) == (before.record.distance_m, "bench.npz")
    assert after.reference is not None
    assert after.reference.inliers.mean() < 0.8
    assert main(run) == 1
    assert main([*run, "--overwrite"]) == 0
    assert "m off the wall" in capsys.readouterr().out


@pytest.mark.usefixtures("pressed_enter")
def test_watching_ends_with_enter_and_then_the_wall_is_measured(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call("--wall", "--watch", "--camera", "sim", "--out", str(tmp_path / "w.toml"))
    assert "0.2000 m" in capsys.readouterr().err
    assert load_wall(tmp_path / "w.toml").frames == 10


def test_a_tape_moves_the_wall_to_where_it_says(call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "w.toml"
    call("--wall", "--camera", "sim:bare-wall", "--tape-m", "0.203", "--out", str(out))
    record = load_wall(out)
    assert record.distance_m == record.rig.lidar.distance_m == pytest.approx(0.203, abs=2e-6)
    assert record.range_offset_m == pytest.approx(0.003 * np.sqrt(2.0), abs=1e-5)
    assert (record.range_offset_cause, record.verdict) == ("origin", "good")
    assert "offset    +4.2 ± 1.4 mm of the lidar's origin" in capsys.readouterr().out


def test_a_misread_tape_writes_nothing(call: Call, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"the tape says 0\.3000 m and the lidar 0\.2000 m"):
        call("--wall", "--camera", "sim:bare-wall", "--tape-m", "0.3", "--out", str(tmp_path / "w.toml"))
    assert not list(tmp_path.iterdir())


def test_a_wall_out_of_range_is_written_and_said(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "wall.toml"
    call("--wall", "--camera", "sim:bare-wall", "--out", str(out), scale=2.0)
    assert load_wall(out).verdict == "out of range"
    assert "move the lidar 10 cm closer" in capsys.readouterr().out


def test_a_refusal_writes_nothing(call: Call, tmp_path: Path) -> None:
    with pytest.raises(WallRefusedError, match="behind the wall's plane") as caught:
        call("--wall", "--camera", "sim", "--out", str(tmp_path / "wall.toml"), patch=1.5)
    assert caught.value.exit_code == 1
    assert not list(tmp_path.iterdir())


def test_a_source_without_frames_is_refused(call: Call, tmp_path: Path) -> None:
    with pytest.raises(WallRefusedError, match="gave no frames"):
        call("--wall", "--camera", "sim", "--out", str(tmp_path / "wall.toml"), frames=0)


@pytest.mark.parametrize("name", ["wall.toml", "wall.npz", "wall.html"])
def test_what_is_there_is_kept_unless_asked(call: Call, tmp_path: Path, name: str) -> None:
    out, mine = tmp_path / "wall.toml", tmp_path / name
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputExistsError, match=name):
        call("--wall", "--camera", "sim:bare-wall", "--out", str(out))
    assert mine.read_text(encoding="utf-8") == "mine"
    assert list(tmp_path.iterdir()) == [mine]
    call("--wall", "--camera", "sim:bare-wall", "--out", str(out), "--overwrite")
    assert load_wall(out).verdict == "good"


def test_without_out_a_dated_name_in_this_folder(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    call("--wall", "--camera", "sim:bare-wall")
    (path,) = tmp_path.glob("wall-*.toml")
    assert load_wall(path).verdict == "good"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--camera", "sim"],
        ["--wall"],
        ["--wall", "--camera", "sim", "--bag", "run.bag"],
        ["--wall", "--camera", "sim", "--frames", "0"],
        ["--wall", "--camera", "sim", "--tape-m", "0"],
        ["--wall", "--camera", "sim", "--occluder-x-m", "0.2"],
        ["--wall", "--camera", "sim", "--occluder-gap-m", "0.1"],
        ["--wall", "--camera", "sim", "--occluder", "wall.toml"],
        ["--occluder", "wall.toml", "--camera", "sim", "--board"],
        ["--occluder", "wall.toml", "--camera", "sim", "--watch"],
        ["--occluder", "wall.toml", "--camera", "sim", "--tape-m", "0.2"],
        ["--wall", "--camera", "sim", "--board-in", "colour"],
    ],
)
def test_wrong_usage_is_told(call: Call, arguments: list[str]) -> None:
    with pytest.raises(typer.BadParameter) as caught:
        call(*arguments)
    assert caught.value.exit_code == 2
