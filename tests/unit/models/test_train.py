"""The training loop on a tiny network: exact resuming after any stop, the run's files, several
processes.
"""

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
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import small_run
import torch
from nlos_models.errors import CheckpointError, RecipeError, TrainingError
from nlos_models.records import TRAINING_LOG
from nlos_models.training import loop as train
from nlos_models.training import run_files, schedule
from nlos_models.training.direct import NormalBatch
from nlos_models.training.distributed import launch, open_fabric, precision_on, seed_of, share_of
from small_run import STEPS, SmallRun, Stopped, changed_tensors, small_recipe, state_of
from torch import Tensor, nn
from torch._inductor import config
from torch._inductor.exc import InductorError
from torch.multiprocessing.spawn import ProcessExitedException

pytestmark = pytest.mark.usefixtures("one_thread")


def _trained(folder: Path, **changes: object) -> SmallRun:
    run = SmallRun(small_recipe(**changes), folder)
    run.go()
    return run


def _assert_same(one: SmallRun, other: SmallRun) -> None:
    assert not changed_tensors(one.net.state_dict(), other.net.state_dict())
    assert one.log == other.log


@pytest.mark.parametrize(
    "how", [{"schedule": "one-cycle"}, {"schedule": "plateau"}, {"average": 0.9}], ids=str
)
@pytest.mark.parametrize("fail_at", [1, STEPS, STEPS + 2, 3 * STEPS])
def test_resumed_run_equals_uninterrupted(
    tmp_path: Path, how: dict[str, object], fail_at: int
) -> None:
    whole = _trained(tmp_path / "whole", **how)
    with pytest.raises(Stopped):
        SmallRun(whole.recipe, tmp_path / "failed").go(fail_at)
    torch.manual_seed(99)

    _assert_same(_trained(tmp_path / "failed", **how), whole)


@pytest.mark.slow
def test_run_killed_at_random_moments_equals_uninterrupted(tmp_path: Path) -> None:
    recipe = small_recipe(schedule="one-cycle", epochs=2)
    clerk = small_run.Executioner()
    whole = small_run.run_watched(recipe, tmp_path / "whole", clerk)
    moments = random.Random(0).sample(range(2, clerk.seen // 2), 4)  # noqa: S311  each start resumes the last one
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["nlos_models.training.loop", "pytest"]
    )  # each process begins with them imported
    ends: list[int | None] = []
    for moment in moments:
        facts = recipe.model_dump_json(), str(tmp_path / "killed"), moment
        child = context.Process(target=small_run.be_killed, args=facts)
        child.start()
        child.join()
        ends.append(child.exitcode)

    assert ends[:3] == [-signal.SIGKILL] * 3
    assert (tmp_path / "killed" / run_files.LAST).exists()
    _assert_same(_trained(tmp_path / "killed", schedule="one-cycle", epochs=2), whole)


def test_stopped_run_names_its_step_and_resumes_there(
    tmp_path: Path,
) -> None:
    whole = _trained(tmp_path / "whole")
    calls = count(1)
    messages = list[str]()
    run = SmallRun(whole.recipe, tmp_path / "stopped")

    with pytest.raises(KeyboardInterrupt):
        run.go(stop=lambda: next(calls) == STEPS + 2, on_message=messages.append)

    assert [("epoch 1" in message, "step 2" in message) for message in messages] == [(True, True)]

    again = _trained(tmp_path / "stopped")

    assert again.steps[0] == (STEPS + 3, 4 * STEPS)
    _assert_same(again, whole)


def test_failed_run_resumes_from_its_last_checkpoint(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(epochs=1), tmp_path / "failed")
    seconds = count(0.0, 1.0)
    with pytest.raises(Stopped):
        # Saved after steps 2 and 4.
        run.go(fail_at=5, clock=lambda: next(seconds), checkpoint_s=2.5)

    assert _trained(tmp_path / "failed", epochs=1).steps[0][0] in {3, 4, 5}


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_held_out_loss_falls(
    tmp_path: Path, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    log = _trained(tmp_path, epochs=10, precision=precision).log

    assert [int(row["epoch"]) for row in log] == list(range(10))
    assert float(log[-1]["held_out_loss"]) < 0.5 * float(log[0]["held_out_loss"])


def test_progress_counts_steps_and_finished_run_is_not_repeated(tmp_path: Path) -> None:
    (run, again) = (SmallRun(small_recipe(), tmp_path) for _ in range(2))
    epochs = list[dict[str, float]]()
    figures = run.go(on_epoch=epochs.append)

    assert run.steps == [(k + 1, 4 * STEPS) for k in range(4 * STEPS)]
    assert run.done == [k / (4 * STEPS) for k in range(4 * STEPS)]
    assert [row["epoch"] for row in epochs] == [0, 1, 2, 3]
    assert not (tmp_path / "tensorboard").exists()
    assert again.go() == figures == run.score()
    assert again.steps == []
    _assert_same(again, run)
    assert _trained(tmp_path / "other", seed=1).log != run.log


def test_run_of_other_recipe_or_origin_is_refused(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(epochs=1), tmp_path)
    run.go(origin="these weights")
    reworded = SmallRun(small_recipe(epochs=1, deviations=["other words"]), tmp_path)
    reworded.go(origin="these weights")

    assert not reworded.steps

    with pytest.raises(RecipeError, match="recipe"):
        _trained(tmp_path, learning_rate=0.5)
    with pytest.raises(RecipeError, match="weights"):
        SmallRun(run.recipe, tmp_path).go(origin="those weights")

    state = run_files.read_last(tmp_path, pytest.fail)
    del state["origin"]  # a state that does not name its origin is accepted
    run_files.write_last(tmp_path, state)
    SmallRun(run.recipe, tmp_path).go(origin="those weights")


def test_keep_best_restores_first_best_epoch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_plateau_run_ends_with_its_rate_and_stays_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(schedule, "SMALLEST_RATE", 2e-3)
    monkeypatch.setattr(SmallRun, "score", lambda _: {"held_out_loss": 1.0})
    done = _trained(tmp_path, epochs=20).steps

    assert 2 * STEPS <= len(done) <= 5 * STEPS  # the rate falls to 1e-2, 3e-3 and 9e-4
    assert _trained(tmp_path, epochs=20).steps == []


@pytest.mark.parametrize("compiled", [False, True])
def test_gradient_that_is_not_finite_ends_the_run(tmp_path: Path, compiled: bool) -> None:
    broken = SmallRun(small_recipe(gradient_limit=1.0), tmp_path)
    broken.y = broken.y * float("nan")

    with pytest.raises(TrainingError, match=r"gradient is nan in epoch 0.*learning_rate") as ended:
        broken.go(compiled=compiled)

    assert ("--compile" in str(ended.value)) == compiled


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

    assert not (tmp_path / "nan" / run_files.BEST).exists()


def _state(step: int) -> dict[str, object]:
    return {
        "step": step,
        "module": {"weight": torch.arange(4.0) + step},
        "rows": [{"loss": float(step)}],
    }


def _damage(path: Path, how: str) -> None:
    raw = path.read_bytes()
    flipped = raw[:-20] + bytes([raw[-20] ^ 1]) + raw[-19:]
    path.write_bytes({"cut": raw[: len(raw) // 2], "flipped": flipped, "empty": b""}[how])


def test_read_last_returns_last_state_written(tmp_path: Path) -> None:
    assert run_files.read_last(tmp_path, pytest.fail) is None

    for step in range(3):
        run_files.write_last(tmp_path, _state(step))

    torch.testing.assert_close(
        run_files.read_last(tmp_path, pytest.fail), _state(2), rtol=0, atol=0
    )
    assert {path.name for path in tmp_path.iterdir()} == {run_files.LAST, run_files.PREVIOUS}

    (tmp_path / run_files.LAST).unlink()  # as a kill between the two renames leaves it

    assert run_files.read_last(tmp_path, pytest.fail)["step"] == 1

    (tmp_path / "folder" / run_files.LAST).mkdir(parents=True)

    with pytest.raises(CheckpointError, match="damaged"):
        run_files.read_last(tmp_path / "folder", print)


def test_run_of_fewer_objects_than_a_batch_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="25"):
        SmallRun(small_recipe(objects=25, batch=25), tmp_path).go()


@pytest.mark.parametrize("how", ["cut", "flipped", "empty"])
def test_read_last_falls_back_to_the_previous_state(tmp_path: Path, how: str) -> None:
    for step in (1, 2):
        run_files.write_last(tmp_path, _state(step))
    _damage(tmp_path / run_files.LAST, how)
    messages: list[str] = []

    assert run_files.read_last(tmp_path, messages.append)["step"] == 1
    assert [str(tmp_path / run_files.LAST) in message for message in messages] == [True]


@pytest.mark.parametrize("how", ["cut", "flipped", "empty"])
def test_read_best_refuses_a_missing_or_damaged_state(tmp_path: Path, how: str) -> None:
    with pytest.raises(CheckpointError, match=run_files.BEST):
        run_files.read_best(tmp_path)
    run_files.write_best(tmp_path, _state(3))

    assert run_files.read_best(tmp_path)["step"] == 3

    _damage(tmp_path / run_files.BEST, how)
    with pytest.raises(CheckpointError, match=run_files.BEST):
        run_files.read_best(tmp_path)


def test_state_that_cannot_be_read_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for step in (1, 2):
        run_files.write_last(tmp_path, _state(step))
    refused = Mock(side_effect=PermissionError(13, "Permission denied"))
    monkeypatch.setattr(run_files, "read_bounded", refused)

    with pytest.raises(CheckpointError, match=r"cannot be read \(Permission denied\)") as caught:
        run_files.read_last(tmp_path, pytest.fail)

    assert "delete" not in str(caught.value)


def test_read_last_refuses_where_both_states_are_damaged(tmp_path: Path) -> None:
    for step in (1, 2):
        run_files.write_last(tmp_path, _state(step))
    _damage(tmp_path / run_files.LAST, "flipped")
    _damage(tmp_path / run_files.PREVIOUS, "flipped")

    with pytest.raises(CheckpointError, match=run_files.LAST) as caught:
        run_files.read_last(tmp_path, pytest.fail)

    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


def test_full_disk_keeps_earlier_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_files.write_last(tmp_path, _state(1))
    run_files.write_log(tmp_path, [{"loss": 1.0}])
    monkeypatch.setattr(
        os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    )
    for write in (
        lambda: run_files.write_last(tmp_path, _state(2)),
        lambda: run_files.write_log(tmp_path, [{"loss": 2.0}]),
    ):
        with pytest.raises(TrainingError, match="No space left on device"):
            write()

    assert run_files.read_last(tmp_path, pytest.fail)["step"] == 1
    assert {path.name for path in tmp_path.iterdir()} == {run_files.LAST, TRAINING_LOG}
    assert "1.0" in (tmp_path / TRAINING_LOG).read_text(encoding="utf-8")


def test_digest_depends_on_every_bit_and_order() -> None:
    torch.manual_seed(0)
    net = nn.Linear(3, 2)
    digest = train.digest_of
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
    assert [event.value for event in drawn] == pytest.approx(
        [float(row["held_out_loss"]) for row in run.log]
    )


def test_missing_tensorboard_names_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(TrainingError, match=r"nlos-cam\[train\]"):
        run_files.TensorBoardLog(tmp_path, 0)


@pytest.fixture
def compiler() -> Iterator[None]:
    torch.compiler.reset()
    with config.patch(compile_threads=1):  # else torch keeps some for later
        yield
    torch.compiler.reset()


@pytest.mark.slow
@pytest.mark.skipif(
    not any(map(shutil.which, filter(None, config.cpp.cxx))),
    reason="torch.compile needs a compiler",
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.usefixtures("compiler")
def test_compiled_part_has_loss_and_gradients_of_plain_one() -> None:
    linear = nn.Linear(3, 2)
    dropout = nn.Dropout(0.5)
    x = torch.rand(8, 3)
    found = []

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


NO_GRADIENTS = Mock(side_effect=InductorError(RuntimeError("No g++\nand more"), None))


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "network", [torch.compile(nn.Linear(3, 2), backend=_no_compiler), NO_GRADIENTS]
)
def test_failed_compilation_is_reported_in_one_line(
    network: nn.Module,
) -> None:
    with (
        pytest.raises(TrainingError, match=r"--compile .*No g\+\+") as caught,
        train.explain_compile_errors(),
    ):
        network(torch.rand(1, 3))
    assert "\n" not in str(caught.value)


def test_errors_of_the_network_are_not_blamed_on_the_compiler() -> None:
    with (
        pytest.raises(RuntimeError, match="shapes cannot be multiplied"),
        train.explain_compile_errors(),
    ):
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
def test_state_of_another_kind_is_refused(
    tmp_path: Path, state: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    content = io.BytesIO()
    torch.save(state, content)
    for name in (run_files.LAST, run_files.PREVIOUS):
        (tmp_path / name).write_bytes(
            hashlib.sha256(content.getvalue()).digest() + content.getvalue()
        )

    with pytest.raises(CheckpointError, match=str(tmp_path)) as caught:
        SmallRun(small_recipe(), tmp_path).go()

    assert "\n" not in str(caught.value)
    assert "unpickled" not in capsys.readouterr().out


def test_processes_share_a_batch_without_repeating_samples() -> None:
    batch = NormalBatch(torch.arange(12).reshape(6, 2), torch.arange(6))
    shares = [share_of(batch, rank, 3) for rank in range(3)]

    assert all(
        type(share) is NormalBatch and len(share.normal) == len(share.image) == 2
        for share in shares
    )
    assert sorted(torch.cat([share.image for share in shares]).tolist()) == list(range(6))

    for share in shares:
        assert torch.equal(share.normal, batch.normal[share.image])

    assert share_of(batch, 0, 1) is batch
    assert [part.tolist() for part in share_of((batch.image, batch.image), 1, 2)] == [[1, 3, 5]] * 2


def test_seeds_differ_by_their_parts_and_count() -> None:
    parts = [(0,), (1,), (0, 1), (1, 0), (0, 0, 1), (0, 0, 2), (0, 1, 0)]

    assert len({seed_of(*part) for part in parts}) == len(parts)
    assert all(0 <= seed_of(*part) < 2**63 for part in parts)
    assert seed_of(3, 4) == seed_of(3, 4)


@pytest.mark.slow
def test_two_processes_end_with_weights_of_one(tmp_path: Path) -> None:
    made: dict[str, Any] = launch(
        open_fabric(small_recipe(), accelerator="cpu", devices=2), small_run.on_two, tmp_path
    )
    alone = SmallRun(small_recipe(epochs=3, schedule="one-cycle"), tmp_path / "alone", plain=True)
    figures = alone.go(fabric=open_fabric(small_recipe(), accelerator="cpu"))
    together = SmallRun(alone.recipe, tmp_path / "whole", plain=True)
    for name, tensor in alone.net.state_dict().items():
        torch.testing.assert_close(torch.tensor(made["net"][name]), tensor, rtol=1e-4, atol=1e-6)

    assert made["figures"] == pytest.approx(figures, rel=1e-4)

    for mine, its in zip(alone.log, together.log, strict=True):
        assert {k: float(v) for k, v in mine.items()} == pytest.approx(
            {k: float(v) for k, v in its.items()}, rel=1e-4
        )

    assert made["scored"] == 3  # only the leading process evaluates

    told, interrupted = made["messages"]

    assert ("step 4" in told, interrupted) == (True, "interrupted")
    assert made["again"] == made["net"]


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (TrainingError("the disk is full"), "^the disk is full$"),
        (ZeroDivisionError("by nothing"), "ended early .ZeroDivisionError: by nothing"),
    ],
    ids=["expected", "unexpected"],
)
def test_launch_raises_the_error_of_the_one_that_failed(
    rank: int, error: Exception, raised: str
) -> None:
    """The other one loses its connection, which says nothing about the cause."""
    fabric = open_fabric(small_recipe(), accelerator="cpu", devices=2)

    with pytest.raises(TrainingError, match=raised):
        launch(fabric, small_run.fail_in_one, rank, error)


def test_open_fabric_refuses_uneven_batch_and_missing_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecipeError, match=r"batch of 4 .* 3 processes"):
        open_fabric(small_recipe(), accelerator="cpu", devices=3)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(TrainingError, match="2 GPUs"):
        open_fabric(small_recipe(), accelerator="cuda", devices=2)


@pytest.mark.parametrize(("vectors", "made"), [("AVX2", "32-true"), ("AVX512", "bf16-mixed")])
def test_cpu_that_emulates_bfloat16_trains_in_float32(
    monkeypatch: pytest.MonkeyPatch, vectors: str, made: str
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: vectors)
    halves = small_recipe(precision="bf16-mixed")
    singles = small_recipe()

    assert precision_on("cpu", halves) == made
    assert precision_on("cuda", halves) == "bf16-mixed"
    assert precision_on("cpu", singles) == "32-true"


KILLED = ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL")


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        *(
            (error, type(error))
            for error in (KeyboardInterrupt(), RecipeError("a"), ZeroDivisionError(), OSError("b"))
        ),
        (KILLED, TrainingError),
    ],
)
def test_launch_raises_error_of_process(error: BaseException, raised: type[BaseException]) -> None:
    fail = Mock(side_effect=error)
    start = fail if error is KILLED else lambda work: work(None)
    with pytest.raises(raised, match="SIGKILL" if error is KILLED else None):
        launch(SimpleNamespace(world_size=2, launch=start), fail)
    alone = SimpleNamespace(world_size=1, launch=pytest.fail)

    assert launch(alone, lambda its, a, b: (its is alone, a + b), 2, 3) == (True, 5)
