"""`evaluate`: a folder of report, figures and pictures, from the test set, from seeds or from a dataset."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.data import MapSet
from small_maps import SmallDataset

from nlos_cam.cli import evaluate
from nlos_cam.cli.main import main
from nlos_cam.dataset import build
from nlos_cam.dataset.build import DatasetPlan
from nlos_cam.evaluate import baselines, subjects
from nlos_cam.objects.benchmark import test_set

RIG = load_rig("paper-rig")
METRICS = {"silhouette_iou", "accuracy_mean_abs", "accuracy_within_2_percent", "foreground_rmse_mm"}


class Guesser:
    """A network that answers everything with the same plate, and keeps the depth that it was shown."""

    runtime = "none"

    def __init__(self, eats: str = "raw maps") -> None:
        recipe = SimpleNamespace(left_out=["cup"])
        self.record = SimpleNamespace(
            rig_name=RIG.name, rig_checksum=RIG.checksum, input=eats, vae_recipe=recipe, compressor_recipe=None
        )
        self.seen: list[np.ndarray] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (1, 64, 80)
        self.seen.append(depth_m)
        image = np.zeros((1, 64, 64), np.float32)
        image[:, 16:48, 16:48] = 0.6
        return image


def _maps(plan: DatasetPlan, count: int) -> MapSet:
    images = build.procedural_images(plan.first_seed, count, plan.box)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    return MapSet(wide + 0.3, 40 * wide, images)


class Stored(SmallDataset):
    """Stands for a dataset on the disk, of two cups and a hat."""

    def __init__(self, plan: DatasetPlan, count: int) -> None:
        super().__init__(_maps(plan, count), plan)
        self.folder = Path("stored")

    def column(self, name: str) -> Any:
        return {"category": np.array(["cup", "hat", "cup"], object), "seed": np.arange(3)}[name]


@pytest.fixture(autouse=True)
def guessing(monkeypatch: pytest.MonkeyPatch) -> list[DatasetPlan]:
    """A guesser for the weights, a few training objects that are not rendered; the plans asked for are kept."""
    asked: list[DatasetPlan] = []

    def training_maps(plan: DatasetPlan, *_: object) -> Stored:
        asked.append(plan)
        return Stored(DatasetPlan(plan.rig, build.TRAINING_SEED), 4)

    monkeypatch.setattr(baselines, "training_maps", training_maps)
    monkeypatch.setattr(baselines, "NEIGHBOURS", 4)
    monkeypatch.setattr(evaluate, "load_reconstructor", lambda *_: Guesser())
    return asked


@pytest.fixture
def stored(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a dataset."""
    monkeypatch.setattr(build, "open_dataset", lambda _: Stored(DatasetPlan(RIG, build.HELD_OUT_SEED), 3))
    return "held-out"


def _last(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_dataset_is_judged_beside_the_baselines_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stored: str
) -> None:
    out = tmp_path / "figures"
    arguments = ["evaluate", "--out", str(out), "--dataset", stored, "--training", stored, "--json"]
    assert main(arguments) == 0
    result = _last(capsys)
    assert {*METRICS, "baselines", "per_category", "objects", "seconds", "out"} < set(result)
    assert result["objects"] == 3
    assert set(result["baselines"]) == {"all_background", "mean_object", "nearest_neighbour"}
    assert result["baselines"]["nearest_neighbour"]["silhouette_iou"]["value"] == 1  # it is the set itself
    assert set(result["per_category"]) == {"cup", "hat"}
    assert set(result["shown_and_left_out"]) == {"shown", "left out"}
    assert result["training_objects"] == 3
    assert result["notes"] == ["the weights' VAE was never shown cup"]
    written = json.loads((out / "figures.json").read_text(encoding="utf-8"))
    assert written == {name: value for name, value in result.items() if name != "out"}
    assert (out / "sheet.png").read_bytes().startswith(b"\x89PNG")
    assert main(arguments) == 1
    assert _last(capsys)["error"]["type"] == "OutputExistsError"
    assert main([*arguments, "--overwrite"]) == 0


def test_without_a_dataset_the_test_set_is_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, guessing: list[DatasetPlan]
) -> None:
    monkeypatch.setattr(subjects, "test_set", lambda box: test_set(box)[:2])
    assert main(["evaluate", "--out", str(tmp_path / "figures"), "--json"]) == 0
    result = _last(capsys)
    assert result["objects"] == 2
    assert (result["rig"], guessing[0].rig) == (RIG.name, RIG)
    assert list(result["per_category"]) == [test_set(DatasetPlan(RIG, 0).box)[0].category]
    assert "nearest_neighbour" in result["baselines"]


def test_seeded_objects_are_judged_without_the_nearest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], guessing: list[DatasetPlan]
) -> None:
    arguments = ["evaluate", "--out", str(tmp_path / "figures"), "--count", "1", "--no-nearest", "--json"]
    assert main(arguments) == 0
    result = _last(capsys)
    assert result["objects"] == 1
    assert set(result["baselines"]) == {"all_background", "mean_object"}
    assert result["advantage_over_nearest_neighbour"] is None
    assert not guessing


@pytest.mark.parametrize(
    "more",
    [
        ["--dataset", "held-out", "--count", "3"],
        ["--dataset", "held-out", "--rig", "paper-rig"],
        ["--training", "held-out", "--no-nearest"],
    ],
)
def test_options_that_contradict_each_other_are_wrong_usage(tmp_path: Path, stored: str, more: list[str]) -> None:
    assert stored in more
    assert main(["evaluate", "--out", str(tmp_path / "figures"), *more]) == 2
    assert not list(tmp_path.iterdir())


def test_weights_that_eat_difference_maps_are_given_them_and_the_baselines_the_raw_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, stored: str
) -> None:
    network = Guesser("difference maps")
    monkeypatch.setattr(evaluate, "load_reconstructor", lambda *_: network)
    bare = np.full((64, 80), 0.25, np.float32), np.zeros((64, 80), np.float32)
    monkeypatch.setattr(subjects, "render_bare_wall", lambda _: bare)
    arguments = ["evaluate", "--dataset", stored, "--training", stored, "--out", str(tmp_path / "figures"), "--json"]
    assert main(arguments) == 0
    result, raw = _last(capsys), _maps(DatasetPlan(RIG, build.HELD_OUT_SEED), 3)
    np.testing.assert_allclose(np.concatenate(network.seen), raw.depth_m - 0.25, atol=1e-6)
    assert result["input"] == "difference maps"
    assert result["baselines"]["nearest_neighbour"]["silhouette_iou"]["value"] == 1


def test_a_wall_is_refused_by_weights_that_eat_raw_maps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stored: str
) -> None:
    arguments = ["evaluate", "--dataset", stored, "--wall", "wall.toml", "--out", str(tmp_path / "figures"), "--json"]
    assert main(arguments) == 1
    assert "leave out --wall" in _last(capsys)["error"]["message"]
    assert not list(tmp_path.iterdir())


def test_evaluate_without_weights_is_4(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from nlos_models.inference import load_reconstructor

    monkeypatch.setattr(evaluate, "load_reconstructor", load_reconstructor)
    assert main(["evaluate", "--out", str(tmp_path / "f"), "--weights", str(tmp_path / "none"), "--json"]) == 4
    assert _last(capsys)["error"]["type"] == "CheckpointError"
    assert not (tmp_path / "f").exists()
