"""The curve over recordings: nested sets, each run once, the trainer's command, and objects that nobody trains on."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.rig import load_rig
from nlos_models.data import MapSet

from nlos_cam.dataset import build
from nlos_cam.dataset.labelled import Labelled
from nlos_cam.errors import NlosCamError

RIG = load_rig("paper-rig")
PARTS = {"adaptation": 5, "validation": 2, "held-out": 3}


@pytest.fixture(scope="module")
def tools(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("transfer_curve")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Names of recordings in the three parts."""
    for part, count in PARTS.items():
        (tmp_path / "bench" / part).mkdir(parents=True)
        for k in range(count):
            (tmp_path / "bench" / part / f"{part}-{k}.bag").touch()
    return tmp_path / "bench"


def _read(recordings: list[Path], *, frames: int) -> Labelled:
    """Samples whose every value is the recording's own."""
    names = [path.stem for path in recordings for _ in range(frames)]
    value = np.array([sum(name.encode()) / 1e4 for name in names], np.float32)[:, None, None]
    maps, image = value + np.zeros((64, 80), np.float32), (value + np.zeros((64, 64))).astype(np.float16)
    return Labelled(MapSet(maps, maps, image), image.astype(np.float32), tuple(names), tuple(names), RIG)


@pytest.fixture
def seen(tools: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What was judged: by which weights, how many samples. Figures tell the weights' own count of samples."""
    judged: list[Any] = []

    def judge(weights: Path | None, maps: MapSet) -> dict[str, Any]:
        judged.append((weights, len(maps.image)))
        value = float(int(weights.name.split("-")[0])) if weights else 50.0
        figure = {"value": value, "low": value - 1, "high": value + 1}
        return {"foreground_rmse_mm": figure, "silhouette_iou": figure}

    monkeypatch.setattr(tools, "read_labelled", _read)
    monkeypatch.setattr(tools, "_judged", judge)
    return judged


def _trainer(lessons: list[Any]) -> Callable[[Any], Path]:
    def train(lesson: Any) -> Path:
        maps, _ = build.read(lesson.dataset)
        validation, _ = build.read(lesson.validation)
        lessons.append((lesson.samples, {float(v) for v in maps.depth_m[:, 0, 0]}, len(validation.image)))
        lesson.out.mkdir(parents=True)
        return lesson.out

    return train


@given(st.integers(1, 40), st.lists(st.integers(1, 60), min_size=1, max_size=5), st.integers(0, 9))
def test_sets_are_nested_and_of_the_sizes_asked_for(
    tools: ModuleType, count: int, counts: list[int], seed: int
) -> None:
    recordings = [Path(f"{k}.bag") for k in range(count)]
    sets = tools.nested(recordings, counts, seed)
    assert list(sets) == sorted({min(size, count) for size in counts})
    members = [set(chosen) for chosen in sets.values()]
    assert [len(one) for one in members] == list(sets)
    assert all(one <= other for one, other in pairwise(members))


def test_each_number_of_recordings_is_trained_on_by_each_trainer_and_judged_on_what_none_saw(
    tools: ModuleType, folder: Path, tmp_path: Path, seen: list[Any]
) -> None:
    lessons: list[Any] = []
    trainers = {name: _trainer(lessons) for name in ("transfer", "scratch")}
    points = list(tools.curve(folder, tmp_path / "runs", trainers, None, counts=(2, 4), frames=3))
    assert [(point.trainer, point.recordings) for point in points] == [
        ("before", 0),
        ("transfer", 2),
        ("scratch", 2),
        ("transfer", 4),
        ("scratch", 4),
    ]
    assert [lesson[0] for lesson in lessons] == [6, 6, 12, 12]
    assert [len(lesson[1]) for lesson in lessons] == [2, 2, 4, 4]
    assert lessons[0][1] <= lessons[2][1]
    assert {lesson[2] for lesson in lessons} == {PARTS["validation"] * 3}
    assert {samples for _, samples in seen} == {PARTS["held-out"]}
    assert seen[0][0] is None
    assert points[3].figures["foreground_rmse_mm"]["value"] == 4.0


def test_what_was_reached_is_not_run_again(tools: ModuleType, folder: Path, tmp_path: Path, seen: list[Any]) -> None:
    lessons: list[Any] = []
    first, again = (
        list(tools.curve(folder, tmp_path / "runs", {"transfer": _trainer(lessons)}, None, counts=counts, frames=1))
        for counts in ((2,), (2, 3))
    )
    assert again[:2] == first
    assert len(lessons) == 2
    assert len(seen) == 4  # before, twice: it costs nothing


def test_a_command_trains_and_its_failure_is_told(tools: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    codes = iter((0, 1))
    monkeypatch.setattr(tools, "nlos_cam", lambda arguments: calls.append(arguments) or next(codes))
    lesson = tools.Lesson(Path("data"), Path("val"), 24, Path("run"))
    train = tools.commanded("transfer", Path("r.toml"), "--weights", Path("w"))
    assert train(lesson) == Path("run")
    told = "train transfer --recipe r.toml --dataset data --held-out val --objects 24 --out run --weights w"
    assert " ".join(calls[0]) == told
    with pytest.raises(NlosCamError, match=r"train transfer .* ended with 1"):
        train(lesson)


def test_a_curve_is_drawn(tools: ModuleType, folder: Path, tmp_path: Path, seen: list[Any]) -> None:
    points = list(tools.curve(folder, tmp_path / "runs", {"transfer": _trainer([])}, None, counts=(2, 4), frames=1))
    tools.draw(points, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    assert seen
    assert json.loads((tmp_path / "runs" / "02-transfer" / "figures.json").read_text())


def test_figures_of_exact_images_are_perfect_and_those_of_nothing_are_not(tool: Callable[[str], ModuleType]) -> None:
    figures = tool("transfer_figures")
    image = np.where(np.indices((2, 64, 64))[2] > 20, np.float32(0.5), np.float32(0.0))
    maps = MapSet(np.zeros((2, 64, 80), np.float32), np.zeros((2, 64, 80), np.float32), image)
    exact, nothing, near = (
        figures.judge(lambda *_, made=made: made, MapSet(*(m[:1] for m in vars(maps).values())), figures.paper_box())
        for made in (image[:1], 0 * image[:1], image[:1] + np.float32(0.1) * (image[:1] > 0))
    )
    assert exact["silhouette_iou"]["value"] == exact["accuracy_within_2_percent"]["value"] == 1
    assert exact["foreground_rmse_mm"]["value"] == 0
    assert nothing["silhouette_iou"]["value"] == 0
    assert nothing["foreground_rmse_mm"]["value"] is None
    assert near["foreground_rmse_mm"]["value"] == pytest.approx(0.1 * 280 / 0.9, rel=1e-3)
    assert near["foreground_too_far_mm"]["value"] == pytest.approx(-0.1 * 280 / 0.9, rel=1e-3)
    assert nothing["foreground_too_far_mm"]["value"] is None
    assert exact["objects"] == 1
