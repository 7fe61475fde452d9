"""The training loop on a tiny network: exact resuming after any stop, the run's files, TensorBoard, torch.compile."""

import copy
import errno
import hashlib
import io
import multiprocessing
import os
import random
import shutil
import signal
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, NoReturn

import pytest
import torch
from nlos_models import recipe as schedule
from nlos_models import train
from nlos_models.errors import CheckpointError, RecipeError, TrainingError
from small_run import (
    STEPS,
    Executioner,
    SmallRun,
    Stopped,
    be_killed,
    changed_tensors,
    run_watched,
    small_recipe,
    state_of,
)
from torch import Tensor, nn
from torch._inductor import config
from torch._inductor.exc import InductorError

pytestmark = pytest.mark.usefixtures("one_thread")


def _trained(folder: Path, **changes: object) -> SmallRun:
    run = SmallRun(small_recipe(**changes), folder)
    run.go()
    return run


def _assert_same(one: SmallRun, other: SmallRun) -> None:
    assert not changed_tensors(one.net.state_dict(), other.net.state_dict())
    assert one.log == other.log


@pytest.mark.parametrize("schedule", ["one-cycle", "plateau"])
@pytest.mark.parametrize("fail_at", [1, STEPS, STEPS + 2, 3 * STEPS])
def test_resumed_run_equals_uninterrupted(tmp_path: Path, schedule: str, fail_at: int) -> None:
    whole = _trained(tmp_path / "whole", schedule=schedule)
    with pytest.raises(Stopped):
        SmallRun(whole.recipe, tmp_path / "failed").go(fail_at)
    torch.manual_seed(99)
    _assert_same(_trained(tmp_path / "failed", schedule=schedule), whole)


@pytest.mark.slow
def test_run_killed_at_random_moments_equals_uninterrupted(tmp_path: Path) -> None:
    recipe = small_recipe(schedule="one-cycle", epochs=2)
    clerk = Executioner()
    whole = run_watched(recipe, tmp_path / "whole", clerk)
    moments = random.Random(0).sample(range(2, clerk.seen // 2), 4)  # noqa: S311  each start resumes the last one
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["nlos_models.train", "pytest"])  # each process begins with them imported
    ends: list[int | None] = []
    for moment in moments:
        child = context.Process(target=be_killed, args=(recipe.model_dump_json(), str(tmp_path / "killed"), moment))
        child.start()
        child.join()
        ends.append(child.exitcode)
    assert ends[:3] == [-signal.SIGKILL] * 3
    assert (tmp_path / "killed" / train.LAST).exists()
    _assert_same(_trained(tmp_path / "killed", schedule="one-cycle", epochs=2), whole)


def test_stopped_run_names_step_and_resumes_there(tmp_path: Path) -> None:
    whole, calls, messages = _trained(tmp_path / "whole"), count(1), list[str]()
    run = SmallRun(whole.recipe, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt):
        run.go(stop=lambda: next(calls) == STEPS + 2, on_message=messages.append)
    assert len(messages) == 1
    assert "epoch 1" in messages[0]
    assert "step 2" in messages[0]
    again = _trained(tmp_path / "stopped")
    assert again.steps[0] == (STEPS + 3, 4 * STEPS)
    _assert_same(again, whole)


def test_run_saves_state_at_checkpoint_interval(tmp_path: Path) -> None:
    seconds = count(0.0, 1.0)
    run = SmallRun(small_recipe(epochs=1), tmp_path)
    with pytest.raises(Stopped):
        run.go(fail_at=5, clock=lambda: next(seconds), checkpoint_s=2.5)  # saved after steps 2 and 4
    assert _trained(tmp_path, epochs=1).steps[0][0] in {3, 4, 5}


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_held_out_loss_falls(tmp_path: Path, precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    log = _trained(tmp_path, epochs=10, precision=precision).log
    assert [int(row["epoch"]) for row in log] == list(range(10))
    assert float(log[-1]["held_out_loss"]) < 0.5 * float(log[0]["held_out_loss"])


def test_progress_counts_steps_and_finished_run_is_not_repeated(tmp_path: Path) -> None:
    (run, again), epochs = (SmallRun(small_recipe(), tmp_path) for _ in range(2)), list[dict[str, float]]()
    figures = run.go(on_epoch=epochs.append)
    assert run.steps == [(k + 1, 4 * STEPS) for k in range(4 * STEPS)]
    assert run.done == [k / (4 * STEPS) for k in range(4 * STEPS)]
    assert [row["epoch"] for row in epochs] == [0, 1, 2, 3]
    assert not (tmp_path / "tensorboard").exists()
    assert again.go() == figures == run.score()
    assert again.steps == []
    _assert_same(again, run)
    assert _trained(tmp_path / "other", seed=1).log != run.log


def test_run_of_other_recipe_or_origin_or_of_few_objects_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="25"):
        SmallRun(small_recipe(objects=25, batch=25), tmp_path).go()
    run = SmallRun(small_recipe(epochs=1), tmp_path)
    run.go(origin="these weights")
    reworded = SmallRun(small_recipe(epochs=1, deviations=["other words"]), tmp_path)
    reworded.go(origin="these weights")
    assert not reworded.steps
    with pytest.raises(RecipeError, match="recipe"):
        _trained(tmp_path, learning_rate=0.5)
    with pytest.raises(RecipeError, match="weights"):
        SmallRun(run.recipe, tmp_path).go(origin="those weights")
    state = train.read_last(tmp_path, pytest.fail)
    del state["origin"]  # a state that does not name its origin is accepted
    train.write_last(tmp_path, state)
    SmallRun(run.recipe, tmp_path).go(origin="those weights")


def test_keep_best_restores_first_best_epoch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = list[dict[str, Tensor]]()

    def score(run: SmallRun) -> dict[str, float]:
        judged.append(state_of(run.net))
        return {"held_out_loss": [3.0, 1.0, 2.0, 1.0][(len(judged) - 1) % 4]}

    monkeypatch.setattr(SmallRun, "score", score)
    best, last = (SmallRun(small_recipe(keep=keep), tmp_path / keep) for keep in ("best", "last"))
    assert best.go() == {"held_out_loss": 1.0}
    last.go()
    assert not changed_tensors(judged[1], best.net.state_dict())
    assert not changed_tensors(judged[3], last.net.state_dict())


def test_plateau_run_ends_with_its_rate_and_stays_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(schedule, "SMALLEST_RATE", 2e-3)
    monkeypatch.setattr(SmallRun, "score", lambda _: {"held_out_loss": 1.0})
    done = _trained(tmp_path, epochs=20).steps
    assert 2 * STEPS <= len(done) <= 5 * STEPS  # the rate falls to 1e-2, 3e-3 and 9e-4
    assert _trained(tmp_path, epochs=20).steps == []


def test_diverged_run_keeps_earlier_epochs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Stopped):
        SmallRun(small_recipe(), tmp_path).go(fail_at=STEPS + 1)
    broken = SmallRun(small_recipe(), tmp_path)
    broken.y = broken.y * float("nan")
    with pytest.raises(TrainingError, match=r"nan .*epoch 1.*learning_rate"):
        broken.go()
    _assert_same(_trained(tmp_path), _trained(tmp_path / "whole"))
    monkeypatch.setattr(SmallRun, "score", lambda _: {"held_out_loss": float("nan")})
    with pytest.raises(TrainingError, match="epoch 0"):
        _trained(tmp_path / "nan")
    assert not (tmp_path / "nan" / train.BEST).exists()


def _state(step: int) -> dict[str, object]:
    return {"step": step, "module": {"weight": torch.arange(4.0) + step}, "rows": [{"loss": float(step)}]}


def _damage(path: Path, how: str) -> None:
    raw = bytearray(path.read_bytes())
    if how == "cut":
        raw = raw[: len(raw) // 2]
    if how == "flipped":
        raw[-20] ^= 1
    path.write_bytes(b"" if how == "empty" else raw)


def test_read_last_returns_last_state_written(tmp_path: Path) -> None:
    assert train.read_last(tmp_path, pytest.fail) is None
    for step in range(3):
        train.write_last(tmp_path, _state(step))
    state = train.read_last(tmp_path, pytest.fail)
    assert (state["step"], state["rows"]) == (2, [{"loss": 2.0}])
    assert torch.equal(state["module"]["weight"], torch.arange(4.0) + 2)
    assert {path.name for path in tmp_path.iterdir()} == {train.LAST, train.PREVIOUS}
    (tmp_path / train.LAST).unlink()  # as a kill between the two renames leaves it
    assert train.read_last(tmp_path, pytest.fail)["step"] == 1


@pytest.mark.parametrize("how", ["cut", "flipped", "empty"])
def test_read_last_falls_back_to_previous_state(tmp_path: Path, how: str) -> None:
    for step in (1, 2):
        train.write_last(tmp_path, _state(step))
    _damage(tmp_path / train.LAST, how)
    messages: list[str] = []
    assert train.read_last(tmp_path, messages.append)["step"] == 1
    assert len(messages) == 1
    assert str(tmp_path / train.LAST) in messages[0]
    _damage(tmp_path / train.PREVIOUS, "flipped")
    with pytest.raises(CheckpointError, match=train.LAST) as caught:
        train.read_last(tmp_path, pytest.fail)
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


def test_full_disk_keeps_earlier_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train.write_last(tmp_path, _state(1))
    train.write_log(tmp_path, [{"loss": 1.0}])

    def full(file: int) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    monkeypatch.setattr(os, "fsync", full)
    for write in (lambda: train.write_last(tmp_path, _state(2)), lambda: train.write_log(tmp_path, [{"loss": 2.0}])):
        with pytest.raises(TrainingError, match="No space left on device"):
            write()
    assert train.read_last(tmp_path, pytest.fail)["step"] == 1
    assert {path.name for path in tmp_path.iterdir()} == {train.LAST, train.LOG}
    assert "1.0" in (tmp_path / train.LOG).read_text(encoding="utf-8")


def test_read_best_refuses_missing_or_damaged_state(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=train.BEST):
        train.read_best(tmp_path)
    train.write_best(tmp_path, _state(3))
    assert train.read_best(tmp_path)["step"] == 3
    _damage(tmp_path / train.BEST, "cut")
    with pytest.raises(CheckpointError, match=train.BEST):
        train.read_best(tmp_path)


def test_digest_depends_on_every_bit_and_order() -> None:
    torch.manual_seed(0)
    net, digest = nn.Linear(3, 2), train.digest_of
    digests = {digest(), digest("a"), digest("b"), digest(None), before := digest(net)}
    assert digest(copy.deepcopy(net)) == before
    net.bias.data[0] += 1e-3
    digests |= {digest(net), digest(net, "a"), digest("a", net), digest(nn.Linear(3, 2).half())}
    assert len(digests) == 9


@pytest.mark.slow
def test_tensorboard_logs_figures_of_each_epoch(tmp_path: Path) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = SmallRun(small_recipe(), tmp_path)
    run.go(tensorboard=True)
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert set(events.Tags()["scalars"]) == {"rate", "loss", "held_out_loss", "seconds"}
    drawn = events.Scalars("held_out_loss")
    assert [event.step for event in drawn] == [0, 1, 2, 3]
    assert [event.value for event in drawn] == pytest.approx([float(row["held_out_loss"]) for row in run.log])


def test_missing_tensorboard_names_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(TrainingError, match=r"nlos-cam\[train\]"):
        train.TensorBoardLog(tmp_path, 0)


@pytest.fixture
def compiler() -> Iterator[None]:
    torch.compiler.reset()
    with config.patch(compile_threads=1):  # else torch keeps some for later
        yield
    torch.compiler.reset()


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, filter(None, config.cpp.cxx))), reason="torch.compile needs a compiler")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.usefixtures("compiler")
def test_compiled_part_has_loss_and_gradients_of_plain_one() -> None:
    linear, dropout, x, found = nn.Linear(3, 2), nn.Dropout(0.5), torch.rand(8, 3), []

    def noisy(x: Tensor) -> Tensor:
        return dropout(linear(x + 0.2 * torch.randn_like(x)))

    for part in (noisy, train.compile_network(noisy)):
        linear.zero_grad()
        torch.manual_seed(5)
        loss = part(x).square().sum()
        loss.backward()
        found.append((loss.detach(), linear.weight.grad.clone()))
    torch.testing.assert_close(*found)


def _no_compiler(*_: object) -> None:
    raise RuntimeError("No g++\nand a page of other words")


def _no_gradients(_: Tensor) -> None:
    raise InductorError(RuntimeError("No g++\nand more"), None)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize("network", [torch.compile(nn.Linear(3, 2), backend=_no_compiler), _no_gradients])
def test_failed_compilation_is_one_line(network: nn.Module) -> None:
    with pytest.raises(TrainingError, match=r"--compile .*No g\+\+") as caught, train.explain_compile_errors():
        network(torch.rand(1, 3))
    assert "\n" not in str(caught.value)


def test_error_of_network_is_not_blamed_on_compiler() -> None:
    with pytest.raises(RuntimeError, match="shapes cannot be multiplied"), train.explain_compile_errors():
        nn.Linear(3, 2)(torch.rand(1, 4))


class Hostile:
    """Object whose unpickling would run code."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("unpickled",))


@pytest.mark.parametrize(
    "state",
    [5, [1], Hostile(), {"recipe": 3}, {"recipe": "{}", "epoch": "a"}],
    ids=["number", "list", "hostile", "recipe", "epoch"],
)
def test_state_of_another_kind_is_refused_in_one_line(
    tmp_path: Path, state: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    content = io.BytesIO()
    torch.save(state, content)
    for name in (train.LAST, train.PREVIOUS):
        (tmp_path / name).write_bytes(hashlib.sha256(content.getvalue()).digest() + content.getvalue())
    with pytest.raises(CheckpointError, match=str(tmp_path)) as caught:
        SmallRun(small_recipe(), tmp_path).go()
    assert "\n" not in str(caught.value)
    assert "unpickled" not in capsys.readouterr().out


def test_state_that_is_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / train.LAST).mkdir()
    with pytest.raises(CheckpointError, match="damaged"):
        train.read_last(tmp_path, print)
