"""`train`: from recipes and data to weights with their record, mostly with small networks."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
import torch
from nlos_calibration import load_rig
from nlos_models import (
    QualitySet,
    checkpoint,
    export_folder,
    load_doubt,
    load_pipeline,
    load_record,
    load_uncertainty_model,
    runs,
    tasks,
    train,
)
from nlos_models.arrays import Float16
from nlos_models.quality import FEATURES
from safetensors.torch import load_file, save_file
from small_doubt import untrained_doubt, watched_weights
from small_maps import SmallDataset, small_images, small_maps, untrained_weights, use_small_networks

from nlos_cam.cli import train as command
from nlos_cam.cli.main import main
from nlos_cam.dataset import TRAINING_OUTLIERS, DatasetPlan, doubt_samples, training_maps
from nlos_cam.dataset.doubt_samples import EMPTY, ORDINARY, DoubtSamples
from nlos_cam.files import claim
from nlos_cam.objects import CATEGORIES

pytestmark = pytest.mark.usefixtures("one_thread")

RIG = load_rig("paper-rig")
PLAN = DatasetPlan(RIG.model_copy(update={"name": "bench"}), 0)
BASE = "objects = 8\nheld_out = 4\nepochs = 2\nbatch = 4\nlearning_rate = 1e-3\n"
LOSS = "latent_weight = 0.05\nimage_weight = 1.0\n"
RECIPES = {
    "vae": 'task = "vae"\n' + BASE,
    "two": 'task = "compressor"\n' + BASE + LOSS,
    "one": 'task = "compressor"\nsteps = "one"\nlatent_weight = 0\nimage_weight = 1\n' + BASE,
    "joint": 'task = "compressor"\nsteps = "two-then-joint"\n' + BASE + LOSS,
    "difference": 'task = "compressor"\nmaps = "difference maps"\n' + BASE + LOSS,
    "transfer": 'task = "transfer"\nstatistics = "own"\nall_layers_epochs = 1\n' + BASE + LOSS,
    "doubt": 'task = "doubt"\noutliers = 7\nempties = 14\n' + BASE,
}
FIGURES = {"held_out_loss", "held_out_iou"}
Answer, Patch = dict[str, Any], pytest.MonkeyPatch
Go = Callable[..., tuple[int, Answer]]


def _doubt_samples(_: Path, counts: dict[str, int], seed: int, *__: object, **___: object) -> DoubtSamples:
    """Return samples of which every fourth cannot be seen."""
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    maps = small_maps(len(kinds), seed % 97)
    cells = np.where(np.arange(len(kinds)) % 4 == 0, 0, 100).astype(np.int32)
    return DoubtSamples(maps.depth_m, maps.intensity, maps.image.astype(np.float16), cells, np.array(kinds))


def _arguments(folder: Path, recipe: str, out: Path, *options: str) -> list[str]:
    task = recipe if recipe in {"vae", "transfer", "doubt"} else "compressor"
    maps = [] if task == "vae" else ["--dataset", "data", "--held-out", "held-out"]
    return ["train", task, "--recipe", str(folder / f"{recipe}.toml"), "--out", str(out), *maps, *options, "--json"]


@pytest.fixture(autouse=True, scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Small networks and datasets; the folders of weights whose graphs are not exported, since that takes seconds."""
    folders = list[Path]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "export_folder", folders.append)
        use_small_networks(patch, tasks, checkpoint, runs)
        counts = {"data": 8, "held-out": 4}
        sets = {name: SmallDataset(small_maps(count, len(name)), PLAN) for name, count in counts.items()}
        for module in ("nlos_cam.dataset", "nlos_cam.dataset.training_maps"):
            patch.setattr(f"{module}.open_dataset", lambda of, **_: sets[of.name])
        patch.setattr("nlos_cam.dataset.procedural_images", lambda seed, count, *_, **__: small_images(count, seed))
        patch.setattr(doubt_samples, "samples_on_disk", _doubt_samples)
        patch.setenv("NLOS_CAM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield folders


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, a VAE and two-step weights of small networks."""
    folder = tmp_path_factory.mktemp("train")
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    assert main(_arguments(folder, "vae", folder / "vae")) == 0
    assert main(_arguments(folder, "two", folder / "two", "--vae", str(folder / "vae"))) == 0
    return folder


@pytest.fixture
def go(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Go:
    def run(recipe: str, *options: str | Path) -> tuple[int, Answer]:
        capsys.readouterr()
        code = main(_arguments(folder, recipe, tmp_path / "out", *map(str, options)))
        lines = capsys.readouterr().out.splitlines()
        return code, json.loads(lines[-1]) if lines else {}

    return run


def _same_file(part: str, one: Path, other: Path) -> bool:
    mine, its = ((folder / f"{part}.safetensors").read_bytes() for folder in (one, other))
    return mine == its


def test_train_vae_answers_with_folder_and_figures(go: Go, tmp_path: Path) -> None:
    code, answer = go("vae")
    assert (code, set(answer), answer["out"]) == (0, {"out", *FIGURES}, str(tmp_path / "out"))
    record = load_record(tmp_path / "out")
    assert record.figures == {name: answer[name] for name in FIGURES}
    assert (record.rig_name, record.rig_checksum) == (RIG.name, RIG.checksum)
    assert len((tmp_path / "out" / "log.csv").read_text(encoding="utf-8").splitlines()) == 3


def test_train_follows_shared_options(go: Go, tmp_path: Path, monkeypatch: Patch) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(train, "compile_network", lambda network: compiled.append(network) or network)
    assert go("vae", "--budget", "0.5", "--objects", "6", "--compile")[0] == 0
    assert len(compiled) == 1
    recipe = load_record(tmp_path / "out").vae_recipe
    assert (recipe.epochs, recipe.objects) == (1, 6)
    assert "0.5" in recipe.deviations[-1]


def test_train_vae_leaves_out_categories_of_recipe(go: Go, folder: Path, monkeypatch: Patch) -> None:
    shown: list[set[str]] = []

    def images(
        seed: int, count: int, _: object, kinds: tuple[str, ...], *, backgrounds: float, **__: object
    ) -> Float16:
        shown.append({*kinds, f"{backgrounds}"})
        return small_images(count, seed)

    monkeypatch.setattr("nlos_cam.dataset.procedural_images", images)
    (folder / "vae.toml").write_text(RECIPES["vae"] + 'left_out = ["car", "boat"]\nbackgrounds = 0.25\n')
    assert go("vae")[0] == 0
    (folder / "vae.toml").write_text(RECIPES["vae"])
    assert shown == [{*CATEGORIES, "0.25"} - {"car", "boat"}] * 2


def test_interrupted_train_exits_130_and_resumes_to_same_weights(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    stop, messages = Event(), list[str]()
    stop.set()
    with monkeypatch.context() as patch:
        patch.setattr(command, "stop_on_signals", lambda _: nullcontext(stop))
        patch.setattr(command, "say", messages.append)
        assert go("vae")[0] == 130
    assert "step 1" in messages[-1]
    assert not (tmp_path / "out" / "decoder.safetensors").exists()
    assert go("vae")[0] == 0
    assert _same_file("encoder", tmp_path / "out", folder / "vae")
    assert _same_file("decoder", tmp_path / "out", folder / "vae")


def test_train_compressor_uses_shipped_vae_and_streams(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: Patch, exported: list[Path]
) -> None:
    monkeypatch.setattr(runs, "weights_folder", lambda *_: folder / "vae")
    assert go("two")[0] == 0
    assert exported[-1] == tmp_path / "out"
    assert _same_file("compressor", tmp_path / "out", folder / "two")
    record = load_record(tmp_path / "out")
    assert [run.task for run in record.runs] == ["vae", "compressor"]
    assert (record.rig_name, record.rig_checksum, record.input) == ("bench", PLAN.rig.checksum, "raw maps")
    assert all(_same_file(part, tmp_path / "out", folder / "vae") for part in ("encoder", "decoder"))
    shutil.rmtree(tmp_path / "out")
    assert go("two", "--stream")[0] == 0
    assert _same_file("preprocess", tmp_path / "out", folder / "two")


@pytest.mark.slow
def test_joint_weights_keep_encoder_and_one_step_weights_have_none(
    go: Go, folder: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(runs, "export_folder", export_folder)
    assert go("joint", "--weights", folder / "two")[0] == 0
    assert (tmp_path / "out" / "network.onnx").is_file()
    assert not _same_file("decoder", tmp_path / "out", folder / "two")
    assert _same_file("encoder", tmp_path / "out", folder / "two")
    assert go("one", "--out", tmp_path / "one")[0] == 0
    assert load_record(tmp_path / "one").vae_recipe is None
    assert not (tmp_path / "one" / "encoder.safetensors").exists()
    load_pipeline(tmp_path / "one")


@pytest.mark.slow
def test_train_on_difference_maps_records_input(go: Go, folder: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    flat = np.zeros((64, 80), np.float32)
    monkeypatch.setattr(training_maps, "render_bare_wall", lambda _: (flat, flat + 3))
    assert go("difference", "--vae", folder / "vae")[0] == 0
    assert load_record(tmp_path / "out").input == "difference maps"
    raw, difference = (load_file(where / "preprocess.safetensors") for where in (folder / "two", tmp_path / "out"))
    torch.testing.assert_close(raw["mean"] - difference["mean"], torch.tensor([0.0, 0.0, 3.0, 3.0]), atol=1e-4, rtol=0)


@pytest.mark.slow
def test_train_transfer_reports_both_figures_and_keeps_decoder(go: Go, folder: Path, tmp_path: Path) -> None:
    tensors = load_file(folder / "two" / "compressor.safetensors")
    other = Path(shutil.copytree(folder / "two", tmp_path / "other"))
    save_file({**tensors, "classifier.1.weight": torch.zeros(7, 100)}, other / "compressor.safetensors")
    (other / "SHA256SUMS").unlink()
    assert go("transfer", "--weights", other)[0] == 4
    code, answer = go("transfer", "--weights", other, "--partial")
    assert (code, set(answer)) == (0, {"out", *FIGURES, "before"})
    assert answer["before"]["held_out_loss"] != answer["held_out_loss"]
    record = load_record(tmp_path / "out")
    assert record.runs == [*load_record(folder / "two").runs, record.transfer_recipe]
    assert _same_file("decoder", tmp_path / "out", folder / "two")
    assert _same_file("encoder", tmp_path / "out", folder / "two")
    assert (tmp_path / "out" / "all-layers" / "log.csv").exists()


@pytest.mark.parametrize(
    ("recipe", "options", "code", "words"),
    [
        ("vae", ["--accelerator", "cuda", "--devices", "4"], 1, "4 GPUs"),
        ("vae", ["--devices", "3"], 4, "3 processes"),
        ("transfer", ["--recipe", "vae.toml"], 1, "'vae'"),
        ("transfer", ["--weights", "none"], 4, "none"),
        ("two", ["--vae", "none"], 4, "none"),
        ("vae", ["--weights", "w"], 1, "--weights"),
        ("two", ["--weights", "w"], 1, "--weights"),
        ("joint", ["--weights", "w", "--vae", "v"], 1, "--vae"),
        ("transfer", ["--objects", "9"], 1, "9"),
    ],
)
def test_train_refuses_options_that_do_not_fit(
    go: Go, folder: Path, recipe: str, options: list[str], code: int, words: str, tmp_path: Path,
    monkeypatch: Patch,
) -> None:  # fmt: skip
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.chdir(folder)
    start = ["--weights", "two"] if recipe == "transfer" and "--weights" not in options else []
    ended, answer = go(recipe, *start, *options)
    assert ended == code
    assert words in answer["error"]["message"]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_train_doubt_writes_weights_with_doubt_once(go: Go, folder: Path, tmp_path: Path) -> None:
    code, answer = go("doubt", "--weights", folder / "two")
    assert code == 0
    load_pipeline(tmp_path / "out")
    loaded = load_doubt(tmp_path / "out")
    assert loaded[1].learnt == list(TRAINING_OUTLIERS)
    assert loaded[1].figures == {"held_out_loss": answer["held_out_loss"]}
    for out in ("out", "two"):
        code, answer = go("doubt", "--weights", folder / "two", "--out", (folder if out == "two" else tmp_path) / out)
        assert (code, "--out" in answer["error"]["message"]) == (1, True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maps", "x_max_m", "objects", "word"),
    [("difference maps", None, 8, "raw maps"), ("raw maps", 3.0, 8, "rig"), ("raw maps", None, 9, "9")],
)
def test_train_doubt_refuses_other_maps_or_rig(
    go: Go, tmp_path: Path, maps: str, x_max_m: float | None, objects: int, word: str
) -> None:
    wall = PLAN.rig.wall if x_max_m is None else load_rig("bare-wall").wall.model_copy(update={"x_max_m": x_max_m})
    untrained_weights(tmp_path / "others", rig=PLAN.rig.model_copy(update={"wall": wall}), maps=maps)
    code, answer = go("doubt", "--weights", tmp_path / "others", "--objects", str(objects))
    assert (code, word in answer["error"]["message"]) == (1, True)


@pytest.mark.slow
def test_train_doubt_ignores_invisible_outliers(go: Go, folder: Path, monkeypatch: Patch) -> None:
    sets = list[Any]()
    monkeypatch.setattr("nlos_models.run_doubt", lambda *every: sets.extend(every[-2:]) or {})
    assert go("doubt", "--weights", folder / "two")[0] == 0
    training, per_kind = sets[0], dict.fromkeys(TRAINING_OUTLIERS, 7)
    every = _doubt_samples(Path(), {EMPTY: 14, ORDINARY: 7 * len(TRAINING_OUTLIERS) // 2, **per_kind}, 0)
    outliers, visible = ~np.isin(every.kind, [EMPTY, ORDINARY]), every.cells > 0
    assert training.nothing.sum() == 14
    assert (~training.nothing & ~training.outside).sum() == 8 + ((every.kind == ORDINARY) & visible).sum()
    assert training.outside.sum() == (outliers & visible).sum() < outliers.sum()


def test_train_quality_replaces_a_damaged_model(
    tmp_path: Path, monkeypatch: Patch, capsys: pytest.CaptureFixture[str]
) -> None:
    untrained_doubt(weights := tmp_path / "run", watched_weights(tmp_path / "watched"))
    (weights / "quality.json").write_text("{", encoding="utf-8")
    figures = np.random.default_rng(0).standard_normal((120, FEATURES)).astype(np.float32)
    iou = 1 / (1 + np.exp(-figures[:, 0]))
    kinds = np.array(["cup", "bowl", "rods", "blobs"] * 30)
    known = QualitySet(figures, iou, 0.2 - 0.1 * iou, kinds, np.arange(120) % 4 > 1)
    monkeypatch.setattr("nlos_models.load_reconstructor", lambda *_: None)
    monkeypatch.setattr("nlos_cam.dataset.open_dataset", lambda *_, **__: None)
    monkeypatch.setattr("nlos_cam.dataset.quality_set", lambda *_: known)
    monkeypatch.setattr("nlos_models.doubt_training.STEPS", 20)
    assert main(["train", "quality", "--weights", str(weights), "--dataset", str(tmp_path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (answer["weights"], answer["objects"]) == (str(weights), 120)
    assert load_uncertainty_model(weights, tmp_path).quality.record.objects == 120


def test_train_direct_refuses_a_store_in_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (recipe := tmp_path / "direct.toml").write_text('task = "direct"\n' + BASE)
    (store := tmp_path / "store").mkdir()
    maps = ["--dataset", str(tmp_path), "--held-out", str(tmp_path), "--store", str(store)]
    with claim(store, inside=True):
        assert main(["train", "direct", "--recipe", str(recipe), "--out", str(tmp_path / "out"), *maps]) == 1
    assert "being written" in capsys.readouterr().err
