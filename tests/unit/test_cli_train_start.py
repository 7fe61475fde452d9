"""What runs set out from: the weights that the recipe asks for, of its kind, and every run that made them."""

from pathlib import Path

import pytest
import torch
from nlos_models import checkpoint
from nlos_models import runs as train_start
from nlos_models.checkpoint import CheckpointRecord, save_pipeline, save_vae
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.runs import compressor_start, transfer_start, vae_start
from safetensors.torch import load_file, save_file
from small_maps import SmallCompressor, SmallVae, use_small_networks

from nlos_cam.errors import SceneError

RIG = ("paper-rig", "0123")


def _recipe(task: str, **changes: object) -> Recipe:
    facts = {"task": task, "objects": 8, "held_out": 2, "epochs": 1, "batch": 2, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | {"image_weight": 1.0} | changes)


VAE, OTHER_VAE, TWO = _recipe("vae"), _recipe("vae", seed=1), _recipe("compressor")
AGAIN = _recipe("compressor", start="weights", seed=1)


@pytest.fixture(autouse=True)
def _small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    use_small_networks(monkeypatch, checkpoint, train_start)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Two-step weights with their encoder: they are a VAE too."""
    torch.manual_seed(1)
    vae = SmallVae()
    record = CheckpointRecord.of([VAE, TWO], RIG)
    save_pipeline(tmp_path / "two", Pipeline(SmallCompressor(), vae.decoder), record, vae.encoder)
    return tmp_path / "two"


def test_a_vae_goes_on_from_a_vae_and_its_runs_alone(weights: Path) -> None:
    trained, runs = vae_start(VAE, weights)
    assert runs == [VAE]
    stored = load_file(weights / "decoder.safetensors")["output.weight"].float()
    assert torch.equal(trained.decoder.output.weight, stored)


def test_a_compressor_from_scratch_knows_the_runs_of_its_vae_alone(weights: Path) -> None:
    start, runs = compressor_start(TWO, weights, None)
    assert (runs, start.pipeline) == ([VAE], None)


def test_a_compressor_that_goes_on_knows_the_runs_of_its_weights_and_of_its_new_vae(
    weights: Path, tmp_path: Path
) -> None:
    save_vae(tmp_path / "other", SmallVae(), CheckpointRecord.of([OTHER_VAE], RIG))
    start, runs = compressor_start(AGAIN, tmp_path / "other", weights)
    assert runs == [VAE, TWO, OTHER_VAE]
    assert start.pipeline is not None
    assert start.vae is not None
    assert not torch.equal(start.vae.decoder.output.weight, start.pipeline.decoder.output.weight)
    assert compressor_start(AGAIN, weights, weights)[1] == [TWO, VAE]
    record = CheckpointRecord.of([TWO, VAE, AGAIN], RIG)
    assert (record.vae_recipe, record.compressor_recipe, record.earlier) == (VAE, AGAIN, [TWO])


def test_one_step_sets_out_from_nothing() -> None:
    start, runs = compressor_start(_recipe("compressor", steps="one", latent_weight=0), None, None)
    assert (start.vae, start.pipeline, runs) == (None, None, [])


def _start(recipe: Recipe, weights: Path) -> object:
    if recipe.task == "transfer":
        return transfer_start(recipe, weights, partial=False)
    return compressor_start(recipe, weights, weights)


GOING_ON = [AGAIN, _recipe("compressor", steps="two-then-joint"), _recipe("transfer")]


@pytest.mark.parametrize("recipe", GOING_ON)
def test_weights_that_eat_other_maps_are_refused(weights: Path, recipe: Recipe) -> None:
    other = recipe.model_copy(update={"maps": "difference maps"})
    with pytest.raises(SceneError, match="these weights eat raw maps, the recipe says difference maps"):
        _start(other, weights)


@pytest.mark.parametrize("recipe", GOING_ON[:2])
def test_weights_of_another_width_are_refused(weights: Path, recipe: Recipe) -> None:
    with pytest.raises(SceneError, match=r"these weights are 1 wide, the recipe says 0\.5: change one of them"):
        _start(recipe.model_copy(update={"width": 0.5}), weights)


@pytest.mark.parametrize("recipe", GOING_ON)
def test_weights_of_colour_are_refused(weights: Path, recipe: Recipe) -> None:
    record = CheckpointRecord.of([_recipe("vae", colour=True)], RIG).model_dump_json()
    (weights / "checkpoint.json").write_text(record, encoding="utf-8")
    with pytest.raises(SceneError, match=r"two holds weights in colour \(simulation only.*, the recipe is of depth"):
        _start(recipe, weights)


@pytest.mark.parametrize("recipe", [VAE, AGAIN, _recipe("compressor", steps="two-then-joint")])
def test_weights_of_depth_are_refused_in_colour(weights: Path, recipe: Recipe) -> None:
    in_colour = recipe.model_copy(update={"colour": True})
    with pytest.raises(SceneError, match=r"two holds weights of depth, the recipe is in colour \(simulation only"):
        vae_start(in_colour, weights) if recipe == VAE else _start(in_colour, weights)


def test_what_is_not_taken_of_partly_fitting_weights_is_as_the_recipes_seed_has_it(weights: Path) -> None:
    tensors = load_file(weights / "compressor.safetensors")
    del tensors["classifier.1.weight"]
    save_file(tensors, weights / "compressor.safetensors")
    rows: list[torch.Tensor] = []
    for seed in (3, 3, 4):
        torch.rand(1)
        pipeline, runs = transfer_start(_recipe("transfer", seed=seed), weights, partial=True)
        rows.append(pipeline.compressor.get_parameter("classifier.1.weight").detach())
        assert runs == [VAE, TWO]
    assert torch.equal(rows[0], rows[1])
    assert not torch.equal(rows[0], rows[2])
