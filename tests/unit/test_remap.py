"""What training and transfer share: targets worked out ahead, running in parts, figures, frozen parts."""

from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models import tasks
from nlos_models.data import InMemory, map_batches
from nlos_models.errors import TrainingError
from nlos_models.pipeline import Pipeline
from nlos_models.recipe import Recipe
from nlos_models.tasks import Remapping, figures_of, latents_of, run
from nlos_models.train import Running
from small_maps import SmallCompressor, SmallVae, small_images, small_maps

pytestmark = pytest.mark.usefixtures("one_thread")

RECIPE = Recipe(task="compressor", objects=8, held_out=4, epochs=1, batch=4, learning_rate=1e-3)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(3)


def _ignore(done: int, total: int) -> None:
    assert done <= total


@torch.no_grad()
def test_the_latents_worked_out_ahead_are_those_of_the_images_and_of_their_mirrors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tasks, "SCORING_BATCH", 3)
    encoder, maps = SmallVae().eval().encoder, small_maps(8, 3)
    straight, mirrored = latents_of(encoder, maps.image), latents_of(encoder, maps.image[:, ::-1])
    for batch in map_batches(maps, 4, torch.Generator().manual_seed(0)):
        chosen = torch.where(batch.mirrored[:, None, None], mirrored[batch.row], straight[batch.row])
        torch.testing.assert_close(chosen, torch.stack(encoder(batch.image), dim=1), atol=1e-5, rtol=1e-4)


def test_running_in_parts_equals_running_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, maps = Pipeline(SmallCompressor(), SmallVae().decoder).eval(), small_maps(5, 2)
    whole = run(pipeline, maps)
    assert whole.shape == (5, 64, 64)
    monkeypatch.setattr(tasks, "SCORING_BATCH", 2)
    np.testing.assert_allclose(run(pipeline, maps), whole, atol=1e-5)


def test_figures_are_of_the_images() -> None:
    truth = small_images(3, 0)
    assert figures_of(truth.astype(np.float32), truth) == {"held_out_loss": 0.0, "held_out_iou": 1.0}
    off = truth.astype(np.float32)
    off[0, 0, 0] += 0.3
    figures = figures_of(off, truth)
    assert figures["held_out_loss"] == pytest.approx(0.09 / 3)
    assert figures["held_out_iou"] < 1


def test_the_latent_and_the_image_each_count_by_their_weights(tmp_path: Path) -> None:
    losses = []
    for latent, image in ((1.0, 0.0), (0.0, 1.0), (2.0, 3.0)):
        torch.manual_seed(3)
        vae = SmallVae().eval()
        pipeline = Pipeline(SmallCompressor(), vae.decoder)
        recipe = RECIPE.model_copy(
            update={"latent_weight": latent, "image_weight": image, "batch": 8, "dropout": 0.0, "left_noise": 0.0}
        )
        task = Remapping(pipeline, vae.encoder, InMemory(small_maps(8, 0)), small_maps(4, 1))
        rows: list[dict[str, float]] = []
        task.fit(recipe, [vae.decoder], tmp_path / f"{latent}", _ignore, Running(on_epoch=rows.append))
        losses.append(rows[0]["loss"])
    assert losses[2] == pytest.approx(2 * losses[0] + 3 * losses[1], rel=1e-4)


def test_surface_counts_as_much_as_the_recipe_says(tmp_path: Path) -> None:
    losses = []
    for weight in (1.0, 2.0, 3.0):
        torch.manual_seed(3)
        vae = SmallVae().eval()
        changes = {"latent_weight": 0.0, "image_weight": 1.0, "batch": 8, "dropout": 0.0, "left_noise": 0.0}
        recipe = RECIPE.model_copy(update={**changes, "surface_weight": weight})
        task = Remapping(Pipeline(SmallCompressor(), vae.decoder), None, InMemory(small_maps(8, 0)), small_maps(4, 1))
        rows: list[dict[str, float]] = []
        task.fit(recipe, [vae.decoder], tmp_path / f"{weight}", _ignore, Running(on_epoch=rows.append))
        losses.append(rows[0]["loss"])
    assert losses[2] - losses[1] == pytest.approx(losses[1] - losses[0], rel=1e-4)
    assert losses[1] > losses[0]


def test_aiming_at_a_latent_without_an_encoder_is_one_line(tmp_path: Path) -> None:
    pipeline = Pipeline(SmallCompressor(), SmallVae().decoder)
    task = Remapping(pipeline, None, InMemory(small_maps(8, 0)), small_maps(4, 1))
    with pytest.raises(TrainingError, match="no encoder to aim at"):
        task.fit(RECIPE, [], tmp_path, _ignore, Running())
