"""The two steps of training, on a few images: losses fall, runs resume to the same bits, the VAE stays frozen."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models import tasks
from nlos_models.compressor import Compressor
from nlos_models.data import MapSet, map_batches
from nlos_models.pipeline import Pipeline
from nlos_models.preprocess import channel_statistics, split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.res_vae import ResVae
from nlos_models.tasks import run, train_compressor, train_vae

COUNT, BATCH = 16, 8


class Stopped(Exception):  # noqa: N818  a stand-in for Ctrl-C
    """Someone pulled the plug."""


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _recipe(task: str, **changes: object) -> Recipe:
    facts = {"task": task, "objects": COUNT, "held_out": 4, "epochs": 2, "batch": BATCH, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | {"schedule": "one-cycle"} | changes)


def _images(count: int, seed: int) -> np.ndarray:
    generator, images = np.random.default_rng(seed), np.zeros((count, 64, 64), np.float16)
    for image in images:
        row, column = generator.integers(8, 30, 2)
        image[row : row + 24, column : column + 24] = generator.uniform(0.3, 1)
    return images


def _maps(count: int, seed: int) -> MapSet:
    images = _images(count, seed)
    intensity = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8))) * 50
    depth = np.where(intensity > 0, intensity / 100, np.float32(np.nan)).astype(np.float32)
    return MapSet(depth, intensity, images)


def _ignore(done: int, total: int) -> None:
    assert done <= total


def _log(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(encoding="utf-8") as file:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


def _stop_at(step: int, total: int) -> None:
    if step == total // 2 + 1:
        raise Stopped


Trained = tuple[ResVae, dict[str, float], Path]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("vae")
    vae, figures = train_vae(_recipe("vae"), _images(COUNT, 0), _images(4, 1), folder, _ignore)
    return vae, figures, folder


def _assert_same(one: torch.nn.Module, other: torch.nn.Module) -> None:
    for (name, mine), its in zip(one.state_dict().items(), other.state_dict().values(), strict=True):
        assert torch.equal(mine, its), name


def test_the_vaes_loss_falls_and_its_figures_are_those_of_the_last_epoch(trained: Trained) -> None:
    vae, figures, folder = trained
    log = _log(folder)
    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    assert {key: float(log[-1][key]) for key in figures} == figures
    assert 0 <= figures["held_out_iou"] <= 1
    assert not vae.training


def test_a_stopped_and_resumed_vae_equals_an_uninterrupted_one(trained: Trained, tmp_path: Path) -> None:
    data = _images(COUNT, 0), _images(4, 1)
    with pytest.raises(Stopped):
        train_vae(_recipe("vae"), *data, tmp_path, _stop_at)
    torch.manual_seed(99)
    vae, figures = train_vae(_recipe("vae"), *data, tmp_path, _ignore)
    _assert_same(vae, trained[0])
    assert figures == trained[1]
    assert _log(tmp_path) == _log(trained[2])


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.05, 1.0)], ids=["latent", "latent and image"])
def test_a_stopped_and_resumed_compressor_equals_an_uninterrupted_one(
    trained: Trained, tmp_path: Path, weights: tuple[float, float]
) -> None:
    recipe = _recipe("compressor", latent_weight=weights[0], image_weight=weights[1])
    data = _maps(COUNT, 0), _maps(4, 1)
    whole, figures = train_compressor(recipe, trained[0], *data, tmp_path / "whole", _ignore)
    with pytest.raises(Stopped):
        train_compressor(recipe, trained[0], *data, tmp_path / "stopped", _stop_at)
    resumed, again = train_compressor(recipe, trained[0], *data, tmp_path / "stopped", _ignore)
    _assert_same(resumed, whole)
    assert figures == again
    log = _log(tmp_path / "whole")
    assert log == _log(tmp_path / "stopped")
    assert float(log[-1]["loss"]) < float(log[0]["loss"])


def test_the_compressor_learns_with_the_vae_frozen_and_its_own_statistics(trained: Trained, tmp_path: Path) -> None:
    before = {name: tensor.clone() for name, tensor in trained[0].state_dict().items()}
    maps = _maps(COUNT, 0)
    recipe = _recipe("compressor", epochs=1, image_weight=1.0, left_noise=0.1)
    pipeline, _ = train_compressor(recipe, trained[0], maps, _maps(4, 1), tmp_path, _ignore)
    for name, tensor in trained[0].state_dict().items():
        assert torch.equal(tensor, before[name]), name
    _assert_same(pipeline.decoder, trained[0].decoder)
    mean, spread = channel_statistics(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    assert torch.equal(pipeline.preprocess.mean, mean)
    assert torch.equal(pipeline.preprocess.spread, spread)
    assert pipeline.preprocess.left_noise == 0.1
    assert not pipeline.training


@torch.no_grad()
def test_the_latents_worked_out_ahead_are_those_of_the_images_and_of_their_mirrors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tasks, "SCORING_BATCH", 3)
    vae, maps = ResVae().eval(), _maps(8, 3)
    straight, mirrored = tasks._latents(vae, maps.image), tasks._latents(vae, maps.image[:, ::-1])
    for batch in map_batches(maps, 4, torch.Generator().manual_seed(0)):
        chosen = torch.where(batch.mirrored[:, None, None], mirrored[batch.row], straight[batch.row])
        torch.testing.assert_close(chosen, torch.stack(vae.encoder(batch.image), dim=1), atol=1e-5, rtol=1e-4)


def test_running_in_parts_equals_running_one_by_one(trained: Trained, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    pipeline, maps = Pipeline(Compressor(), trained[0].decoder).eval(), _maps(5, 2)
    whole = run(pipeline, maps)
    assert whole.shape == (5, 64, 64)
    monkeypatch.setattr(tasks, "SCORING_BATCH", 2)
    np.testing.assert_allclose(run(pipeline, maps), whole, atol=1e-4)
