"""`evaluate` judges weights on objects or a dataset; `tradeoff` measures settings, and keeps its
rows at Ctrl-C.
"""

import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from nlos_models import CheckpointRecord
from nlos_models.training import MapSet, VaeRecipe
from small_frames import SheetNetwork, sheet_network
from small_maps import SmallDataset

from nlos_cam import evaluate
from nlos_cam.dataset import HELD_OUT_SEED, TRAINING_SEED, DatasetPlan, procedural_images
from nlos_cam.evaluate import (
    TARGETS,
    baselines,
    measure_renders,
    reconstruct_tradeoff,
    render_settings,
    report,
    subjects,
)
from nlos_cam.objects import benchmark_objects
from nlos_cam.render import STOPS, Scene, paper_scene, render

RIG = load_rig("paper-rig")
Patch = pytest.MonkeyPatch
Run = Callable[..., Any]
OUT = Path("cost")
JUDGE, RENDER, RECONSTRUCT = (
    (*command.split(), "--out", out)
    for command, out in (
        ("evaluate", "figures"),
        ("tradeoff render", OUT),
        ("tradeoff reconstruct", OUT),
    )
)
STORED = ["--dataset", "held-out", "--training", "held-out/training"]


class Guesser(SheetNetwork):
    """Network that answers everything with the same plate, and keeps the depth maps it was
    given.
    """

    def __init__(self, eats: str = "raw maps") -> None:
        super().__init__()
        vars(self.record).update(
            input=eats, compressor_recipe=None, vae_recipe=SimpleNamespace(left_out=["cup"])
        )

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        inside = np.abs(np.arange(64) - 31.5) < 16
        return super().__call__(depth_m, intensity) * np.outer(inside, inside)


def _maps(plan: DatasetPlan, count: int) -> MapSet:
    images = procedural_images(plan.first_seed, count, plan.box)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    return MapSet(wide + 0.3, 40 * wide, images)


class Stored(SmallDataset):
    """Dataset on the disk, of two cups and a hat."""

    folder = Path("stored")

    def __init__(self, first_seed: int, count: int, rig: Rig = RIG) -> None:
        plan = DatasetPlan(rig, first_seed)
        super().__init__(_maps(plan, count), plan)
        self.seeds = set(range(first_seed, first_seed + count))

    def column(self, name: str) -> Any:
        return {"category": np.array(["cup", "hat", "cup"], object), "seed": np.arange(3)}[name]


@pytest.fixture(autouse=True)
def guessing(monkeypatch: Patch) -> list[DatasetPlan]:
    """A guesser as weights, a dataset, and training objects that are not rendered; their plans are
    kept.
    """
    asked: list[DatasetPlan] = []
    Path("held-out/training").mkdir(parents=True)

    def training_maps(plan: DatasetPlan, *_: object) -> Stored:
        asked.append(plan)
        return Stored(TRAINING_SEED, 4)

    monkeypatch.setattr(baselines, "training_maps", training_maps)
    monkeypatch.setattr(baselines, "NEIGHBOURS", 4)
    monkeypatch.setattr(report, "load_reconstructor", lambda *_: Guesser())

    def open_dataset(folder: Path) -> Stored:
        stored = Stored(HELD_OUT_SEED, 3)
        stored.folder = folder
        if folder.name == "training":  # the same maps under other seeds
            stored.seeds = set(range(TRAINING_SEED, TRAINING_SEED + 3))
        return stored

    monkeypatch.setattr(subjects.data, "open_dataset", open_dataset)
    return asked


@pytest.fixture
def unwritten(monkeypatch: Patch) -> None:
    """Reports take seconds."""
    monkeypatch.setattr("nlos_cam.evaluate.write_report", lambda *_: None)


@pytest.mark.usefixtures("unwritten")
def test_evaluate_prints_figures_of_dataset(run: Run) -> None:
    result = run(*JUDGE, *STORED)

    assert {*TARGETS, "baselines", "per_category", "objects", "seconds", "out"} < set(result)
    assert result["objects"] == 3
    assert result["training_objects"] == 3
    assert set(result["per_category"]) == {"cup", "hat"}
    assert set(result["shown_and_left_out"]) == {"shown", "left out"}
    assert ["cup" in note for note in result["notes"]] == [True]


@pytest.mark.usefixtures("unwritten")
@pytest.mark.parametrize(("rig", "weights"), [("paper-rig", "direct"), ("wide-rig", "wide")])
def test_evaluate_names_weights_by_the_datasets_rig(
    run: Run, monkeypatch: Patch, rig: str, weights: str
) -> None:
    stored = Stored(HELD_OUT_SEED, 3, load_rig(rig))
    monkeypatch.setattr(subjects.data, "open_dataset", lambda _: stored)

    assert run(*JUDGE, "--dataset", "held-out", "--no-nearest")["weights"] == weights


@pytest.mark.usefixtures("unwritten")
def test_evaluate_compares_with_baselines(run: Run) -> None:
    baseline = run(*JUDGE, *STORED)["baselines"]

    assert set(baseline) == {"all_background", "mean_object", "nearest_neighbour"}
    assert baseline["nearest_neighbour"]["silhouette_iou"]["value"] == 1  # it is the set itself


def test_evaluate_writes_its_figures_once(run: Run, monkeypatch: Patch) -> None:
    out = Path("figures")

    result = run(*JUDGE, *STORED)

    del result["out"]

    assert json.loads((out / "figures.json").read_text("utf-8")) == result
    assert "\nhat 1," in (out / "objects.csv").read_text("utf-8")
    assert run(*JUDGE, *STORED, code=1)["error"]["type"] == "OutputExistsError"

    monkeypatch.setattr("nlos_cam.evaluate.write_report", lambda *_: None)
    run(*JUDGE, *STORED, "--overwrite")


@pytest.mark.slow
def test_evaluate_uses_test_set_without_dataset(
    run: Run, monkeypatch: Patch, guessing: list[DatasetPlan]
) -> None:
    monkeypatch.setattr(
        subjects.shapes, "benchmark_objects", lambda box: benchmark_objects(box)[:2]
    )
    result = run(*JUDGE)

    assert result["objects"] == 2
    assert result["rig"] == RIG.name
    assert guessing[0].rig == RIG
    assert list(result["per_category"]) == [benchmark_objects(DatasetPlan(RIG, 0).box)[0].category]
    assert "nearest_neighbour" in result["baselines"]


@pytest.mark.usefixtures("unwritten")
def test_evaluate_count_uses_seeded_objects(run: Run, guessing: list[DatasetPlan]) -> None:
    result = run(*JUDGE, "--count", "1", "--no-nearest")

    assert result["objects"] == 1
    assert set(result["baselines"]) == {"all_background", "mean_object"}
    assert result["advantage_over_nearest_neighbour"] is None
    assert not guessing


@pytest.mark.usefixtures("unwritten")
@pytest.mark.parametrize(
    ("maps", "options", "wall_m"),
    [
        ("raw maps", [], 0),
        ("difference maps", [], 0.25),
        ("difference maps", ["--wall", "wall.toml"], 0.5),
    ],
)
def test_evaluate_subtracts_bare_wall_for_the_weights_alone(
    run: Run, monkeypatch: Patch, maps: str, options: list[str], wall_m: float
) -> None:
    network = Guesser(maps)
    blank = np.zeros((64, 80), np.float32)
    monkeypatch.setattr(report, "load_reconstructor", lambda *_: network)
    monkeypatch.setattr(
        subjects.data, "render_bare_wall", lambda _: (blank + np.float32(0.25), blank)
    )
    monkeypatch.setattr(
        subjects.data, "measured_bare_wall", lambda _: (blank + np.float32(0.5), blank)
    )
    result = run(*JUDGE, *STORED, *options)
    raw = _maps(DatasetPlan(RIG, HELD_OUT_SEED), 3)

    np.testing.assert_allclose(np.stack(network.given), raw.depth_m - wall_m, atol=1e-6)
    assert result["input"] == maps
    assert result["baselines"]["nearest_neighbour"]["silhouette_iou"]["value"] == 1


def test_evaluate_refuses_wall_for_weights_of_raw_maps(run: Run) -> None:
    assert "--wall" in run(*JUDGE, *STORED, "--wall", "wall.toml", code=1)["error"]["message"]
    assert [*Path().iterdir()] == [Path("held-out")]


SMALL = {name: replace(stop, relay_columns=8, relay_rows=4) for name, stop in STOPS.items()}
FIRST = 6  # measured rows: the accuracy stops, and two of the ingredients
FILES = {"tradeoff.html", "tradeoff.json", "tradeoff.md", "tradeoff.png"}


@pytest.fixture(autouse=True)
def small(monkeypatch: Patch) -> list[Scene]:
    """A thirty-second part of the patches and of the relay wall; the scenes asked for are kept."""
    asked: list[Scene] = []

    def shrunk(scene: Scene) -> Scene:
        depth = np.full((16, 16), np.nan, np.float32)
        depth[4:12, 4:12] = scene.object_depth_m[24:40:2, 24:40:2]
        return replace(scene, object_depth_m=depth)

    def measured(scene: Scene) -> Iterator[evaluate.RenderRow]:
        asked.append(scene)
        return islice(
            measure_renders(shrunk(scene), SMALL, lambda work, _: (work(), 0.5)[1]), FIRST
        )

    monkeypatch.setattr("nlos_cam.evaluate.measure_renders", measured)
    settings = lambda scene: render_settings(shrunk(scene), SMALL)[:FIRST]  # noqa: E731
    monkeypatch.setattr("nlos_cam.evaluate.render_settings", settings)
    return asked


@pytest.fixture
def plates(monkeypatch: Patch) -> None:
    """Networks that answer with a plate, for any weights."""
    load = reconstruct_tradeoff.models.load_reconstructor

    def loaded(folder: Path, cache: Path) -> Any:
        record = load(folder, cache).record
        network = Mock(spec=("record", "runtime"), side_effect=sheet_network)
        network.configure_mock(record=record, runtime="plate")
        return network

    monkeypatch.setattr(reconstruct_tradeoff.models, "load_reconstructor", loaded)
    monkeypatch.setattr(reconstruct_tradeoff, "MIN_CALLS", 2)


def _assert_written(result: dict[str, Any]) -> None:
    assert result["out"] == str(OUT)
    assert {path.name for path in OUT.iterdir()} == FILES
    assert json.loads((OUT / "tradeoff.json").read_text()) == {
        k: v for k, v in result.items() if k != "out"
    }


@pytest.mark.usefixtures("small")
def test_tradeoff_render_overwrites_when_asked(run: Run) -> None:
    OUT.mkdir()
    precious = OUT / "tradeoff.md"
    precious.write_text("precious")

    assert run(*RENDER, code=1)["error"]["type"] == "OutputExistsError"
    assert precious.read_text() == "precious"
    _assert_written(run(*RENDER, "--overwrite"))
    assert precious.read_text() != "precious"


def test_tradeoff_render_writes_table_and_plot(run: Run, small: list[Scene]) -> None:
    depth_m = paper_scene().scene_at(0).object_depth_m

    result = run(*RENDER)

    _assert_written(result)
    assert result["complete"]
    assert {stop["name"] for stop in result["stops"]} == set(STOPS)
    assert result["patches"] == np.isfinite(depth_m).sum()
    np.testing.assert_array_equal(small[0].object_depth_m, depth_m)


@pytest.mark.usefixtures("plates")
def test_tradeoff_reconstruct_writes_table_and_plot(run: Run) -> None:
    result = run(*RECONSTRUCT, "--count", "1")

    _assert_written(result)
    assert (result["complete"], result["objects"], len(result["settings"])) == (True, 1, 8)
    assert result["recommended"]["name"] in {row["name"] for row in result["settings"]}


@pytest.mark.usefixtures("plates")
def test_tradeoff_reconstruct_measures_each_rig_s_weights_on_it(run: Run) -> None:
    result = run(*RECONSTRUCT, "--count", "1", "--weights", "wide", "--weights", "direct")

    rigs = {row["weights"]: row["rig"] for row in result["settings"]}
    assert rigs == {"wide": "wide-rig", "direct": "paper-rig"}
    assert all(set(TARGETS) <= set(row["unseen"]) for row in result["settings"])


@pytest.mark.slow
def test_tradeoff_render_uses_object_that_render_renders(run: Run, small: list[Scene]) -> None:
    run(*RENDER, "--object", "bowl", "--seed", "4")
    run("render", "bowl", "--seed", "4", "--accuracy", "draft", "--out", "maps.npz")
    with np.load("maps.npz") as file:
        np.testing.assert_array_equal(small[0].object_depth_m, file["object_depth_m"])
        np.testing.assert_array_equal(render(small[0], "draft").depth_m, file["depth_m"])


@pytest.mark.usefixtures("plates")
@pytest.mark.parametrize(
    ("command", "number", "rows"),
    [
        pytest.param(RENDER, signal.SIGINT, 3, marks=pytest.mark.slow),
        pytest.param(RENDER, signal.SIGTERM, 3, marks=pytest.mark.slow),
        (RENDER, signal.SIGINT, 0),
        ((*RECONSTRUCT, "--count", "1"), signal.SIGINT, 2),
    ],
)
def test_tradeoff_keeps_rows_measured_before_signal(
    run: Run, monkeypatch: Patch, command: tuple[str, ...], number: signal.Signals, rows: int
) -> None:
    measure = "measure_renders" if command is RENDER else "measure_reconstructions"
    whole = getattr(evaluate, measure)

    def cut_short(*arguments: Any) -> Iterator[Any]:
        for at, row in enumerate(whole(*arguments)):
            if at == rows:
                signal.raise_signal(number)
            yield row

    monkeypatch.setattr(f"nlos_cam.evaluate.{measure}", cut_short)
    before = signal.getsignal(number)
    result = run(*command, code=130)

    assert signal.getsignal(number) == before

    if rows:
        _assert_written(result)
        assert (result["complete"], len(result.get("stops", result.get("settings")))) == (
            False,
            rows,
        )
    else:
        assert result["out"] is None
        assert [*Path().iterdir()] == [Path("held-out")]


def test_tradeoff_refuses_color_weights_before_rendering(run: Run) -> None:
    recipe = VaeRecipe(
        task="vae", colour=True, objects=2, held_out=1, epochs=1, batch=2, learning_rate=1e-3
    )
    record = CheckpointRecord.of([recipe], ("paper-rig", "0"))
    (weights := Path("color")).mkdir()
    (weights / "checkpoint.json").write_text(record.model_dump_json(), encoding="utf-8")

    assert str(weights) in run(*RECONSTRUCT, "--weights", weights, code=4)["error"]["message"]
    assert not OUT.exists()
