"""Inference: ONNX Runtime held equal to torch, exports that are cached."""

import shutil
import sys
import tomllib
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from nlos_models import errors, export, inference
from nlos_models.checkpoint import load_network, load_pipeline
from nlos_models.compressor import Compressor
from nlos_models.direct import DirectNetwork
from nlos_models.errors import CheckpointError, MissingExtraError, ModelError
from nlos_models.export import TorchReconstructor
from nlos_models.inference import (
    OnnxReconstructor,
    Reconstructor,
    load_reconstructor,
    load_uncertainty_model,
)
from nlos_models.metrics import MIN_V
from nlos_models.pipeline import RemappingNetwork, split_and_stack
from nlos_models.records import (
    SHIPPED,
    checksum_of_watched,
    shipped_folder,
    weights_folder,
)
from nlos_models.training import checkpoints
from nlos_models.training.checkpoints import save_pipeline
from nlos_models.training.recipe import DirectSize
from nlos_models.uncertainty_network import load_uncertainty_network
from nlos_models.vae import Decoder
from small_maps import HARD_MAPS, hard_maps, noise_maps
from small_run import small_record

pytestmark = pytest.mark.usefixtures("one_thread")

RECORD = small_record()
HANDFUL = 8
"""Pixels of an image that may fall to the other side of the silhouette's threshold."""
Pair = tuple[Reconstructor, Reconstructor]


@pytest.fixture(autouse=True, scope="module")
def _no_gpu() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inference, "_has_cuda", lambda: False)
        yield


@pytest.fixture(scope="module")
def pipeline() -> RemappingNetwork:
    torch.manual_seed(0)
    made = RemappingNetwork(Compressor(), Decoder())
    maps = [torch.from_numpy(m) for m in noise_maps(8)]
    made.preprocess.learn(split_and_stack(*maps))
    with torch.no_grad():
        made.train()(*maps)  # statistics that are not those of a new network
        features = made.eval().decoder.blocks(made.latent(*maps)[:, :, None, None])
        logits = made.decoder.output(features)
        output = made.decoder.output
        output.bias.copy_(
            2 * (output.bias - logits.mean()) / logits.std()
        )  # an image with contrast: it has edges
        output.weight.mul_(2 / logits.std())
    return made


@pytest.fixture(scope="module")
def folders(
    pipeline: RemappingNetwork, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    weights = tmp_path_factory.mktemp("weights")
    cache = tmp_path_factory.mktemp("cache")
    save_pipeline(weights, pipeline, RECORD)
    return weights, cache


@pytest.fixture(scope="module")
def pair(folders: tuple[Path, Path]) -> Pair:
    """The exported pipeline, and the same weights in torch."""
    return load_reconstructor(*folders), TorchReconstructor(*load_pipeline(folders[0]), "cpu")


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 5])
def test_onnx_reconstruction_equals_torch(pair: Pair, batch: int) -> None:
    assert isinstance(pair[0], OnnxReconstructor)
    assert pair[0].record == pair[1].record == RECORD
    assert pair[0].runtime != pair[1].runtime

    maps = noise_maps(batch)
    mine, its = (reconstructor(*maps) for reconstructor in pair)
    for image, reconstructor in zip((mine, its), pair, strict=True):
        strided = reconstructor(*(np.asfortranarray(part) for part in maps))
        np.testing.assert_allclose(strided, image, atol=1e-6)

    assert mine.shape == its.shape == (batch, 64, 64)
    assert mine.dtype == its.dtype == np.float32

    both = (mine > 0) & (its > 0)

    assert ((mine > 0) != (its > 0)).sum((1, 2)).max() <= HANDFUL
    assert 0 < both.mean() < 1
    np.testing.assert_allclose(mine[both], its[both], atol=1e-4)


@pytest.mark.slow
def test_network_is_exported_once(
    folders: tuple[Path, Path], pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = noise_maps(1)
    monkeypatch.setattr(export, "export_onnx", lambda _: pytest.fail("exported again"))

    np.testing.assert_array_equal(load_reconstructor(*folders)(*maps), pair[0](*maps))
    assert [path.suffix for path in folders[1].iterdir()] == [".onnx"]


@pytest.mark.slow
def test_image_of_hard_maps_is_a_possible_one(pair: Pair) -> None:
    for name, reconstructor in product(HARD_MAPS, pair):
        image = reconstructor(*(part.numpy() for part in hard_maps(name)))
        assert ((image == 0) | ((image >= MIN_V) & (image <= 1))).all(), name


def test_color_networks_are_not_exported(
    pipeline: RemappingNetwork,
) -> None:
    color = RemappingNetwork(pipeline.compressor, Decoder(3, 512), intensities=3)
    with pytest.raises(ModelError, match="simulation only"):
        export.export_onnx(color)
    with pytest.raises(ModelError, match="simulation only"):
        export.export_onnx(DirectNetwork(color=True))


def test_exports_are_named_by_their_weights(pipeline: RemappingNetwork) -> None:
    before = export.checksum_of(pipeline)

    assert export.checksum_of(pipeline) == before
    assert export.checksum_of(RemappingNetwork(pipeline.compressor, Decoder())) != before


@pytest.mark.slow
def test_trace_of_an_architecture_serves_other_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    size = DirectSize(features=8, width=8, blocks=1, token=8, mixers=1)
    first, second = (DirectNetwork(size).eval() for _ in range(2))
    maps = noise_maps(3)
    export.export_onnx(first)
    with monkeypatch.context() as patch:
        patch.setattr(export, "_trace", lambda *_: pytest.fail("traced again"))
        graph = OnnxReconstructor(export.export_onnx(second), RECORD)

    found = graph.answer(*maps)
    wanted = TorchReconstructor(second, RECORD, "cpu").answer(*maps)
    np.testing.assert_allclose(found.surface, wanted.surface, atol=1e-5)
    np.testing.assert_allclose(found.image, wanted.image, atol=1e-4)

    second.norm.eps = 1.0  # of the same weights, another function
    other = OnnxReconstructor(export.export_onnx(second), RECORD)
    assert not np.allclose(other.answer(*maps).surface, wanted.surface, atol=1e-3)


@pytest.mark.slow
def test_linked_graphs_equal_full_exports_bit_for_bit(
    folders: tuple[Path, Path], pair: Pair, tmp_path: Path
) -> None:
    weights = Path(shutil.copytree(folders[0], tmp_path / "weights"))
    maps = noise_maps(3)
    (graph,) = export.export_folder(weights)

    assert graph.stat().st_size < 400_000

    linked = load_reconstructor(weights, tmp_path / "unused")

    np.testing.assert_array_equal(linked(*maps), pair[0](*maps))
    assert not (tmp_path / "unused").exists()

    content = bytearray((weights / "compressor.safetensors").read_bytes())
    content[-1] ^= 1  # the graph still opens
    (weights / "compressor.safetensors").write_bytes(content)

    with pytest.raises(CheckpointError, match="other weights"):
        OnnxReconstructor(graph, RECORD, checksum=checksum_of_watched(weights))


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_graphs_equal_shipped_checkpoint_in_torch(name: str) -> None:
    """The images to within 1e-4, and at most a handful of pixels on the other side of the
    silhouette's threshold.
    """
    rows, columns = np.mgrid[:64, :80]  # of a slanted wall, with a brighter patch that moves
    patch = np.exp(-(((rows - 32) / 12) ** 2) - ((columns - 30) / 15) ** 2)
    depth_m = np.stack([0.2 + 0.004 * columns + 0.01 * k for k in range(3)]).astype(np.float32)
    maps = (
        depth_m,
        np.stack([10 + 30 * np.roll(patch, 6 * k, 1) for k in range(3)]).astype(np.float32),
    )
    shipped = shipped_folder(name)
    network = load_reconstructor(shipped, Path("unused"))
    uncertainty = load_uncertainty_model(shipped, Path("unused"))

    assert isinstance(network, OnnxReconstructor)

    mine = network(*maps)
    its = TorchReconstructor(*load_network(shipped), "cpu")(*maps)
    both = (mine > 0) & (its > 0)

    assert ((mine > 0) != (its > 0)).sum((1, 2)).max() <= HANDFUL
    assert both.mean() > 0
    np.testing.assert_allclose(mine[both], its[both], atol=1e-4)

    reference = load_uncertainty_network(shipped)
    with torch.inference_mode():
        theirs = reference[0](*(torch.from_numpy(part) for part in (*maps, mine)))
    for said, wanted in zip(uncertainty(*maps, mine), theirs, strict=True):
        np.testing.assert_allclose(said, wanted, rtol=1e-3, atol=1e-5)


def test_weights_without_graph_need_torch_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in shipped_folder().glob("*.*"):
        if path.suffix != ".onnx":
            (tmp_path / path.name).symlink_to(path)

    assert errors.require("json", "reading").__name__ == "json"

    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        errors.require("no_such_module", "reading")

    monkeypatch.setitem(sys.modules, "nlos_models.export", None)
    without_torch = Mock(side_effect=ModuleNotFoundError("No module named 'torch'", name="torch"))
    monkeypatch.setattr(errors, "import_module", without_torch)
    for load in (load_reconstructor, load_uncertainty_model):
        with pytest.raises(
            MissingExtraError, match=r"onnx.* torch.*pip install \"nlos-cam\[train\]\""
        ) as found:
            load(tmp_path, tmp_path / "cache")
        assert "\n" not in str(found.value)

    with pytest.raises(MissingExtraError, match="training needs torch"):
        errors.require("nlos_models.training.loop", "training")


def test_paper_vae_names_the_command_that_makes_its_encoder() -> None:
    with pytest.raises(CheckpointError, match=r"encoder.*train vae --recipe vae-encoder"):
        checkpoints.load_vae()
    assert checkpoints.load_encoder() is None


def test_folder_without_a_record_is_no_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        load_reconstructor(tmp_path / "other", tmp_path)


def test_wheel_holds_all_shipped_weights() -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text("utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]

    assert "models/nlos_models" in wheel["packages"]
    assert "exclude" not in wheel
    assert all((shipped_folder(name) / "network.onnx").exists() for name in SHIPPED)


def test_weights_by_name_give_way_to_a_folder_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    assert weights_folder(None) == shipped_folder() == weights_folder(Path("direct"))

    name = Path("paper")

    assert weights_folder(name) == weights_folder(None, "paper") == shipped_folder("paper")

    name.mkdir()

    assert weights_folder(name) == name
    assert weights_folder(tmp_path / "other") == tmp_path / "other"
