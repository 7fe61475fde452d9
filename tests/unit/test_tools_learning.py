"""Small versions of the tools that tell what limits a figure, where weights work, and how they compare."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models import checkpoint
from nlos_models.checkpoint import shipped_folder
from small_maps import small_maps, untrained_weights, use_small_networks

from nlos_cam.dataset.build import TEST_SEED, DatasetPlan
from nlos_cam.evaluate import subjects
from nlos_cam.evaluate.metrics import BARS
from nlos_cam.evaluate.subjects import Judged, seeded_objects
from nlos_cam.objects.depth_map import object_box

TOOLS = Path(__file__).parents[2] / "tools"
RIG = load_rig("paper-rig")
BOX = object_box(RIG)
Tool = Callable[[str], ModuleType]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks that take no time, wherever weights are loaded."""
    use_small_networks(monkeypatch, checkpoint)


@pytest.fixture
def two_step(tmp_path: Path) -> Path:
    """The shipped weights, as if their decoder were still the VAE's: it has not moved far from it."""
    folder = Path(shutil.copytree(shipped_folder(), tmp_path / "two"))
    record = json.loads((folder / "checkpoint.json").read_text(encoding="utf-8"))
    record["compressor_recipe"]["steps"] = "two"
    (folder / "checkpoint.json").write_text(json.dumps(record), encoding="utf-8")
    return folder


def test_each_experiment_on_one_object_has_its_figures(tool: Tool, two_step: Path) -> None:
    limits = tool("limits")
    some = seeded_objects(0, 1, BOX)
    rows = {row.name: row for row in limits.experiments(two_step, some, some, frames=(2,))}
    assert list(rows)[:2] == ["as evaluated", "VAE alone"]
    assert {"noise off", "2 frames", "training's objects"} < set(rows)
    assert rows["noise off"].latent_error != rows["as evaluated"].latent_error > 0
    text = limits.as_markdown(list(rows.values()))
    assert len(text.splitlines()) == 2 + len(rows)
    assert rows["VAE alone"].figures["silhouette_iou"].value > 0.5  # the truth's own latent, decoded


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("steps", ["one", "two-then-joint"])
def test_what_needs_the_vaes_latent_is_left_out_where_the_decoder_does_not_speak_it(
    tool: Tool, tmp_path: Path, steps: str
) -> None:
    untrained_weights(tmp_path / "w", rig=RIG, steps=steps, maps="difference maps")
    some = seeded_objects(0, 1, BOX)
    rows = {row.name: row for row in tool("limits").experiments(tmp_path / "w", some, some, frames=())}
    assert list(rows) == ["as evaluated", "no silhouette step", "noise off", "training's objects"]
    assert {row.latent_error for row in rows.values()} == {None}


class Plate:
    def __init__(self, eats: str = "raw maps") -> None:
        self.calls, self.record = 0, SimpleNamespace(input=eats)

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape
        self.calls += 1
        return np.full((1, 64, 64), 0.5, np.float32)


def test_a_map_of_rigs_keeps_the_cells_that_are_done_of_the_same_weights(tool: Tool, tmp_path: Path) -> None:
    rig_map = tool("rig_map")
    some, plate, path = seeded_objects(0, 1, BOX), Plate(), tmp_path / "rig_map.json"
    grid = [(0.2, 45.0), (0.3, 15.0)]
    rig_map.measured(RIG, grid[:1], some, {"plate": plate}, path, "these")
    cells = rig_map.measured(RIG, grid, some, {"plate": plate}, path, "these")
    assert plate.calls == 2
    assert [(cell["distance_m"], cell["yaw_deg"]) for cell in cells] == grid
    assert json.loads(path.read_text(encoding="utf-8"))["cells"] == cells
    rig_map.measured(RIG, grid[:1], some, {"plate": plate}, path, "others")
    assert plate.calls == 3
    rig_map.draw(tmp_path / "map.png", cells, RIG)
    assert 5_000 < (tmp_path / "map.png").stat().st_size < 200_000
    assert {path.name for path in tmp_path.iterdir()} == {"rig_map.json", "map.png"}


def test_a_map_of_a_network_that_finds_nothing_says_so(tool: Tool, tmp_path: Path) -> None:
    none = {"value": None, "low": None, "high": None}
    cell = {"distance_m": 0.2, "yaw_deg": 45.0, "weights": {"blind": dict.fromkeys(BARS, none)}}
    tool("rig_map").draw(tmp_path / "map.png", [cell], RIG)
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_on_every_rig_difference_maps_are_less_its_own_bare_wall(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    rig_map, asked = tool("rig_map"), list[Any]()
    bare = np.zeros((64, 80), np.float32), np.zeros((64, 80), np.float32)
    monkeypatch.setattr(subjects, "render_bare_wall", lambda plan: (asked.append(plan.rig), bare)[1])
    networks = {"raw": Plate(), "difference": Plate("difference maps")}
    there = rig_map.rig_at(RIG, 0.3, 15.0)
    assert set(rig_map.cell_at(there, seeded_objects(0, 1, BOX), networks)["weights"]) == set(networks)
    assert asked == [there]


def test_the_lidar_alone_moves_over_the_map(tool: Tool) -> None:
    there = tool("rig_map").rig_at(RIG, 0.3, 15.0)
    assert (there.lidar.distance_m, there.lidar.yaw_deg) == (0.3, 15.0)
    assert (there.occluder, there.object_box, there.intrinsics) == (RIG.occluder, RIG.object_box, RIG.intrinsics)


def test_cells_of_other_weights_or_objects_are_told_apart(tool: Tool) -> None:
    checksum = tool("rig_map").checksum
    some, others = seeded_objects(0, 1, BOX), seeded_objects(1, 1, BOX)
    assert checksum({"a": None}, some) == checksum({"a": None}, some)
    assert len({checksum({"a": None}, some), checksum({"b": None}, some), checksum({"a": None}, others)}) == 3


def test_the_comparisons_row_is_filled_in_from_figures(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = tool("comparison")
    figure = {"value": 0.625, "low": 0.5, "high": 0.75}
    figures: dict[str, Any] = {"objects": 54, **dict.fromkeys(BARS, figure)}
    cost = {
        "machine": "a machine",
        "settings": [
            {"name": "quick", "weights": "small", "milliseconds": 3.1},
            {"name": "quick", "weights": "large", "milliseconds": 7.4},
        ],
        "recommended": {"name": "quick", "weights": "large"},
    }
    for name, table in (("figures.json", figures), ("tradeoff_reconstruct.json", cost)):
        (tmp_path / name).write_text(json.dumps(table), encoding="utf-8")
    page = (TOOLS.parent / "docs" / "comparison.md").read_text(encoding="utf-8")
    (tmp_path / "comparison.md").write_text(page.replace("nlos-cam, measured", "stale"), encoding="utf-8")
    monkeypatch.setattr(comparison, "DOCS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["comparison.py", "--check"])
    assert comparison.main() == 1
    monkeypatch.setattr(sys, "argv", ["comparison.py"])
    assert comparison.main() == 0
    text = (tmp_path / "comparison.md").read_text(encoding="utf-8")
    assert "33 ms (one frame) | 7 ms (quick; a machine)" in text
    assert "silhouette_iou 0.625 (0.5 to 0.75)" in text
    monkeypatch.setattr(sys, "argv", ["comparison.py", "--check"])
    assert comparison.main() == 0


def test_what_leaving_a_kind_out_costs_is_told_of_it_and_of_all_others(tool: Tool) -> None:
    unseen, levels = tool("unseen_kinds"), np.linspace(0.2, 0.8, 6)
    kinds = ["airplane", "cup", "airplane", "cup", "table", "cup"]
    with_them: dict[str, Any] = dict.fromkeys(BARS, levels)
    worse = levels - np.array([0.1 if kind == "airplane" else 0.0 for kind in kinds])
    rows = unseen.compared(dict.fromkeys(BARS, worse), with_them, kinds, ["airplane", "table"])
    assert [(row["objects"], row["count"]) for row in rows] == [("airplane", 2), ("table", 1), ("all others", 3)]
    costs = [row["without_better_by"]["silhouette_iou"]["value"] for row in rows]
    assert costs == pytest.approx([-0.1, 0, 0])
    text = unseen.as_markdown(rows)
    assert "| airplane (2) | never seen |" in text
    assert "**-0.1 (-0.1 to -0.1)**" in text
    with pytest.raises(SystemExit, match="no boat among the maps"):
        unseen.compared(with_them, with_them, kinds, ["boat"])


def test_both_weights_are_judged_on_the_same_maps(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unseen = tool("unseen_kinds")
    use_small_networks(monkeypatch, checkpoint)
    for name in ("without", "with"):
        untrained_weights(tmp_path / name, rig=RIG)
    kinds = ["airplane", "table", "cup"]
    judged = Judged("some", kinds, kinds, small_maps(3, 0), DatasetPlan(RIG, TEST_SEED))
    monkeypatch.setattr(unseen, "stored_objects", lambda _: judged)
    argv = ["unseen_kinds.py", str(tmp_path / "without"), str(tmp_path / "with"), "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", argv)
    unseen.main()
    rows = json.loads((tmp_path / "unseen_kinds.json").read_text(encoding="utf-8"))["rows"]
    assert {row["without_better_by"]["silhouette_iou"]["value"] for row in rows} == {0}  # they are the same weights
    assert "| all others (1) | seen |" in capsys.readouterr().out
