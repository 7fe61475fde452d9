"""`train` on rendered datasets, in color and of depth: both steps, streams, and refused
combinations of the two.
"""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from nlos_calibration import load_rig
from nlos_models import SIMULATION_ONLY, load_pipeline, load_reconstructor, load_record
from nlos_models.errors import CheckpointError
from nlos_models.training import MapSet, load_encoder, load_vae, run
from small_run import log_rows

from nlos_cam.cli.main import main
from nlos_cam.dataset import DatasetPlan, open_dataset
from nlos_cam.dataset.samples import make_samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError
from nlos_cam.objects import TEXTURES

pytestmark = [pytest.mark.usefixtures("narrow_networks", "one_thread"), pytest.mark.slow]

BASE = "objects = 2\nheld_out = 2\nepochs = 3\nbatch = 2\nlearning_rate = 1e-3\n"
IMAGE = "image_weight = 1\n"
RECIPES = {
    "vae": 'task = "vae"\ncolour = true\n',
    "vae-of-depth": 'task = "vae"\n',
    "compressor": 'task = "compressor"\ncolour = true\n' + IMAGE,
    "compressor-on": 'task = "compressor"\ncolour = true\nstart = "weights"\n' + IMAGE,
    "compressor-of-depth": 'task = "compressor"\n' + IMAGE,
    "transfer-of-depth": 'task = "transfer"\n' + IMAGE,
}
Run = Callable[..., Any]


@pytest.fixture(scope="module")
def folder(one_thread: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, training and held-out datasets in color and of depth, and a VAE of each."""
    del one_thread
    folder = tmp_path_factory.mktemp("color")
    for name, textures in (("data", tuple(TEXTURES)), ("depth", ())):
        for seed, of in ((40, name), (50, f"{name}-held-out")):
            plan = DatasetPlan(load_rig("paper-rig"), seed, accuracy="draft", textures=textures)
            (folder / of).mkdir()
            samples = make_samples(plan, range(seed, seed + 2))
            store(shard_path(folder / of, seed), samples, plan.provenance, "")
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text + BASE, encoding="utf-8")
    for name in ("vae", "vae-of-depth"):
        recipe = str(folder / f"{name}.toml")
        assert main(["train", "vae", "--recipe", recipe, "--out", str(folder / name)]) == 0
    return folder


@pytest.fixture
def go(folder: Path, out: Path, run: Run) -> Run:
    def train(recipe: str, *flags: str, data: str = "data", code: int = 0, **options: str) -> Any:
        named = {
            "recipe": f"{recipe}.toml",
            "dataset": data,
            "held-out": f"{data}-held-out",
            **options,
        }
        paths = [part for name, value in named.items() for part in (f"--{name}", folder / value)]
        return run(
            "train", recipe.split("-", maxsplit=1)[0], "--out", out, *paths, *flags, code=code
        )

    return train


class Trained(NamedTuple):
    """A compressor of color, trained from a VAE."""

    answer: dict[str, Any]
    vae: Path
    held_out: MapSet


@pytest.fixture
def trained(go: Run, folder: Path) -> Trained:
    answer = go("compressor", "--tensorboard", vae="vae")
    held_out = open_dataset(folder / "data-held-out", color=True).arrays()
    return Trained(answer, folder / "vae", held_out)


def test_color_training_is_noted_as_simulation_only(trained: Trained, out: Path) -> None:
    record = load_record(out)

    assert trained.answer["note"] == SIMULATION_ONLY
    assert (record.color, record.note) == (True, SIMULATION_ONLY)

    with pytest.raises(CheckpointError, match="simulation only"):
        load_reconstructor(out, out.with_name("onnx"))


def test_color_training_makes_images_in_color(trained: Trained, out: Path) -> None:
    images = run(load_pipeline(out)[0], trained.held_out)

    assert images.shape == trained.held_out.image.shape == (2, 3, 64, 64)


def test_color_training_takes_encoder_and_recipe_of_its_vae(trained: Trained, out: Path) -> None:
    encoder = load_encoder(out)
    vae = load_vae(trained.vae)[0]

    torch.testing.assert_close(encoder.state_dict(), vae.encoder.state_dict(), rtol=0, atol=0)
    assert load_record(out).vae_recipe == load_record(trained.vae).vae_recipe


def test_color_training_logs_a_falling_loss(trained: Trained, out: Path) -> None:
    assert (out / "tensorboard").is_dir()
    for log in (log_rows(out), log_rows(trained.vae)):
        assert float(log[-1]["loss"]) < float(log[0]["loss"])


def test_color_training_records_the_figures_it_prints(trained: Trained, out: Path) -> None:
    names = {"held_out_loss", "held_out_iou", "held_out_colour_error"}
    figures = load_record(out).figures

    assert figures.keys() == names == trained.answer.keys() - {"out", "note"}
    assert figures == {name: trained.answer[name] for name in names}


def test_finished_color_training_answers_again(go: Run, trained: Trained) -> None:
    assert go("compressor", vae="vae") == trained.answer


@pytest.fixture
def first(trained: Trained, folder: Path, out: Path) -> Iterator[Path]:
    """The trained weights as the start of others."""
    del trained
    moved = out.rename(folder / "first")
    yield moved
    shutil.rmtree(moved)


def test_color_training_continues_from_weights(go: Run, first: Path, out: Path) -> None:
    go("compressor-on", "--stream", vae="vae", weights=first.name)

    assert [run.start for run in load_record(out).runs] == ["scratch", "scratch", "weights"]


def test_training_of_depth_refuses_weights_of_color(go: Run, first: Path) -> None:
    refused = go("transfer-of-depth", data="depth", weights=first.name, code=1)

    message = refused["error"]["message"]

    assert str(first) in message
    assert "simulation only" in message


@pytest.mark.parametrize(
    ("recipe", "options", "code", "word"),
    [
        ("compressor", {}, 1, "simulation only"),
        ("compressor", {"data": "depth", "vae": "vae"}, 4, "depth"),
        ("compressor-on", {"vae": "vae"}, 1, "simulation only"),
        ("compressor-of-depth", {"vae": "vae"}, 1, "simulation only"),
        ("compressor-of-depth", {"vae": "vae-of-depth"}, 4, "simulation only"),
        ("compressor-of-depth", {"vae": "data"}, 4, "data"),
    ],
)
def test_train_refuses_mixture_of_depth_and_color(
    go: Run, folder: Path, out: Path, recipe: str, options: dict[str, str], code: int, word: str
) -> None:
    with pytest.raises(RecordingError, match="simulation only"):
        open_dataset(folder / "data")

    assert word in go(recipe, **options, code=code)["error"]["message"]
    assert not out.exists()
