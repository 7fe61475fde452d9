"""`evaluate` writes report, figures and pictures of weights on the test set, on seeded objects or on a dataset."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import MapSet
from small_maps import SmallDataset

from nlos_cam.cli.main import main
from nlos_cam.dataset import HELD_OUT_SEED, TRAINING_SEED, DatasetPlan, procedural_images
from nlos_cam.evaluate import TARGETS, baselines, report, subjects
from nlos_cam.objects import benchmark_objects

RIG = load_rig("paper-rig")
STORED = ["--dataset", "held-out", "--training", "held-out"]


class Guesser:
    """Network that answers everything with the same plate, and keeps the depth maps it was given."""

    runtime = "none"

    def __init__(self, eats: str = "raw maps") -> None:
        facts = {"rig_name": RIG.name, "rig_checksum": RIG.checksum, "input": eats, "compressor_recipe": None}
        self.record = SimpleNamespace(vae_recipe=SimpleNamespace(left_out=["cup"]), **facts)
        self.seen: list[np.ndarray] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (1, 64, 80)
        self.seen.append(depth_m)
        image = np.zeros((1, 64, 64), np.float32)
        image[:, 16:48, 16:48] = 0.6
        return image


def _maps(plan: DatasetPlan, count: int) -> MapSet:
    images = procedural_images(plan.first_seed, count, plan.box)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    return MapSet(wide + 0.3, 40 * wide, images)


class Stored(SmallDataset):
    """Dataset on the disk, of two cups and a hat."""

    folder = Path("stored")

    def __init__(self, first_seed: int, count: int) -> None:
        plan = DatasetPlan(RIG, first_seed)
        super().__init__(_maps(plan, count), plan)

    def column(self, name: str) -> Any:
        return {"category": np.array(["cup", "hat", "cup"], object), "seed": np.arange(3)}[name]


@pytest.fixture(autouse=True)
def guessing(monkeypatch: pytest.MonkeyPatch) -> list[DatasetPlan]:
    """A guesser as weights, a dataset, and training objects that are not rendered; their plans are kept."""
    asked: list[DatasetPlan] = []

    def training_maps(plan: DatasetPlan, *_: object) -> Stored:
        asked.append(plan)
        return Stored(TRAINING_SEED, 4)

    monkeypatch.setattr(baselines, "training_maps", training_maps)
    monkeypatch.setattr(baselines, "NEIGHBOURS", 4)
    monkeypatch.setattr(report, "load_reconstructor", lambda *_: Guesser())
    monkeypatch.setattr(subjects, "open_dataset", lambda _: Stored(HELD_OUT_SEED, 3))
    return asked


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    def call(*options: str, code: int = 0) -> Any:
        assert main(["evaluate", "--out", str(tmp_path / "figures"), *options, "--json"]) == code
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return call


def test_evaluate_writes_figures_of_dataset_beside_baselines(
    tmp_path: Path, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    result, out = run(*STORED), tmp_path / "figures"
    assert {*TARGETS, "baselines", "per_category", "objects", "seconds", "out"} < set(result)
    assert (result["objects"], result["training_objects"]) == (3, 3)
    assert set(result["baselines"]) == {"all_background", "mean_object", "nearest_neighbour"}
    assert result["baselines"]["nearest_neighbour"]["silhouette_iou"]["value"] == 1  # it is the set itself
    assert set(result["per_category"]) == {"cup", "hat"}
    assert set(result["shown_and_left_out"]) == {"shown", "left out"}
    assert ["cup" in note for note in result["notes"]] == [True]
    assert json.loads((out / "figures.json").read_text("utf-8")) == {k: v for k, v in result.items() if k != "out"}
    assert "\nhat 1," in (out / "objects.csv").read_text("utf-8")
    assert run(*STORED, code=1)["error"]["type"] == "OutputExistsError"
    monkeypatch.setattr("nlos_cam.evaluate.write_report", lambda *_: None)
    run(*STORED, "--overwrite")


@pytest.mark.slow
def test_evaluate_uses_test_set_without_dataset(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, guessing: list[DatasetPlan]
) -> None:
    monkeypatch.setattr(subjects, "benchmark_objects", lambda box: benchmark_objects(box)[:2])
    result = run()
    assert (result["objects"], result["rig"], guessing[0].rig) == (2, RIG.name, RIG)
    assert list(result["per_category"]) == [benchmark_objects(DatasetPlan(RIG, 0).box)[0].category]
    assert "nearest_neighbour" in result["baselines"]


def test_evaluate_count_uses_seeded_objects(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, guessing: list[DatasetPlan]
) -> None:
    monkeypatch.setattr("nlos_cam.evaluate.write_report", lambda *_: None)
    result = run("--count", "1", "--no-nearest")
    assert result["objects"] == 1
    assert set(result["baselines"]) == {"all_background", "mean_object"}
    assert result["advantage_over_nearest_neighbour"] is None
    assert not guessing


@pytest.mark.parametrize(
    ("maps", "options", "wall_m"),
    [("raw maps", [], 0), ("difference maps", [], 0.25), ("difference maps", ["--wall", "wall.toml"], 0.5)],
)
def test_evaluate_subtracts_bare_wall_for_the_weights_alone(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, maps: str, options: list[str], wall_m: float
) -> None:
    network, blank = Guesser(maps), np.zeros((64, 80), np.float32)
    monkeypatch.setattr(report, "load_reconstructor", lambda *_: network)
    monkeypatch.setattr(subjects, "render_bare_wall", lambda _: (blank + np.float32(0.25), blank))
    monkeypatch.setattr(subjects, "measured_bare_wall", lambda _: (blank + np.float32(0.5), blank))
    monkeypatch.setattr("nlos_cam.evaluate.write_report", lambda *_: None)
    result, raw = run(*STORED, *options), _maps(DatasetPlan(RIG, HELD_OUT_SEED), 3)
    np.testing.assert_allclose(np.concatenate(network.seen), raw.depth_m - wall_m, atol=1e-6)
    assert result["input"] == maps
    assert result["baselines"]["nearest_neighbour"]["silhouette_iou"]["value"] == 1


def test_evaluate_refuses_wall_for_weights_of_raw_maps(tmp_path: Path, run: Callable[..., Any]) -> None:
    assert "--wall" in run(*STORED, "--wall", "wall.toml", code=1)["error"]["message"]
    assert not list(tmp_path.iterdir())
