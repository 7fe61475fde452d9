"""`nlos-cam calibrate` and `nlos-cam board`."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pytest
from nlos_calibration import BOARDS, Board, Occluder, OccluderRecord, load_measured, load_rig, load_wall, wall_depth
from nlos_calibration.errors import CalibrationError, WallRefusedError
from rich.console import Console
from synthetic_scenes import at_near_edge, clean_infrared, infrared_frames

from nlos_cam.calibrate import FrameFit, View, fit_frame
from nlos_cam.camera import Recording, SimulatedCamera
from nlos_cam.cli.calibrate import EVERY, gauge, panel, until_enter, watch_wall
from nlos_cam.cli.common import release_outputs
from nlos_cam.cli.main import build_app, main
from nlos_cam.errors import OutputExistsError
from nlos_cam.frames import Frame
from nlos_cam.render.sensor.sensor import DEPTH_UNIT_M, SensedImages

Capsys = pytest.CaptureFixture[str]
RIG = load_rig("bare-wall")
A4 = BOARDS["a4"]
Call = Callable[..., Any]


class FakeCamera:
    """A camera of 10 frames of the bare wall; `scale` moves the wall, `patch` puts part of the view behind it."""

    intrinsics = RIG.pinhole.scaled(160, 120)
    identity: ClassVar = {"name": "L515", "serial": "f0246262", "firmware": "1.5.8.1"}
    incomplete = dropped = taken = 0

    def __init__(self, uri: str = "sim", scale: float = 1.0, patch: float = 1.0, frames: int = 10) -> None:
        self.uri, self.frames = uri, frames
        depth_m = scale * wall_depth(RIG.wall_from_lidar, self.intrinsics)
        depth_m[40:80, 40:100] *= patch
        self.depth_m = depth_m.astype(np.float32)

    def telemetry(self, ending: str = "") -> dict[str, float]:
        return {"ldd_temperature": 40.0} if "ldd_temperature".endswith(ending) else {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def __iter__(self) -> Iterator[Frame]:
        counts = np.zeros(self.depth_m.shape, np.uint8)
        for number in range(self.frames):
            self.taken += 1
            yield Frame(self.depth_m, counts, counts, number / 30.0, number, self.intrinsics, {"laser_power": 80.0})


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "wall.toml"


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, out: Path) -> Call:
    """Run `nlos-cam calibrate --out wall.toml` on a fake camera; returns that camera."""

    def run(*arguments: str, **wall: Any) -> FakeCamera | None:
        opened: list[FakeCamera] = []

        def open_fake(uri: str, *, on_progress: Callable[[int, int], None]) -> FakeCamera:
            on_progress(1, 1)
            opened.append(FakeCamera(uri, **wall))
            return opened[0]

        monkeypatch.setattr("nlos_cam.camera.open_camera", open_fake)
        monkeypatch.setattr("nlos_cam.calibrate.files.report_html", lambda *_: "")  # it takes a second to draw
        try:
            build_app("calibrate")(["calibrate", *arguments, "--out", str(out)], standalone_mode=False)
        finally:
            release_outputs()
        return opened[0] if opened else None

    return run


WALL = "--wall", "--camera", "sim:bare-wall"


def json_of(capsys: Capsys) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def assert_shown(capsys: Capsys, *parts: str) -> None:
    shown = capsys.readouterr().out
    assert not [part for part in parts if part not in shown]


def test_calibrate_json_is_what_the_record_holds(call: Call, out: Path, capsys: Capsys) -> None:
    call(*WALL, "--json")
    result, record = json_of(capsys), load_wall(out)
    assert (result.pop("out"), result.pop("report")) == (str(out), str(out.with_suffix(".html")))
    assert result == record.model_dump(mode="json", include=set(result))
    assert set(result) >= {"distance_m", "facing_deg", "residual_m", "inlier_fraction", "verdict", "advice", "frames"}
    assert set(result) >= {"distance_std_m", "facing_std_deg", "yaw_std_deg", "pitch_std_deg", "range_offset_m"}
    assert (result["distance_m"], result["facing_deg"]) == pytest.approx((0.2, 45.0), abs=1e-6)
    assert (record.camera, record.frames, record.verdict) == ("sim:bare-wall", 10, "good")
    assert abs((record.created - datetime.now().astimezone().date()).days) <= 1


def test_calibrate_writes_device_and_reference(call: Call, out: Path, capsys: Capsys) -> None:
    camera = call("--wall", "--camera", "l515")
    record, reference = load_wall(out), load_measured(out).reference
    assert (record.serial, record.firmware, record.settings) == ("f0246262", "1.5.8.1", {"laser_power": 80.0})
    assert (record.temperatures_c, record.footprint_share) == ({"ldd_temperature": 40.0}, 1.0)
    assert record.reference == "wall.npz"
    assert (reference.frames, reference.settings) == (10, {"laser_power": 80.0})
    np.testing.assert_allclose(reference.depth_m, camera.depth_m, rtol=1e-6)
    assert reference.inliers.mean() == pytest.approx(record.inlier_fraction)
    assert_shown(capsys, "200.00 ± 0.0", "45.00", " mm RMS", "Verdict: good", "wall.npz", "open wall.html")


@pytest.mark.slow
def test_calibrate_finds_the_occluder_on_a_simulated_bench(tmp_path: Path, capsys: Capsys) -> None:
    wall, bench, scene = tmp_path / "wall.toml", tmp_path / "bench.toml", tmp_path / "empty.toml"
    scene.write_text('name = "empty bench"\nrig = "paper-rig"\n', encoding="utf-8")
    assert main(["calibrate", *WALL, "--frames", "20", "--out", str(wall)]) == 0
    run = ["calibrate", "--occluder", str(wall), "--camera", f"sim:{scene}", "--frames", "20", "--out", str(bench)]
    assert main([*run, "--json"]) == 0
    result = json_of(capsys)
    assert result["occluder"]["source"] == "detected"
    assert (result["occluder"]["x_m"], result["occluder"]["gap_m"]) == pytest.approx((0.2, 0.1), abs=0.001)
    before, after = load_measured(wall), load_measured(bench)
    assert (after.record.distance_m, result["reference"]) == (before.record.distance_m, "bench.npz")
    assert after.reference.inliers.mean() < 0.8
    assert main(run) == 1
    assert main([*run, "--overwrite"]) == 0


def test_calibrate_takes_frames_and_the_entered_occluder(call: Call, out: Path, capsys: Capsys) -> None:
    camera = call("--wall", "--bag", "run.bag", "--frames", "3", "--occluder-x-m", "0.25", "--occluder-gap-m", "0.08")
    record = load_wall(out)
    assert camera.uri == "bag:run.bag"
    assert camera.taken == record.frames == 3
    assert record.rig.occluder == Occluder(x_m=0.25, z_min_m=0.08)
    assert record.occluder == OccluderRecord(source="entered", x_m=0.25, gap_m=0.08)
    assert_shown(capsys, "250.0 mm", "80.0 mm", "entered")


def test_calibrate_measures_after_watching(
    call: Call, out: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", StringIO("\n"))
    call("--wall", "--watch", "--camera", "sim")
    assert "200.0 mm" in capsys.readouterr().err
    assert load_wall(out).frames == 10


def test_calibrate_moves_by_tape_and_reports_out_of_range(call: Call, out: Path, capsys: Capsys) -> None:
    call(*WALL, "--tape-m", "0.203")
    record = load_wall(out)
    assert record.distance_m == record.rig.lidar.distance_m == pytest.approx(0.203, abs=2e-6)
    assert record.range_offset_m == pytest.approx(0.003 * np.sqrt(2.0), abs=1e-5)
    assert (record.range_offset_cause, record.verdict) == ("origin", "good")
    assert "+4.2 ± 1.4 mm" in capsys.readouterr().out
    call(*WALL, "--overwrite", scale=2.0)
    assert load_wall(out).verdict == "out of range"
    assert "10 cm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "camera", "error", "value"),
    [
        (WALL, {"patch": 1.5}, WallRefusedError, r"\d+%"),
        (WALL, {"frames": 0}, WallRefusedError, "sim:bare-wall"),
        ((*WALL, "--tape-m", "0.3"), {}, CalibrationError, r"300\.0 mm.*200\.0 mm"),
    ],
    ids=["patch", "no frames", "tape"],
)
def test_calibrate_that_is_refused_writes_nothing(
    call: Call, out: Path, arguments: list[str], camera: dict[str, Any], error: type[CalibrationError], value: str
) -> None:
    with pytest.raises(error, match=value) as caught:
        call(*arguments, **camera)
    assert caught.value.exit_code == 1
    assert not list(out.parent.iterdir())


@pytest.mark.parametrize("name", ["wall.toml", "wall.npz", "wall.html"])
def test_calibrate_keeps_existing_files_unless_asked(call: Call, out: Path, name: str) -> None:
    mine = out.with_name(name)
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputExistsError, match=name):
        call(*WALL)
    assert mine.read_text(encoding="utf-8") == "mine"
    assert list(out.parent.iterdir()) == [mine]
    call(*WALL, "--overwrite")
    assert load_wall(out).verdict == "good"


def test_calibrate_without_out_writes_a_dated_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nlos_cam.camera.open_camera", lambda *_, **__: FakeCamera())
    monkeypatch.setattr("nlos_cam.calibrate.files.report_html", lambda *_: "")
    assert main(["calibrate", *WALL]) == 0
    (path,) = tmp_path.glob("wall-*.toml")
    assert load_wall(path).verdict == "good"


class BoardWorld:
    """The bare wall of a rig with a board of some scale on it; depth lacks `offset_m`, or is of a view with a step."""

    rig = RIG

    def __init__(self, scale: float, offset_m: float, step_m: float) -> None:
        seen = View(RIG.wall_from_lidar, RIG.pinhole)
        self._clean = clean_infrared(A4, seen, replace(at_near_edge(A4, seen), scale=scale))
        self._depth_m = np.where(seen.depth_m < 4.0, seen.depth_m - offset_m, 0.0)
        self._depth_m[:, :300] -= step_m

    def images(self, number: int) -> SensedImages:
        generator = np.random.default_rng(number)
        noise_m = generator.standard_normal(self._depth_m.shape) * (0.0005 + 0.002 * self._depth_m)
        depth = np.where(self._depth_m > 0.0, np.rint((self._depth_m + noise_m) / DEPTH_UNIT_M), 0.0)
        ir = infrared_frames(self._clean, generator, 1)[0]
        return SensedImages(depth.astype(np.uint16), ir, np.full(ir.shape, 15, np.uint8))

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)

    def celsius(self, number: int) -> dict[str, float]:
        return {"ldd_temperature": 40.0 + 0.0 * number}


@pytest.fixture
def record(tmp_path: Path, hurried_clock: Any) -> Callable[..., Path]:
    def made(scale: float = 1.0, offset_m: float = 0.0, step_m: float = 0.0) -> Path:
        path = tmp_path / "board.bag"
        world, recording = BoardWorld(scale, offset_m, step_m), Recording(path, frames=8)
        with SimulatedCamera("sim:board", world, clock=hurried_clock(), recording=recording) as camera:
            assert sum(1 for _ in camera) >= 8
        return path

    return made


def calibrated(capsys: Capsys, bag: Path, *further: str) -> dict[str, Any]:
    out = bag.with_name("wall.toml")
    assert main(["calibrate", "--wall", "--board", "--bag", str(bag), "--out", str(out), "--json", *further]) == 0
    result = json_of(capsys)
    assert result["board"] == load_wall(out).model_dump(mode="json")["board"]
    return result


Record = Callable[..., Path]


@pytest.mark.slow
def test_calibrate_board_uses_depth_and_board(record: Record, capsys: Capsys) -> None:
    bag = record()
    result = calibrated(capsys, bag)
    board = result["board"]
    assert (result["verdict"], board["used"], board["causes"]) == ("good", "both", [])
    assert (result["distance_m"], result["facing_deg"]) == pytest.approx((0.2, 45.0), abs=0.01)
    assert board["corners"] >= 20
    assert board["distance_m"] == pytest.approx(0.2, abs=3 * board["distance_std_m"])
    assert abs(board["disagreement_m"]) < 0.002
    assert main(["calibrate", "--wall", "--board", "--bag", str(bag), "--out", str(bag.with_name("w.toml"))]) == 0
    assert_shown(capsys, "printed board", f"{board['corners']} corners", "used: both")


@pytest.mark.slow
def test_calibrate_board_replaces_depth_that_is_refused(record: Record, capsys: Capsys) -> None:
    bag = record(step_m=0.05)
    assert main(["calibrate", "--wall", "--bag", str(bag), "--out", str(bag.with_name("w.toml"))]) == 1
    result = calibrated(capsys, bag, "--square-mm", "30")
    assert (result["verdict"], result["board"]["used"], result["board"]["measured"]) == ("doubtful", "board", True)
    assert result["residual_m"] is None
    assert result["board"]["depth_refused"]
    assert result["distance_m"] == pytest.approx(0.2, abs=3 * result["distance_std_m"])


def test_calibrate_board_refuses_a_recording_without_one(noise_bag: Path, out: Path, capsys: Capsys) -> None:
    arguments = ["--wall", "--board", "--paper", "a3", "--bag", str(noise_bag), "--out", str(out), "--json"]
    assert main(["calibrate", *arguments]) == 1
    error = json_of(capsys)["error"]
    assert error["type"] == "BoardRefusedError"
    assert "9 x 13" in error["message"]
    assert not out.exists()


def test_watch_panel_shows_fit_or_refusal() -> None:
    text = StringIO()
    console = Console(file=text, width=140)
    console.print(panel(fit_frame(next(iter(FakeCamera())))))
    assert all(part in text.getvalue() for part in ("200.0 mm", "45.00°", "good", "●"))
    console.print(panel(FrameFit(None, "the wall [so to say] is not flat", 0.25)))
    assert all(part in text.getvalue() for part in ("the wall [so to say] is not", "25.0%"))


def test_watch_ends_with_the_camera_or_on_request() -> None:
    stops = iter([False] * (2 * EVERY - 1) + [True])
    last = watch_wall(FakeCamera(frames=100), lambda: next(stops))  # type: ignore[arg-type]
    assert last.fit is not None
    assert not list(stops)
    assert watch_wall(FakeCamera(frames=0), lambda: False) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("typed", ["\n", ""])
def test_until_enter_ends_on_enter_or_end_of_input(monkeypatch: pytest.MonkeyPatch, typed: str) -> None:
    monkeypatch.setattr("sys.stdin", StringIO(typed))
    stopped, deadline = until_enter(), time.monotonic() + 30.0
    while not stopped():
        assert time.monotonic() < deadline


def test_gauge_points_to_where_a_value_lies() -> None:
    places = [gauge(value, 0.15, 0.3).index("●") for value in (0.15, 0.2, 0.25, 0.3)]
    assert places == sorted(places)
    assert "◀" in gauge(0.1, 0.15, 0.3)
    assert "▶" in gauge(0.31, 0.15, 0.3)
    assert len({len(gauge(value, 0.15, 0.3)) for value in (0.0, 0.2, 1.0)}) == 1


def test_board_json_is_the_board_that_was_printed_with_a_note_how_to_print(tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "board.pdf"
    for paper, board in BOARDS.items():
        assert main(["board", "--out", str(out), "--paper", paper, "--json", "--overwrite"]) == 0
        result = json_of(capsys)
        assert out.read_bytes().startswith(b"%PDF")
        assert (result.pop("out"), result.pop("paper"), len(result.pop("page_mm"))) == (str(out), paper, 2)
        assert Board.model_validate(result) == board
    assert main(["board", "--out", str(out), "--overwrite"]) == 0
    assert_shown(capsys, "6 x 9", "30 mm", "a4", "100 %", "board.pdf")
