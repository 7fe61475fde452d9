"""`train doubt`: from weights and maps to a folder of weights with their doubt, on small networks."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig
from nlos_models import checkpoint
from nlos_models.doubt_checkpoint import load_doubt
from small_maps import SmallDataset, small_maps, untrained_weights, use_small_networks

from nlos_cam.cli import train
from nlos_cam.cli.main import main
from nlos_cam.dataset import build
from nlos_cam.dataset.doubt_samples import EMPTY, ORDINARY, DoubtSamples
from nlos_cam.dataset.outliers import TO_LEARN

RIG = load_rig("paper-rig")
PLAN = build.DatasetPlan(RIG, 0)
RECIPE = (
    'task = "doubt"\nobjects = 8\noutliers = 7\nempties = 14\nheld_out = 4\nepochs = 1\nbatch = 8\n'
    "learning_rate = 1e-3\n"
)
Go = Callable[..., tuple[int, dict[str, Any]]]


def small_samples(_: Path, counts: dict[str, int], seed: int, *__: object, **___: object) -> DoubtSamples:
    """Every fourth outlier cannot be seen."""
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    maps = small_maps(len(kinds), seed % 97)
    cells = np.where(np.arange(len(kinds)) % 4 == 0, 0, 100).astype(np.int32)
    return DoubtSamples(maps.depth_m, maps.intensity, maps.image.astype(np.float16), cells, np.array(kinds))


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    use_small_networks(monkeypatch, checkpoint)
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(train, "samples_on_disk", small_samples)
    sets = {name: SmallDataset(small_maps(count, count), PLAN) for name, count in (("data", 8), ("held-out", 6))}
    monkeypatch.setattr(build, "open_dataset", lambda of, **_: sets[of.name])
    yield
    torch.set_num_threads(before)


@pytest.fixture
def go(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Go:
    (tmp_path / "doubt.toml").write_text(RECIPE, encoding="utf-8")
    untrained_weights(tmp_path / "weights", rig=RIG)

    def run(*options: str, weights: str = "weights", out: str = "out") -> tuple[int, dict[str, Any]]:
        files = {"--recipe": "doubt.toml", "--weights": weights, "--out": out}
        given = [part for name, file in files.items() for part in (name, str(tmp_path / file))]
        code = main(["train", "doubt", *given, "--dataset", "data", "--held-out", "held-out", *options, "--json"])
        lines = capsys.readouterr().out.splitlines()
        return code, json.loads(lines[-1]) if lines else {}

    return run


def test_the_runs_folder_is_one_of_weights_with_their_doubt(go: Go, tmp_path: Path) -> None:
    code, answer = go()
    assert code == 0
    assert answer["held_out_loss"] == pytest.approx(answer["held_out_loss"])
    checkpoint.load_pipeline(tmp_path / "out")
    loaded = load_doubt(tmp_path / "out")
    assert loaded is not None
    assert loaded[1].learnt == list(TO_LEARN)
    assert loaded[1].figures == {"held_out_loss": answer["held_out_loss"]}


def test_a_second_run_does_not_write_over_the_first(go: Go) -> None:
    assert go()[0] == 0
    code, answer = go()
    assert code == 1
    assert "holds weights already" in answer["error"]["message"]
    code, answer = go(out="weights")
    assert code == 1
    assert "holds weights already" in answer["error"]["message"]


@pytest.mark.parametrize(
    ("recipe", "rig", "told"),
    [
        ({"maps": "difference maps"}, RIG, "doubt is learnt of raw maps"),
        (
            {},
            RIG.model_copy(update={"wall": load_rig("bare-wall").wall.model_copy(update={"x_max_m": 3.0})}),
            "one rig",
        ),
    ],
)
def test_weights_of_difference_maps_or_another_rig_are_refused(
    go: Go, tmp_path: Path, recipe: dict[str, Any], rig: Any, told: str
) -> None:
    untrained_weights(tmp_path / "others", rig=rig, **recipe)
    code, answer = go(weights="others")
    assert code == 1
    assert told in answer["error"]["message"]


def test_more_objects_than_there_are_cannot_be_learnt_from(go: Go) -> None:
    code, answer = go("--objects", "9")
    assert code == 1
    assert "holds 8 objects, the recipe asks for 9: build that many" in answer["error"]["message"]


def test_outliers_that_cannot_be_seen_are_not_learnt_from(go: Go, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[Any]()

    def note(*sets: Any) -> dict[str, float]:
        seen.extend(sets[-2:])
        return {}

    monkeypatch.setattr(train, "run_doubt", note)
    assert go()[0] == 0
    training = seen[0]
    every = small_samples(Path(), {EMPTY: 14, ORDINARY: 7 * len(TO_LEARN) // 2, **dict.fromkeys(TO_LEARN, 7)}, 0)
    outliers = ~np.isin(every.kind, [EMPTY, ORDINARY])
    assert training.nothing.sum() == 14
    assert (~training.nothing & ~training.outside).sum() == 8 + ((every.kind == ORDINARY) & (every.cells > 0)).sum()
    assert training.outside.sum() == (outliers & (every.cells > 0)).sum() < outliers.sum()
