"""Ablations differ in what they say they differ in."""

import subprocess
import sys
from pathlib import Path

import pytest
from ablation_runs import BASE, CHANGES, EPOCHS, OBJECTS, options_of, recipe_of
from nlos_models.recipe import load_recipe

SOURCES = {"vae": Path("vae"), "dataset": Path("maps"), "held_out": Path("others")}


@pytest.mark.parametrize("name", CHANGES)
def test_a_way_differs_from_the_first_in_its_changes_alone(name: str) -> None:
    mine, first = (recipe_of(one).model_dump(exclude={"deviations"}) for one in (name, "two"))
    assert {key for key in mine if mine[key] != first[key]} == CHANGES[name].keys() - {"deviations"}


@pytest.mark.parametrize("name", sorted(CHANGES.keys() - {"joint"}))
def test_all_ways_but_the_one_that_goes_on_see_a_tenth_of_the_recipes_maps(name: str) -> None:
    recipe, shipped = recipe_of(name), load_recipe(BASE)
    assert recipe.objects * recipe.epochs == OBJECTS * EPOCHS == shipped.objects * shipped.epochs // 10


@pytest.mark.parametrize(
    ("name", "given", "left_out"),
    [("two", "--vae", "--weights"), ("one", "--dataset", "--vae"), ("joint", "--weights", "--vae")],
)
def test_a_way_is_given_what_its_steps_set_out_from(name: str, given: str, left_out: str, tmp_path: Path) -> None:
    options = options_of(name, tmp_path, SOURCES)
    assert given in options
    assert left_out not in options
    assert load_recipe(Path(options[options.index("--recipe") + 1])) == recipe_of(name)


def test_an_unknown_way_is_named_before_anything_is_trained(tmp_path: Path) -> None:
    words = ["--vae", "v", "--dataset", "d", "--held-out", "h", "--only", "three"]
    tool = Path(__file__).parents[2] / "tools/ablation_runs.py"
    done = subprocess.run(
        [sys.executable, tool, tmp_path / "runs", *words], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2
    assert "no way is called 'three'" in done.stderr
    assert not (tmp_path / "runs").exists()
