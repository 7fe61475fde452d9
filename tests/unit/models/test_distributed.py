"""Training in several processes: shares of a batch, equal weights at the end, and errors as they were raised."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from nlos_models.distributed import launch, open_fabric, precision_on, seed_of, share_of
from nlos_models.errors import RecipeError, TrainingError
from small_run import SmallRun, on_two, small_recipe
from torch import Tensor
from torch.multiprocessing.spawn import ProcessExitedException


class Pair(NamedTuple):
    """Batch with named parts."""

    x: Tensor
    y: Tensor


def test_share_of_splits_batch_without_repeating_samples() -> None:
    batch = Pair(torch.arange(12).reshape(6, 2), torch.arange(6))
    shares = [share_of(batch, rank, 3) for rank in range(3)]
    assert all(type(share) is Pair and len(share.x) == len(share.y) == 2 for share in shares)
    assert sorted(torch.cat([share.y for share in shares]).tolist()) == list(range(6))
    for share in shares:
        assert torch.equal(share.x, batch.x[share.y])
    assert share_of(batch, 0, 1) is batch
    assert [part.tolist() for part in share_of((batch.y, batch.y), 1, 2)] == [[1, 3, 5]] * 2


def test_seed_of_depends_on_every_number_and_its_place() -> None:
    parts = [(0,), (1,), (0, 1), (1, 0), (0, 0, 1), (0, 0, 2), (0, 1, 0)]
    assert len({seed_of(*part) for part in parts}) == len(parts)
    assert all(0 <= seed_of(*part) < 2**63 for part in parts)
    assert seed_of(3, 4) == seed_of(3, 4)


@pytest.mark.slow
def test_two_processes_end_with_weights_of_one(tmp_path: Path) -> None:
    made: dict[str, Any] = launch(open_fabric(small_recipe(), accelerator="cpu", devices=2), on_two, tmp_path)
    alone = SmallRun(small_recipe(epochs=3, schedule="one-cycle"), tmp_path / "alone", plain=True)
    figures = alone.go(fabric=open_fabric(small_recipe(), accelerator="cpu"))
    together = SmallRun(alone.recipe, tmp_path / "whole", plain=True)
    for name, tensor in alone.net.state_dict().items():
        torch.testing.assert_close(torch.tensor(made["net"][name]), tensor, rtol=1e-4, atol=1e-6)
    assert made["figures"] == pytest.approx(figures, rel=1e-4)
    for mine, its in zip(alone.log, together.log, strict=True):
        assert {k: float(v) for k, v in mine.items()} == pytest.approx({k: float(v) for k, v in its.items()}, rel=1e-4)
    assert made["scored"] == 3  # only the leading process evaluates
    assert len(made["messages"]) == 2
    assert "step 4" in made["messages"][0]
    assert made["messages"][1] == "interrupted"
    assert made["again"] == made["net"]


def test_open_fabric_refuses_uneven_batch_and_missing_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecipeError, match=r"batch of 4 .* 3 processes"):
        open_fabric(small_recipe(), accelerator="cpu", devices=3)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(TrainingError, match="2 GPUs"):
        open_fabric(small_recipe(), accelerator="cuda", devices=2)


@pytest.mark.parametrize(("vectors", "made"), [("AVX2", "32-true"), ("AVX512", "bf16-mixed")])
def test_cpu_that_emulates_bfloat16_trains_in_float32(monkeypatch: pytest.MonkeyPatch, vectors: str, made: str) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: vectors)
    halves, singles = small_recipe(precision="bf16-mixed"), small_recipe()
    assert precision_on("cpu", halves) == made
    assert precision_on("cuda", halves) == "bf16-mixed"
    assert precision_on("cpu", singles) == "32-true"


KILLED = ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL")


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        *((error, type(error)) for error in (KeyboardInterrupt(), RecipeError("a"), ZeroDivisionError(), OSError("b"))),
        (KILLED, TrainingError),
    ],
)
def test_launch_raises_error_of_process(error: BaseException, raised: type[BaseException]) -> None:
    def fail(_: Any) -> None:
        raise error

    start = fail if error is KILLED else lambda work: work(None)
    with pytest.raises(raised, match="SIGKILL" if error is KILLED else None):
        launch(SimpleNamespace(world_size=2, launch=start), fail)
    alone = SimpleNamespace(world_size=1, launch=pytest.fail)
    assert launch(alone, lambda its, a, b: (its is alone, a + b), 2, 3) == (True, 5)
