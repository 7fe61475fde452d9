"""The tutorial's commands, run in the small: a page that has rotted fails here."""

import runpy
import shutil
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest

from nlos_cam.camera import simulated_world
from nlos_cam.cli.main import main
from nlos_cam.render.scene_file import Motion, SceneFile, paper_scene

ROOT = Path(__file__).parents[3]
SHORTER = {"--seconds": "0.5", "--count": "2", "--every": "5"}


@pytest.fixture
def tutorial(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("tutorial")


def still_scene() -> SceneFile:
    """The airplane, of which one pose is rendered and not ninety."""
    return paper_scene().model_copy(update={"motion": Motion(poses=1)})


def shortened(words: list[str]) -> list[str]:
    """The same command for less long, and without a browser."""
    said = [SHORTER.get(before, word) for before, word in zip(["", *words], words, strict=False)]
    return [*said, *(["--no-view"] if words[1] == "live" else [])]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    """Run one command in an empty folder with the examples, in this process."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulated_world, "paper_scene", still_scene)

    def call(words: list[str]) -> int:
        if words[0] == "nlos-cam":
            return main(shortened(words)[1:])
        monkeypatch.setattr(sys, "argv", words[1:])
        runpy.run_path(words[1], run_name="__main__")
        return 0

    return call


@pytest.mark.slow
def test_every_command_of_the_tutorial_does_its_work(tutorial: ModuleType, run: Callable[[list[str]], int]) -> None:
    text = tutorial.PAGE.read_text(encoding="utf-8")
    commands = tutorial.commands_of(text)
    assert len(commands) >= 10
    for words in commands:
        assert run(words) == 0, " ".join(words)
    made = [word for words in commands for before, word in pairwise(words) if before == "--out"]
    assert [name for name in made if not Path(name).exists()] == []


def test_every_command_block_is_followed_by_its_answer(tutorial: ModuleType) -> None:
    text = tutorial.PAGE.read_text(encoding="utf-8")
    assert text.count("```sh\n") == len(tutorial.STEP.findall(text))
    assert all(found["answer"].strip() for found in tutorial.STEP.finditer(text)), "run `python tools/docs/tutorial.py`"
