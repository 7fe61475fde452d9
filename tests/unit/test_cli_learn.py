"""`train`: from objects to weights, in the small."""

import json
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import pytest
import torch
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import load_pipeline, load_vae

from nlos_cam.cli.main import main
from nlos_cam.dataset import build

pytestmark = pytest.mark.usefixtures("one_thread")

RIG = load_rig("paper-rig")
RECIPE = """
task = "{task}"
objects = 4
held_out = 2
epochs = 1
batch = 2
learning_rate = 1e-3
schedule = "one-cycle"
"""
Call = Callable[..., Any]


class InThisProcess:
    """Stands for the pool of processes, whose start takes seconds."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, work: Call, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(work(*arguments))
        return future


def _recipe(folder: Path, task: str) -> str:
    path = folder / f"{task}.toml"
    path.write_text(RECIPE.format(task=task), encoding="utf-8")
    return str(path)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, a trained VAE, and two datasets."""
    folder = tmp_path_factory.mktemp("learn")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "ProcessPoolExecutor", InThisProcess)
        for name, count, seed in (("data", "4", "0"), ("held-out", "2", "10000000")):
            assert main(["dataset", "build", "--out", str(folder / name), "--count", count, "--seed", seed]) == 0
    _recipe(folder, "compressor")
    assert main(["train", "vae", "--recipe", _recipe(folder, "vae"), "--out", str(folder / "vae")]) == 0
    return folder


def _last(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def _train_compressor(made: Path, out: Path, **changes: str) -> int:
    names = {"recipe": "compressor.toml", "vae": "vae", "dataset": "data", "held-out": "held-out"} | changes
    options = [part for name, value in names.items() for part in (f"--{name}", str(made / value))]
    return main(["train", "compressor", *options, "--out", str(out), "--json"])


def test_a_trained_vae_has_weights_a_log_and_a_record(made: Path) -> None:
    _, record = load_vae(made / "vae")
    assert (record.rig_name, record.rig_checksum) == (RIG.name, RIG.checksum)
    assert record.vae_recipe.objects == 4
    assert set(record.figures) == {"held_out_loss", "held_out_iou"}
    assert len((made / "vae" / "log.csv").read_text(encoding="utf-8").splitlines()) == 2


def test_training_again_changes_nothing(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (made / "vae" / "decoder.safetensors").read_bytes()
    assert main(["train", "vae", "--recipe", str(made / "vae.toml"), "--out", str(made / "vae"), "--json"]) == 0
    assert set(_last(capsys)) == {"out", "held_out_loss", "held_out_iou"}
    assert (made / "vae" / "decoder.safetensors").read_bytes() == before


def test_a_trained_compressor_is_a_pipeline_with_the_vaes_decoder(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _train_compressor(made, tmp_path / "run") == 0
    result = _last(capsys)
    assert result["out"] == str(tmp_path / "run")
    pipeline, record = load_pipeline(tmp_path / "run")
    assert record.compressor_recipe is not None
    assert (record.vae_recipe.task, record.compressor_recipe.task) == ("vae", "compressor")
    assert record.figures == {name: result[name] for name in ("held_out_loss", "held_out_iou")}
    vae, _ = load_vae(made / "vae")
    torch.testing.assert_close(pipeline.decoder.state_dict(), vae.decoder.state_dict(), rtol=0, atol=0)


def test_the_weights_are_tied_to_the_rig_that_the_maps_were_rendered_for(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, original = RIG.model_copy(update={"name": "other"}), build.open_dataset

    def opened(folder: Path, *, colour: bool) -> build.Dataset:
        found = original(folder, colour=colour)
        return replace(found, plan=replace(found.plan, rig=other))

    monkeypatch.setattr(build, "open_dataset", opened)
    assert _train_compressor(made, tmp_path / "run") == 0
    _, record = load_pipeline(tmp_path / "run")
    assert (record.rig_name, record.rig_checksum) == (other.name, other.checksum)


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"recipe": "vae.toml"}, 1, "a recipe for 'vae'"),
        ({"recipe": "none.toml"}, 4, "none.toml"),
        ({"dataset": "held-out", "held-out": "data"}, 1, "holds 2 objects, the recipe asks for 4"),
        ({"held-out": "data"}, 1, "is to learn from and to be judged by"),
        ({"dataset": "none"}, 4, "no dataset in"),
        ({"vae": "data"}, 4, "no checkpoint in"),
    ],
)
def test_what_does_not_fit_together_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, str], code: int, words: str
) -> None:
    assert _train_compressor(made, tmp_path / "run", **changes) == code
    assert words in _last(capsys)["error"]["message"]
    assert not (tmp_path / "run").exists()


def test_datasets_of_two_rigs_are_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = build.open_dataset

    def opened(folder: Path, *, colour: bool) -> build.Dataset:
        found = original(folder, colour=colour)
        return replace(found, plan=replace(found.plan, rig=RIG.model_copy(update={"name": folder.name})))

    monkeypatch.setattr(build, "open_dataset", opened)
    assert _train_compressor(made, tmp_path / "run") == 1
    assert "different rigs" in _last(capsys)["error"]["message"]
