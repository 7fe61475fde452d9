"""Tutorial check: runs every command of docs/tutorial.md in order and writes the answers into it
(no arguments).
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from nlos_cam.info import describe_program

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "tutorial.md"
STEP = re.compile(r"```sh\n(?P<commands>.*?)```\n\n```text\n(?P<answer>.*?)```", re.DOTALL)
"""Commands, and right after them their answers."""
BLOCK = re.compile(r"^ *```(?:sh|bash)\n(?P<commands>.*?)^ *```", re.DOTALL | re.MULTILINE)
"""Commands of any page."""
WIDTH = 110
"""Width of the terminal in characters."""
PROGRESS = re.compile(r"[A-Za-z][\w ]*: (?:\d+/\d+, )?\d+ s")
"""A line of progress, which only a slow machine prints."""

SOURCE = re.compile(r"nlos-cam \d\S*, weights `direct` [0-9a-f]{12}")
"""What gave the answers, in the page's head."""

Runner = Callable[[list[str]], str]
"""Runs one command, given as its words, and returns its output. Raises CalledProcessError where it
fails.
"""


def commands_of(text: str) -> list[list[str]]:
    """Return every command of a page in order, as words."""
    return [
        shlex.split(line) for step in STEP.finditer(text) for line in step["commands"].splitlines()
    ]


def printed_commands(text: str) -> list[list[str]]:
    """Return every command in the shell blocks of any page, as words without comments."""
    blocks = (block["commands"].replace("\\\n", " ") for block in BLOCK.finditer(text))
    lines = (shlex.split(line, comments=True) for block in blocks for line in block.splitlines())
    return [words for words in lines if words]


def answered(text: str, run: Runner) -> str:
    """Return the page with the present answers of its commands."""

    def step(found: re.Match[str]) -> str:
        lines = found["commands"].splitlines()
        answers = [run(shlex.split(line)) for line in lines]
        return f"```sh\n{found['commands']}```\n\n```text\n{''.join(answers)}```"

    return STEP.sub(step, text)


def source() -> str:
    """Return the program and the weights, as the page names what gave its answers."""
    facts = describe_program()
    return f"nlos-cam {facts['version']}, weights `direct` {facts['weights']['direct']}"


def as_program(words: list[str]) -> list[str]:
    """Return the words that start a command with this Python."""
    if words[0] == "python":
        return [sys.executable, *words[1:]]
    return [sys.executable, "-P", "-c", "from nlos_cam.cli import run; run()", *words[1:]]


def run_in(folder: Path) -> Runner:
    """Return a runner of commands in a folder that holds the repository's examples."""
    shutil.copytree(ROOT / "examples", folder / "examples")
    paths = os.pathsep.join(str(ROOT / part) for part in (".", "calibration", "models"))

    def run(words: list[str]) -> str:
        wide = {**os.environ, "COLUMNS": str(WIDTH), "PYTHONPATH": paths}
        ended = subprocess.run(
            as_program(words), cwd=folder, env=wide, capture_output=True, text=True, check=True
        )
        lines = [line.rstrip() for line in (ended.stderr + ended.stdout).splitlines()]
        return "".join(f"{line}\n" for line in lines if line and not PROGRESS.fullmatch(line))

    return run


def main() -> int:
    """Run all commands in a temporary folder."""
    with TemporaryDirectory() as folder:
        text = answered(PAGE.read_text(encoding="utf-8"), run_in(Path(folder)))
    text = SOURCE.sub(source(), text)
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
