"""`live` and `replay` on a measured wall: difference maps, warnings, what is refused before anything streams."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_wall import RIG, SMALL, WallCamera, bare_wall, write_wall

from nlos_cam.cli import live as commands
from nlos_cam.cli.main import main

RECORD = SimpleNamespace(rig_name=RIG.name, rig_checksum=RIG.checksum, input="raw maps")


class FakeNetwork:
    """Shows nothing, and notes what it eats."""

    runtime = "nothing at all"

    def __init__(self) -> None:
        self.record = RECORD
        self.eaten: list[np.ndarray] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape == (len(depth_m), 64, 80)
        self.eaten.extend(depth_m)
        return np.zeros((len(depth_m), 64, 64), np.float32)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeNetwork:
    found = FakeNetwork()
    monkeypatch.setattr("nlos_cam.reconstruct.pipeline.os.cpu_count", lambda: 1)  # so that it eats in order
    monkeypatch.setattr(commands, "load_networks", lambda *_: found)
    monkeypatch.setattr(commands, "load_doubt", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    write_wall(tmp_path / "wall.toml", bare_wall())
    use(monkeypatch, WallCamera(150, moved=range(30, 80)))
    return found


def use(monkeypatch: pytest.MonkeyPatch, camera: WallCamera) -> None:
    monkeypatch.setattr(commands, "open_camera", lambda *_, **__: camera)


def told(capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """The JSON object that ends stdout, and stderr on one line."""
    captured = capsys.readouterr()
    return json.loads(captured.out.splitlines()[-1]), captured.err.replace("\n", " ")


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize("command", [("live", "--camera", "sim", "--no-view"), ("replay", "a.bag", "--out", "out")])
def test_a_warning_is_told_once_when_it_begins_and_once_when_it_ends(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setattr("nlos_cam.live.frame_queue.QUEUE_FRAMES", 1000)
    assert main([*command, "--wall", "wall.toml", "--json"]) == 0
    report, said = told(capsys)
    [(warning, frames)] = report["warnings"].items()
    assert 0 < frames < 150
    assert said.count("warning: the range has drifted") == said.count(f"no longer: {warning}") == 1


@pytest.mark.usefixtures("network")
def test_a_person_is_told_the_warnings_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", "--camera", "bag:a.bag", "--no-view", "--wall", "wall.toml"]) == 0
    assert " frames: " in capsys.readouterr().out


def test_maps_are_averaged_over_as_many_frames_as_asked(network: FakeNetwork) -> None:
    arguments = ["replay", "a.bag", "--wall", "wall.toml", "--out", "out", "--overwrite"]
    assert main(arguments) == 0
    assert main([*arguments, "--average", "20"]) == 0
    alone, averaged = (np.array(network.eaten[first : first + 30]) for first in (0, 150))
    np.testing.assert_allclose(averaged[25], alone[6:26].mean(axis=0), atol=1e-6)  # NaN where NaN
    assert main([*arguments, "--average", "0"]) == 2


def test_weights_that_eat_difference_maps_are_fed_those_or_refused(
    network: FakeNetwork, capsys: pytest.CaptureFixture[str]
) -> None:
    network.record = SimpleNamespace(**{**vars(RECORD), "input": "difference maps"})
    assert main(["replay", "a.bag", "--wall", "wall.toml", "--out", "out", "--json"]) == 0
    assert abs(np.nanmean(network.eaten[20])) < 1e-3
    capsys.readouterr()
    assert main(["live", "--camera", "sim", "--no-view", "--json"]) == 1
    assert "give --wall with a reference" in told(capsys)[0]["error"]["message"]


@pytest.mark.usefixtures("network")
def test_a_record_without_a_reference_is_told_to_watch_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    write_wall(tmp_path / "old.toml")
    for name, notes in (("old.toml", 1), ("wall.toml", 0)):
        assert main(["replay", "a.bag", "--wall", name, "--out", "out", "--overwrite", "--json"]) == 0
        assert told(capsys)[1].count("note: this wall's record has no reference") == notes


@pytest.mark.usefixtures("network")
def test_a_camera_of_another_size_is_refused_before_it_streams(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = WallCamera(9)
    camera.intrinsics = SMALL.scaled(40, 32)
    use(monkeypatch, camera)
    assert main(["live", "--camera", "sim", "--no-view", "--wall", "wall.toml", "--json"]) == 1
    error = told(capsys)[0]["error"]
    assert (error["type"], error["message"][:50]) == (
        "CalibrationError",
        "the wall was measured at 80x64, the camera gives 4",
    )
