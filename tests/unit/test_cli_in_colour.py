"""Colour as commands run it: datasets, both steps, weights that load, and what does not belong together."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import load_pipeline, load_record
from nlos_models.recipe import SIMULATION_ONLY, load_recipe

from nlos_cam.cli.main import main
from nlos_cam.dataset import build
from nlos_cam.dataset.samples import make_samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.dataset.training_maps import read_maps
from nlos_cam.errors import RecordingError
from nlos_cam.objects.textures import TEXTURES

pytestmark = pytest.mark.usefixtures("narrow_networks")

BASE = "objects = 2\nheld_out = 2\nepochs = 1\nbatch = 2\nlearning_rate = 1e-3\nimage_weight = 1\n"
RECIPES = {
    "vae": 'task = "vae"\ncolour = true\n',
    "compressor": 'task = "compressor"\ncolour = true\n',
    "compressor-on": 'task = "compressor"\ncolour = true\nstart = "weights"\n',
    "compressor-of-depth": 'task = "compressor"\n',
    "transfer-of-depth": 'task = "transfer"\n',
}
Answer = dict[str, Any]
Go = Callable[..., tuple[int, Answer]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, datasets in colour and of depth with what they are judged by, and a VAE in colour."""
    folder, threads = tmp_path_factory.mktemp("colour"), torch.get_num_threads()
    for name, textures in (("data", tuple(TEXTURES)), ("depth", ())):
        for seed, of in ((40, name), (50, f"{name}-held-out")):
            plan = build.DatasetPlan(load_rig("paper-rig"), seed, accuracy="draft", textures=textures)
            (folder / of).mkdir()
            store(shard_path(folder / of, seed), make_samples(plan, range(seed, seed + 2)), plan.provenance, "")
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text + BASE, encoding="utf-8")
    torch.set_num_threads(1)
    assert main(["train", "vae", "--recipe", str(folder / "vae.toml"), "--out", str(folder / "vae")]) == 0
    torch.set_num_threads(threads)
    return folder


@pytest.fixture
def go(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Go:
    def train(recipe: str, *flags: str, data: str = "data", **options: str) -> tuple[int, Answer]:
        maps = ["--dataset", str(folder / data), "--held-out", str(folder / f"{data}-held-out"), *flags]
        named = [part for name, value in options.items() for part in (f"--{name}", str(folder / value))]
        task, out = recipe.split("-", maxsplit=1)[0], tmp_path / "out"
        code = main(["train", task, "--recipe", f"{folder / recipe}.toml", "--out", str(out), *maps, *named, "--json"])
        return code, json.loads(capsys.readouterr().out.splitlines()[-1])

    return train


def test_both_steps_leave_a_pipeline_that_loads_says_what_it_is_and_goes_on(
    go: Go, folder: Path, tmp_path: Path
) -> None:
    code, answer = go("compressor", vae="vae")
    assert (code, answer["note"]) == (0, SIMULATION_ONLY)
    _, record = load_pipeline(tmp_path / "out")
    assert record.figures == {name: value for name, value in answer.items() if name not in {"out", "note"}}
    assert record.colour
    assert record.note == SIMULATION_ONLY
    assert record.vae_recipe == load_record(folder / "vae").vae_recipe
    assert go("compressor", vae="vae") == (code, answer)  # it was through
    (tmp_path / "out").rename(folder / "first")
    assert go("compressor-on", vae="vae", weights="first")[0] == 0
    assert [run.start for run in load_record(tmp_path / "out").runs] == ["scratch", "scratch", "weights"]
    assert go("transfer-of-depth", data="depth", weights="first")[1]["error"]["message"].startswith(
        f"{folder / 'first'} holds weights in colour (simulation only"
    )


def test_a_stream_in_colour_trains_on_the_maps_that_memory_does(go: Go, tmp_path: Path) -> None:
    assert go("compressor", "--stream", "--tensorboard", vae="vae")[0] == 0
    streamed, record = load_pipeline(tmp_path / "out")
    assert (tmp_path / "out" / "tensorboard").is_dir()
    (tmp_path / "out").rename(tmp_path / "streamed")
    assert go("compressor", vae="vae")[0] == 0
    held, same = load_pipeline(tmp_path / "out")
    assert torch.equal(streamed.preprocess.mean, held.preprocess.mean)
    assert record.runs == same.runs


@pytest.mark.parametrize(
    ("recipe", "options", "code", "words"),
    [
        ("compressor", {}, 1, "what is shipped holds weights of depth, the recipe is in colour (simulation only"),
        ("compressor", {"data": "depth", "vae": "vae"}, 4, "holds a dataset of depth: make one with"),
        ("compressor-on", {"vae": "vae"}, 1, "what is shipped holds weights of depth"),
        ("compressor-of-depth", {"vae": "vae"}, 1, "vae holds weights in colour (simulation only"),
    ],
)
def test_what_does_not_belong_together_is_one_line(
    go: Go, tmp_path: Path, recipe: str, options: dict[str, str], code: int, words: str
) -> None:
    ended, answer = go(recipe, **options)
    assert (ended, words in answer["error"]["message"]) == (code, True), answer
    assert not (tmp_path / "out").exists()


def test_what_reads_datasets_of_depth_refuses_one_in_colour(folder: Path) -> None:
    recipe = load_recipe(folder / "compressor-of-depth.toml")
    reads = (lambda: build.read(folder / "data"), lambda: read_maps(recipe, folder / "data", folder / "depth", None))
    for read in reads:
        with pytest.raises(RecordingError, match=r"data holds a dataset in colour \(simulation only"):
            read()
