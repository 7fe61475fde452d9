"""TensorBoard logs: written where wanted, and one clear line where the package is missing."""

import sys
from pathlib import Path

import pytest
from nlos_models.errors import TrainingError
from nlos_models.train import Board
from small_run import SmallRun, small_recipe


def test_a_run_logs_each_epochs_figures(tmp_path: Path) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = SmallRun(small_recipe(), tmp_path)
    run.go(tensorboard=True)
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert set(events.Tags()["scalars"]) == {"rate", "loss", "held_out_loss", "seconds"}
    drawn = events.Scalars("held_out_loss")
    assert [event.step for event in drawn] == [0, 1, 2, 3]
    assert [event.value for event in drawn] == pytest.approx([float(row["held_out_loss"]) for row in run.log])


def test_nothing_is_logged_unasked(tmp_path: Path) -> None:
    SmallRun(small_recipe(epochs=1), tmp_path).go()
    assert not (tmp_path / "tensorboard").exists()


def test_a_missing_package_is_one_line_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(TrainingError, match=r"pip install 'nlos-cam\[train\]'"):
        Board(tmp_path, 0)
