"""Weights side by side: each is judged on the same objects, as it eats them, and held against the first."""

import importlib
import json
import sys
from argparse import ArgumentTypeError
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models import checkpoint
from nlos_models.checkpoint import load_record
from small_maps import small_maps, untrained_weights, use_small_networks

from nlos_cam.dataset.build import TEST_SEED, DatasetPlan
from nlos_cam.evaluate import subjects
from nlos_cam.evaluate.metrics import BARS, PerObject
from nlos_cam.evaluate.subjects import Judged

TOOLS = Path(__file__).parents[2] / "tools"
RIG = load_rig("paper-rig")
OBJECTS = 6


@pytest.fixture
def ablations(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The tool, with networks that take no time and maps that are not rendered; `rendered` counts the rigs."""
    monkeypatch.syspath_prepend(TOOLS)
    use_small_networks(monkeypatch, checkpoint)
    tool = importlib.import_module("ablations")
    names = [f"cup {k}" for k in range(OBJECTS)]
    tool.rendered = []

    def fresh(rig: Any, count: int | None = None) -> Judged:
        tool.rendered.append((rig.name, count))
        maps = small_maps(OBJECTS, 0)
        return Judged("some", names, ["cup"] * OBJECTS, maps, DatasetPlan(rig, TEST_SEED))

    monkeypatch.setattr(tool, "fresh_objects", fresh)
    bare = np.zeros((64, 80), np.float32), np.zeros((64, 80), np.float32)
    monkeypatch.setattr(subjects, "render_bare_wall", lambda _: bare)
    return tool


@pytest.fixture
def weights(tmp_path: Path) -> dict[str, Path]:
    """Four ways to train."""
    ways: dict[str, dict[str, Any]] = {
        "two": {"objects": 40},
        "one": {"objects": 10, "steps": "one"},
        "joint": {"objects": 20, "steps": "two-then-joint"},
        "difference": {"objects": 30, "maps": "difference maps"},
    }
    for seed, (name, recipe) in enumerate(ways.items()):
        untrained_weights(tmp_path / name, rig=RIG, seed=seed, **recipe)
    return {name: tmp_path / name for name in ways}


def test_all_weights_are_judged_on_objects_that_are_rendered_once(
    ablations: ModuleType, weights: dict[str, Path], tmp_path: Path
) -> None:
    text = ablations.compare(weights, {name: weights[name] for name in ("two", "one")}, tmp_path / "out", 6)
    assert ablations.rendered == [(RIG.name, 6)]
    table = json.loads((tmp_path / "out" / "ablations.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in table["compared"]] == list(weights)
    assert [row["steps"] for row in table["compared"]] == ["two", "one", "two-then-joint", "two"]
    assert [row["input"] for row in table["compared"]][2:] == ["raw maps", "difference maps"]
    assert [(row["name"], row["objects"]) for row in table["learning_curve"]] == [("one", 10), ("two", 40)]
    for row in [*table["compared"], *table["learning_curve"]]:
        assert all(set(row[metric]) == {"value", "low", "high"} for metric in BARS)
    assert (tmp_path / "out" / "ablations.md").read_text(encoding="utf-8") == text
    assert all(f"| {name} | " in text for name in weights)
    picture = tmp_path / "out" / "images" / "ablations.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def _trained(ablations: ModuleType, folder: Path, name: str, shift: float) -> Any:
    """Weights that are better than some others by the same on every object, which differ much among themselves."""
    levels = np.linspace(0.2, 0.8, OBJECTS)
    values: PerObject = dict.fromkeys(BARS, levels + shift)
    return ablations.Trained(name, load_record(folder), values | {"foreground_rmse_mm": 20 * (1 - levels - shift)})


def test_differences_are_taken_object_by_object(ablations: ModuleType, weights: dict[str, Path]) -> None:
    first, better = (_trained(ablations, weights["two"], name, by) for name, by in (("first", 0.0), ("better", 0.05)))
    table = ablations.as_table([first, better], [])
    _, row = table["compared"]
    assert row["silhouette_iou"]["low"] < table["compared"][0]["silhouette_iou"]["high"]  # they overlap
    for metric in BARS:
        found = row["better_than_first"][metric]
        assert found["low"] == pytest.approx(found["value"])
        assert found["value"] == pytest.approx(1.0 if metric == "foreground_rmse_mm" else 0.05)
        assert table["compared"][0]["better_than_first"][metric]["value"] == 0
    text = ablations.as_markdown(table)
    assert "Better than first by" in text
    assert "**0.05 (0.05 to 0.05)**" in text
    assert "**" not in ablations.as_markdown(ablations.as_table([first, first], [])).replace("**bold**", "")


def test_a_curve_alone_needs_no_comparison(ablations: ModuleType, weights: dict[str, Path], tmp_path: Path) -> None:
    text = ablations.compare({"two": weights["two"]}, {}, tmp_path)
    assert "Better than" not in text
    assert "With more objects" not in text


def test_weights_are_named_by_their_folder_or_as_one_says(ablations: ModuleType, weights: dict[str, Path]) -> None:
    named = sys.modules["named_weights"]
    assert named.named(str(weights["two"])) == ("two", weights["two"])
    assert named.named(f"both steps={weights['two']}") == ("both steps", weights["two"])
    with pytest.raises(ArgumentTypeError, match="no weights in"):
        named.named(str(weights["two"].parent))
    with pytest.raises(SystemExit, match="two weights are called 'two'"):
        named.by_name([("two", weights["two"]), ("two", weights["one"])])
    assert ablations.by_name is named.by_name


def test_what_cannot_be_judged_ends_the_tool_with_one_line(
    ablations: ModuleType, weights: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (weights["one"] / "compressor.safetensors").write_bytes(b"no weights")
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["ablations.py", *map(str, weights.values()), "--out", str(out)])
    with pytest.raises(SystemExit, match=r"error: .*compressor.safetensors cannot be read as weights"):
        ablations.main()
    assert not out.exists()
    clash = ["ablations.py", str(weights["two"]), "--curve", f"two={weights['joint']}"]
    monkeypatch.setattr(sys, "argv", clash)
    with pytest.raises(SystemExit, match="two weights are called 'two'"):
        ablations.main()
