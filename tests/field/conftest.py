"""Commands run in an empty folder, as a person would run them."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from noise_bags import make_all
from rosbags.rosbag1 import Reader, Writer

from nlos_cam.cli.main import main
from nlos_cam.recording import SAMPLE

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


Edit = Callable[[str, int, bytes], Iterable[tuple[int, bytes]]]
Remake = Callable[..., Path]


@pytest.fixture
def remake(tmp_path: Path) -> Remake:
    """Write a recording with messages (topic, time in ns, bytes) that `edit` makes of another's,
    and without the topics on which it leaves none.
    """

    def make(edit: Edit, *, source: Path = SAMPLE, name: str = "other.bag") -> Path:
        writer = Writer(tmp_path / name)
        made: dict[int, Any] = {}
        with Reader(source) as reader, writer:
            for found, time_ns, raw in reader.messages():
                for new_time_ns, new_raw in edit(found.topic, time_ns, raw):
                    if found.id not in made:
                        made[found.id] = writer.add_connection(
                            found.topic,
                            found.msgtype,
                            msgdef=found.msgdef.data,
                            md5sum=found.digest,
                        )
                    writer.write(made[found.id], new_time_ns, new_raw)
        return tmp_path / name

    return make


@pytest.fixture(scope="session")
def noise(recorded: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record forty small frames."""
    return recorded(tmp_path_factory.mktemp("noise") / "noise.bag", frames=40)


@pytest.fixture(scope="session")
def noise_bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Record forty frames, closed and as a kill leaves them."""
    return make_all(tmp_path_factory.mktemp("killed"))
