"""The board's renderer against what it is said to model, its trials, and a small version of its study."""

import importlib
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from nlos_calibration.board import BOARDS
from nlos_calibration.board_pose import PrintErrors
from nlos_calibration.rig import load_rig

TOOLS = Path(__file__).parents[2] / "tools"
RIG = load_rig("bare-wall")
PINHOLE, A4 = RIG.pinhole, BOARDS["a4"]


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_view")


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_trials")


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("board_study")


def test_paper_and_toner_have_their_counts(views: ModuleType) -> None:
    """Without a spot: the falloff of a bare wall, its brightest pixel at the gain, toner at its albedo."""
    seen, light = views.View(RIG.wall_from_lidar, PINHOLE), views.Light(spot_mm=0.0)
    away, placed = views.Placed(50.0), views.at_near_edge(A4, seen)
    bare, with_board = (views.clean_view(A4, seen, where, light) for where in (away, placed))
    assert bare.max() == pytest.approx(48.0)
    points = seen.pinhole.rays() * seen.depth_m[..., np.newaxis]
    length_m = np.linalg.norm(points, axis=-1)
    lit = seen.depth_m < 2.0
    inverse_cube = bare[lit] * length_m[lit] ** 3
    np.testing.assert_allclose(inverse_cube, inverse_cube[0], rtol=1e-3)
    albedo = with_board[bare > 1.0] / bare[bare > 1.0]
    assert albedo.min() == pytest.approx(views.TONER, abs=1e-3)
    assert albedo.max() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("turn_rad", [0.0, 0.6])
def test_corners_are_where_the_rendered_squares_meet(views: ModuleType, turn_rad: float) -> None:
    """About a true corner the pattern is the same after half a turn; about a point half a pixel off it is not."""
    seen = importlib.import_module("wall_scenes").view(0.25, 20.0, 5.0, PINHOLE)
    placed, sharp = replace(views.at_near_edge(A4, seen), turn_rad=turn_rad), views.Light(spot_mm=0.0)
    albedo = views.clean_view(A4, seen, placed, sharp) / views.clean_view(A4, seen, views.Placed(50.0), sharp)
    true_px = views.corners_px(A4, seen, placed)
    true_px = true_px[((true_px > 8) & (true_px < np.array([631, 471]))).all(axis=1)]
    turn = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)

    def asymmetry(shift_px: float) -> float:
        x, y = (
            (true_px[:, k, np.newaxis] + shift_px + 4.0 * way(turn)).astype(np.float32)
            for k, way in enumerate((np.cos, np.sin))
        )
        rings = cv2.remap(albedo.astype(np.float32), x, y, cv2.INTER_LINEAR)
        return float(np.abs(rings - np.roll(rings, 200, axis=1)).mean())

    assert len(true_px) > 20
    assert asymmetry(0.0) < 0.03
    assert asymmetry(0.5) > 3.0 * asymmetry(0.0)


def test_a_sheet_is_placed_where_it_is_said(views: ModuleType) -> None:
    placed = views.Placed(0.2, 0.03, 0.0, scale=0.97, stretch=1.01)
    middle = np.array([*(size * 0.5e-3 for size in A4.size_mm), 1.0])
    np.testing.assert_allclose(placed.wall_from_board(A4) @ middle, [0.2, 0.03, 0.0, 1.0], atol=1e-12)
    across, down = placed.wall_from_board(A4)[:2, 0], placed.wall_from_board(A4)[:2, 1]
    assert np.linalg.norm(across) / np.linalg.norm(down) == pytest.approx(1.01)
    assert np.linalg.norm(across) * np.linalg.norm(down) == pytest.approx(0.97**2)
    assert down[1] < 0.0  # the sheet's y runs down the wall


def test_the_near_edge_is_in_view_and_the_middle_is_on_the_axis(views: ModuleType) -> None:
    seen = views.View(RIG.wall_from_lidar, PINHOLE)
    edge = views.corners_px(A4, seen, views.at_near_edge(A4, seen))
    assert 0.0 < edge[:, 0].min() < 100.0
    placed = views.in_the_middle(seen)
    np.testing.assert_allclose(views.corners_px(A4, seen, placed).mean(axis=0), [PINHOLE.ppx, PINHOLE.ppy], atol=60.0)


def test_frames_have_the_lidars_noise_and_saturate(views: ModuleType) -> None:
    clean = np.full((40, 50), 25.0)
    frames = views.frames_of(clean, np.random.default_rng(0), 50).astype(float)
    assert frames.mean() == pytest.approx(25.0, abs=0.05)
    assert frames.std() == pytest.approx(np.sqrt(0.7**2 + 0.09 * 25.0 + 1.0 / 12.0), rel=0.02)
    assert views.frames_of(np.full((2, 2), 400.0), np.random.default_rng(0), 1).max() == 255


def test_a_summary_counts_what_lies_inside(trials: ModuleType) -> None:
    measured = [(np.full(3, float(k)), np.array([1.0, 2.5, -3.0 * (k == 0)])) for k in range(4)]
    told = trials.summary(measured, ["why"])
    assert (told["measured"], told["refused"]) == (4, 1)
    assert list(told["in_95_percent_interval"].values()) == [1.0, 0.0, 0.75]
    assert trials.summary([], ["why"]) == {"measured": 0, "refused": 1}


def test_a_trial_by_corners_knows_of_bows(trials: ModuleType) -> None:
    seen = trials.view(0.2, 40.0, 0.0, PINHOLE)
    bench = trials.Bench(A4, seen, trials.at_near_edge(A4, seen))
    flat = trials.by_corners(bench, 0.02, np.random.default_rng(0), PrintErrors(0.0, 1e-6, 1e-7))
    bowed = trials.by_corners(bench, 0.02, np.random.default_rng(0), PrintErrors(0.0, 1e-6, 1e-3))
    assert abs(flat.bow_m) < 1e-6
    assert abs(bowed.bow_m) > 1e-5


def test_a_small_study_is_written_and_drawn(
    study: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    monkeypatch.setattr(study, "DOCS", tmp_path)
    monkeypatch.setattr(study, "DISTANCES_M", (0.2,))
    monkeypatch.setattr(study, "ANGLES_DEG", (45.0,))
    monkeypatch.setattr(study, "SPOTS_MM", (1.0,))
    monkeypatch.setattr(study, "GAINS", (48.0,))
    monkeypatch.setattr(study, "TO_FILL_A4", {30.0: (6, 9, "DICT_4X4_50")})
    monkeypatch.setattr(study, "FRAMES", 2)
    monkeypatch.setattr(study, "RUNS", study.Runs(grid=1, images=2, corners=3, ways=1))
    study.main()
    table = json.loads((tmp_path / "board_study.json").read_text(encoding="utf-8"))
    assert table == json.loads(capsys.readouterr().out)
    assert (table["grid_told"]["found"], len(table["grid"])) == (1.0, 1)
    assert table["squares_by_spot_mm"]["30"]["1"]["found"] == 1.0
    assert table["ways_to_average"]["of_images"]["measured"] == 1
    assert (tmp_path / "images" / "board_study.png").stat().st_size > 5000
