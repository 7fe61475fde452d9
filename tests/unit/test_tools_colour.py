"""The demonstration of colour: the commands that it gives fit each other and its recipes."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from nlos_models.recipe import load_recipe

Tool = Callable[[str], ModuleType]


@pytest.mark.parametrize("small", [False, True])
def test_the_sets_are_as_large_as_the_recipe_asks_and_the_second_step_takes_what_the_first_ones_made(
    tool: Tool,
    small: bool,
) -> None:
    *builds, vae, compressor = tool("colour_demo").commands(Path("out"), "draft", 3, small=small)
    options = [dict(zip(command[3:][::2], command[3:][1::2], strict=True)) for command in builds]
    assert all(command[:3] == ["dataset", "build", "--colour"] for command in builds)
    first, second = (dict(zip(made[2::2], made[3::2], strict=True)) for made in (vae, compressor))
    recipe = load_recipe(Path(second["--recipe"]))
    assert load_recipe(Path(first["--recipe"])).task == "vae"
    assert [int(option["--count"]) for option in options] == [recipe.objects, recipe.held_out]
    assert [option["--out"] for option in options] == [second["--dataset"], second["--held-out"]]
    assert second["--vae"] == first["--out"]
    assert len({option["--seed"] for option in options}) == 2
    assert all((option["--accuracy"], option["--workers"]) == ("draft", "3") for option in options)
