"""`tradeoff render` and `tradeoff reconstruct` write table and plot, and keep what was measured at Ctrl-C."""

import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_models import CheckpointRecord, Recipe

from nlos_cam import evaluate
from nlos_cam.cli.main import main
from nlos_cam.evaluate import RenderRow, measure_renders, render_settings, runtime_tradeoff
from nlos_cam.render import STOPS, Scene, paper_scene, render

SMALL = {name: replace(stop, relay_columns=8, relay_rows=4) for name, stop in STOPS.items()}
FIRST = 6  # measured rows: the accuracy stops, and two of the ingredients
FILES = {"tradeoff.html", "tradeoff.json", "tradeoff.md", "tradeoff.png"}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """A thirty-second part of the patches and of the relay wall; the scenes asked for are kept."""
    asked: list[Scene] = []

    def shrunk(scene: Scene) -> Scene:
        depth = np.full((16, 16), np.nan, np.float32)
        depth[4:12, 4:12] = scene.object_depth_m[24:40:2, 24:40:2]
        return replace(scene, object_depth_m=depth)

    def measured(scene: Scene) -> Iterator[RenderRow]:
        asked.append(scene)
        return islice(measure_renders(shrunk(scene), SMALL, lambda work, _: (work(), 0.5)[1]), FIRST)

    monkeypatch.setattr("nlos_cam.evaluate.measure_renders", measured)
    settings = lambda scene: render_settings(shrunk(scene), SMALL)[:FIRST]  # noqa: E731
    monkeypatch.setattr("nlos_cam.evaluate.render_settings", settings)
    return asked


@pytest.fixture
def plates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runtimes that answer with a plate, for any weights."""

    def plate(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert depth_m.shape == intensity.shape
        return np.full((1, 64, 64), 0.5, np.float32)

    made = {name: lambda _: plate for name in ("torch float32, cpu", "ONNX Runtime float32")}
    monkeypatch.setattr("nlos_cam.evaluate.runtimes", lambda *_: made)
    monkeypatch.setattr(runtime_tradeoff, "MIN_CALLS", 2)


Run = Callable[..., dict[str, Any]]


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(name: str, *options: str, code: int = 0) -> dict[str, Any]:
        assert main(["tradeoff", name, *options, "--out", str(tmp_path / "cost"), "--json"]) == code
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return call


def _assert_written(out: Path, result: dict[str, Any]) -> None:
    assert result["out"] == str(out)
    assert {path.name for path in out.iterdir()} == FILES
    assert json.loads((out / "tradeoff.json").read_text()) == {k: v for k, v in result.items() if k != "out"}


def test_tradeoff_render_writes_table_and_plot(tmp_path: Path, run: Run, small: list[Scene]) -> None:
    result = run("render")
    _assert_written(tmp_path / "cost", result)
    assert result["complete"]
    assert {stop["name"] for stop in result["stops"]} == set(STOPS)
    assert result["patches"] == np.isfinite(paper_scene().scene_at(0).object_depth_m).sum()
    np.testing.assert_array_equal(small[0].object_depth_m, paper_scene().scene_at(0).object_depth_m)


@pytest.mark.usefixtures("plates")
def test_tradeoff_reconstruct_writes_table_and_plot(tmp_path: Path, run: Run) -> None:
    result = run("reconstruct", "--count", "1")
    _assert_written(tmp_path / "cost", result)
    assert (result["complete"], result["objects"], len(result["settings"])) == (True, 1, 6)
    assert result["recommended"]["name"] in {row["name"] for row in result["settings"]}


@pytest.mark.slow
def test_tradeoff_render_uses_object_that_render_renders(tmp_path: Path, run: Run, small: list[Scene]) -> None:
    thing = ["--object", "bowl", "--seed", "4"]
    run("render", *thing)
    assert main(["render", "bowl", *thing[2:], "--accuracy", "draft", "--out", str(tmp_path / "maps.npz")]) == 0
    with np.load(tmp_path / "maps.npz") as file:
        np.testing.assert_array_equal(small[0].object_depth_m, file["object_depth_m"])
        np.testing.assert_array_equal(render(small[0], "draft").depth_m, file["depth_m"])


@pytest.mark.usefixtures("plates")
@pytest.mark.parametrize(
    ("name", "number", "rows"),
    [
        pytest.param("render", signal.SIGINT, 3, marks=pytest.mark.slow),
        pytest.param("render", signal.SIGTERM, 3, marks=pytest.mark.slow),
        ("render", signal.SIGINT, 0),
        ("reconstruct", signal.SIGINT, 2),
    ],
)
def test_tradeoff_keeps_rows_measured_before_signal(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, name: str, number: signal.Signals, rows: int
) -> None:
    measure = "measure_renders" if name == "render" else "measure_runtimes"
    whole = getattr(evaluate, measure)

    def cut_short(*arguments: Any) -> Iterator[Any]:
        for at, row in enumerate(whole(*arguments)):
            if at == rows:
                signal.raise_signal(number)
            yield row

    monkeypatch.setattr(f"nlos_cam.evaluate.{measure}", cut_short)
    before = signal.getsignal(number)
    result = run(name, *(["--count", "1"] if name == "reconstruct" else []), code=130)
    assert signal.getsignal(number) == before
    if rows:
        _assert_written(tmp_path / "cost", result)
        assert (result["complete"], len(result.get("stops", result.get("settings")))) == (False, rows)
    else:
        assert result["out"] is None
        assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_tradeoff_overwrites_only_on_demand(tmp_path: Path, run: Run) -> None:
    (tmp_path / "cost").mkdir()
    (precious := tmp_path / "cost" / "tradeoff.md").write_text("precious")
    assert run("render", code=1)["error"]["type"] == "OutputExistsError"
    assert precious.read_text() == "precious"
    run("render", "--overwrite")
    assert precious.read_text() != "precious"


def test_tradeoff_refuses_color_weights_before_rendering(tmp_path: Path, run: Run) -> None:
    recipe = Recipe(task="vae", colour=True, objects=2, held_out=1, epochs=1, batch=2, learning_rate=1e-3)
    record = CheckpointRecord.of([recipe], ("paper-rig", "0"))
    (tmp_path / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")
    result = run("reconstruct", "--weights", str(tmp_path), code=4)
    assert str(tmp_path) in result["error"]["message"]
    assert not (tmp_path / "cost").exists()
