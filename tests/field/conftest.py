"""Commands run in an empty folder, as a person would run them."""

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
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command with --json, assert its exit code, and return its Answer."""

    def call(*arguments: object, code: int = 0) -> Answer:
        capsys.readouterr()
        assert main([*map(str, arguments), "--json"]) == code
        out, err = capsys.readouterr()
        answer = Answer(json.loads((out.splitlines() or ["{}"])[-1]))
        answer.err = " ".join(err.split())
        return answer

    return call
