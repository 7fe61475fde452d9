"""Training recipes: the committed ones, budgets, refusals that name the field, and learning-rate
schedules.
"""

import json
from pathlib import Path

import pytest
import torch
from nlos_models.errors import ModelError, RecipeError
from nlos_models.training import load_recipe, packaged_recipes
from nlos_models.training.recipe import recipe_of
from nlos_models.training.schedule import PLATEAU_PATIENCE, SMALLEST_RATE, has_ended, schedule_of
from small_run import small_recipe
from torch import nn

LEAST = {"objects": 10, "held_out": 2, "epochs": 1, "batch": 2, "learning_rate": 1e-3}
RECIPES = Path(__file__).parents[3] / "models" / "recipes"


@pytest.mark.parametrize("path", sorted(RECIPES.glob("*.toml")), ids=lambda path: path.stem)
def test_committed_recipe_loads_by_path_or_name(path: Path) -> None:
    recipe = load_recipe(path)
    name = path.stem.removeprefix("paper-rig-")

    assert recipe.task in path.stem
    assert recipe.deviations
    assert (
        load_recipe(packaged_recipes()[name])
        == load_recipe(Path(name))
        == load_recipe(Path(path.stem))
        == recipe
    )


def test_recipe_loads_by_name_beside_the_folder_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("vae").mkdir()  # of `train vae --recipe vae --out vae`, which goes on there

    assert load_recipe(Path("vae")).task == "vae"


def test_si_recipes_have_the_values_of_the_paper() -> None:
    vae, compressor, transfer = (
        load_recipe(RECIPES / f"si-{task}.toml") for task in ("vae", "compressor", "transfer")
    )

    assert {recipe.schedule for recipe in (vae, compressor, transfer)} == {"plateau"}
    assert (vae.learning_rate, vae.betas, vae.kl_weight, vae.augmentation) == (
        1e-3,
        (0.5, 0.999),
        0.05,
        "turns",
    )
    assert (compressor.learning_rate, compressor.left_noise, compressor.dropout) == (0.01, 0.2, 0.5)
    assert (compressor.latent_weight, compressor.image_weight, compressor.steps) == (
        1.0,
        0.0,
        "two",
    )
    assert 3 <= transfer.all_layers_epochs <= 5
    assert (transfer.learning_rate, transfer.epochs, transfer.statistics) == (1e-3, 10, "kept")

    for task in ("vae", "compressor"):
        for scale, schedule in (("", "plateau"), ("-small", "one-cycle")):
            recipe = load_recipe(RECIPES / f"colour-{task}{scale}.toml")
            assert (recipe.task, recipe.colour, recipe.kl_weight, recipe.schedule) == (
                task,
                True,
                0.03,
                schedule,
            )


@pytest.mark.parametrize("name", ["difference", "one-step"])
def test_compared_recipes_have_the_same_budget(name: str) -> None:
    one, other = (
        load_recipe(RECIPES / f"paper-rig-compressor-{part}gpu.toml") for part in ("", f"{name}-")
    )
    for field in (
        "objects",
        "held_out",
        "epochs",
        "batch",
        "learning_rate",
        "schedule",
        "dropout",
        "seed",
        "keep",
    ):
        assert getattr(one, field) == getattr(other, field)


@pytest.mark.parametrize(
    ("share", "epochs", "objects"),
    [(1.0, 34, 6000), (0.1, 3, 6000), (0.5, 17, 6000), (0.01, 1, 2040), (0.0001, 1, 64)],
)
def test_scaled_recipe_has_share_of_objects_times_epochs(
    share: float, epochs: int, objects: int
) -> None:
    scaled = small_recipe(objects=6000, epochs=34, batch=64, deviations=["a"]).scaled(share)

    assert scaled.epochs == epochs
    assert scaled.objects == objects
    assert scaled.deviations[0] == "a"
    assert (len(scaled.deviations) == 1) == (share == 1)
    assert recipe_of(json.loads(scaled.model_dump_json())) == scaled


def test_of_objects_limits_batch_and_refuses_bad_numbers() -> None:
    recipe = small_recipe(objects=100, batch=8)

    assert recipe.of_objects(5).objects == 5
    assert recipe.of_objects(5).batch == 5
    assert recipe.of_objects(50).objects == 50
    assert recipe.of_objects(50).batch == 8

    with pytest.raises(RecipeError, match="1"):
        recipe.of_objects(1)

    for share in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(RecipeError, match=f"{share:g}"):
            recipe.scaled(share)


JOINT = {"steps": "two-then-joint", "image_weight": 1}
ONE = {"steps": "one", "latent_weight": 0, "image_weight": 1}


@pytest.mark.parametrize(
    ("task", "changes", "words"),
    [
        ("vae", {"batch": 1}, "batch.*1"),
        ("vae", {"batch": 64}, "objects"),
        ("vae", {"objects": None}, "objects"),
        ("vae", {"learning_rat": 1e-3}, "learning_rat"),
        ("guess", {}, "task.*guess"),
        ("compressor", {"augmentation": "turns"}, "augmentation"),
        ("transfer", ONE, "steps"),
        ("compressor", {"latent_weight": 0}, "latent_weight"),
        ("compressor", {**ONE, "latent_weight": None}, "latent"),
        ("compressor", {**JOINT, "image_weight": None}, "image_weight"),
        ("transfer", {"start": "weights"}, "start"),
        ("compressor", {"start": "weights", **ONE}, "start"),
        ("compressor", {"start": "weights", **JOINT}, "start"),
        ("compressor", {"latent_warm_up": 0.1}, "latent_warm_up"),
        ("transfer", {"colour": True}, "colour"),
        ("direct", {"blend": 0.5}, "blend"),
        ("compressor", {"colour": True, "maps": "difference maps"}, "simulation only"),
    ],
)
def test_wrong_recipe_is_refused_with_field(
    tmp_path: Path, task: str, changes: dict[str, object], words: str
) -> None:
    facts = {**LEAST, "task": task, **changes}
    text = "\n".join(
        f"{name} = {json.dumps(value)}" for name, value in facts.items() if value is not None
    )
    (path := tmp_path / "recipe.toml").write_text(text, encoding="utf-8")

    with pytest.raises(RecipeError, match=words) as caught:
        load_recipe(path)

    assert "\n" not in str(caught.value)
    assert "{" not in str(caught.value)


@pytest.mark.parametrize("content", [b"task = ", b"\xff\xfe\x00", b"", None])
def test_load_recipe_names_unreadable_file_or_similar_name(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "recipe.toml"
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(RecipeError, match=r"recipe\.toml") as caught:
        load_recipe(path)

    assert isinstance(caught.value, ModelError)
    assert caught.value.exit_code == 4

    with pytest.raises(RecipeError, match="Did you mean 'transfer'"):
        load_recipe(Path("transfre"))


def _optimizer(rate: float) -> torch.optim.Optimizer:
    return torch.optim.SGD([nn.Parameter(torch.zeros(1))], rate)


@pytest.mark.parametrize("rate", [1e-2, 2e-3, 1e-3, 1.3e-8])
def test_plateau_schedule_ends_without_progress(rate: float) -> None:
    recipe = small_recipe(schedule="plateau", learning_rate=rate)
    optimizer = _optimizer(rate)
    schedule = schedule_of(recipe, optimizer, 1)
    rates = [rate]
    while not has_ended(recipe, rates[-1]):
        assert len(rates) < 100
        schedule.step(1.0)
        rates.append(optimizer.param_groups[0]["lr"])

    assert rates[-2] >= SMALLEST_RATE > rates[-1]
    assert rates[1 : PLATEAU_PATIENCE + 2] == [rate] * (PLATEAU_PATIENCE + 1)
    assert rates[PLATEAU_PATIENCE + 2 :][:1] in ([], [pytest.approx(0.3 * rate)])


def test_one_cycle_schedule_rises_to_rate_and_falls_to_end() -> None:
    recipe = small_recipe(schedule="one-cycle", learning_rate=1e-3)
    optimizer = _optimizer(1e-3)
    schedule = schedule_of(recipe, optimizer, 101)
    rates = list[float]()
    for _ in range(100):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    peak = rates.index(max(rates))

    assert max(rates) == pytest.approx(1e-3, rel=1e-2)
    assert rates == sorted(rates[: peak + 1]) + sorted(rates[peak + 1 :], reverse=True)
    assert optimizer.param_groups[0]["lr"] < SMALLEST_RATE
    assert not has_ended(recipe, 0.0)


@pytest.mark.parametrize("task", ['["vae"]', '{ name = "vae" }'])
def test_recipe_whose_task_is_no_text_is_refused(tmp_path: Path, task: str) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(f"task = {task}\n", encoding="utf-8")
    with pytest.raises(RecipeError, match="task: must be one of"):
        load_recipe(path)
