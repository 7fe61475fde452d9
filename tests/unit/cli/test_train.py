"""`train`: from recipes and data to weights with their record, mostly with small networks."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from threading import Event
from typing import Any

import nlos_models as models
import numpy as np
import pytest
import torch
from nlos_calibration import load_rig
from nlos_models import checkpoint, load_pipeline, load_record
from nlos_models.quality import FEATURES
from nlos_models.training import QualitySet, checkpoints, loop, runs, tasks
from safetensors.torch import load_file, save_file
from small_maps import SmallDataset, small_images, small_maps, untrained_weights, use_small_networks
from small_uncertainty import untrained_uncertainty, watched_weights

from nlos_cam.cli import train as command
from nlos_cam.cli.main import main
from nlos_cam.dataset import TRAINING_OUTLIERS, DatasetPlan, training_maps, uncertainty_samples
from nlos_cam.dataset.uncertainty_samples import EMPTY, ORDINARY, UncertaintySamples
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
    "direct": 'task = "transfer"\nlatent_weight = 0\nimage_weight = 1\n' + BASE,
    "doubt": 'task = "doubt"\noutliers = 7\nempties = 14\n' + BASE,
}
FIGURES = {"held_out_loss", "held_out_iou"}
Patch = pytest.MonkeyPatch
Run = Callable[..., Any]


def _uncertainty_samples(
    _: Path, counts: dict[str, int], seed: int, *__: object, **___: object
) -> UncertaintySamples:
    """Return samples of which every fourth cannot be seen."""
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    maps = small_maps(len(kinds), seed % 97)
    cells = np.where(np.arange(len(kinds)) % 4 == 0, 0, 100).astype(np.int32)
    return UncertaintySamples(
        maps.depth_m, maps.intensity, maps.image.astype(np.float16), cells, np.array(kinds)
    )


def _arguments(folder: Path, recipe: str, out: Path, *options: object) -> list[str]:
    task = recipe if recipe in {"vae", "transfer", "doubt"} else "compressor"
    maps = [] if task == "vae" else ["--dataset", "data", "--held-out", "held-out"]
    return [
        "train",
        task,
        "--recipe",
        str(folder / f"{recipe}.toml"),
        "--out",
        str(out),
        *maps,
        *map(str, options),
    ]


@pytest.fixture(autouse=True, scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Small networks and datasets; the folders of weights whose graphs are not exported, since that
    takes seconds.
    """
    folders = list[Path]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "export_folder", folders.append)
        use_small_networks(patch, tasks, checkpoint, checkpoints, runs)
        counts = {"data": 8, "held-out": 4}
        sets = {
            name: SmallDataset(small_maps(count, len(name)), PLAN, Path(name), 100 * number)
            for number, (name, count) in enumerate(counts.items())
        }
        for module in ("nlos_cam.dataset", "nlos_cam.dataset.training_maps"):
            patch.setattr(f"{module}.open_dataset", lambda of, **_: sets[of.name])
        patch.setattr(
            "nlos_cam.dataset.procedural_images",
            lambda seed, count, *_, **__: small_images(count, seed),
        )
        patch.setattr(uncertainty_samples, "samples_on_disk", _uncertainty_samples)
        patch.setenv("NLOS_CAM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield folders


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipes, a VAE and two-step weights of small networks."""
    folder = tmp_path_factory.mktemp("train")
    for name, text in RECIPES.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    assert main(_arguments(folder, "vae", folder / "vae")) == 0
    assert main(_arguments(folder, "two", folder / "two", "--vae", folder / "vae")) == 0
    return folder


@pytest.fixture
def go(folder: Path, out: Path, run: Run) -> Run:
    return lambda recipe, *options, code=0: run(
        *_arguments(folder, recipe, out, *options), code=code
    )


def _same(one: Path, other: Path, *parts: str) -> list[bool]:
    files = [f"{part}.safetensors" for part in parts]
    return [(one / file).read_bytes() == (other / file).read_bytes() for file in files]


def test_train_vae_answers_with_folder_and_figures(go: Run, out: Path) -> None:
    answer = go("vae")
    record = load_record(out)

    assert set(answer) == {"out", *FIGURES}
    assert answer["out"] == str(out)
    assert record.figures == {name: answer[name] for name in FIGURES}
    assert record.rig_name == RIG.name
    assert record.rig_checksum == RIG.checksum
    assert len((out / "log.csv").read_text(encoding="utf-8").splitlines()) == 3


def test_train_follows_shared_options(go: Run, out: Path, monkeypatch: Patch) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(
        loop, "compile_network", lambda network: compiled.append(network) or network
    )
    go("vae", "--budget", "0.5", "--objects", "6", "--compile")

    assert len(compiled) == 1

    recipe = load_record(out).vae_recipe

    assert recipe.epochs == 1
    assert recipe.objects == 6
    assert "0.5" in recipe.deviations[-1]


def test_train_vae_leaves_out_categories_of_recipe(
    go: Run, folder: Path, monkeypatch: Patch
) -> None:
    shown: list[set[str]] = []

    def images(
        seed: int,
        count: int,
        _: object,
        kinds: tuple[str, ...],
        *,
        backgrounds: float,
        **__: object,
    ) -> Any:
        shown.append({*kinds, f"{backgrounds}"})
        return small_images(count, seed)

    monkeypatch.setattr("nlos_cam.dataset.procedural_images", images)
    (folder / "left-out.toml").write_text(
        RECIPES["vae"] + 'left_out = ["car", "boat"]\nbackgrounds = 0.25\n'
    )
    go("vae", "--recipe", folder / "left-out.toml")

    assert shown == [{*CATEGORIES, "0.25"} - {"car", "boat"}] * 2


def test_interrupted_train_exits_130_and_resumes_exactly(
    go: Run, folder: Path, out: Path, monkeypatch: Patch
) -> None:
    stop = Event()
    messages = list[str]()
    stop.set()
    with monkeypatch.context() as patch:
        patch.setattr(command, "stop_on_signals", lambda _: nullcontext(stop))
        patch.setattr(command, "say", messages.append)
        go("vae", code=130)

    assert "step 1" in messages[-1]
    assert not (out / "decoder.safetensors").exists()

    go("vae")

    assert _same(out, folder / "vae", "encoder", "decoder") == [True, True]


def test_train_compressor_uses_shipped_vae_and_streams(
    go: Run, folder: Path, out: Path, monkeypatch: Patch, exported: list[Path]
) -> None:
    monkeypatch.setattr(runs, "weights_folder", lambda *_: folder / "vae")
    go("two")

    assert exported[-1] == out
    assert _same(out, folder / "two", "compressor") == [True]

    record = load_record(out)

    assert [run.task for run in record.runs] == ["vae", "compressor"]
    assert record.rig_name == "bench"
    assert record.rig_checksum == PLAN.rig.checksum
    assert record.input == "raw maps"
    assert _same(out, folder / "vae", "encoder", "decoder") == [True, True]

    shutil.rmtree(out)
    go("two", "--stream")

    assert _same(out, folder / "two", "preprocess") == [True]


@pytest.mark.slow
def test_joint_keeps_encoder_and_one_step_has_none(
    go: Run, folder: Path, out: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(runs, "export_folder", models.export_folder)
    go("joint", "--weights", folder / "two")

    assert (out / "network.onnx").is_file()
    assert _same(out, folder / "two", "decoder", "encoder") == [False, True]

    go("one", "--out", one := out.with_name("one"))

    assert load_record(one).vae_recipe is None
    assert not (one / "encoder.safetensors").exists()

    load_pipeline(one)


@pytest.mark.slow
def test_train_on_difference_maps_records_input(
    go: Run, folder: Path, out: Path, monkeypatch: Patch
) -> None:
    flat = np.zeros((64, 80), np.float32)
    monkeypatch.setattr(training_maps, "render_bare_wall", lambda _: (flat, flat + 3))
    go("difference", "--vae", folder / "vae")

    assert load_record(out).input == "difference maps"

    raw, difference = (
        load_file(where / "preprocess.safetensors") for where in (folder / "two", out)
    )

    torch.testing.assert_close(
        raw["mean"] - difference["mean"], torch.tensor([0.0, 0.0, 3.0, 3.0]), atol=1e-4, rtol=0
    )


@pytest.mark.slow
def test_train_transfer_reports_both_figures_and_keeps_decoder(
    go: Run, folder: Path, out: Path
) -> None:
    tensors = load_file(folder / "two" / "compressor.safetensors")
    other = Path(shutil.copytree(folder / "two", out.with_name("other")))
    save_file(
        {**tensors, "classifier.1.weight": torch.zeros(7, 100)}, other / "compressor.safetensors"
    )
    (other / "SHA256SUMS").unlink()
    go("transfer", "--weights", other, code=4)
    answer = go("transfer", "--weights", other, "--partial")

    assert set(answer) == {"out", *FIGURES, "before", "kept", "fitted"}
    assert answer["fitted"] == str(out)
    assert answer["before"]["held_out_loss"] != answer["held_out_loss"]

    record = load_record(out)

    assert record.runs == [*load_record(folder / "two").runs, record.transfer_recipe]
    assert _same(out, folder / "two", "decoder", "encoder") == [True, True]
    assert (out / "all-layers" / "log.csv").exists()


@pytest.mark.slow
def test_transfer_that_worsens_keeps_the_earlier_weights(
    go: Run, folder: Path, out: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(runs, "figures_of", lambda *_: {"held_out_loss": 0.0, "held_out_iou": 1.0})
    answer = go("transfer", "--weights", folder / "two")
    fitted = out / "fitted"

    assert answer["kept"] == "earlier"
    assert answer["fitted"] == str(fitted)
    assert _same(out, folder / "two", "compressor", "decoder") == [True, True]
    assert _same(fitted, folder / "two", "compressor") == [False]
    assert load_record(out).runs == load_record(folder / "two").runs
    assert load_record(fitted).transfer_recipe is not None
    assert go("transfer", "--weights", folder / "two") == answer


def test_finished_run_keeps_no_states_and_is_not_repeated(
    go: Run, folder: Path, out: Path, monkeypatch: Patch
) -> None:
    answer = go("two", "--vae", folder / "vae")

    assert not [*out.rglob("*.ckpt")]

    monkeypatch.setattr(runs, "train_compressor", pytest.fail)

    assert go("two", "--vae", folder / "vae") == answer

    others = {
        name: SmallDataset(small_maps(8, 1), PLAN, Path(name), 100 * number)
        for number, name in enumerate(("data", "held-out"))
    }
    monkeypatch.setattr(
        "nlos_cam.dataset.training_maps.open_dataset", lambda of, **_: others[of.name]
    )

    assert "choose another --out" in go("two", "--vae", folder / "vae", code=4)["error"]["message"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ("vae --accelerator cuda --devices 4", 1, "4 GPUs"),
        ("vae --devices 3", 4, "3 processes"),
        ("transfer --weights two --recipe vae.toml", 1, "'vae'"),
        ("transfer --weights none", 4, "none"),
        ("two --vae none", 4, "none"),
        ("vae --weights w", 1, "--weights"),
        ("two --weights w", 1, "--weights"),
        ("joint --weights w --vae v", 1, "--vae"),
        ("transfer --weights two --objects 9", 1, "9"),
        ("transfer --weights two --vae none", 1, "--vae none"),
        ("transfer --recipe direct.toml --weights direct --vae two", 1, "--vae"),
        ("transfer --recipe direct.toml --weights direct --compile", 1, "--compile"),
    ],
)
def test_train_refuses_options_that_do_not_fit(
    go: Run, folder: Path, out: Path, monkeypatch: Patch, arguments: str, code: int, words: str
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.chdir(folder)

    assert words in go(*arguments.split(), code=code)["error"]["message"]
    assert not out.exists()


@pytest.mark.slow
def test_train_doubt_writes_weights_with_doubt_once(go: Run, folder: Path, out: Path) -> None:
    weights = folder / "two"
    answer = go("doubt", "--weights", weights)
    load_pipeline(out)
    record = models.load_uncertainty_network(out)[1]

    assert record.learnt == list(TRAINING_OUTLIERS)
    assert record.figures == {"held_out_loss": answer["held_out_loss"]}

    for again in (out, weights):
        assert (
            "--out" in go("doubt", "--weights", weights, "--out", again, code=1)["error"]["message"]
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maps", "x_max_m", "objects", "word"),
    [
        ("difference maps", None, 8, "raw maps"),
        ("raw maps", 3.0, 8, "rig"),
        ("raw maps", None, 9, "9"),
    ],
)
def test_train_doubt_refuses_other_maps_or_rig(
    go: Run, tmp_path: Path, maps: str, x_max_m: float | None, objects: int, word: str
) -> None:
    wall = (
        PLAN.rig.wall
        if x_max_m is None
        else load_rig("bare-wall").wall.model_copy(update={"x_max_m": x_max_m})
    )
    untrained_weights(
        others := tmp_path / "others", rig=PLAN.rig.model_copy(update={"wall": wall}), maps=maps
    )

    assert (
        word in go("doubt", "--weights", others, "--objects", objects, code=1)["error"]["message"]
    )


@pytest.mark.slow
def test_train_doubt_ignores_invisible_outliers(go: Run, folder: Path, monkeypatch: Patch) -> None:
    sets = list[Any]()
    monkeypatch.setattr(
        "nlos_models.training.run_uncertainty", lambda *every: sets.extend(every[-2:]) or {}
    )
    go("doubt", "--weights", folder / "two")
    training = sets[0]
    per_kind = dict.fromkeys(TRAINING_OUTLIERS, 7)
    every = _uncertainty_samples(
        Path(), {EMPTY: 14, ORDINARY: 7 * len(TRAINING_OUTLIERS) // 2, **per_kind}, 0
    )
    outliers = ~np.isin(every.kind, [EMPTY, ORDINARY])
    visible = every.cells > 0

    assert training.nothing.sum() == 14
    assert (~training.nothing & ~training.outside).sum() == 8 + (
        (every.kind == ORDINARY) & visible
    ).sum()
    assert training.outside.sum() == (outliers & visible).sum() < outliers.sum()


def test_train_quality_replaces_a_damaged_model(
    tmp_path: Path, monkeypatch: Patch, run: Run, shown: Run
) -> None:
    untrained_uncertainty(weights := tmp_path / "run", watched_weights(tmp_path / "watched"))
    (weights / "quality.json").write_text("{", encoding="utf-8")
    figures = np.random.default_rng(0).standard_normal((120, FEATURES)).astype(np.float32)
    iou = 1 / (1 + np.exp(-figures[:, 0]))
    kinds = np.array(["cup", "bowl", "rods", "blobs"] * 30)
    known = QualitySet(figures, iou, 0.2 - 0.1 * iou, kinds, np.arange(120) % 4 > 1)
    monkeypatch.setattr("nlos_models.load_reconstructor", lambda *_: None)
    monkeypatch.setattr("nlos_cam.dataset.open_dataset", lambda *_, **__: None)
    monkeypatch.setattr("nlos_cam.dataset.quality_set", lambda *_: known)
    monkeypatch.setattr("nlos_models.training.quality.MIN_STEPS", 20)
    answer = run("train", "quality", "--weights", weights, "--dataset", tmp_path)

    assert answer["weights"] == str(weights)
    assert answer["objects"] == 120
    assert models.load_uncertainty_model(weights, tmp_path).quality.record.objects == 120
    assert (
        "came with"
        in shown("train", "quality", "--weights", "paper", "--dataset", tmp_path, code=1).err
    )


def test_train_quality_leaves_weights_of_a_bench_alone(tmp_path: Path, shown: Run) -> None:
    """The record of a bench has the checksum of its weights: with another one it is damaged."""
    (tmp_path / "bench.toml").write_text("bench_version = 1\n", encoding="utf-8")
    untrained_uncertainty(weights := tmp_path / "weights", watched_weights(tmp_path / "watched"))

    command = "train", "quality", "--weights", weights, "--dataset", tmp_path
    assert "belongs to a bench" in shown(*command, code=1).err


def test_train_direct_refuses_a_store_in_use(tmp_path: Path, out: Path, shown: Run) -> None:
    (recipe := tmp_path / "direct.toml").write_text('task = "direct"\n' + BASE)
    (store := tmp_path / "store").mkdir()
    maps = "--dataset", "data", "--held-out", "held-out", "--store", store
    with claim(store, inside=True):
        assert (
            "being written"
            in shown("train", "direct", "--recipe", recipe, "--out", out, *maps, code=1).err
        )
