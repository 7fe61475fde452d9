"""Recipes: the committed ones load, a wrong one says which field."""

from pathlib import Path

import pytest
from nlos_models.errors import ModelError, RecipeError
from nlos_models.recipe import Recipe, load_recipe

RECIPES = Path(__file__).parents[2] / "models" / "recipes"
LEAST = 'task = "vae"\nobjects = 10\nheld_out = 2\nepochs = 1\nbatch = 2\nlearning_rate = 1e-3\n'


def _write(folder: Path, text: str) -> Path:
    path = folder / "recipe.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("path", sorted(RECIPES.glob("*.toml")), ids=lambda path: path.stem)
def test_committed_recipes_load_and_say_why_they_leave_the_paper(path: Path) -> None:
    recipe = load_recipe(path)
    assert recipe.task in path.stem
    assert recipe.deviations


def test_the_papers_recipes_are_what_the_paper_states() -> None:
    vae, compressor, transfer = (load_recipe(RECIPES / f"si-{task}.toml") for task in ("vae", "compressor", "transfer"))
    assert {recipe.schedule for recipe in (vae, compressor, transfer)} == {"plateau"}
    assert (vae.learning_rate, vae.betas, vae.kl_weight, vae.augmentation) == (1e-3, (0.5, 0.999), 0.05, "turns")
    assert (compressor.learning_rate, compressor.left_noise, compressor.dropout) == (0.01, 0.2, 0.5)
    assert (compressor.latent_weight, compressor.image_weight, compressor.steps) == (1.0, 0.0, "two")
    assert 3 <= transfer.all_layers_epochs <= 5
    assert (transfer.learning_rate, transfer.epochs, transfer.statistics) == (1e-3, 10, "kept")


@pytest.mark.parametrize("name", ["difference", "one-step"])
def test_what_is_compared_has_the_same_budget(name: str) -> None:
    one, other = (load_recipe(RECIPES / f"paper-rig-compressor-{part}gpu.toml") for part in ("", f"{name}-"))
    kept = ("objects", "held_out", "epochs", "batch", "learning_rate", "schedule", "dropout", "seed", "keep")
    assert {field: getattr(one, field) for field in kept} == {field: getattr(other, field) for field in kept}


@pytest.mark.parametrize(
    ("share", "epochs", "objects"),
    [(1.0, 34, 6000), (0.1, 3, 6000), (0.5, 17, 6000), (0.01, 1, 2040), (0.0001, 1, 64)],
)
def test_a_share_of_the_budget_is_that_of_objects_times_epochs(share: float, epochs: int, objects: int) -> None:
    recipe = Recipe(task="vae", objects=6000, held_out=1, epochs=34, batch=64, learning_rate=1e-3, deviations=["a"])
    scaled = recipe.scaled(share)
    assert (scaled.epochs, scaled.objects) == (epochs, objects)
    assert scaled.deviations[0] == "a"
    assert (len(scaled.deviations) == 1) == (share == 1)
    assert Recipe.model_validate(scaled.model_dump()) == scaled


@pytest.mark.parametrize("share", [0.0, -1.0, 1.5, float("nan")])
def test_a_share_that_is_none_is_refused(share: float) -> None:
    with pytest.raises(RecipeError, match="choose a share above 0"):
        Recipe(task="vae", objects=10, held_out=1, epochs=1, batch=2, learning_rate=1e-3).scaled(share)


def test_on_fewer_objects_the_batch_is_never_larger_than_all() -> None:
    recipe = Recipe(task="vae", objects=100, held_out=1, epochs=1, batch=8, learning_rate=1e-3)
    assert (recipe.of_objects(5).objects, recipe.of_objects(5).batch) == (5, 5)
    assert (recipe.of_objects(50).objects, recipe.of_objects(50).batch) == (50, 8)
    with pytest.raises(RecipeError, match="1 objects are too few"):
        recipe.of_objects(1)


@pytest.mark.parametrize(
    ("task", "lines", "words"),
    [
        ("compressor", 'augmentation = "turns"', "for a VAE"),
        ("transfer", 'steps = "one"\nlatent_weight = 0\nimage_weight = 1', "a transfer keeps the decoder"),
        ("compressor", "latent_weight = 0", "nothing to learn by"),
        ("compressor", 'steps = "one"\nimage_weight = 1', "no latent to aim at"),
        ("compressor", 'steps = "two-then-joint"', "set an image_weight"),
        ("transfer", 'start = "weights"', "start 'weights' is for a VAE or a two-step compressor"),
        ("compressor", 'start = "weights"\nsteps = "one"\nlatent_weight = 0\nimage_weight = 1', "start 'weights'"),
        ("compressor", 'start = "weights"\nsteps = "two-then-joint"\nimage_weight = 1', "start 'weights'"),
        ("compressor", "latent_warm_up = 0.1", "a VAE's noise and divergence"),
        ("transfer", "colour = true", "no bench to transfer to"),
        ("compressor", 'colour = true\nmaps = "difference maps"', "no difference maps"),
    ],
)
def test_a_recipe_at_odds_with_itself_is_one_line(tmp_path: Path, task: str, lines: str, words: str) -> None:
    with pytest.raises(RecipeError, match=words) as caught:
        load_recipe(_write(tmp_path, LEAST.replace("vae", task) + lines))
    assert "\n" not in str(caught.value)
    assert "{" not in str(caught.value)


def test_what_the_paper_states_is_the_default() -> None:
    recipe = Recipe(task="vae", objects=10, held_out=1, epochs=1, batch=2, learning_rate=1e-3)
    assert (recipe.betas, recipe.kl_weight, recipe.schedule) == ((0.5, 0.999), 0.05, "plateau")
    assert (recipe.left_noise, recipe.dropout) == (0.2, 0.5)


def test_a_recipe_survives_its_record() -> None:
    recipe = Recipe(task="vae", objects=10, held_out=1, epochs=1, batch=2, learning_rate=1e-3, deviations=["a"])
    assert Recipe.model_validate_json(recipe.model_dump_json()) == recipe


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("batch = 1", "batch"),
        ("epochs = 0", "epochs"),
        ("learning_rate = -1.0", "learning_rate"),
        ("learning_rate = 1e-8", "learning_rate"),
        ('task = "guess"', "task"),
        ('schedule = "cosine"', "schedule"),
        ("dropout = 1.0", "dropout"),
        ("betas = [0.5]", "betas"),
    ],
)
def test_a_wrong_value_names_its_field_and_the_value(tmp_path: Path, line: str, field: str) -> None:
    kept = [old for old in LEAST.splitlines() if not old.startswith(field)]
    with pytest.raises(RecipeError, match=rf"{field}.*got") as caught:
        load_recipe(_write(tmp_path, "\n".join([*kept, line])))
    assert "\n" not in str(caught.value)


def test_a_field_nobody_knows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="learning_rat"):
        load_recipe(_write(tmp_path, LEAST + "learning_rat = 1e-3\n"))


def test_a_missing_field_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="objects"):
        load_recipe(_write(tmp_path, LEAST.replace("objects = 10\n", "")))


def test_fewer_objects_than_a_batch_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="objects"):
        load_recipe(_write(tmp_path, LEAST.replace("batch = 2", "batch = 64")))


@pytest.mark.parametrize("content", [b"task = ", b"\xff\xfe\x00", b""])
def test_what_is_no_recipe_is_a_recipe_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "recipe.toml"
    path.write_bytes(content)
    with pytest.raises(RecipeError, match=r"recipe\.toml"):
        load_recipe(path)


def test_a_missing_file_is_a_recipe_error(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="cannot be read") as caught:
        load_recipe(tmp_path / "none.toml")
    assert isinstance(caught.value, ModelError)
    assert caught.value.exit_code == 4
