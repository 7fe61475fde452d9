"""`train` on rendered datasets, in color and of depth: both steps, streams, and refused
combinations of the two.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from nlos_calibration import load_rig
from nlos_models import SIMULATION_ONLY, load_pipeline, load_reconstructor, load_record
from nlos_models.errors import CheckpointError
from nlos_models.training import load_encoder, load_vae, run
from small_run import log_rows

from nlos_cam.cli.main import main
from nlos_cam.dataset import DatasetPlan, open_dataset
from nlos_cam.dataset.samples import make_samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError
from nlos_cam.objects import TEXTURES

pytestmark = [pytest.mark.usefixtures("narrow_networks", "one_thread"), pytest.mark.slow]

BASE = "objects = 2\nheld_out = 2\nepochs = 3\nbatch = 2\nlearning_rate = 1e-3\nimage_weight = 1\n"
RECIPES = {
    "vae": 'task = "vae"\ncolour = true\n',
    "vae-of-depth": 'task = "vae"\n',
    "compressor": 'task = "compressor"\ncolour = true\n',
    "compressor-on": 'task = "compressor"\ncolour = true\nstart = "weights"\n',
    "compressor-of-depth": 'task = "compressor"\n',
    "transfer-of-depth": 'task = "transfer"\n',
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
            store(
                shard_path(folder / of, seed),
                make_samples(plan, range(seed, seed + 2)),
                plan.provenance,
                "",
            )
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text + BASE, encoding="utf-8")
    for name in ("vae", "vae-of-depth"):
        assert (
            main(
                [
                    "train",
                    "vae",
                    "--recipe",
                    str(folder / f"{name}.toml"),
                    "--out",
                    str(folder / name),
                ]
            )
            == 0
        )
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


def test_color_training_notes_simulation_and_continues(go: Run, folder: Path, out: Path) -> None:
    answer = go("compressor", "--tensorboard", vae="vae")
    assert (out / "tensorboard").is_dir()
    assert answer["note"] == SIMULATION_ONLY
    pipeline, record = load_pipeline(out)
    held_out = open_dataset(folder / "data-held-out", color=True).arrays()
    assert run(pipeline, held_out).shape == held_out.image.shape == (2, 3, 64, 64)
    encoder = load_encoder(out)
    vae = load_vae(folder / "vae")[0]
    torch.testing.assert_close(encoder.state_dict(), vae.encoder.state_dict(), rtol=0, atol=0)
    with pytest.raises(CheckpointError, match="simulation only"):
        load_reconstructor(out, out.with_name("onnx"))
    for log in (log_rows(out), log_rows(folder / "vae")):
        assert float(log[-1]["loss"]) < float(log[0]["loss"])
    assert set(record.figures) == {"held_out_loss", "held_out_iou", "held_out_colour_error"}
    assert record.figures == {
        name: value for name, value in answer.items() if name not in {"out", "note"}
    }
    assert (record.color, record.note) == (True, SIMULATION_ONLY)
    assert record.vae_recipe == load_record(folder / "vae").vae_recipe
    assert go("compressor", vae="vae") == answer  # it had finished
    out.rename(folder / "first")
    go("compressor-on", "--stream", vae="vae", weights="first")
    assert [run.start for run in load_record(out).runs] == ["scratch", "scratch", "weights"]
    refused = go("transfer-of-depth", data="depth", weights="first", code=1)["error"]["message"]
    assert all(word in refused for word in (str(folder / "first"), "simulation only"))


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
