"""Attacks of tools/robustness: they notice what they look for."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

Tool = Callable[[str], ModuleType]


def ended(code: int, said: str) -> subprocess.CompletedProcess[str]:
    return subprocess.CompletedProcess([], code, "", said)


@pytest.mark.parametrize(
    ("code", "said", "wrong"),
    [
        (1, "error: a.npz cannot be written: free some space", ""),
        (1, "Traceback (most recent call last):\nMemoryError", "Traceback"),
        (1, "one\ntwo\nthree\nfour", "4 lines"),
        (-11, "", "-11"),
        (0, "", "a.npz is not whole"),
    ],
)
def test_starved_command_that_ends_badly_is_noticed(
    tool: Tool, tmp_path: Path, code: int, said: str, wrong: str
) -> None:
    starve = tool("starve_commands")
    found = starve.wrong_with(starve.COMMANDS["render"], tmp_path, ended(code, said))
    assert wrong in found
    assert bool(found) == bool(wrong)


def test_starved_command_that_leaves_parts_is_noticed(tool: Tool, tmp_path: Path) -> None:
    starve = tool("starve_commands")
    (tmp_path / ".a.npz.part").mkdir()
    assert ".a.npz.part" in starve.wrong_with(starve.COMMANDS["render"], tmp_path, ended(1, "error: full"))
    (tmp_path / ".a.npz.part").rmdir()
    (tmp_path / "a.npz").touch()
    assert "not whole" in starve.wrong_with(starve.COMMANDS["render"], tmp_path, ended(1, "error: full"))


def test_findings_of_two_groups_are_joined(tool: Tool) -> None:
    fuzz = tool("fuzz")
    light, torch = fuzz.Findings(), fuzz.Findings()
    light.add("a.bag", fuzz.Verdict("refused", "", 200, 0.1))
    torch.add("b.h5", fuzz.Verdict("crash", "", 300, 0.2))
    torch.bad.append({"input": "b.h5"})
    facts = light.replaced(torch, ["b.h5"]).facts()
    assert (facts["cases"], facts["verdicts"]) == (2, {"refused": 1, "crash": 1})
    assert (facts["most_mib"], facts["bad"]) == ({"a.bag": 200, "b.h5": 300}, [{"input": "b.h5"}])


def test_page_that_nobody_serves_is_not_served(tool: Tool) -> None:
    assert tool("attack_view").page_ms("http://127.0.0.1:9/") is None
