"""The command that a dataset tells is the one that was given, with what was left to its defaults."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from nlos_cam.cli.dataset import command_of


def _told(*arguments: str) -> list[str]:
    app, told = typer.Typer(), list[str]()

    @app.command()
    def make(
        context: typer.Context,
        folder: Path,
        count: Annotated[int, typer.Option("--how-many")] = 3,
        wall: Path | None = None,
        overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
        json: Annotated[bool, typer.Option("--json")] = False,
    ) -> None:
        del folder, count, wall, overwrite, json
        told.append(command_of(context, "make"))

    app([*arguments], standalone_mode=False)
    return shlex.split(told[0])


def test_arguments_options_and_flags_are_as_they_were_given() -> None:
    start = ["nlos-cam", "dataset", "make"]
    assert _told("a folder") == [*start, "a folder", "--how-many", "3"]
    given = ["in", "--how-many", "5", "--wall", "my wall.toml", "--overwrite"]
    assert _told(*given) == [*start, *given]


def test_how_the_result_was_told_is_left_out() -> None:
    assert _told("in", "--json") == _told("in")
