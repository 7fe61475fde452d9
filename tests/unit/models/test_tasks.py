"""Training tasks on a few images: VAE, compressor and transfer learn, resume exactly and freeze
what they should.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from nlos_models.errors import TrainingError
from nlos_models.pipeline import RemappingNetwork, channel_statistics, split_and_stack
from nlos_models.training import Recipe, Running, Scores, tasks
from nlos_models.training import loop as train
from nlos_models.training.data import InMemory, map_batches
from small_maps import SmallCompressor, SmallVae, small_images, small_maps, use_small_networks
from small_run import Stopped, changed_tensors, log_rows, small_recipe, state_of
from torch import Tensor

pytestmark = pytest.mark.usefixtures("one_thread")

Patch = pytest.MonkeyPatch
COUNT = 16
BATCH = 8
STEPS = COUNT // BATCH
CLASSIFIER_TENSORS = {"compressor.classifier.1.weight", "compressor.classifier.1.bias"}


@pytest.fixture(autouse=True, scope="module")
def _small_networks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        use_small_networks(patch, tasks)
        yield


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(3)


def _recipe(task: str, **changes: object) -> Recipe:
    facts = {
        "objects": COUNT,
        "epochs": 2,
        "batch": BATCH,
        "learning_rate": 1e-3,
        "schedule": "one-cycle",
    }
    return small_recipe(task=task, **(facts | changes))


def _statistics(maps: object) -> tuple[Tensor, Tensor]:
    return channel_statistics(
        split_and_stack(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))
    )


Trained = tuple[SmallVae, Scores, Path]


def _vae(
    recipe: Recipe, folder: Path, start: object = None, **running: object
) -> tuple[SmallVae, Scores]:
    return tasks.train_vae(
        recipe, small_images(COUNT, 0), small_images(4, 1), folder, Running(**running), start
    )


def _compressor(
    recipe: Recipe, start: tasks.Start, folder: Path, **running: object
) -> tuple[RemappingNetwork, Scores]:
    maps = InMemory(small_maps(COUNT, 0)), small_maps(4, 1)
    return tasks.train_compressor(recipe, start, *maps, folder, Running(**running))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("vae")
    return *_vae(_recipe("vae"), folder), folder


def test_vae_run_returns_the_figures_of_its_last_epoch(trained: Trained) -> None:
    vae, figures, folder = trained
    log = log_rows(folder)

    assert float(log[-1]["loss"]) < float(log[0]["loss"])
    assert {key: float(log[-1][key]) for key in figures} == figures
    assert 0 <= figures["held_out_iou"] <= 1
    assert not vae.training


def test_vae_warm_up_ignores_divergence(tmp_path: Path) -> None:
    losses = list[list[str]]()
    for weight in (0.0, 5.0):
        recipe = _recipe("vae", latent_warm_up=0.5, kl_weight=weight, epochs=4)
        _vae(recipe, tmp_path / f"{weight}")
        losses.append([row["loss"] for row in log_rows(tmp_path / f"{weight}")])

    assert [one == other for one, other in zip(*losses, strict=True)] == [True, True, False, False]


def test_vae_continues_from_weights(trained: Trained, tmp_path: Path) -> None:
    start = SmallVae()
    start.load_state_dict(before := state_of(trained[0]))
    vae, figures = _vae(
        _recipe("vae", start="weights", epochs=1, learning_rate=1e-7), tmp_path, start=start
    )
    for name, tensor in vae.named_parameters():  # at this rate they stay close
        torch.testing.assert_close(tensor.data, before[name], rtol=0, atol=1e-5)

    assert changed_tensors(before, vae.state_dict())
    assert figures["held_out_loss"] == pytest.approx(trained[1]["held_out_loss"], rel=0.05)


def test_vae_trains_an_encoder_for_a_given_decoder(trained: Trained, tmp_path: Path) -> None:
    start = SmallVae()
    start.decoder.load_state_dict(kept := state_of(trained[0].decoder))
    encoder = state_of(start.encoder)
    vae, _ = _vae(_recipe("vae", start="decoder", epochs=1), tmp_path / "decoder", start=start)

    assert not changed_tensors(kept, vae.decoder.state_dict())
    assert changed_tensors(encoder, vae.encoder.state_dict())


def test_compressor_keeps_vae_frozen_and_learns_statistics(
    trained: Trained, tmp_path: Path
) -> None:
    before = state_of(trained[0])
    recipe = _recipe("compressor", epochs=1, image_weight=1.0, left_noise=0.1)
    pipeline, _ = _compressor(recipe, tasks.Start(trained[0]), tmp_path)

    assert not changed_tensors(before, trained[0].state_dict())
    assert not changed_tensors(pipeline.decoder.state_dict(), trained[0].decoder.state_dict())

    learnt = pipeline.preprocess.mean, pipeline.preprocess.spread

    assert all(map(torch.equal, learnt, _statistics(small_maps(COUNT, 0))))
    assert pipeline.preprocess.left_noise == 0.1
    assert not pipeline.training


def test_one_step_training_trains_own_decoder(tmp_path: Path) -> None:
    recipe = _recipe("compressor", steps="one", latent_weight=0, image_weight=1.0)
    one, _ = _compressor(recipe, tasks.Start(), tmp_path / "one")
    less, _ = _compressor(recipe.model_copy(update={"epochs": 1}), tasks.Start(), tmp_path / "less")
    changed = changed_tensors(one.state_dict(), less.state_dict())

    assert {name.split(".")[0] for name in changed} == {"compressor", "decoder"}

    log = log_rows(tmp_path / "one")

    assert float(log[-1]["loss"]) < float(log[0]["loss"])


def test_joint_training_moves_both_networks_but_not_encoder(
    trained: Trained, tmp_path: Path
) -> None:
    vae = SmallVae()
    vae.load_state_dict(state_of(trained[0]))
    two = RemappingNetwork(SmallCompressor(), vae.decoder)
    two.preprocess.mean.fill_(0.25)
    before = state_of(two)
    encoder = state_of(vae.encoder)
    recipe = _recipe(
        "compressor",
        steps="two-then-joint",
        epochs=1,
        image_weight=1.0,
        dropout=0.2,
        learning_rate=1e-6,
    )
    joint, _ = _compressor(recipe, tasks.Start(vae, two), tmp_path)
    after = joint.state_dict()
    for part in ("compressor.classifier.1.weight", "decoder.output.weight"):
        assert not torch.equal(after[part], before[part])
        torch.testing.assert_close(
            after[part], before[part], rtol=0, atol=1e-5
        )  # at this rate it stays close

    assert torch.equal(after["preprocess.mean"], before["preprocess.mean"])
    assert not changed_tensors(encoder, vae.encoder.state_dict())
    assert joint.compressor.classifier[0].p == 0.2


def test_compressor_continues_from_weights_with_decoder_of_vae(
    trained: Trained, tmp_path: Path
) -> None:
    earlier = RemappingNetwork(SmallCompressor(), SmallVae().decoder)
    before = state_of(earlier.compressor)
    recipe = _recipe(
        "compressor", start="weights", epochs=1, image_weight=1.0, learning_rate=1e-7, dropout=0.2
    )
    pipeline, _ = _compressor(recipe, tasks.Start(trained[0], earlier), tmp_path)
    for name, tensor in pipeline.compressor.named_parameters():
        torch.testing.assert_close(tensor.data, before[name], rtol=0, atol=1e-5)

    assert not changed_tensors(pipeline.decoder.state_dict(), trained[0].decoder.state_dict())
    assert pipeline.compressor.classifier[0].p == 0.2


def test_compiled_networks_are_the_trained_ones(
    trained: Trained, tmp_path: Path, monkeypatch: Patch
) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(
        train, "compile_network", lambda network: compiled.append(network) or network
    )
    plain, quick = (
        _vae(_recipe("vae", epochs=1), tmp_path / f"{on}", compiled=on)[0] for on in (False, True)
    )

    assert compiled == [quick]
    assert not changed_tensors(plain.state_dict(), quick.state_dict())

    recipe = _recipe("compressor", epochs=1, image_weight=1.0)
    made, _ = _compressor(recipe, tasks.Start(trained[0]), tmp_path / "c", compiled=True)

    assert compiled[1:] == [made.latent, made.decoder]


def test_turn_some_with_mirror_gives_all_eight_views() -> None:
    image = torch.rand(1, 1, 4, 4)
    turned = tasks.turn_some(image.expand(4, -1, -1, -1), torch.arange(4))
    eight = [view for one in turned for view in (one, one.flip(-2))]

    assert len({tuple(view.flatten().tolist()) for view in eight}) == 8
    assert torch.equal(turned[0], image[0])
    assert torch.equal(turned[2], image[0].flip(-1, -2))
    assert any(torch.equal(view, image[0].flip(-1)) for view in eight)  # SI 3's horizontal flip


@pytest.mark.parametrize(("augmentation", "turns"), [("mirror", []), ("turns", [0, 1, 2, 3])])
def test_vae_turns_images_by_recipe(
    tmp_path: Path, monkeypatch: Patch, augmentation: str, turns: list[int]
) -> None:
    quarters: list[int] = []
    monkeypatch.setattr(
        tasks, "turn_some", lambda images, turns: quarters.extend(turns.tolist()) or images
    )
    _vae(_recipe("vae", epochs=1, augmentation=augmentation), tmp_path)

    assert sorted(set(quarters)) == turns
    assert len(quarters) == (COUNT if turns else 0)


@torch.no_grad()
def test_images_and_latents_in_parts_equal_those_at_once(monkeypatch: Patch) -> None:
    pipeline = RemappingNetwork(SmallCompressor(), SmallVae().decoder).eval()
    maps = small_maps(8, 3)
    whole = tasks.run(pipeline, maps)
    encoder = SmallVae().eval().encoder

    assert whole.shape == (8, 64, 64)

    monkeypatch.setattr(tasks, "SCORING_BATCH", 3)

    np.testing.assert_allclose(tasks.run(pipeline, maps), whole, atol=1e-5)

    straight = tasks.latents_of(encoder, maps.image)
    mirrored = tasks.latents_of(encoder, maps.image[:, ::-1])
    for batch in map_batches(maps, 4, torch.Generator().manual_seed(0)):
        chosen = torch.where(
            batch.mirrored[:, None, None], mirrored[batch.row], straight[batch.row]
        )
        torch.testing.assert_close(
            chosen, torch.stack(encoder(batch.image), dim=1), atol=1e-5, rtol=1e-4
        )


def test_figures_are_mean_squared_error_sum_and_iou() -> None:
    truth = small_images(3, 0)
    off = truth.astype(np.float32)

    assert tasks.figures_of(off, truth) == {"held_out_loss": 0.0, "held_out_iou": 1.0}

    off[0, 0, 0] += 0.3
    figures = tasks.figures_of(off, truth)

    assert figures["held_out_loss"] == pytest.approx(0.09 / 3)
    assert figures["held_out_iou"] < 1

    color = np.stack([truth, 0.9 * truth, 0.5 * truth], axis=1)

    assert list(tasks.figures_of(color.astype(np.float32), color).values()) == [
        0.0,
        1.0,
        0.0,
    ]  # loss, IoU, color error

    nothing = tasks.figures_of(np.zeros_like(color, np.float32), color)

    assert nothing["held_out_iou"] == 0.0
    assert nothing["held_out_colour_error"] == 1.0


def _first_loss(folder: Path, encoder: bool = True, **changes: float) -> float:
    torch.manual_seed(3)
    vae = SmallVae().eval()
    still = {"objects": 8, "epochs": 1, "dropout": 0.0, "left_noise": 0.0, "schedule": "plateau"}
    recipe = _recipe("compressor").model_copy(update={**still, **changes})
    pipeline = RemappingNetwork(SmallCompressor(), vae.decoder)
    source = InMemory(small_maps(8, 0))
    task = tasks.Remapping(pipeline, vae.encoder if encoder else None, source, small_maps(4, 1))
    rows = list[Scores]()
    task.fit(recipe, [vae.decoder], folder, Running(on_epoch=rows.append))
    return rows[0]["loss"]


def test_loss_weights_latent_image_and_surface(tmp_path: Path) -> None:
    weights = ((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (2.0, 3.0, 1.0), (0.0, 1.0, 2.0), (0.0, 1.0, 3.0))
    names = ("latent_weight", "image_weight", "surface_weight")
    losses = [
        _first_loss(tmp_path / f"{each}", **dict(zip(names, each, strict=True))) for each in weights
    ]
    latent, image, both, twice, thrice = losses

    assert both == pytest.approx(2 * latent + 3 * image, rel=1e-4)
    assert thrice - twice == pytest.approx(twice - image, rel=1e-4)
    assert twice > image


class Bench:
    """Synthetic weights, and maps of a few recordings."""

    def __init__(self, folder: Path) -> None:
        torch.manual_seed(5)
        self.vae = SmallVae().eval()
        self.folder = folder
        self.steps = list[tuple[int, int]]()
        self.pipeline = RemappingNetwork(SmallCompressor(), self.vae.decoder).eval()
        self.pipeline.preprocess.mean.fill_(0.25)
        self.maps = small_maps(COUNT, 0)
        self.held_out = small_maps(4, 1)

    def go(self, fail_at: int | None = None, **changes: object) -> Scores:
        def on_step(done: int, total: int) -> None:
            self.steps.append((done, total))
            if done == fail_at:
                raise Stopped

        recipe = _recipe(
            "transfer", **({"epochs": 3, "all_layers_epochs": 2, "image_weight": 1.0} | changes)
        )
        recipe = recipe.model_copy(update={"schedule": "plateau"})
        source = InMemory(self.maps)
        encoder = self.vae.encoder
        running = Running(on_step=on_step)
        return tasks.train_transfer(
            recipe, self.pipeline, encoder, source, self.held_out, self.folder, running
        )[1]

    @property
    def state(self) -> dict[str, Tensor]:
        return state_of(self.pipeline)


def test_transfer_changes_all_layers_and_then_the_classifier(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    bench = Bench(tmp_path / "second")
    before = bench.state
    fit = tasks.Remapping.fit
    bench.go(all_layers_epochs=0, epochs=1, dropout=0.25, left_noise=0.125)

    assert changed_tensors(before, bench.state) == CLASSIFIER_TENSORS
    assert bench.pipeline.compressor.classifier[0].p == 0.25
    assert bench.pipeline.preprocess.left_noise == 0.125

    def first_alone(
        self: tasks.Remapping, recipe: Recipe, frozen: list, folder: Path, *rest: object
    ) -> object:
        return fit(self, recipe, frozen, folder, *rest) if folder.name == tasks.ALL_LAYERS else {}

    monkeypatch.setattr(tasks.Remapping, "fit", first_alone)
    bench = Bench(tmp_path / "first")
    bench.go()
    ours = {name for name in before if name.startswith("compressor")}

    assert any("running_mean" in name for name in ours)
    assert changed_tensors(before, bench.state) == ours


def test_transfer_phases_have_epochs_and_rates_of_the_recipe(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "whole")
    figures = bench.go()
    first, second = (log_rows(bench.folder / name) for name in (tasks.ALL_LAYERS, tasks.CLASSIFIER))

    assert len(first) == 2
    assert len(second) == 3
    assert {float(row["rate"]) for row in first + second} == {1e-3}
    assert figures["held_out_loss"] == float(second[-1]["held_out_loss"])
    assert bench.steps == [(k + 1, 5 * STEPS) for k in range(5 * STEPS)]


def test_transfer_resumes_exactly_in_either_phase(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "whole")
    figures = bench.go()
    for fail_at in (STEPS + 1, 3 * STEPS + 1):
        with pytest.raises(Stopped):
            Bench(tmp_path / f"{fail_at}").go(fail_at)
        again = Bench(tmp_path / f"{fail_at}")
        assert again.go() == figures
        assert not changed_tensors(bench.state, again.state)


def test_transfer_second_phase_starts_from_best_epoch(tmp_path: Path, monkeypatch: Patch) -> None:
    losses = iter([2.0, 1.0, 3.0, *[9.0] * 9])
    found = list[dict[str, Tensor]]()
    bench = Bench(tmp_path)

    def figures(*_: object) -> Scores:
        found.append(bench.state)
        return {"held_out_loss": next(losses)}

    monkeypatch.setattr(tasks, "figures_of", figures)
    bench.go(all_layers_epochs=3, epochs=1, keep="best", dropout=0.0)
    after_best, last = (changed_tensors(found[k], bench.state) for k in (1, 2))

    assert after_best == CLASSIFIER_TENSORS
    assert last > after_best


@pytest.mark.parametrize(
    ("statistics", "own"), [("kept", []), ("own", [0, 1, 2, 3]), ("own intensity", [2, 3])]
)
def test_transfer_normalises_maps_by_recipe(
    tmp_path: Path, statistics: str, own: list[int]
) -> None:
    bench = Bench(tmp_path)
    wanted = [torch.full((4,), 0.25), torch.ones(4)]
    for values, theirs in zip(wanted, _statistics(bench.maps), strict=True):
        values[own] = theirs[own]
    bench.go(statistics=statistics, all_layers_epochs=0, epochs=1)

    assert all(
        map(torch.equal, (bench.pipeline.preprocess.mean, bench.pipeline.preprocess.spread), wanted)
    )


@pytest.mark.parametrize(("steps", "word"), [("two", "--vae"), ("two-then-joint", "--weights")])
def test_compressor_training_names_missing_start_or_encoder(
    tmp_path: Path, steps: str, word: str
) -> None:
    with pytest.raises(TrainingError, match=word):
        _compressor(_recipe("compressor", steps=steps, image_weight=1.0), tasks.Start(), tmp_path)
    with pytest.raises(TrainingError, match="encoder"):
        _first_loss(tmp_path, encoder=False)
