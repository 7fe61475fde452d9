"""The generated pages are as the program and the measured figures are."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

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
