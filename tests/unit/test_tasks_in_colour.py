"""Both steps of training in colour, on a few images: what their shapes could break; depth's tests hold the rest."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_calibration.arrays import Float16
from nlos_models.checkpoint import CheckpointRecord, load_encoder, load_pipeline, load_vae, save_pipeline, save_vae
from nlos_models.data import InMemory, MapSet
from nlos_models.errors import CheckpointError
from nlos_models.inference import load_reconstructor
from nlos_models.pipeline import Pipeline, channel_statistics, split_and_stack
from nlos_models.recipe import SIMULATION_ONLY, Recipe, load_recipe
from nlos_models.tasks import Start, figures_of, rebuilt, run, train_compressor, train_vae
from nlos_models.vae import ResVae

pytestmark = pytest.mark.usefixtures("narrow_networks")

COUNT, BATCH = 8, 4
RECIPES = Path(__file__).parents[2] / "models" / "recipes"

Trained = tuple[ResVae, dict[str, float], Path]


def _recipe(task: str, **changes: object) -> Recipe:
    facts = {"task": task, "objects": COUNT, "held_out": 2, "epochs": 2, "batch": BATCH, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | {"colour": True, "kl_weight": 0.03, "schedule": "one-cycle"} | changes)


def _images(count: int, seed: int) -> Float16:
    generator, images = np.random.default_rng(seed), np.zeros((count, 3, 64, 64), np.float16)
    for image in images:
        row, column = generator.integers(8, 30, 2)
        image[:, row : row + 24, column : column + 24] = generator.uniform(0.3, 1, (3, 1, 1))
    return images


def _maps(count: int, seed: int) -> MapSet:
    images = _images(count, seed)
    intensity = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (0, 0), (8, 8))) * 50
    bright = intensity.max(1)
    depth = np.where(bright > 0, bright / 100, np.float32(np.nan)).astype(np.float32)
    return MapSet(depth, intensity, images)


def _ignore(done: int, total: int) -> None:
    assert done <= total


def _compressor(recipe: Recipe, start: Start, folder: Path) -> tuple[Pipeline, dict[str, float]]:
    return train_compressor(recipe, start, InMemory(_maps(COUNT, 0)), _maps(2, 1), folder, _ignore)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("vae")
    vae, figures = train_vae(_recipe("vae"), _images(COUNT, 0), _images(2, 1), folder, _ignore)
    return vae, figures, folder


def test_the_vaes_loss_falls_and_its_figures_are_those_of_colour(trained: Trained) -> None:
    vae, figures, folder = trained
    with (folder / "log.csv").open(encoding="utf-8") as file:
        log = list(csv.DictReader(file))
    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    assert set(figures) == {"held_out_loss", "held_out_iou", "held_out_colour_error"}
    assert not vae.training
    assert rebuilt(vae, _images(2, 1)).shape == (2, 3, 64, 64)


def test_a_finished_run_is_not_trained_again(trained: Trained) -> None:
    vae, figures = train_vae(_recipe("vae"), _images(COUNT, 0), _images(2, 1), trained[2], _ignore)
    for name, tensor in vae.state_dict().items():
        assert torch.equal(tensor, trained[0].state_dict()[name]), name
    assert figures == trained[1]


def test_the_compressor_learns_with_the_vae_frozen_and_comes_back_from_its_folder(
    trained: Trained, tmp_path: Path
) -> None:
    before = {name: tensor.clone() for name, tensor in trained[0].state_dict().items()}
    maps, held_out = _maps(COUNT, 0), _maps(2, 1)
    recipe = _recipe("compressor", epochs=1, latent_weight=0.03, image_weight=1.0)
    pipeline, figures = _compressor(recipe, Start(trained[0]), tmp_path)
    assert figures == figures_of(run(pipeline, held_out), held_out.image)
    for name, tensor in trained[0].state_dict().items():
        assert torch.equal(tensor, before[name]), name
    mean, spread = channel_statistics(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    assert torch.equal(pipeline.preprocess.mean, mean)
    assert torch.equal(pipeline.preprocess.spread, spread)
    record = CheckpointRecord(
        rig_name="paper-rig", rig_checksum="0", vae_recipe=_recipe("vae"), compressor_recipe=recipe
    )
    save_pipeline(tmp_path, pipeline, record, trained[0].encoder)
    loaded, told = load_pipeline(tmp_path)
    assert told == record.model_copy(update={"note": SIMULATION_ONLY})
    encoder = load_encoder(tmp_path)
    assert encoder is not None
    torch.testing.assert_close(encoder.state_dict(), trained[0].encoder.state_dict(), rtol=1e-3, atol=1e-6)
    latents = [torch.from_numpy(m) for m in (held_out.depth_m, held_out.intensity)]
    with torch.inference_mode():
        torch.testing.assert_close(loaded.latent(*latents), pipeline.latent(*latents), atol=0.02, rtol=0.02)
    assert run(loaded, held_out).shape == (2, 3, 64, 64)
    with pytest.raises(CheckpointError, match=r"full colour \(simulation only"):
        load_reconstructor(tmp_path, tmp_path / "onnx")


def test_a_colour_vae_comes_back_and_weights_of_depth_are_refused_for_it(trained: Trained, tmp_path: Path) -> None:
    record = CheckpointRecord(rig_name="paper-rig", rig_checksum="0", vae_recipe=_recipe("vae"))
    save_vae(tmp_path, trained[0], record)
    vae, _ = load_vae(tmp_path)
    torch.testing.assert_close(vae.state_dict(), trained[0].state_dict(), rtol=1e-3, atol=1e-6)
    save_vae(tmp_path, ResVae(), record)
    with pytest.raises(CheckpointError, match="does not fit this network"):
        load_vae(tmp_path)


def test_one_step_has_a_decoder_in_colour_of_its_own_and_goes_on_from_weights(trained: Trained, tmp_path: Path) -> None:
    one = _recipe("compressor", steps="one", latent_weight=0, image_weight=1.0, epochs=1)
    first, figures = _compressor(one, Start(), tmp_path / "one")
    assert first.decoder.output.out_channels == 3
    assert set(figures) == {"held_out_loss", "held_out_iou", "held_out_colour_error"}
    still = _recipe("compressor", start="weights", epochs=1, learning_rate=1e-7, image_weight=1.0, schedule="plateau")
    weight = first.compressor.get_submodule("classifier.1").state_dict()["weight"].clone()
    on, _ = _compressor(still, Start(trained[0], first), tmp_path / "on")
    after = on.compressor.get_submodule("classifier.1").state_dict()["weight"]
    torch.testing.assert_close(after, weight, rtol=0, atol=1e-6)
    assert on.decoder is trained[0].decoder


def test_colours_that_share_no_pixel_with_the_truth_are_as_wrong_as_can_be() -> None:
    truth = _images(2, 0)
    assert figures_of(truth.astype(np.float32), truth) == {
        "held_out_loss": 0.0,
        "held_out_iou": 1.0,
        "held_out_colour_error": 0.0,
    }
    nothing = figures_of(np.zeros_like(truth, np.float32), truth)
    assert (nothing["held_out_iou"], nothing["held_out_colour_error"]) == (0.0, 1.0)


@pytest.mark.parametrize("task", ["vae", "compressor"])
@pytest.mark.parametrize(("scale", "schedule"), [("", "plateau"), ("-small", "one-cycle")])
def test_the_recipes_of_colour_have_si_3s_weight_at_either_scale(task: str, scale: str, schedule: str) -> None:
    recipe = load_recipe(RECIPES / f"colour-{task}{scale}.toml")
    assert (recipe.task, recipe.colour, recipe.kl_weight, recipe.schedule) == (task, True, 0.03, schedule)
    assert recipe.deviations
