"""Several processes: each has its share, all end with the same weights, and errors come out as what they were."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from nlos_models.distributed import launched, open_fabric, seed_of, share_of
from nlos_models.errors import RecipeError, TrainingError
from small_run import SmallRun, on_two, small_recipe
from torch import Tensor
from torch.multiprocessing.spawn import ProcessExitedException


class Pair(NamedTuple):
    """A batch with names."""

    x: Tensor
    y: Tensor


def test_the_shares_of_a_batch_are_all_of_it_and_no_sample_twice() -> None:
    batch = Pair(torch.arange(12).reshape(6, 2), torch.arange(6))
    shares = [share_of(batch, rank, 3) for rank in range(3)]
    assert all(type(share) is Pair and len(share.x) == len(share.y) == 2 for share in shares)
    assert sorted(torch.cat([share.y for share in shares]).tolist()) == list(range(6))
    for share in shares:
        assert torch.equal(share.x, batch.x[share.y])
    assert share_of(batch, 0, 1) is batch
    assert [part.tolist() for part in share_of((batch.y, batch.y), 1, 2)] == [[1, 3, 5]] * 2


def test_seeds_differ_by_every_number_and_its_place() -> None:
    parts = [(0,), (1,), (0, 1), (1, 0), (0, 0, 1), (0, 0, 2), (0, 1, 0)]
    assert len({seed_of(*part) for part in parts}) == len(parts)
    assert all(0 <= seed_of(*part) < 2**63 for part in parts)
    assert seed_of(3, 4) == seed_of(3, 4)


def test_two_processes_end_with_the_weights_of_one(tmp_path: Path) -> None:
    made: dict[str, Any] = launched(open_fabric(small_recipe(), accelerator="cpu", devices=2), on_two, tmp_path)
    alone = SmallRun(small_recipe(epochs=3, schedule="one-cycle"), tmp_path / "alone", plain=True)
    figures = alone.go(fabric=open_fabric(small_recipe(), accelerator="cpu"))
    together = SmallRun(alone.recipe, tmp_path / "whole", plain=True)
    for name, tensor in alone.net.state_dict().items():
        torch.testing.assert_close(torch.tensor(made["net"][name]), tensor, rtol=1e-4, atol=1e-6)
    assert made["figures"] == pytest.approx(figures, rel=1e-4)
    for mine, its in zip(alone.log, together.log, strict=True):
        assert {k: float(v) for k, v in mine.items()} == pytest.approx({k: float(v) for k, v in its.items()}, rel=1e-4)
    assert made["scored"] == 3  # the leader alone judges
    assert made["told"] == ["stopped in epoch 1: the same command goes on from step 4", "interrupted"]
    assert made["again"] == made["net"]


def test_a_batch_that_cannot_be_shared_evenly_is_refused() -> None:
    with pytest.raises(RecipeError, match="a batch of 4 is not shared by 3 processes evenly"):
        open_fabric(small_recipe(), accelerator="cpu", devices=3)


def test_more_gpus_than_there_are_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(TrainingError, match="2 GPUs asked for, 0 there"):
        open_fabric(small_recipe(), accelerator="cuda", devices=2)


def _fabric(world_size: int, launch: Callable[..., Any]) -> Any:
    return SimpleNamespace(world_size=world_size, launch=launch)


def _stop(_: Any) -> None:
    raise KeyboardInterrupt


def _refuse(_: Any) -> None:
    raise RecipeError("no such recipe")


def test_one_process_is_this_one() -> None:
    fabric = _fabric(1, pytest.fail)
    assert launched(fabric, lambda its, a, b: (its is fabric, a + b), 2, 3) == (True, 5)


@pytest.mark.parametrize(("work", "error"), [(_stop, KeyboardInterrupt), (_refuse, RecipeError)])
def test_what_a_process_foresaw_comes_out_as_it_was(work: Callable[..., None], error: type[BaseException]) -> None:
    fabric = _fabric(2, lambda guarded: guarded(None))
    with pytest.raises(error):
        launched(fabric, work)


def test_what_no_process_foresaw_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        launched(_fabric(2, lambda guarded: guarded(None)), lambda _: 1 / 0)
    with pytest.raises(OSError, match="odd"):
        launched(_fabric(2, lambda guarded: guarded(None)), lambda _: (_ for _ in ()).throw(OSError("odd")))


def test_a_process_that_died_is_one_line() -> None:
    def launch(_: object) -> None:
        raise ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL")

    with pytest.raises(TrainingError, match=r"ended early \(process 1 terminated with signal SIGKILL\)"):
        launched(_fabric(2, launch), _stop)
