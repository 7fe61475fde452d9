"""Transfer in two phases: what may change in each, what is kept, and a run that goes on where it was stopped."""

import csv
from pathlib import Path

import pytest
import torch
from nlos_models import tasks
from nlos_models.data import InMemory
from nlos_models.errors import RecipeError
from nlos_models.pipeline import Pipeline, channel_statistics, split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.tasks import ALL_LAYERS, CLASSIFIER, train_transfer
from small_maps import SmallCompressor, SmallVae, small_maps

pytestmark = pytest.mark.usefixtures("one_thread")

COUNT, BATCH = 16, 8
STEPS = COUNT // BATCH


class Stopped(Exception):  # noqa: N818  a stand-in for a fault
    """Someone pulled the plug."""


def _recipe(**changes: object) -> Recipe:
    facts = {"task": "transfer", "objects": COUNT, "held_out": 4, "epochs": 3, "batch": BATCH, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | {"all_layers_epochs": 2, "image_weight": 1.0} | changes)


class Bench:
    """Synthetic weights, and a few recordings' maps."""

    def __init__(self, folder: Path) -> None:
        torch.manual_seed(5)
        self.vae, self.folder, self.steps = SmallVae().eval(), folder, list[tuple[int, int]]()
        self.pipeline = Pipeline(SmallCompressor(), self.vae.decoder).eval()
        self.pipeline.preprocess.mean.fill_(0.25)
        self.maps, self.held_out = small_maps(COUNT, 0), small_maps(4, 1)

    def go(self, recipe: Recipe, fail_at: int | None = None) -> dict[str, float]:
        def on_step(done: int, total: int) -> None:
            self.steps.append((done, total))
            if done == fail_at:
                raise Stopped

        source = InMemory(self.maps)
        _, figures = train_transfer(
            recipe, self.pipeline, self.vae.encoder, source, self.held_out, self.folder, on_step
        )
        return figures

    @property
    def state(self) -> dict[str, torch.Tensor]:
        return {name: tensor.clone() for name, tensor in self.pipeline.state_dict().items()}


def _changed(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> set[str]:
    return {name for name, tensor in before.items() if not torch.equal(tensor, after[name])}


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_in_the_second_phase_nothing_but_the_classifier_changes(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    before = bench.state
    bench.go(_recipe(all_layers_epochs=0))
    assert _changed(before, bench.state) == {"compressor.classifier.1.weight", "compressor.classifier.1.bias"}


def test_in_the_first_phase_all_of_the_compressor_changes_batch_norms_too_and_the_decoder_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path)
    before, fit = bench.state, tasks.Remapping.fit

    def first_alone(self: tasks.Remapping, recipe: Recipe, frozen: list, folder: Path, *rest: object) -> object:
        return fit(self, recipe, frozen, folder, *rest) if folder.name == ALL_LAYERS else {}

    monkeypatch.setattr(tasks.Remapping, "fit", first_alone)
    bench.go(_recipe())
    ours = {name for name in before if name.startswith("compressor")}
    assert any("running_mean" in name for name in ours)
    assert _changed(before, bench.state) == ours


def test_the_phases_have_the_epochs_and_rates_of_the_recipe(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    figures = bench.go(_recipe())
    first, second = (_rows(tmp_path / name) for name in (ALL_LAYERS, CLASSIFIER))
    assert (len(first), len(second)) == (2, 3)
    assert {float(row["rate"]) for row in first + second} == {1e-3}
    assert figures["held_out_loss"] == float(second[-1]["held_out_loss"])
    assert bench.steps == [(k + 1, 5 * STEPS) for k in range(5 * STEPS)]


def test_the_second_phase_sets_out_from_the_first_ones_best_epoch_where_that_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses, found = iter([2.0, 1.0, 3.0, *[9.0] * 9]), list[dict[str, torch.Tensor]]()
    bench = Bench(tmp_path)

    def figures(*_: object) -> dict[str, float]:
        found.append(bench.state)
        return {"held_out_loss": next(losses)}

    monkeypatch.setattr(tasks, "figures_of", figures)
    bench.go(_recipe(all_layers_epochs=3, epochs=1, keep="best", dropout=0.0))
    after_best, last = (_changed(found[k], bench.state) for k in (1, 2))
    assert after_best == {"compressor.classifier.1.weight", "compressor.classifier.1.bias"}
    assert last > after_best


@pytest.mark.parametrize(("statistics", "own"), [("kept", []), ("own", [0, 1, 2, 3]), ("own intensity", [2, 3])])
def test_maps_are_normalised_as_the_recipe_says(tmp_path: Path, statistics: str, own: list[int]) -> None:
    bench = Bench(tmp_path)
    stacked = split_and_stack(torch.from_numpy(bench.maps.depth_m), torch.from_numpy(bench.maps.intensity))
    wanted = [torch.full((4,), 0.25), torch.ones(4)]
    for values, theirs in zip(wanted, channel_statistics(stacked), strict=True):
        values[own] = theirs[own]
    bench.go(_recipe(statistics=statistics, all_layers_epochs=0, epochs=1))
    assert torch.equal(bench.pipeline.preprocess.mean, wanted[0])
    assert torch.equal(bench.pipeline.preprocess.spread, wanted[1])


def test_the_recipes_dropout_and_noise_are_used(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.go(_recipe(all_layers_epochs=0, epochs=1, dropout=0.25, left_noise=0.125))
    assert bench.pipeline.compressor.classifier[0].p == 0.25
    assert bench.pipeline.preprocess.left_noise == 0.125


@pytest.mark.parametrize("fail_at", [STEPS + 1, 3 * STEPS + 1])
def test_a_failed_and_resumed_transfer_equals_an_uninterrupted_one(tmp_path: Path, fail_at: int) -> None:
    whole = Bench(tmp_path / "whole")
    figures = whole.go(_recipe())
    with pytest.raises(Stopped):
        Bench(tmp_path / "failed").go(_recipe(), fail_at)
    again = Bench(tmp_path / "failed")
    assert again.go(_recipe()) == figures
    assert not _changed(whole.state, again.state)


def test_it_gets_better_on_the_bench(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    figures = bench.go(_recipe(all_layers_epochs=5, epochs=5, latent_weight=0, learning_rate=3e-3, dropout=0))
    assert figures["held_out_loss"] < float(_rows(tmp_path / ALL_LAYERS)[0]["held_out_loss"])


def test_fewer_recordings_than_a_batch_are_one_line(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.maps = small_maps(BATCH - 1, 0)
    with pytest.raises(RecipeError, match="fewer training objects than a batch of 8"):
        bench.go(_recipe())
