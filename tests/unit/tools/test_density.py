"""What the gate on density counts."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

Tool = Callable[[str], ModuleType]


@pytest.mark.parametrize(
    ("text", "packed"),
    [
        ("a, b = 1, 2\n", 1),
        ("a = 1\nb = 2\n", 0),
        ("a, b = pair\n", 0),
        ("a, b = divmod(7, 2)\n", 0),
        ("def f():\n    x, y = y, x\n", 1),
    ],
)
def test_only_tuples_assigned_to_tuples_are_packed(tool: Tool, text: str, packed: int) -> None:
    assert tool("density").density_of(text).packed == packed


def test_layout_and_comments_are_no_tokens(tool: Tool) -> None:
    found = tool("density").density_of("# why\n\nx = 1  # what\n")

    assert found.tokens == 3
    assert found.comments == 1
    assert found.lines == 3


def test_wide_lines_and_skips_are_counted(tool: Tool) -> None:
    found = tool("density").density_of("x = 1  # fmt: " + "skip\n" + "y" * 101 + "\n")

    assert found.wide == 1
    assert found.unformatted == 1


def test_long_names_and_many_asserts_are_named(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    density = tool("density")
    monkeypatch.setattr(density, "ROOT", tmp_path)
    path = tmp_path / "test_a.py"
    body = "    assert True\n" * 9
    path.write_text(f"def test_{'a' * 60}():\n    pass\n\ndef test_b():\n{body}", encoding="utf-8")

    lines = list(density.joined_tests([path]))

    assert len(lines) == 2
    assert "65 characters" in lines[0]
    assert "9 asserts" in lines[1]


def test_the_gate_is_part_of_the_check(tool: Tool) -> None:
    assert ("python", "tools/checks/density.py") in tool("check").GATES
