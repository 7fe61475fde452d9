"""The colour camera that boards are rendered for: its lens, its errors, and a small version of its figures."""

import importlib
import json
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from nlos_calibration.board import find_corners
from nlos_calibration.board_wall import EXACT, CameraErrors

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def colour(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_in_colour")


def test_rendered_corners_are_where_the_lens_puts_them(colour: ModuleType) -> None:
    seen = importlib.import_module("wall_scenes").view(0.25, 30.0, 0.0, colour.LIDAR)
    views = importlib.import_module("board_view")
    bench = colour.Bench(colour.A4, seen, views.at_near_edge(colour.A4, seen), colour.ROOM)
    taken = colour.as_told()
    found = find_corners(colour.colour_frames(bench, taken, 4, np.random.default_rng(0)).mean(axis=0), colour.A4)
    straight = colour.corners_px(colour.A4, taken.seen(bench), bench.placed)[found.ids]
    off_px = np.linalg.norm(found.pixels - colour.through_lens(straight), axis=1)
    assert np.median(off_px) < 0.1
    assert np.median(np.linalg.norm(found.pixels - straight, axis=1)) > 10.0 * np.median(off_px)


def test_a_camera_is_off_by_as_much_as_its_errors_allow(colour: ModuleType) -> None:
    errors, generator = CameraErrors(0.5, 0.002, 0.01), np.random.default_rng(0)
    taken = [colour.as_errors_allow(generator, errors) for _ in range(400)]
    poses = [each.lidar_from_colour @ np.linalg.inv(colour.TOLD.lidar_from_camera) for each in taken]
    turns_deg = np.degrees([cv2.Rodrigues(pose[:3, :3])[0].ravel() for pose in poses])
    shifts_m = [each.lidar_from_colour[:3, 3] - colour.TOLD.lidar_from_camera[:3, 3] for each in taken]
    focal = [each.pinhole.fx / colour.COLOUR.fx - 1.0 for each in taken]
    assert np.std(turns_deg) == pytest.approx(0.5, rel=0.1)
    assert np.std(shifts_m) == pytest.approx(0.002, rel=0.1)
    assert np.std(focal) == pytest.approx(0.01, rel=0.15)
    exact = colour.as_errors_allow(generator, EXACT)
    np.testing.assert_allclose(exact.lidar_from_colour, colour.as_told().lidar_from_colour, atol=1e-12)


def test_a_small_study_is_written(
    colour: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(colour, "OUT", tmp_path / "board_in_colour.json")
    monkeypatch.setattr(colour, "CORNERS", 4)
    monkeypatch.setattr(colour, "IMAGES", 1)
    colour.main()
    table = json.loads(colour.OUT.read_text(encoding="utf-8"))
    assert table == json.loads(capsys.readouterr().out)
    assert [row["measured"] + row["refused"] for row in table["random_benches"].values()] == [4, 4, 1]
