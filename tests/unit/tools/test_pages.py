"""The generated pages are as the program and the measured figures are."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import pytest
import typer

REFERENCE = Path(__file__).parents[3] / "docs" / "reference.md"


@pytest.fixture
def commands(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("pages")


@pytest.mark.slow
def test_every_command_and_option_of_the_program_is_on_the_page(commands: ModuleType) -> None:
    text = (commands.DOCS / "commands.md").read_text(encoding="utf-8")
    assert text == commands.commands_page(), "run `python tools/docs/pages.py commands`"


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


@pytest.mark.parametrize("name", ["comparison", "gallery"])
def test_page_has_the_measured_figures(commands: ModuleType, name: str) -> None:
    page = (commands.DOCS / f"{name}.md").read_text(encoding="utf-8")
    assert commands.PAGES[name]() == page, "run `python tools/docs/pages.py`"


@pytest.mark.slow
def test_stale_page_fails_the_check_until_written(
    commands: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(commands, "DOCS", tmp_path)
    for arguments, code in ((["--check"], 1), ([], 0), (["--check"], 0)):
        monkeypatch.setattr("sys.argv", ["pages.py", "commands", *arguments])
        assert commands.main() == code
    assert "out of date" in capsys.readouterr().out


def figures(value: float) -> dict[str, dict[str, float]]:
    names = "silhouette_iou", "accuracy_mean_abs", "accuracy_within_2_percent", "foreground_rmse_mm"
    return {name: {"value": value, "low": value - 0.1, "high": value + 0.1} for name in names}


def test_the_worst_kind_comes_first_and_the_bar_last(commands: ModuleType) -> None:
    table = commands.by_kind({**figures(0.5), "per_category": {"cup": figures(0.8), "car": figures(0.2)}})
    names = [line.split(" | ")[0] for line in table.splitlines()[2:]]
    assert names == ["| car", "| cup", "| **all 54**", "| **the bar**"]


def test_tables_take_the_place_of_those_before_them_and_of_nothing_else(commands: ModuleType) -> None:
    page = "a\n<!-- by kind -->\n<!-- end -->\nb\n<!-- by limit -->\nold\n<!-- end -->\nc\n"
    tables = {"by kind": "1\n", "by limit": "2\n"}
    filled = commands.filled(page, tables)
    assert filled == "a\n<!-- by kind -->\n1\n<!-- end -->\nb\n<!-- by limit -->\n2\n<!-- end -->\nc\n"
    assert commands.filled(filled, tables) == filled
