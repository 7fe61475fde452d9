"""The training loop on a network small enough to train in a moment: stop anywhere, resume, same bits."""

import multiprocessing
import random
import signal
from itertools import count
from pathlib import Path

import pytest
import torch
from nlos_models import recipe as schedule
from nlos_models.errors import RecipeError, TrainingError
from nlos_models.train import BEST, LAST, read_last, write_last
from small_run import STEPS, Executioner, SmallRun, Stopped, be_killed, run_watched, small_recipe

pytestmark = pytest.mark.usefixtures("one_thread")


def _trained(folder: Path, **changes: object) -> SmallRun:
    run = SmallRun(small_recipe(**changes), folder)
    run.go()
    return run


def _assert_same(one: SmallRun, other: SmallRun) -> None:
    for (name, mine), its in zip(one.net.state_dict().items(), other.net.state_dict().values(), strict=True):
        assert torch.equal(mine, its), name
    assert one.log == other.log


@pytest.mark.parametrize("schedule", ["one-cycle", "plateau"])
@pytest.mark.parametrize("fail_at", [1, STEPS, STEPS + 2, 3 * STEPS])
def test_a_run_that_failed_and_was_resumed_equals_an_uninterrupted_one(
    tmp_path: Path, schedule: str, fail_at: int
) -> None:
    whole = _trained(tmp_path / "whole", schedule=schedule)
    with pytest.raises(Stopped):
        SmallRun(whole.recipe, tmp_path / "failed").go(fail_at)
    torch.manual_seed(99)
    _assert_same(_trained(tmp_path / "failed", schedule=schedule), whole)


def test_a_run_killed_at_random_moments_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    recipe = small_recipe(schedule="one-cycle", epochs=2)
    clerk = Executioner()
    whole = run_watched(recipe, tmp_path / "whole", clerk)
    moments = random.Random(0).sample(range(2, clerk.seen // 2), 4)  # noqa: S311  each start goes on from the last
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["nlos_models.train", "pytest"])  # each process begins with them imported
    ends: list[int | None] = []
    for moment in moments:
        child = context.Process(target=be_killed, args=(recipe.model_dump_json(), str(tmp_path / "killed"), moment))
        child.start()
        child.join()
        ends.append(child.exitcode)
    assert ends[:3] == [-signal.SIGKILL] * 3
    assert (tmp_path / "killed" / LAST).exists()
    resumed = SmallRun(recipe, tmp_path / "killed")
    resumed.go()
    _assert_same(resumed, whole)


def test_a_run_asked_to_stop_says_where_and_goes_on_from_that_very_step(tmp_path: Path) -> None:
    whole, calls, told = _trained(tmp_path / "whole"), count(1), list[str]()
    run = SmallRun(whole.recipe, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt):
        run.go(stop=lambda: next(calls) == STEPS + 2, tell=told.append)
    assert told == ["stopped in epoch 1: the same command goes on from step 2"]
    again = _trained(tmp_path / "stopped")
    assert again.steps[0] == (STEPS + 3, 4 * STEPS)
    _assert_same(again, whole)


def test_a_state_is_saved_as_often_as_asked(tmp_path: Path) -> None:
    seconds = count(0.0, 1.0)
    run = SmallRun(small_recipe(epochs=1), tmp_path)
    with pytest.raises(Stopped):
        run.go(fail_at=5, clock=lambda: next(seconds), checkpoint_s=2.5)  # saved after steps 2 and 4
    again = SmallRun(run.recipe, tmp_path)
    again.go()
    assert again.steps[0][0] in {3, 4, 5}


def test_the_seed_decides_the_run(tmp_path: Path) -> None:
    first, again = (_trained(tmp_path / name) for name in ("first", "again"))
    _assert_same(first, again)
    assert _trained(tmp_path / "other", seed=1).log != first.log


def test_the_loss_falls(tmp_path: Path) -> None:
    log = _trained(tmp_path, epochs=10).log
    assert [int(row["epoch"]) for row in log] == list(range(10))
    assert float(log[-1]["held_out_loss"]) < 0.5 * float(log[0]["held_out_loss"])


def test_progress_counts_every_step_to_the_end_and_every_epoch(tmp_path: Path) -> None:
    run, epochs = SmallRun(small_recipe(), tmp_path), list[dict[str, float]]()
    run.go(on_epoch=epochs.append)
    assert run.steps == [(k + 1, 4 * STEPS) for k in range(4 * STEPS)]
    assert run.done == [k / (4 * STEPS) for k in range(4 * STEPS)]
    assert [row["epoch"] for row in epochs] == [0, 1, 2, 3]


def test_a_finished_run_does_not_train_again_and_still_tells_its_figures(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(), tmp_path)
    figures = run.go()
    again = SmallRun(small_recipe(), tmp_path)
    assert again.go() == figures == run.score()
    assert again.steps == []
    _assert_same(again, run)


def test_a_run_of_another_recipe_is_refused(tmp_path: Path) -> None:
    _trained(tmp_path)
    with pytest.raises(RecipeError, match="another recipe"):
        _trained(tmp_path, learning_rate=0.5)


def test_a_run_from_another_origin_is_refused_and_one_that_does_not_tell_is_not(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(epochs=1), tmp_path)
    run.go(origin="these weights")
    with pytest.raises(RecipeError, match="a run from other weights"):
        SmallRun(run.recipe, tmp_path).go(origin="those weights")
    state = read_last(tmp_path, pytest.fail)
    assert state is not None
    del state["origin"]
    write_last(tmp_path, state)
    SmallRun(run.recipe, tmp_path).go(origin="those weights")


def test_the_best_epoch_is_handed_on_where_the_recipe_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged: dict[float, dict[str, torch.Tensor]] = {}

    def score(run: SmallRun) -> dict[str, float]:
        loss = [3.0, 1.0, 2.0, 1.0][len(judged) % 4]
        judged[len(judged)] = {name: tensor.clone() for name, tensor in run.net.state_dict().items()}
        return {"held_out_loss": loss}

    monkeypatch.setattr(SmallRun, "score", score)
    best, last = (SmallRun(small_recipe(keep=keep), tmp_path / keep) for keep in ("best", "last"))
    assert best.go() == {"held_out_loss": 1.0}
    last.go()
    torch.testing.assert_close(dict(best.net.state_dict()), judged[1], rtol=0, atol=0)  # the first of two equals
    torch.testing.assert_close(dict(last.net.state_dict()), judged[3], rtol=0, atol=0)


def test_a_run_whose_learning_rate_reached_its_end_stops_and_does_not_train_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(schedule, "SMALLEST_RATE", 2e-3)
    monkeypatch.setattr(SmallRun, "score", lambda _: {"held_out_loss": 1.0})
    done = _trained(tmp_path, epochs=20).steps
    assert 2 * STEPS <= len(done) <= 5 * STEPS  # the rate falls to 1e-2, 3e-3 and 9e-4
    assert _trained(tmp_path, epochs=20).steps == []


def test_a_run_that_diverges_ends_with_a_line_and_keeps_the_epochs_before(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(), tmp_path)
    with pytest.raises(Stopped):
        run.go(fail_at=STEPS + 1)
    broken = SmallRun(small_recipe(), tmp_path)
    broken.y = broken.y * float("nan")
    with pytest.raises(TrainingError, match=r"loss is nan in epoch 1: choose a smaller learning_rate"):
        broken.go()
    _assert_same(_trained(tmp_path), _trained(tmp_path / "whole"))


def test_a_held_out_loss_that_is_no_number_is_never_the_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SmallRun, "score", lambda _: {"held_out_loss": float("nan")})
    with pytest.raises(TrainingError, match="held-out loss is not a number in epoch 0"):
        _trained(tmp_path)
    assert not (tmp_path / BEST).exists()


def test_frozen_parameters_stay(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(), tmp_path)
    frozen = run.net[0].weight.requires_grad_(requires_grad=False)
    before, free = frozen.clone(), run.net[-1].weight.detach().clone()
    run.go()
    assert torch.equal(frozen, before)
    assert not torch.equal(run.net[-1].weight, free)


def test_one_cycle_runs_to_its_end_however_small_its_rate(tmp_path: Path) -> None:
    assert len(_trained(tmp_path, schedule="one-cycle", learning_rate=1e-7).log) == 4  # it begins at 4e-9


def test_bfloat16_trains_too(tmp_path: Path) -> None:
    log = _trained(tmp_path, precision="bf16-mixed", epochs=8).log
    assert float(log[-1]["held_out_loss"]) < float(log[0]["held_out_loss"])


def test_fewer_objects_than_a_batch_are_one_line(tmp_path: Path) -> None:
    run = SmallRun(small_recipe(), tmp_path)
    run.recipe = run.recipe.model_copy(update={"batch": 32})
    with pytest.raises(RecipeError, match="fewer training objects than a batch of 32"):
        run.go()
