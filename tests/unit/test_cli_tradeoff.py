"""`tradeoff render` and `reconstruct`: a folder of table and plot, kept as far as it got, never over what is there."""

import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_models.checkpoint import CheckpointRecord
from nlos_models.recipe import Recipe

from nlos_cam.cli import tradeoff as command
from nlos_cam.cli.main import main
from nlos_cam.evaluate.render_tradeoff import Row, measure, settings
from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import paper_scene

SMALL = {name: replace(stop, relay_columns=8, relay_rows=4) for name, stop in STOPS.items()}
FIRST = 6
"""Rows that are measured: the stops, and two of the ingredients."""
FILES = {"tradeoff.json", "tradeoff.md", "tradeoff.png"}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """A thirty-second part of the patches and of the relay wall; the scenes asked for are kept."""
    asked: list[Scene] = []

    def shrunk(scene: Scene) -> Scene:
        assert scene.object_depth_m is not None
        depth = np.full((16, 16), np.nan, np.float32)
        depth[4:12, 4:12] = scene.object_depth_m[24:40:2, 24:40:2]
        return replace(scene, object_depth_m=depth)

    def measured(scene: Scene) -> Iterator[Row]:
        asked.append(scene)
        return islice(measure(shrunk(scene), SMALL, lambda work, _: (work(), 0.5)[1]), FIRST)

    monkeypatch.setattr(command, "measure", measured)
    monkeypatch.setattr(command, "settings", lambda scene: settings(shrunk(scene), SMALL)[:FIRST])
    return asked


def _last(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_the_default_scene_becomes_a_table_and_a_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], small: list[Scene]
) -> None:
    out = tmp_path / "cost"
    assert main(["tradeoff", "render", "--out", str(out), "--json"]) == 0
    result = _last(capsys)
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "tradeoff.json").read_text()) == {k: v for k, v in result.items() if k != "out"}
    assert result["out"] == str(out)
    assert result["complete"]
    assert {stop["name"] for stop in result["stops"]} == set(STOPS)
    assert result["patches"] == np.isfinite(paper_scene().scene_at(0).object_depth_m).sum()
    np.testing.assert_array_equal(small[0].object_depth_m, paper_scene().scene_at(0).object_depth_m)


def test_an_object_is_the_one_that_render_renders(tmp_path: Path, small: list[Scene]) -> None:
    assert main(["tradeoff", "render", "--object", "bowl", "--seed", "4", "--out", str(tmp_path / "a")]) == 0
    assert main(["render", "bowl", "--seed", "4", "--accuracy", "draft", "--out", str(tmp_path / "maps.npz")]) == 0
    with np.load(tmp_path / "maps.npz") as file:
        np.testing.assert_array_equal(small[0].object_depth_m, file["object_depth_m"])
        np.testing.assert_array_equal(render(small[0], "draft").depth_m, file["depth_m"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_is_measured_until_a_signal_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    whole = command.measure

    def cut_short(scene: Scene) -> Iterator[Row]:
        for at, row in enumerate(whole(scene)):
            if at == 3:
                signal.raise_signal(number)
            yield row

    monkeypatch.setattr(command, "measure", cut_short)
    before = signal.getsignal(number)
    assert main(["tradeoff", "render", "--out", str(tmp_path / "cost"), "--json"]) == 130
    assert signal.getsignal(number) == before
    result = _last(capsys)
    assert (result["complete"], len(result["stops"])) == (False, 3)
    assert {path.name for path in (tmp_path / "cost").iterdir()} == FILES


def test_a_signal_during_brute_force_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(scene: Scene) -> Iterator[Row]:
        del scene
        signal.raise_signal(signal.SIGINT)
        yield from ()

    monkeypatch.setattr(command, "measure", interrupted)
    assert main(["tradeoff", "render", "--out", str(tmp_path / "cost"), "--json"]) == 130
    assert _last(capsys)["out"] is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--object", "teapot"], 1, "no object 'teapot'"),
        (["--seed", "3"], 2, "--object"),
        (["--object", "cup", "--seed", "-1"], 2, ""),
    ],
)
def test_what_cannot_be_has_its_code_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    assert main(["tradeoff", "render", *arguments, "--out", str(tmp_path / "cost")]) == code
    shown = capsys.readouterr()
    assert words in shown.err
    assert "Traceback" not in shown.err
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_overwritten_only_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    precious = tmp_path / "tradeoff.md"
    precious.write_text("precious")
    arguments = ["tradeoff", "render", "--out", str(tmp_path), "--json"]
    assert main(arguments) == 1
    assert _last(capsys)["error"]["type"] == "OutputExistsError"
    assert precious.read_text() == "precious"
    assert main([*arguments, "--overwrite"]) == 0
    assert precious.read_text() != "precious"


def test_a_file_is_no_folder_even_when_asked_to_overwrite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    precious = tmp_path / "cost"
    precious.write_text("precious")
    assert main(["tradeoff", "render", "--out", str(precious), "--overwrite", "--json"]) == 1
    assert _last(capsys)["error"]["type"] == "OutputExistsError"
    assert precious.read_text() == "precious"


def test_it_is_a_group_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tradeoff", "--help"]) == 0
    assert "render" in capsys.readouterr().out


@pytest.fixture
def plates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runtimes that answer with a plate, for any weights."""

    class Plate:
        def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
            assert depth_m.shape == intensity.shape
            return np.full((1, 64, 64), 0.5, np.float32)

    made = {name: lambda _: Plate() for name in ("torch float32, cpu", "ONNX Runtime float32")}
    monkeypatch.setattr(command.reconstruction, "runtimes", lambda *_: made)
    monkeypatch.setattr(command.reconstruction, "LEAST_CALLS", 2)


@pytest.mark.usefixtures("plates")
def test_reconstruct_becomes_a_table_and_a_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cost"
    assert main(["tradeoff", "reconstruct", "--count", "1", "--out", str(out), "--json"]) == 0
    result = _last(capsys)
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "tradeoff.json").read_text()) == {k: v for k, v in result.items() if k != "out"}
    assert (result["complete"], result["objects"], len(result["settings"])) == (True, 1, 6)
    assert result["recommended"]["name"] in {row["name"] for row in result["settings"]}


@pytest.mark.usefixtures("plates")
def test_reconstruct_keeps_what_was_measured_until_a_signal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = command.reconstruction.measure

    def cut_short(*arguments: Any) -> Iterator[Any]:
        for at, row in enumerate(whole(*arguments)):
            if at == 2:
                signal.raise_signal(signal.SIGINT)
            yield row

    monkeypatch.setattr(command.reconstruction, "measure", cut_short)
    assert main(["tradeoff", "reconstruct", "--count", "1", "--out", str(tmp_path / "cost"), "--json"]) == 130
    result = _last(capsys)
    assert (result["complete"], len(result["settings"])) == (False, 2)
    assert {path.name for path in (tmp_path / "cost").iterdir()} == FILES


def test_weights_that_cannot_be_read_are_4(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = str(tmp_path / "none")
    assert main(["tradeoff", "reconstruct", "--weights", missing, "--out", str(tmp_path / "cost"), "--json"]) == 4
    assert _last(capsys)["error"]["type"] == "CheckpointError"
    assert not list(tmp_path.iterdir())


def test_weights_of_full_colour_are_refused_before_anything_is_rendered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = Recipe(task="vae", colour=True, objects=2, held_out=1, epochs=1, batch=2, learning_rate=1e-3)
    record = CheckpointRecord.of([recipe], ("paper-rig", "0"))
    (tmp_path / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")
    out = tmp_path / "cost"
    assert main(["tradeoff", "reconstruct", "--weights", str(tmp_path), "--out", str(out), "--json"]) == 4
    assert f"{tmp_path} holds weights for full colour (simulation only" in _last(capsys)["error"]["message"]
    assert not out.exists()
