"""The direct network: mirror symmetry, its places of pixels, its loss, exact resuming, and its
checkpoint.
"""

import io
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from nlos_models import direct
from nlos_models.checkpoint import load_network, load_pipeline
from nlos_models.direct import CellNormal, DirectNetwork, image_from_logits
from nlos_models.errors import CheckpointError, TrainingError
from nlos_models.export import TorchReconstructor, export_folder
from nlos_models.inference import load_reconstructor
from nlos_models.metrics import color_metrics
from nlos_models.records import SIMULATION_ONLY, CheckpointRecord, load_record
from nlos_models.training.checkpoints import save_direct
from nlos_models.training.data import InMemory, MapNoise, MapSet, as_images
from nlos_models.training.direct import NormalBatch, _stains, train_direct, transfer_direct, vary
from nlos_models.training.distributed import open_fabric
from nlos_models.training.loop import MINUTES, Running, Scores
from nlos_models.training.losses import two_heads_error
from nlos_models.training.recipe import DirectSize, recipe_of
from nlos_models.training.run_files import BEST, LAST
from nlos_models.training.runs import (
    TrainingRun,
    direct_start,
    record_run,
    run_transfer,
    transfer_start,
)
from nlos_models.training.tasks import figures_of
from nlos_models.training.tasks import run as reconstruct
from onnx import TensorProto
from small_maps import small_maps
from small_run import changed_tensors
from torch import Tensor, nn

pytestmark = pytest.mark.usefixtures("one_thread")
RUN = {
    "objects": 16,
    "held_out": 4,
    "epochs": 2,
    "batch": 4,
    "learning_rate": 3e-3,
    "schedule": "cosine",
    "weight_decay": 0.05,
    "average": 0.9,
    "noise": 0.02,
}
SIZE = DirectSize(features=8, width=8, blocks=1, token=8, mixers=1)


def _recipe(**changes: object) -> Any:
    facts = RUN | {
        "task": "direct",
        "warm_up_steps": 2,
        "gradient_limit": 1.0,
        "dropout": 0.1,
        "direct": SIZE,
    }
    return recipe_of(facts | changes)


def _transfer_recipe(**changes: object) -> Any:
    facts = RUN | {"task": "transfer", "latent_weight": 0.0, "image_weight": 1.0, "dropout": 0.1}
    return recipe_of(facts | {"warm_up_steps": 2, "gradient_limit": 1.0} | changes)


def _painted(maps: MapSet) -> MapSet:
    """Return the same objects in one color each, green twice as bright as red, in maps as in
    images.
    """
    share = np.array([0.4, 0.8, 0.6], np.float32)[:, None, None]
    return MapSet(
        maps.depth_m,
        maps.intensity[:, None] * share,
        (maps.image[:, None] * share).astype(np.float16),
    )


class Source:
    """Twelve objects, fewer than an epoch's samples."""

    def __init__(self, maps: MapSet | None = None) -> None:
        self.maps = maps or small_maps(12, 0)
        self.normal = CellNormal(color=self.maps.image.ndim == 4)
        self.noise: MapNoise | None = None
        depth_m, intensity = (
            torch.from_numpy(values) for values in (self.maps.depth_m, self.maps.intensity)
        )
        self.normal.learn(depth_m, intensity)
        self.batch = NormalBatch(
            self.normal(depth_m, intensity).half(), torch.from_numpy(self.maps.image)
        )

    def batches(self, batch: int, generator: torch.Generator) -> Iterable[NormalBatch]:
        for rows in torch.randperm(12, generator=generator).split(batch):
            yield NormalBatch(*(values[rows] for values in self.batch if values is not None))


def _shaken() -> DirectNetwork:
    """Return a network for these maps, of random parameters: residual blocks would otherwise start
    as nothing.
    """
    network = DirectNetwork(SIZE)
    network.normal.load_state_dict(Source().normal.state_dict())
    torch.manual_seed(1)
    for parameter in network.parameters():
        nn.init.normal_(parameter, 0, 0.2)
    return network.eval()


def test_answer_to_mirrored_maps_is_the_mirrored_answer() -> None:
    network = _shaken()
    normal = torch.randn(3, 2, 64, 80)
    logits = network.logits(normal)

    torch.testing.assert_close(network.logits(normal.flip(-2)), logits.flip(-2), rtol=0, atol=1e-5)
    assert float(logits.detach().std()) > 0.1
    assert (logits - logits.flip(-2)).abs().max() > 0.1


def test_mirror_linear_is_a_linear_layer_of_both_sides() -> None:
    layer = direct.MirrorLinear(5, 3)
    sides = torch.randn(4, 2, 5)
    own = (layer.even.weight + layer.odd.weight) / 2
    other = (layer.even.weight - layer.odd.weight) / 2
    top = 0.98 * (sides[:, 0] @ own.T + sides[:, 1] @ other.T) + 0.7 * layer.even.bias

    torch.testing.assert_close(layer(sides)[:, 0], top)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (9, 21), (40, 63), (63, 5)])
def test_each_pixel_has_its_place(row: int, column: int) -> None:
    """A head's bias moves the same pixel of every token: its rows count down above, up below the
    middle.
    """
    network = _shaken()
    normal = torch.zeros(1, 2, 64, 80)
    plain = network.logits(normal)
    within = (row if row < 32 else 63 - row) % 8
    with torch.no_grad():
        network.heads.bias[64 + 8 * within + column % 8] += 1  # the second head: depth
    moved = (network.logits(normal) - plain).abs() > 0.5

    assert moved[0, 1, row, column]
    assert int(moved.sum()) == 64


def test_cells_are_normalised_symmetrically_and_clipped() -> None:
    maps = small_maps(40, 0)
    normal = CellNormal()
    depth_m = torch.from_numpy(maps.depth_m.copy())
    intensity = torch.from_numpy(maps.intensity)
    depth_m[:, 3, 7] = torch.nan
    normal.learn(depth_m, intensity)
    values = normal(depth_m, intensity)

    assert (values[:, :, 3, 7] == 0).all()
    assert values.abs().max() <= direct.CLIP
    torch.testing.assert_close(normal(depth_m.flip(-2), intensity.flip(-2)), values.flip(-2))


def test_gain_of_a_frame_is_taken_out() -> None:
    normal = CellNormal()
    generator = torch.Generator().manual_seed(0)
    depth_m = 0.3 + 0.01 * torch.randn(30, 64, 80, generator=generator)
    busy = torch.linspace(0, 0.2, 80) * torch.randn(
        30, 64, 80, generator=generator
    )  # columns differ more and more
    intensity = 20 * torch.exp(busy)
    normal.learn(depth_m, intensity)

    assert float(normal.spread[1].min()) == pytest.approx(direct.MIN_LIGHT_SPREAD)

    for gain in (-1.0, 0.05, 0.7):
        brighter = torch.expm1(torch.log1p(intensity) + gain)
        torch.testing.assert_close(
            normal(depth_m, brighter), normal(depth_m, intensity), atol=1e-3, rtol=0
        )

    assert not normal(torch.full_like(depth_m, torch.nan), intensity).any()


def test_loss_is_least_at_the_truth() -> None:
    truth = torch.zeros(2, 64, 64)
    truth[:, 10:30, 20:50] = torch.linspace(0.2, 0.9, 30)

    def logits(surface: Tensor) -> Tensor:
        depth = torch.logit((truth - 0.1).clamp(1e-3) / 0.9)
        return torch.stack([torch.where(surface, 12.0, -12.0), depth], dim=1)

    exact = logits(truth > 0)

    assert float(two_heads_error(exact, truth)) < 1e-3
    torch.testing.assert_close(direct.image_from_logits(exact), truth, rtol=0, atol=1e-3)
    assert two_heads_error(logits(truth.roll(1, -1) > 0), truth) > 0.1
    assert two_heads_error(exact + torch.tensor([0.0, 0.5])[:, None, None], truth) > 0.05


def test_image_is_cut_where_the_expected_overlap_is_largest() -> None:
    """An object of which much is unsure is shown larger than one that is sure; nothing stays
    nothing.
    """
    share = torch.full((3, 64, 64), 0.01)
    share[:2, 20:40, 20:40] = 0.9
    share[0, 20:40, 40:44] = 0.4
    share[1, :, 40:] = 0.28
    share[1, 20:40, 40:44] = 0.4
    images = image_from_logits(torch.stack([torch.logit(share), torch.zeros_like(share)], dim=1))

    assert [int((image > 0).sum()) for image in images] == [400, 480, 0]


def test_color_is_learnt_by_the_same_two_heads(tmp_path: Path) -> None:
    recipe = _recipe(colour=True, epochs=25, dropout=0.0, average=0.0)
    source = Source(_painted(small_maps(12, 0)))
    network, figures = train_direct(recipe, source, _painted(small_maps(4, 1)), tmp_path)
    made = reconstruct(network, source.maps)

    assert made.shape == source.maps.image.shape

    found = color_metrics(made, source.maps.image.astype(np.float32))

    assert "held_out_colour_error" in figures
    assert found["silhouette_iou"].mean() > 0.5
    assert found["colour_error"].mean() < 0.2

    normal = source.batch.normal[:3].float()

    torch.testing.assert_close(
        network.logits(normal.flip(-2)), network.logits(normal).flip(-2), rtol=0, atol=1e-5
    )

    varied = vary(
        network.normal, normal, None, torch.full((3, 64, 80), 0.3), torch.full((3,), 0.01)
    )
    moved = (varied - normal) * network.normal.spread
    returns = (normal != 0).any(1) & (varied.abs() < 5).all(1)

    torch.testing.assert_close(
        moved[:, 0][returns], torch.full_like(moved[:, 0][returns], 0.01), atol=1e-4, rtol=0
    )
    assert float(moved[:, 1:].median()) >= 0

    save_direct(tmp_path, network, CheckpointRecord.of([recipe], ("paper-rig", "0" * 64)))
    again, record = load_network(tmp_path)

    assert (record.note, record.color) == (SIMULATION_ONLY, True)
    assert (
        float((np.abs(reconstruct(again, source.maps) - made) < 0.02).mean()) > 0.999
    )  # float16 moves an edge

    with pytest.raises(TrainingError, match="simulation only"):
        direct_start(_recipe(start="weights"), tmp_path)


def _train(
    folder: Path, running: Running | None = None, **changes: object
) -> tuple[DirectNetwork, Scores]:
    return train_direct(_recipe(**changes), Source(), small_maps(4, 1), folder, running)


def test_run_follows_its_recipe(tmp_path: Path) -> None:
    whole, _ = _train(tmp_path / "whole")
    for name, changes in (
        ("plain", {"average": 0.0}),
        ("varied", {"wall_texture": 0.05, "range_offset_m": 0.05}),
    ):
        assert changed_tensors(
            whole.state_dict(), _train(tmp_path / name, **changes)[0].state_dict()
        )


def test_training_goes_on_from_weights_that_grow(weights: Path, tmp_path: Path) -> None:
    """More blocks and mixers begin as nothing: the first epoch of no learning has the weights' own
    answers.
    """
    recipe = _recipe(
        start="weights",
        learning_rate=1e-7,
        dropout=0.0,
        epochs=1,
        direct=SIZE.model_copy(update={"mixers": 3}),
    )
    start, runs = direct_start(recipe, weights)

    assert runs == [_recipe()]

    grown, _ = train_direct(recipe, Source(), small_maps(4, 1), tmp_path, start=start)

    np.testing.assert_allclose(
        reconstruct(grown, Source().maps), reconstruct(start, Source().maps), atol=1e-3
    )
    assert direct_start(_recipe(), None) == (None, [])


def test_weights_of_another_rig_take_the_cells_of_their_new_one(
    weights: Path, tmp_path: Path
) -> None:
    """Their layers go on; a cell's median and spread are the new rig's."""
    start, _ = direct_start(_recipe(start="weights"), weights)
    nearer = Source(replace(small_maps(12, 0), depth_m=small_maps(12, 0).depth_m - 0.05))

    network, _ = train_direct(
        _recipe(start="weights"), nearer, small_maps(4, 1), tmp_path, start=start
    )

    assert torch.equal(network.normal.median, nearer.normal.median)
    assert not torch.equal(network.normal.median, start.normal.median)


def test_blend_is_the_mean_of_trained_and_earlier_weights(weights: Path, tmp_path: Path) -> None:
    start, _ = direct_start(_recipe(start="weights"), weights)
    made = list[tuple[DirectNetwork, Scores]]()
    for share in (1.0, 0.25):
        recipe = _recipe(start="weights", blend=share)
        made.append(
            train_direct(recipe, Source(), small_maps(4, 1), tmp_path / f"{share}", start=start)
        )
    (trained, plain), (blended, figures) = made
    before = start.state_dict()
    after = trained.state_dict()
    for name, found in blended.state_dict().items():
        torch.testing.assert_close(found, 0.75 * before[name] + 0.25 * after[name])

    assert (
        figures
        == figures_of(reconstruct(blended, small_maps(4, 1)), small_maps(4, 1).image)
        != plain
    )


def test_average_is_scored_and_kept_and_minutes_are_logged(tmp_path: Path) -> None:
    times = iter(range(0, 100000, 45))
    network, figures = _train(tmp_path, Running(clock=lambda: float(next(times))))
    truth = as_images(small_maps(4, 1).image)[:, 0].numpy()
    error = np.square(reconstruct(network, small_maps(4, 1)) - truth).sum((1, 2)).mean()

    assert figures["held_out_loss"] == pytest.approx(error, rel=1e-5)
    assert (tmp_path / BEST).exists()

    lines = (tmp_path / MINUTES).read_text(encoding="utf-8").splitlines()

    assert lines[0].split()[1:3] == ["epoch", "0"]
    assert "samples/s" in lines[-1]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("direct")
    save_direct(folder, _shaken(), CheckpointRecord.of([_recipe()], ("paper-rig", "0" * 64)))
    export_folder(folder)
    return folder


@pytest.mark.slow
def test_weights_are_exported_and_kept_apart_from_a_pipeline(weights: Path, tmp_path: Path) -> None:
    network, record = load_network(weights)

    assert record.runs == [_recipe()]

    maps = Source().maps
    images = load_reconstructor(weights, tmp_path)(maps.depth_m, maps.intensity)

    np.testing.assert_allclose(images, reconstruct(network, maps), atol=1e-5)

    told = load_reconstructor(weights, tmp_path).answer(maps.depth_m, maps.intensity)
    in_torch = TorchReconstructor(network, record, "cpu").answer(maps.depth_m, maps.intensity)
    for one, other in zip(told, in_torch, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)

    assert ((told.surface > direct.CUTS[-1]) <= (told.image > 0)).all()
    assert ((told.image > 0) <= (told.surface > direct.CUTS[0])).all()
    assert not [*tmp_path.iterdir()]

    stored = onnx.load(weights / "network.onnx", load_external_data=False).graph.initializer
    inline = [
        each.name
        for each in stored
        if len(each.dims) == 2 and each.data_location != TensorProto.EXTERNAL
    ]

    assert not inline  # no matrix is stored twice, the transposed ones included

    with pytest.raises(CheckpointError, match="direct network"):
        load_pipeline(weights)


@pytest.mark.parametrize("change", [{"width": 16}, {"mixers": 0}])
def test_start_refuses_weights_that_the_recipe_cannot_hold(
    weights: Path, change: dict[str, int]
) -> None:
    recipe = _recipe(start="weights", direct=SIZE.model_copy(update=change))
    with pytest.raises(TrainingError, match="not a part of the recipe's"):
        direct_start(recipe, weights)
    with pytest.raises(TrainingError, match="not hold a direct network"):
        direct_start(recipe, Path("paper"))


def test_maps_at_the_clip_stay_finite_on_any_wall() -> None:
    cells = CellNormal()
    cells.spread[:] = 5.0  # light that comes and goes: far below its median is below no light
    darkest = torch.full((2, 2, 64, 80), -5.0)
    brighter_wall = torch.full((2, 64, 80), 0.1)

    varied = vary(cells, darkest, None, brighter_wall, None)

    assert torch.isfinite(varied).all()


def test_varied_maps_are_those_of_another_wall_and_range() -> None:
    """Stains and an offset on normalised maps are what they would be on the maps themselves."""
    maps = small_maps(40, 0)
    normal = CellNormal()
    depth_m = torch.from_numpy(maps.depth_m)
    intensity = torch.from_numpy(maps.intensity)
    normal.learn(depth_m, intensity)
    reflectance = _stains(40, torch.device("cpu")) * 0.05
    offset_m = torch.linspace(-3e-3, 3e-3, 40)
    reflectance -= normal.log_gain(reflectance.expand(40, 64, 80))[
        :, None, None
    ]  # a frame's gain is taken out
    measured = normal(
        depth_m + offset_m[:, None, None], torch.expm1(torch.log1p(intensity)) * reflectance.exp()
    )
    varied = vary(normal, normal(depth_m, intensity), None, reflectance, offset_m)

    assert float((measured - varied).abs().median()) < 0.02
    torch.testing.assert_close(vary(normal, varied, None, None, None), varied, atol=1e-4, rtol=0)


def test_stains_have_mean_0_and_variance_1_and_half_are_grain() -> None:
    patterns = _stains(200, torch.device("cpu"))

    assert float(patterns.mean()) == pytest.approx(0, abs=0.03)
    assert float(patterns.var()) == pytest.approx(1, abs=0.05)

    neighbours = (patterns[..., 1:] * patterns[..., :-1]).mean()

    assert 0.4 < float(neighbours) < 0.6  # half stains, half grain


def test_shift_follows_another_bench_and_nothing_else() -> None:
    maps = small_maps(40, 0)
    normal = CellNormal()
    shifted = CellNormal()
    depth_m = torch.from_numpy(maps.depth_m)
    intensity = torch.from_numpy(maps.intensity)
    normal.learn(depth_m, intensity)
    shifted.load_state_dict(normal.state_dict())
    shifted.shift(depth_m, intensity)

    torch.testing.assert_close(shifted.median, normal.median, rtol=0, atol=0.1)

    shifted.load_state_dict(normal.state_dict())
    brighter = torch.expm1(torch.log1p(intensity) + 0.4)  # a gain
    shifted.shift(depth_m + 0.03, brighter, slice(1, None))
    change = shifted.median - normal.median

    assert (change[0] == 0).all()
    torch.testing.assert_close(change[1], torch.full_like(change[1], float(change[1, 0, 0])))
    assert float(change[1, 0, 0]) == pytest.approx(0.4, abs=0.1)


def test_transfer_takes_statistics_to_the_device_of_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = _shaken()
    shifted: list[torch.device] = []
    network.normal.to("meta")  # which refuses tensors of another device, as a GPU does

    def stop(normal: CellNormal, depth_m: Tensor, intensity: Tensor, _: slice) -> None:
        del normal
        shifted.extend([depth_m.device, intensity.device])
        raise KeyboardInterrupt

    monkeypatch.setattr(CellNormal, "shift", stop)
    recipe = _transfer_recipe(all_layers_epochs=1, epochs=1, average=0.0)
    recipe = recipe.model_copy(update={"statistics": "own intensity"})
    with suppress(KeyboardInterrupt):
        transfer_direct(recipe, network, InMemory(Source().maps), small_maps(4, 1), tmp_path)

    assert [device.type for device in shifted] == ["meta", "meta"]


def test_transfer_learns_the_bench_in_two_phases_and_resumes(tmp_path: Path) -> None:
    def go(folder: Path, running: Running | None = None) -> tuple[DirectNetwork, float]:
        recipe = _transfer_recipe(all_layers_epochs=12, epochs=3, average=0.0)
        after, figures = transfer_direct(
            recipe, _shaken(), InMemory(Source().maps), small_maps(4, 1), folder, running
        )
        return after, figures["held_out_loss"]

    network, loss = go(tmp_path / "whole")

    assert (
        loss
        < figures_of(reconstruct(_shaken(), small_maps(4, 1)), small_maps(4, 1).image)[
            "held_out_loss"
        ]
    )

    first = torch.load(
        io.BytesIO((tmp_path / "whole" / "all-layers" / LAST).read_bytes()[32:]), weights_only=True
    )
    last = {
        name
        for name, values in network.state_dict().items()
        if not torch.equal(values, first["module"][name])
    }

    assert {name.partition(".")[0] for name in last} <= {"norm", "heads"}

    with pytest.raises(KeyboardInterrupt):
        go(tmp_path / "cut", Running(stop=iter([False] * 20 + [True]).__next__))

    resumed, again = go(tmp_path / "cut")

    assert again == loss
    assert not changed_tensors(network.state_dict(), resumed.state_dict())


@pytest.mark.slow
def test_transfer_of_direct_weights_is_saved_with_both_runs(weights: Path, tmp_path: Path) -> None:
    recipe = _transfer_recipe(all_layers_epochs=1, epochs=1)
    network, start = transfer_start(recipe, weights, partial=False, on_report=pytest.fail)
    record = record_run(recipe, tmp_path / "out", ("paper-rig", "0" * 64), start.runs, weights)
    job = TrainingRun(recipe, tmp_path / "out", record)
    figures = run_transfer(
        open_fabric(recipe), job, network, None, InMemory(Source().maps), small_maps(4, 1)
    )

    assert set(figures) == {"before", "after"}
    assert load_record(tmp_path / "out").runs == [*start.runs, recipe]

    maps = Source().maps
    (loaded, _) = load_network(tmp_path / "out")
    images = load_reconstructor(tmp_path / "out", tmp_path)(maps.depth_m, maps.intensity)

    np.testing.assert_allclose(images, reconstruct(loaded, maps), atol=1e-5)
