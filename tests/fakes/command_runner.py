"""Fixtures that run commands in an empty folder, as a person would; a conftest imports them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.cli.main import main

Run = Callable[..., Any]


class Answer(dict[str, Any]):
    """Last line of stdout, and stderr on one line."""

    err = ""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command, assert its exit code, and return stdout and stderr."""

    def call(*arguments: object, code: int = 0) -> Any:
        capsys.readouterr()
        assert main(list(map(str, arguments))) == code
        return capsys.readouterr()

    return call


@pytest.fixture
def run(shown: Run) -> Run:
    """Run a command with --json, assert its exit code, and return its Answer."""

    def call(*arguments: object, code: int = 0) -> Answer:
        out, err = shown(*arguments, "--json", code=code)
        answer = Answer(json.loads((out.splitlines() or ["{}"])[-1]))
        answer.err = " ".join(err.split())
        return answer

    return call
