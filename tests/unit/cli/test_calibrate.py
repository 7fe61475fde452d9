"""`nlos-cam calibrate` and `nlos-cam board`."""

import re
import time
from collections.abc import Callable
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import (
    BOARDS,
    Board,
    Occluder,
    OccluderRecord,
    load_measured,
    load_rig,
    load_wall,
    wall_depth,
)
from rich.console import Console
from small_frames import FrameCamera
from synthetic_scenes import at_near_edge, clean_infrared, infrared_frames
from synthetic_walls import View

from nlos_cam.calibrate import FrameFit, fit_frame
from nlos_cam.cli.calibrate import EVERY, gauge, panel, until_enter, watch_wall
from nlos_cam.frames import Frame
from nlos_cam.render.sensor.sensor import DEPTH_UNIT_M, SensedImages

RIG = load_rig("bare-wall")
A4 = BOARDS["a4"]
OUT = Path("wall.toml")
BARE = "calibrate", "--wall", "--camera", "sim:bare-wall"
WALL = *BARE, "--out", OUT
Run = Callable[..., Any]


class FakeCamera(FrameCamera):
    """A camera of 10 frames of the bare wall; `scale` moves the wall, `patch` puts part of the view
    behind it.
    """

    intrinsics = RIG.pinhole.scaled(160, 120)

    def __init__(self, frames: int = 10) -> None:
        super().__init__(frames, make=self._frame, uri="sim")
        self.identity |= {"name": "L515", "firmware": "1.5.8.1"}
        self.scale = 1.0
        self.patch = 1.0
        self.taken = 0

    @property
    def depth_m(self) -> np.ndarray:
        depth_m = self.scale * wall_depth(RIG.wall_from_lidar, self.intrinsics)
        depth_m[40:80, 40:100] *= self.patch
        return depth_m.astype(np.float32)

    def telemetry(self, ending: str = "") -> dict[str, float]:
        return {"ldd_temperature": 40.0} if "ldd_temperature".endswith(ending) else {}

    def _frame(self, number: int) -> Frame:
        self.taken += 1
        counts = np.zeros((120, 160), np.uint8)
        settings = {"laser_power": 80.0}
        return Frame(self.depth_m, counts, counts, number / 30.0, number, self.intrinsics, settings)


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    """A fake camera, which any URI opens."""
    camera = FakeCamera()

    def open_fake(uri: str, *, on_progress: Callable[[int, int], None]) -> FakeCamera:
        on_progress(1, 1)
        camera.uri = uri
        return camera

    monkeypatch.setattr("nlos_cam.camera.open_camera", open_fake)
    # the report takes a second to draw
    monkeypatch.setattr("nlos_cam.calibrate.files.report_html", lambda *_: "")
    return camera


def assert_has(text: str, *parts: str) -> None:
    assert not [part for part in parts if part not in text]


JSON_FIELDS = {
    *("distance_m", "facing_deg", "residual_m", "inlier_fraction", "verdict", "advice", "frames"),
    *("distance_std_m", "facing_std_deg", "yaw_std_deg", "pitch_std_deg", "range_offset_m"),
}


@pytest.mark.usefixtures("camera")
def test_calibrate_json_is_what_the_record_holds(run: Run) -> None:
    result = run(*WALL)

    assert result.pop("out") == "wall.toml"
    assert result.pop("report") == "wall.html"
    assert result.pop("weights")["serve"]
    assert result == load_wall(OUT).model_dump(mode="json", include=set(result))
    assert set(result) >= JSON_FIELDS


@pytest.mark.usefixtures("camera")
def test_calibrate_writes_the_measured_wall(run: Run) -> None:
    run(*WALL)
    record = load_wall(OUT)

    assert record.distance_m == pytest.approx(0.2, abs=1e-6)
    assert record.facing_deg == pytest.approx(45.0, abs=1e-6)
    assert record.camera == "sim:bare-wall"
    assert record.frames == 10
    assert record.verdict == "good"
    assert abs((record.created - datetime.now().astimezone().date()).days) <= 1


@pytest.mark.usefixtures("camera")
def test_calibrate_without_out_names_the_record_itself(run: Run) -> None:
    run(*BARE)
    (path,) = Path().glob("wall-*.toml")

    assert load_wall(path).verdict == "good"


L515 = "calibrate", "--wall", "--camera", "l515", "--out", OUT


@pytest.mark.usefixtures("camera")
def test_calibrate_records_the_device(run: Run) -> None:
    run(*L515)
    record = load_wall(OUT)

    assert record.serial == "f0246262"
    assert record.firmware == "1.5.8.1"
    assert record.settings == {"laser_power": 80.0}
    assert record.temperatures_c == {"ldd_temperature": 40.0}
    assert record.footprint_share == 1.0


def test_calibrate_writes_the_reference(camera: FakeCamera, run: Run) -> None:
    run(*L515)
    record, reference = vars(load_measured(OUT)).values()

    assert record.reference == "wall.npz"
    assert reference.frames == 10
    assert reference.settings == {"laser_power": 80.0}
    np.testing.assert_allclose(reference.depth_m, camera.depth_m, rtol=1e-6)
    assert reference.inliers.mean() == pytest.approx(record.inlier_fraction)


@pytest.mark.usefixtures("camera")
def test_calibrate_prints_result_verdict_and_files(shown: Run) -> None:
    printed = shown(*L515).out

    assert_has(printed, "200.00 ± 0.0", "45.00", " mm RMS")
    assert_has(printed, "Verdict: good", "wall.npz", "open wall.html")


@pytest.mark.slow
def test_calibrate_finds_the_occluder_on_a_simulated_bench(run: Run) -> None:
    Path("empty.toml").write_text('name = "empty bench"\nrig = "paper-rig"\n', encoding="utf-8")
    run(*WALL, "--frames", "20")
    bench = (
        "calibrate",
        "--occluder",
        OUT,
        "--camera",
        "sim:empty.toml",
        "--frames",
        "20",
        "--out",
        "bench.toml",
    )
    result = run(*bench)

    assert result["occluder"]["source"] == "detected"
    assert (result["occluder"]["x_m"], result["occluder"]["gap_m"]) == pytest.approx(
        (0.2, 0.1), abs=0.001
    )

    before = load_measured(OUT)
    after = load_measured(Path("bench.toml"))

    assert after.record.distance_m == before.record.distance_m
    assert result["reference"] == "bench.npz"
    assert after.reference.inliers.mean() < 0.8

    run(*bench, code=1)
    run(*bench, "--overwrite")


def test_calibrate_takes_frames_and_the_entered_occluder(camera: FakeCamera, shown: Run) -> None:
    entered = "--occluder-x-m", "0.25", "--occluder-gap-m", "0.08"
    printed = shown(
        "calibrate", "--wall", "--bag", "run.bag", "--frames", "3", *entered, "--out", OUT
    ).out
    record = load_wall(OUT)

    assert camera.uri == "bag:run.bag"
    assert camera.taken == record.frames == 3
    assert record.rig.occluder == Occluder(x_m=0.25, z_min_m=0.08)
    assert record.occluder == OccluderRecord(source="entered", x_m=0.25, gap_m=0.08)
    assert_has(printed, "250.0 mm", "80.0 mm", "entered")


def test_recording_is_not_watched(run: Run) -> None:
    Path("run.bag").touch()

    for source in (["run.bag"], ["--bag", "run.bag"]):
        assert "not for a recording" in run("calibrate", "--wall", *source, "--watch", code=2).err


@pytest.mark.usefixtures("camera")
def test_calibrate_measures_after_watching(shown: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", StringIO("\n"))

    assert "200.0 mm" in shown(*WALL, "--watch").err
    assert load_wall(OUT).frames == 10


def test_calibrate_moves_by_tape_and_reports_out_of_range(camera: FakeCamera, shown: Run) -> None:
    assert "+4.2 ± 1.4 mm" in shown(*WALL, "--tape-m", "0.203").out

    record = load_wall(OUT)

    assert record.distance_m == record.rig.lidar.distance_m == pytest.approx(0.203, abs=2e-6)
    assert record.range_offset_m == pytest.approx(0.003 * np.sqrt(2.0), abs=1e-5)
    assert record.range_offset_cause == "origin"
    assert record.verdict == "good"

    camera.scale = 2.0

    assert "10 cm" in shown(*WALL, "--overwrite").out
    assert load_wall(OUT).verdict == "out of range"


@pytest.mark.parametrize(
    ("options", "changed", "error", "value"),
    [
        ((), {"patch": 1.5}, "WallRefusedError", r"\d+%"),
        ((), {"_count": 0}, "WallRefusedError", "sim:bare-wall"),
        (("--tape-m", "0.3"), {}, "CalibrationError", r"300\.0 mm.*200\.0 mm"),
    ],
    ids=["patch", "no frames", "tape"],
)
def test_calibrate_that_is_refused_writes_nothing(
    run: Run,
    camera: FakeCamera,
    options: tuple[str, ...],
    changed: dict[str, Any],
    error: str,
    value: str,
) -> None:
    vars(camera).update(changed)
    refused = run(*WALL, *options, code=1)["error"]

    assert refused["type"] == error
    assert re.search(value, refused["message"])
    assert not list(Path().iterdir())


@pytest.mark.usefixtures("camera")
@pytest.mark.parametrize("name", ["wall.toml", "wall.npz", "wall.html"])
def test_calibrate_keeps_existing_files_unless_asked(run: Run, name: str) -> None:
    (mine := Path(name)).write_text("mine", encoding="utf-8")
    refused = run(*WALL, code=1)["error"]

    assert (refused["type"], name in refused["message"]) == ("OutputExistsError", True)
    assert mine.read_text(encoding="utf-8") == "mine"
    assert list(Path().iterdir()) == [mine]

    run(*WALL, "--overwrite")

    assert load_wall(OUT).verdict == "good"


@pytest.fixture
def record(noise_world: Any, recorded: Callable[..., Path]) -> Callable[..., Path]:
    """Record the bare wall with a board on it; with a step, depth is no plane."""

    class BoardWorld(noise_world):
        rig = RIG

        def __init__(self, step_m: float) -> None:
            seen = View(RIG.wall_from_lidar, RIG.pinhole)
            self._clean = clean_infrared(A4, seen, at_near_edge(A4, seen))
            self._depth_m = np.where(seen.depth_m < 4.0, seen.depth_m, 0.0)
            self._depth_m[:, :300] -= step_m

        def images(self, number: int) -> SensedImages:
            generator = np.random.default_rng(number)
            noise_m = generator.standard_normal(self._depth_m.shape) * (
                0.0005 + 0.002 * self._depth_m
            )
            depth = np.where(
                self._depth_m > 0.0, np.rint((self._depth_m + noise_m) / DEPTH_UNIT_M), 0.0
            )
            ir = infrared_frames(self._clean, generator, 1)[0]
            return SensedImages(depth.astype(np.uint16), ir, np.full(ir.shape, 15, np.uint8))

    return lambda step_m=0.0: recorded(Path("board.bag"), 8, BoardWorld(step_m))


@pytest.mark.slow
def test_calibrate_board_uses_depth_and_board(record: Run, run: Run, shown: Run) -> None:
    arguments = "calibrate", "--wall", "--board", "--bag", record(), "--out", OUT
    result = run(*arguments)
    board = result["board"]

    assert board == load_wall(OUT).model_dump(mode="json")["board"]
    assert result["verdict"] == "good"
    assert board["used"] == "both"
    assert board["causes"] == []
    assert (result["distance_m"], result["facing_deg"]) == pytest.approx((0.2, 45.0), abs=0.01)
    assert board["corners"] >= 20
    assert board["distance_m"] == pytest.approx(0.2, abs=3 * board["distance_std_m"])
    assert abs(board["disagreement_m"]) < 0.002
    assert_has(
        shown(*arguments, "--overwrite").out,
        "printed board",
        f"{board['corners']} corners",
        "used: both",
    )


@pytest.mark.slow
def test_calibrate_board_replaces_depth_that_is_refused(record: Run, run: Run) -> None:
    arguments = "calibrate", "--wall", "--bag", record(step_m=0.05), "--out", OUT
    run(*arguments, code=1)
    result = run(*arguments, "--board", "--square-mm", "30")

    assert (result["verdict"], result["board"]["used"], result["board"]["measured"]) == (
        "doubtful",
        "board",
        True,
    )
    assert result["board"] == load_wall(OUT).model_dump(mode="json")["board"]
    assert result["residual_m"] is None
    assert result["board"]["depth_refused"]
    assert result["distance_m"] == pytest.approx(0.2, abs=3 * result["distance_std_m"])


def test_calibrate_board_refuses_a_recording_without_one(noise_bag: Path, run: Run) -> None:
    arguments = "calibrate", "--wall", "--board", "--paper", "a3", "--bag", noise_bag, "--out", OUT
    error = run(*arguments, code=1)["error"]

    assert (error["type"], "9 x 13" in error["message"]) == ("BoardRefusedError", True)
    assert not OUT.exists()


def test_watch_panel_shows_fit_or_refusal() -> None:
    console = Console(file=(text := StringIO()), width=140)
    console.print(panel(fit_frame(next(iter(FakeCamera())))))

    assert_has(text.getvalue(), "200.0 mm", "45.00°", "good", "●")

    console.print(panel(FrameFit(None, "the wall [so to say] is not flat", 0.25)))

    assert_has(text.getvalue(), "the wall [so to say] is not", "25.0%")


def test_watch_ends_with_the_camera_or_on_request() -> None:
    stops = iter([False] * (2 * EVERY - 1) + [True])
    last = watch_wall(FakeCamera(frames=100), lambda: next(stops))  # type: ignore[arg-type]

    assert last.fit is not None
    assert not list(stops)
    assert watch_wall(FakeCamera(frames=0), lambda: False) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("typed", ["\n", ""])
def test_until_enter_ends_on_enter_or_end_of_input(
    monkeypatch: pytest.MonkeyPatch, typed: str
) -> None:
    monkeypatch.setattr("sys.stdin", StringIO(typed))
    stopped = until_enter()
    deadline = time.monotonic() + 30.0
    while not stopped():
        assert time.monotonic() < deadline


def test_gauge_points_to_where_a_value_lies() -> None:
    places = [gauge(value, 0.15, 0.3).index("●") for value in (0.15, 0.2, 0.25, 0.3)]

    assert places == sorted(places)
    assert "◀" in gauge(0.1, 0.15, 0.3)
    assert "▶" in gauge(0.31, 0.15, 0.3)
    assert len({len(gauge(value, 0.15, 0.3)) for value in (0.0, 0.2, 1.0)}) == 1


def test_board_json_is_the_board_that_was_printed(run: Run, shown: Run) -> None:
    command = "board", "--out", "board.pdf", "--overwrite"
    for paper, board in BOARDS.items():
        result = run(*command, "--paper", paper)
        assert Path("board.pdf").read_bytes().startswith(b"%PDF")
        assert (result.pop("out"), result.pop("paper"), len(result.pop("page_mm"))) == (
            "board.pdf",
            paper,
            2,
        )
        assert Board.model_validate(result) == board

    assert_has(shown(*command).out, "6 x 9", "30 mm", "a4", "100 %", "board.pdf")


def test_record_of_another_suffix_is_refused(run: Run) -> None:
    assert ".toml" in run("calibrate", "sim", "--wall", "--out", "wall.rec", code=2).err
