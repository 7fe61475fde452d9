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
