"""The two steps of training, on a few images: losses fall, runs resume to the same bits, the VAE stays frozen."""

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from nlos_models import tasks, train
from nlos_models.data import InMemory
from nlos_models.errors import TrainingError
from nlos_models.pipeline import Pipeline, channel_statistics, split_and_stack
from nlos_models.recipe import Recipe
from nlos_models.tasks import Start, train_compressor, train_vae, turn_some
from nlos_models.train import Running
from small_maps import SmallCompressor, SmallVae, small_images, small_maps, use_small_networks

pytestmark = pytest.mark.usefixtures("one_thread")

COUNT, BATCH = 16, 8


class Stopped(Exception):  # noqa: N818  a stand-in for a fault
    """Someone pulled the plug."""


@pytest.fixture(autouse=True, scope="module")
def _small_networks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        use_small_networks(patch, tasks)
        yield


def _recipe(task: str, **changes: object) -> Recipe:
    facts = {"task": task, "objects": COUNT, "held_out": 4, "epochs": 2, "batch": BATCH, "learning_rate": 1e-3}
    return Recipe.model_validate(facts | {"schedule": "one-cycle"} | changes)


def _ignore(done: int, total: int) -> None:
    assert done <= total


def _stop_at(step: int, total: int) -> None:
    if step == total // 2 + 1:
        raise Stopped


def _log(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(encoding="utf-8") as file:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


Trained = tuple[SmallVae, dict[str, float], Path]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("vae")
    vae, figures = train_vae(_recipe("vae"), small_images(COUNT, 0), small_images(4, 1), folder, _ignore)
    return vae, figures, folder


def _train(recipe: Recipe, start: Start, folder: Path) -> tuple[Pipeline, dict[str, float]]:
    return train_compressor(recipe, start, InMemory(small_maps(COUNT, 0)), small_maps(4, 1), folder, _ignore)


def _copy(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def _same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    assert one.keys() == other.keys()
    return all(torch.equal(tensor, other[name]) for name, tensor in one.items())


def test_the_vaes_loss_falls_and_its_figures_are_those_of_the_last_epoch(trained: Trained) -> None:
    vae, figures, folder = trained
    log = _log(folder)
    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    assert {key: float(log[-1][key]) for key in figures} == figures
    assert 0 <= figures["held_out_iou"] <= 1
    assert not vae.training


def test_a_stopped_and_resumed_vae_equals_an_uninterrupted_one(trained: Trained, tmp_path: Path) -> None:
    data = small_images(COUNT, 0), small_images(4, 1)
    with pytest.raises(Stopped):
        train_vae(_recipe("vae"), *data, tmp_path, _stop_at)
    torch.manual_seed(99)
    vae, figures = train_vae(_recipe("vae"), *data, tmp_path, _ignore)
    assert _same(vae.state_dict(), trained[0].state_dict())
    assert figures == trained[1]
    assert _log(tmp_path) == _log(trained[2])


def test_a_vae_that_warms_up_knows_no_divergence_until_then_and_resumes_alike(tmp_path: Path) -> None:
    data, losses = (small_images(COUNT, 0), small_images(4, 1)), list[list[str]]()
    for weight in (0.0, 5.0):
        folder = tmp_path / f"{weight}"
        recipe = _recipe("vae", latent_warm_up=0.5, kl_weight=weight, epochs=4, schedule="one-cycle")
        with pytest.raises(Stopped):
            train_vae(recipe, *data, folder, _stop_at)
        train_vae(recipe, *data, folder, _ignore)
        losses.append([row["loss"] for row in _log(folder)])
    without, with_it = losses
    assert without[:2] == with_it[:2]
    assert all(one != other for one, other in zip(without[2:], with_it[2:], strict=True))


def test_a_stopped_and_resumed_compressor_equals_an_uninterrupted_one(trained: Trained, tmp_path: Path) -> None:
    recipe, start = _recipe("compressor", latent_weight=0.05, image_weight=1.0), Start(trained[0])
    whole, figures = _train(recipe, start, tmp_path / "whole")
    data = InMemory(small_maps(COUNT, 0)), small_maps(4, 1)
    with pytest.raises(Stopped):
        train_compressor(recipe, start, *data, tmp_path / "stopped", _stop_at)
    resumed, again = train_compressor(recipe, start, *data, tmp_path / "stopped", _ignore)
    assert _same(resumed.state_dict(), whole.state_dict())
    assert figures == again
    log = _log(tmp_path / "whole")
    assert log == _log(tmp_path / "stopped")
    assert float(log[-1]["loss"]) < float(log[0]["loss"])


def test_the_compressor_learns_with_the_vae_frozen_and_its_own_statistics(trained: Trained, tmp_path: Path) -> None:
    before, maps = _copy(trained[0]), small_maps(COUNT, 0)
    recipe = _recipe("compressor", epochs=1, image_weight=1.0, left_noise=0.1)
    pipeline, _ = _train(recipe, Start(trained[0]), tmp_path)
    assert _same(trained[0].state_dict(), before)
    assert _same(pipeline.decoder.state_dict(), trained[0].decoder.state_dict())
    mean, spread = channel_statistics(split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity)))
    assert torch.equal(pipeline.preprocess.mean, mean)
    assert torch.equal(pipeline.preprocess.spread, spread)
    assert pipeline.preprocess.left_noise == 0.1
    assert not pipeline.training


def test_one_step_trains_compressor_and_a_decoder_of_its_own_from_scratch(tmp_path: Path) -> None:
    recipe = _recipe("compressor", steps="one", latent_weight=0, image_weight=1.0)
    one, _ = _train(recipe, Start(), tmp_path / "one")
    again, _ = _train(recipe.model_copy(update={"epochs": 1}), Start(), tmp_path / "less")
    for part in ("compressor", "decoder"):
        mine, its = (pipeline.get_submodule(part).state_dict() for pipeline in (one, again))
        assert not _same(mine, its), part
    log = _log(tmp_path / "one")
    assert float(log[-1]["loss"]) < float(log[0]["loss"])


def test_joint_training_goes_on_from_two_step_weights_and_moves_both_networks_but_not_the_encoder(
    trained: Trained, tmp_path: Path
) -> None:
    vae = SmallVae()
    vae.load_state_dict(_copy(trained[0]))
    two = Pipeline(SmallCompressor(), vae.decoder)
    two.preprocess.mean.fill_(0.25)
    before, encoder = _copy(two), _copy(vae.encoder)
    recipe = _recipe("compressor", steps="two-then-joint", epochs=1, image_weight=1.0, dropout=0.2, learning_rate=1e-6)
    joint, _ = _train(recipe, Start(vae, two), tmp_path)
    after = joint.state_dict()
    for part in ("compressor.classifier.1.weight", "decoder.output.weight"):
        assert not torch.equal(after[part], before[part])
        torch.testing.assert_close(after[part], before[part], rtol=0, atol=1e-5)  # at this rate: from there, not anew
    assert torch.equal(after["preprocess.mean"], before["preprocess.mean"])
    assert _same(vae.encoder.state_dict(), encoder)
    assert joint.compressor.classifier[0].p == 0.2


def test_a_vae_goes_on_from_the_weights_that_it_starts_from(trained: Trained, tmp_path: Path) -> None:
    start, data = SmallVae(), (small_images(COUNT, 0), small_images(4, 1))
    start.load_state_dict(before := _copy(trained[0]))
    recipe = _recipe("vae", start="weights", epochs=1, learning_rate=1e-7)
    vae, figures = train_vae(recipe, *data, tmp_path, _ignore, start=start)
    for name, tensor in vae.named_parameters():  # at this rate: from there, not anew
        torch.testing.assert_close(tensor.data, before[name], rtol=0, atol=1e-5)
    assert not _same(vae.state_dict(), before)
    assert figures["held_out_loss"] == pytest.approx(trained[1]["held_out_loss"], rel=0.05)


def test_a_compressor_goes_on_from_the_weights_that_it_starts_from_before_the_vaes_own_decoder(
    trained: Trained, tmp_path: Path
) -> None:
    earlier = Pipeline(SmallCompressor(), SmallVae().decoder)
    before = _copy(earlier.compressor)
    recipe = _recipe("compressor", start="weights", epochs=1, image_weight=1.0, learning_rate=1e-7, dropout=0.2)
    pipeline, _ = _train(recipe, Start(trained[0], earlier), tmp_path)
    for name, tensor in pipeline.compressor.named_parameters():
        torch.testing.assert_close(tensor.data, before[name], rtol=0, atol=1e-5)
    assert _same(pipeline.decoder.state_dict(), trained[0].decoder.state_dict())
    assert pipeline.compressor.classifier[0].p == 0.2


def test_compiled_networks_are_those_that_are_trained(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(train, "compiled", lambda network: compiled.append(network) or network)
    plain, quick = Running(), Running(compiled=True)
    data, vaes = (small_images(COUNT, 0), small_images(4, 1)), list[SmallVae]()
    for running in (plain, quick):
        vaes.append(train_vae(_recipe("vae", epochs=1), *data, tmp_path / str(len(vaes)), _ignore, running)[0])
    assert compiled == [vaes[1]]
    assert _same(vaes[0].state_dict(), vaes[1].state_dict())
    recipe, maps = _recipe("compressor", epochs=1, image_weight=1.0), InMemory(small_maps(COUNT, 0))
    made, _ = train_compressor(recipe, Start(trained[0]), maps, small_maps(4, 1), tmp_path / "c", _ignore, quick)
    assert compiled[1:] == [made.latent, made.decoder]


@pytest.mark.parametrize(("steps", "words"), [("two", "--vae"), ("two-then-joint", "--weights")])
def test_a_start_without_what_the_steps_need_is_one_line(tmp_path: Path, steps: str, words: str) -> None:
    with pytest.raises(TrainingError, match=words):
        _train(_recipe("compressor", steps=steps, image_weight=1.0), Start(), tmp_path)


def test_turns_are_quarters_and_with_the_mirror_make_all_eight() -> None:
    image = torch.rand(1, 1, 4, 4)
    turned = turn_some(image.expand(4, -1, -1, -1), torch.arange(4))
    eight = [view for one in turned for view in (one, one.flip(-2))]
    assert len({tuple(view.flatten().tolist()) for view in eight}) == 8
    assert torch.equal(turned[0], image[0])
    assert torch.equal(turned[2], image[0].flip(-1, -2))
    assert any(torch.equal(view, image[0].flip(-1)) for view in eight)  # SI 3's horizontal flip


def test_a_vae_is_shown_turned_images_where_the_recipe_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quarters: list[int] = []

    def noted(images: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
        quarters.extend(turns.tolist())
        return images

    monkeypatch.setattr(tasks, "turn_some", noted)
    data = small_images(COUNT, 0), small_images(4, 1)
    train_vae(_recipe("vae", epochs=1, augmentation="mirror"), *data, tmp_path / "mirror", _ignore)
    assert not quarters
    train_vae(_recipe("vae", epochs=1, augmentation="turns"), *data, tmp_path / "turns", _ignore)
    assert set(quarters) == {0, 1, 2, 3}
    assert len(quarters) == COUNT
