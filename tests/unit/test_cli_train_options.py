"""What the `train` commands share: one set of options, the recipe they choose, and no option without effect."""

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from nlos_cam.cli.train import RunOptions, refuse_ignored, with_run_options
from nlos_cam.errors import SceneError

RECIPE = 'task = "vae"\nobjects = 4\nheld_out = 2\nepochs = 2\nbatch = 2\nlearning_rate = 1e-3\n'


@pytest.fixture
def recipe_file(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text(RECIPE, encoding="utf-8")
    return path


def test_a_recipe_of_another_task_is_refused(recipe_file: Path) -> None:
    with pytest.raises(SceneError, match="a recipe for 'vae', not 'transfer'"):
        RunOptions(recipe_file, Path("out")).recipe("transfer")


def test_a_recipe_is_of_the_objects_and_the_budget_asked_for(recipe_file: Path) -> None:
    recipe = RunOptions(recipe_file, Path("out"), objects=3).recipe("vae", 0.5)
    assert (recipe.objects, recipe.epochs) == (3, 1)
    assert RunOptions(recipe_file, Path("out")).recipe("vae").objects == 4


def test_a_command_has_the_shared_options_beside_its_own_and_gets_them_as_one(recipe_file: Path) -> None:
    got: list[object] = []

    def command(run: RunOptions, own: Annotated[int, typer.Option("--own")] = 3) -> None:
        """Says what it got."""
        got.extend((run, own))

    app, runner = typer.Typer(), CliRunner()
    app.command()(with_run_options(command))
    needed = ["--recipe", str(recipe_file), "--out", "runs"]
    assert runner.invoke(app, [*needed, "--objects", "5", "--compile", "--own", "4"]).exit_code == 0
    assert got == [RunOptions(recipe_file, Path("runs"), objects=5, compiled=True), 4]
    assert runner.invoke(app, needed).exit_code == 0
    assert got[2:] == [RunOptions(recipe_file, Path("runs")), 3]
    assert runner.invoke(app, needed[:2]).exit_code == 2
    assert runner.invoke(app, [*needed, "--objects", "1"]).exit_code == 2


def test_an_option_that_would_do_nothing_is_named_and_refused() -> None:
    refuse_ignored("so it is", {"--weights": False})
    with pytest.raises(SceneError, match=r"so it is, so that --wall would do nothing"):
        refuse_ignored("so it is", {"--weights": False, "--wall": True})
