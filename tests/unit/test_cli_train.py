"""`train`: recipes and data to weights with their record, on small networks."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import torch
from nlos_calibration.arrays import Float16
from nlos_calibration.rig import load_rig
from nlos_models import checkpoint, runs, tasks
from nlos_models.checkpoint import load_pipeline, load_record
from safetensors.torch import load_file, save_file
from small_maps import SmallDataset, small_images, small_maps, use_small_networks

from nlos_cam.cli.main import main
from nlos_cam.dataset import build, training_maps
from nlos_cam.objects.generators import CATEGORIES

PLAN = build.DatasetPlan(load_rig("paper-rig"), 0)
COUNTS = {"data": 8, "held-out": 4}
BASE = "objects = 8\nheld_out = 4\nepochs = 2\nbatch = 4\nlearning_rate = 1e-3\n"
LOSS = "latent_weight = 0.05\nimage_weight = 1.0\n"
RECIPES = {
    "vae": 'task = "vae"\n' + BASE,
    "two": 'task = "compressor"\n' + BASE + LOSS,
    "one": 'task = "compressor"\nsteps = "one"\nlatent_weight = 0\nimage_weight = 1\n' + BASE,
    "joint": 'task = "compressor"\nsteps = "two-then-joint"\n' + BASE + LOSS,
    "difference": 'task = "compressor"\nmaps = "difference maps"\n' + BASE + LOSS,
    "transfer": 'task = "transfer"\nstatistics = "own"\nall_layers_epochs = 1\n' + BASE + LOSS,
}
Answer = dict[str, Any]
Go = Callable[..., tuple[int, Answer]]


@pytest.fixture(autouse=True, scope="module")
def _small_networks_and_data() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        use_small_networks(patch, tasks, checkpoint, runs)
        sets = {name: SmallDataset(small_maps(count, len(name)), PLAN) for name, count in COUNTS.items()}
        patch.setattr(build, "open_dataset", lambda of, **_: sets[of.name])
        patch.setattr(build, "procedural_images", lambda seed, count, *_, **__: small_images(count, seed))
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, a VAE, and two-step weights."""
    folder = tmp_path_factory.mktemp("train")
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    assert main(["train", "vae", "--recipe", str(folder / "vae.toml"), "--out", str(folder / "vae")]) == 0
    assert main(_arguments(folder, "two", folder / "two", "--vae", str(folder / "vae"))) == 0
    return folder


def _arguments(folder: Path, recipe: str, out: Path, *options: str) -> list[str]:
    task = {"vae": "vae", "transfer": "transfer"}.get(recipe, "compressor")
    maps = [] if task == "vae" else ["--dataset", "data", "--held-out", "held-out"]
    return ["train", task, "--recipe", str(folder / f"{recipe}.toml"), "--out", str(out), *maps, *options, "--json"]


@pytest.fixture
def go(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Go:
    def run(recipe: str, *options: str) -> tuple[int, Answer]:
        code = main(_arguments(folder, recipe, tmp_path / "out", *options))
        lines = capsys.readouterr().out.splitlines()
        return code, json.loads(lines[-1]) if lines else {}

    return run


def _same_file(part: str, one: Path, other: Path) -> bool:
    mine, its = ((folder / f"{part}.safetensors").read_bytes() for folder in (one, other))
    return mine == its


def test_a_vaes_answer_is_its_folder_and_figures(go: Go, tmp_path: Path) -> None:
    code, answer = go("vae", "--tensorboard")
    assert (code, set(answer)) == (0, {"out", "held_out_loss", "held_out_iou"})
    assert (tmp_path / "out" / "tensorboard").is_dir()
    assert load_record(tmp_path / "out").figures["held_out_loss"] == answer["held_out_loss"]


def test_a_tenth_of_the_budget_and_fewer_objects_are_on_record(go: Go, tmp_path: Path) -> None:
    assert go("vae", "--budget", "0.5", "--objects", "6")[0] == 0
    recipe = load_record(tmp_path / "out").vae_recipe
    assert recipe is not None
    assert (recipe.epochs, recipe.objects) == (1, 6)
    assert "0.5 of the budget" in recipe.deviations[-1]


def test_a_vae_is_shown_the_kinds_that_its_recipe_does_not_leave_out(
    go: Go, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[set[str]] = []

    def images(
        seed: int, count: int, _: object, kinds: tuple[str, ...], *, backgrounds: float, **__: object
    ) -> Float16:
        shown.append({*kinds, f"{backgrounds}"})
        return small_images(count, seed)

    monkeypatch.setattr(build, "procedural_images", images)
    (folder / "vae.toml").write_text(RECIPES["vae"] + 'left_out = ["car", "boat"]\nbackgrounds = 0.25\n')
    assert go("vae")[0] == 0
    (folder / "vae.toml").write_text(RECIPES["vae"])
    assert shown == [{*CATEGORIES, "0.25"} - {"car", "boat"}] * 2


def test_an_interrupted_run_is_130_says_so_and_goes_on_to_the_same_weights(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, told = Event(), list[str]()
    stop.set()
    with monkeypatch.context() as patch:
        patch.setattr(runs, "stop_on_signals", lambda: nullcontext(stop))
        patch.setattr(runs, "say", told.append)
        assert go("vae")[0] == 130
    assert told == ["stopped in epoch 0: the same command goes on from step 1"]
    assert not (tmp_path / "out" / "decoder.safetensors").exists()
    assert go("vae")[0] == 0
    assert _same_file("encoder", tmp_path / "out", folder / "vae")
    assert _same_file("decoder", tmp_path / "out", folder / "vae")


def test_two_step_weights_know_both_recipes_and_take_the_encoder_along(folder: Path) -> None:
    record = load_record(folder / "two")
    assert [run.task for run in record.runs] == ["vae", "compressor"]
    assert (record.rig_checksum, record.input) == (PLAN.rig.checksum, "raw maps")
    assert _same_file("encoder", folder / "two", folder / "vae")


def test_the_shipped_vae_is_aimed_at_where_none_is_named(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "shipped_folder", lambda: folder / "vae")
    assert go("two")[0] == 0
    assert _same_file("compressor", tmp_path / "out", folder / "two")


def test_a_stream_trains_too(go: Go, folder: Path, tmp_path: Path) -> None:
    assert go("two", "--vae", str(folder / "vae"), "--stream")[0] == 0
    assert _same_file("preprocess", tmp_path / "out", folder / "two")


def test_one_step_weights_have_neither_a_vae_nor_an_encoder(go: Go, tmp_path: Path) -> None:
    assert go("one")[0] == 0
    assert load_record(tmp_path / "out").vae_recipe is None
    assert not (tmp_path / "out" / "encoder.safetensors").exists()
    load_pipeline(tmp_path / "out")


def test_joint_training_goes_on_from_two_step_weights(go: Go, folder: Path, tmp_path: Path) -> None:
    assert go("joint", "--weights", str(folder / "two"))[0] == 0
    decoders = [load_file(where / "decoder.safetensors") for where in (tmp_path / "out", folder / "two")]
    assert not torch.equal(*(decoder["output.weight"] for decoder in decoders))
    assert _same_file("encoder", tmp_path / "out", folder / "two")


def test_joint_training_cannot_aim_at_a_latent_that_is_not_there(go: Go, folder: Path, tmp_path: Path) -> None:
    assert main(_arguments(folder, "one", tmp_path / "one")) == 0
    code, answer = go("joint", "--weights", str(tmp_path / "one"))
    assert (code, "has no encoder to aim at" in answer["error"]["message"]) == (1, True)


def test_difference_maps_are_what_the_weights_eat_then(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = small_maps(1, 9)
    monkeypatch.setattr(training_maps, "render_bare_wall", lambda _: (0 * bare.intensity[0], 0 * bare.intensity[0] + 3))
    assert go("difference", "--vae", str(folder / "vae"))[0] == 0
    assert load_record(tmp_path / "out").input == "difference maps"
    raw, difference = (load_file(where / "preprocess.safetensors") for where in (folder / "two", tmp_path / "out"))
    torch.testing.assert_close(raw["mean"] - difference["mean"], torch.tensor([0.0, 0.0, 3.0, 3.0]), atol=1e-4, rtol=0)


def test_a_transfer_tells_before_and_after_and_keeps_the_decoder(go: Go, folder: Path, tmp_path: Path) -> None:
    code, answer = go("transfer", "--weights", str(folder / "two"))
    assert (code, set(answer)) == (0, {"out", "held_out_loss", "held_out_iou", "before"})
    assert answer["before"]["held_out_loss"] != answer["held_out_loss"]
    record = load_record(tmp_path / "out")
    assert record.runs == [*load_record(folder / "two").runs, record.transfer_recipe]
    assert _same_file("decoder", tmp_path / "out", folder / "two")
    assert _same_file("encoder", tmp_path / "out", folder / "two")
    assert (tmp_path / "out" / "all-layers" / "log.csv").exists()


def test_weights_of_another_architecture_are_4_or_taken_in_part_with_a_report(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Path(shutil.copytree(folder / "two", tmp_path / "other"))
    tensors = load_file(other / "compressor.safetensors")
    tensors["classifier.1.weight"] = torch.zeros(7, 100)
    save_file({**tensors, "more": torch.zeros(1)}, other / "compressor.safetensors")
    code, answer = go("transfer", "--weights", str(other))
    assert (code, "does not fit this network" in answer["error"]["message"]) == (4, True)
    told: list[str] = []
    monkeypatch.setattr(runs, "say", told.append)
    assert go("transfer", "--weights", str(other), "--partial")[0] == 0
    assert told == ["compressor: 8 tensors loaded; 1 left over (more), 1 misshapen (classifier.1.weight)"]


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)


@pytest.mark.parametrize(
    ("recipe", "options", "code", "words"),
    [
        ("vae", ["--accelerator", "cuda", "--devices", "4"], 1, "4 GPUs asked for, 0 there"),
        ("vae", ["--devices", "3"], 4, "not shared by 3 processes"),
        ("transfer", ["--weights", "none"], 4, "no checkpoint in none"),
        ("vae", ["--weights", "w"], 1, 'start = "scratch", so that --weights would do nothing'),
        ("two", ["--weights", "w"], 1, "starts from scratch, so that --weights would do nothing"),
        ("joint", ["--weights", "w", "--vae", "v"], 1, "so that --vae would do nothing"),
        ("transfer", ["--objects", "9"], 1, "holds 8 objects, the recipe asks for 9"),
    ],
)
@pytest.mark.usefixtures("no_gpu")
def test_what_cannot_be_is_one_line(
    go: Go, folder: Path, recipe: str, options: list[str], code: int, words: str, tmp_path: Path
) -> None:
    start = [] if recipe == "vae" or "--weights" in options else ["--weights", str(folder / "two")]
    ended, answer = go(recipe, *start, *options)
    assert (ended, words in answer["error"]["message"]) == (code, True), answer
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [["--budget", "2"], ["--budget", "0"], ["--objects", "1"], ["--devices", "0"]])
def test_no_budget_objects_or_devices_are_wrong_usage(go: Go, options: list[str]) -> None:
    assert go("vae", *options)[0] == 2


def test_weights_that_eat_other_maps_than_the_recipe_says_are_refused(go: Go, folder: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(folder / "two", tmp_path / "other"))
    record = load_record(other).model_copy(update={"input": "difference maps"})
    (other / checkpoint.RECORD).write_text(record.model_dump_json(), encoding="utf-8")
    code, answer = go("transfer", "--weights", str(other))
    assert (code, "eat difference maps, the recipe says raw maps" in answer["error"]["message"]) == (1, True)
