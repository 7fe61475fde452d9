"""The reference of commands, held against the program."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import pytest
import typer

REFERENCE = Path(__file__).parents[2] / "docs" / "reference.md"


@pytest.fixture
def commands(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("commands")


def test_every_command_and_option_of_the_program_is_on_the_page(commands: ModuleType) -> None:
    text = commands.PAGE.read_text(encoding="utf-8")
    assert text == commands.page(), "run `python tools/commands.py`"


def test_every_command_is_in_the_table_of_what_they_answer(commands: ModuleType) -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    app = typer.main.get_command(commands.build_app())
    names = [name.removeprefix("nlos-cam ") for name, _ in commands.commands(app)]
    assert len(names) > 15
    assert [name for name in names if f"| `{name}" not in text] == []


def test_a_command_is_told_with_all_that_it_takes(commands: ModuleType) -> None:
    app = typer.Typer()

    @app.command()
    def shine(
        wall: Annotated[str, typer.Argument(metavar="WALL", help="Which.")],
        power: Annotated[float, typer.Option("--power", min=0, max=1, help="How much | of it.")] = 0.5,
        kind: Annotated[Literal["red", "blue"], typer.Option("--kind")] = "red",
        label: Annotated[list[str] | None, typer.Option("--label")] = None,
        json: Annotated[bool, typer.Option("--json")] = False,
    ) -> None:
        """Light a wall.

        For a while.
        """

    command = typer.main.get_command(app)
    assert [name for name, _ in commands.commands(command)] == ["nlos-cam"]
    told = commands.section("nlos-cam shine", command)
    assert told.startswith("## nlos-cam shine\n\nLight a wall. For a while.\n")
    assert "| `WALL` | text | **must be given** | Which. |" in told
    assert "| `--power` | number, at least 0, at most 1 | `0.5` | How much \\| of it. |" in told
    assert "| `--kind` | `red` or `blue` | `red` |  |" in told
    assert "| `--label` | text, more than once |  |  |" in told
    assert "Also: `--json`" in told
    assert "| `--json`" not in told


def test_a_page_that_is_behind_is_told_and_mended(
    commands: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(commands, "PAGE", tmp_path / "commands.md")
    for arguments, code in ((["--check"], 1), ([], 0), (["--check"], 0)):
        monkeypatch.setattr(commands.sys, "argv", ["commands.py", *arguments])
        assert commands.main() == code
    assert "out of date" in capsys.readouterr().out
