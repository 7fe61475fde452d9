"""`calibrate --wall --board` on recordings of a simulated camera whose wall has a board on it."""

import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration.board import BOARDS
from nlos_calibration.rig import Rig, load_rig
from nlos_calibration.wall_record import load_wall

from nlos_cam.camera import Recording
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.cli.main import main
from nlos_cam.render.sensor.sensor import DEPTH_UNIT_M, SensedImages

TOOLS = Path(__file__).parents[2] / "tools"
A4, FRAMES = BOARDS["a4"], 8
Record = Callable[..., Path]


class BoardWorld:
    """The bare wall of a rig with a board of some scale on it; depth lacks `offset_m`, or is of a view with a step."""

    def __init__(self, views: Any, scale: float, offset_m: float, step_m: float) -> None:
        self.rig: Rig = load_rig("bare-wall")
        self._views = views
        seen = views.View(self.rig.wall_from_lidar, self.rig.pinhole)
        placed = replace(views.at_near_edge(A4, seen), scale=scale)
        self._clean = views.clean_view(A4, seen, placed)
        self._depth_m = np.where(seen.depth_m < 4.0, seen.depth_m - offset_m, 0.0)
        self._depth_m[:, :300] -= step_m

    def images(self, number: int) -> SensedImages:
        generator = np.random.default_rng(number)
        noise_m = generator.standard_normal(self._depth_m.shape) * (0.0005 + 0.002 * self._depth_m)
        depth = np.where(self._depth_m > 0.0, np.rint((self._depth_m + noise_m) / DEPTH_UNIT_M), 0.0)
        ir = self._views.frames_of(self._clean, generator, 1)[0]
        return SensedImages(depth.astype(np.uint16), ir, np.full(ir.shape, 15, np.uint8))

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)

    def celsius(self, number: int) -> dict[str, float]:
        del number
        return {"ldd_temperature": 40.0}


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, hurried_clock: Any) -> Record:
    monkeypatch.syspath_prepend(TOOLS)
    views = importlib.import_module("board_view")

    def made(scale: float = 1.0, offset_m: float = 0.0, step_m: float = 0.0) -> Path:
        path = tmp_path / "board.bag"
        world, recording = BoardWorld(views, scale, offset_m, step_m), Recording(path, frames=FRAMES)
        with SimulatedCamera("sim:board", world, clock=hurried_clock(), recording=recording) as camera:
            assert sum(1 for _ in camera) >= FRAMES
        return path

    return made


def calibrated(capsys: pytest.CaptureFixture[str], bag: Path, *further: str) -> dict[str, Any]:
    out = bag.with_name("wall.toml")
    assert main(["calibrate", "--wall", "--board", "--bag", str(bag), "--out", str(out), "--json", *further]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["board"] == load_wall(out).model_dump(mode="json")["board"]
    return result


def test_a_recording_with_a_board_is_measured_by_both(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    result = calibrated(capsys, record())
    assert (result["verdict"], result["board"]["used"], result["board"]["causes"]) == ("good", "both", [])
    assert (result["distance_m"], result["facing_deg"]) == pytest.approx((0.2, 45.0), abs=0.01)
    assert result["board"]["corners"] >= 20
    assert result["board"]["distance_m"] == pytest.approx(0.2, abs=3 * result["board"]["distance_std_m"])
    assert abs(result["board"]["disagreement_m"]) < 0.002


def test_a_print_at_97_percent_is_told_and_its_measure_believed(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = record(scale=0.97)
    wrong = calibrated(capsys, bag)
    assert (wrong["verdict"], wrong["board"]["used"]) == ("doubtful", "depth")
    assert any("print's scale: squares of" in cause for cause in wrong["board"]["causes"])
    right = calibrated(capsys, bag, "--square-mm", "29.1", "--overwrite")
    assert (right["verdict"], right["board"]["used"], right["board"]["measured"]) == ("good", "both", True)


def test_a_lidar_that_is_off_is_told_by_measured_squares(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    result = calibrated(capsys, record(offset_m=0.0045), "--square-mm", "30")
    assert (result["verdict"], result["board"]["used"]) == ("doubtful", "board")
    assert any("range offset" in cause for cause in result["board"]["causes"])
    assert result["distance_m"] == pytest.approx(0.2, abs=3 * result["distance_std_m"])


def test_where_depth_is_refused_the_board_is_left(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    bag = record(step_m=0.05)
    assert main(["calibrate", "--wall", "--bag", str(bag), "--out", str(bag.with_name("w.toml"))]) == 1
    result = calibrated(capsys, bag)
    assert (result["verdict"], result["board"]["used"]) == ("doubtful", "board")
    assert result["residual_m"] is None
    assert result["board"]["depth_refused"]
    assert result["distance_m"] == pytest.approx(0.2, abs=3 * result["distance_std_m"])


def test_a_person_is_told_of_the_board(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    bag = record()
    assert main(["calibrate", "--wall", "--board", "--bag", str(bag), "--out", str(bag.with_name("w.toml"))]) == 0
    told = capsys.readouterr().out
    for part in ("board     0.", "corners", "from the depth's plane", "used: both"):
        assert part in told


def test_no_board_in_a_recording_is_refused_and_nothing_written(
    noise_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "wall.toml"
    arguments = [
        "calibrate",
        "--wall",
        "--board",
        "--paper",
        "a3",
        "--bag",
        str(noise_bag),
        "--out",
        str(out),
        "--json",
    ]
    assert main(arguments) == 1
    error = json.loads(capsys.readouterr().out.splitlines()[-1])["error"]
    assert error["type"] == "BoardRefusedError"
    assert "9 x 13 squares" in error["message"]
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments",
    [["--square-mm", "30"], ["--paper", "a4"], ["--board", "--tape-m", "0.2"], ["--board", "--square-mm", "0"]],
)
def test_wrong_usage_is_told(tmp_path: Path, arguments: list[str]) -> None:
    assert main(["calibrate", "--wall", "--bag", "x.bag", "--out", str(tmp_path / "w.toml"), *arguments]) == 2
