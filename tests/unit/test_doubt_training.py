"""Training: what is learnt from a small set, that it goes on where it was stopped, and what the loss leaves out."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fake_doubter import RECIPE
from nlos_models.doubt_network import DoubtNetwork, DoubtOutput
from nlos_models.doubt_training import (
    MOST_FALSE_ALARMS,
    DoubtBatch,
    as_doubt_batch,
    calibrated,
    doubt_batches,
    doubt_loss,
    said_of,
    train_doubt,
)
from nlos_models.train import Running
from small_doubt import DARK_V, small_doubt_set

pytestmark = pytest.mark.usefixtures("one_thread")

QUICK = RECIPE.model_copy(
    update={"objects": 128, "epochs": 8, "batch": 16, "learning_rate": 5e-3, "schedule": "one-cycle"}
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[DoubtNetwork, Path]:
    folder = tmp_path_factory.mktemp("run")
    made, _ = train_doubt(QUICK, small_doubt_set(128, 0), small_doubt_set(32, 1), folder, lambda *_: None)
    return made, folder


def test_it_learns_what_is_there_what_is_unlike_and_where_errors_are_large(
    trained: tuple[DoubtNetwork, Path],
) -> None:
    fresh = small_doubt_set(64, 2)
    said = said_of(trained[0], fresh)
    right = (said.nothing.numpy() > 0) == fresh.nothing
    assert right.mean() > 0.9
    there = ~fresh.nothing
    assert np.corrcoef(said.outside.numpy()[there], fresh.outside[there])[0, 1] > 0.8
    dark, bright = (said.log_error.numpy()[fresh.truth == value].mean() for value in np.float16([DARK_V, 0.8]))
    assert dark > bright + 0.3


def test_a_finished_run_is_not_run_again(trained: tuple[DoubtNetwork, Path]) -> None:
    steps = list[int]()
    again, _ = train_doubt(
        QUICK, small_doubt_set(128, 0), small_doubt_set(32, 1), trained[1], lambda done, _: steps.append(done)
    )
    assert steps == []
    for name, tensor in trained[0].state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor)


def test_a_stopped_run_goes_on_to_the_same_weights(trained: tuple[DoubtNetwork, Path], tmp_path: Path) -> None:
    steps = list[int]()

    def again(running: Running) -> DoubtNetwork:
        sets = small_doubt_set(128, 0), small_doubt_set(32, 1)
        return train_doubt(QUICK, *sets, tmp_path, lambda done, _: steps.append(done), running)[0]

    with pytest.raises(KeyboardInterrupt):
        again(Running(stop=lambda: len(steps) == 11))
    resumed = again(Running())
    assert steps == list(range(1, 65))
    for name, tensor in trained[0].state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], tensor)


def test_calibration_of_a_trained_network_has_limits_that_keep_their_rates(
    trained: tuple[DoubtNetwork, Path],
) -> None:
    some = small_doubt_set(200, 3)
    fitted, said = calibrated(trained[0], some), said_of(trained[0], some)
    nothing, outside = (
        torch.sigmoid(logits / t).numpy() for logits, t in zip(said[:2], fitted.temperatures, strict=True)
    )
    usual = ~some.nothing & ~some.outside
    assert (outside[usual] > fitted.outside_above + 1e-6).mean() <= MOST_FALSE_ALARMS + 1 / usual.sum()
    assert (nothing[some.nothing] < fitted.nothing_above).mean() <= 1 / some.nothing.sum()
    assert fitted.nothing_above <= 0.5
    assert fitted.error_scale > 0


def test_where_nothing_is_hidden_no_error_is_asked_for() -> None:
    some = small_doubt_set(8, 0)
    batch = as_doubt_batch(some.where(some.nothing))
    one, other = (torch.full((len(batch.made), 64, 64), value) for value in (-3.0, 1.0))
    flat = torch.zeros(len(batch.made))
    losses = [float(doubt_loss(DoubtOutput(flat, flat, log_error, one), batch)) for log_error in (one, other)]
    assert losses[0] == losses[1]


def test_the_likeliest_error_is_the_mean_one() -> None:
    some = small_doubt_set(64, 0)
    batch = as_doubt_batch(some.where(~some.nothing))
    shared = (batch.truth > 0) & (batch.made > 0)
    mean = float((batch.made - batch.truth).abs()[shared].mean().log())
    flat, pixels = torch.zeros(len(batch.made)), torch.zeros_like(batch.made)

    def loss(log_error: float) -> float:
        return float(doubt_loss(DoubtOutput(flat, flat, pixels + log_error, pixels), batch))

    assert loss(mean) < min(loss(mean - 0.2), loss(mean + 0.2))


def test_an_epoch_mirrors_maps_and_images_together() -> None:
    some = small_doubt_set(32, 0)
    batch: DoubtBatch = next(doubt_batches(some, 32, torch.Generator().manual_seed(0)))
    assert sorted(batch.nothing.tolist()) == sorted(some.nothing.astype(float).tolist())
    bright = (batch.intensity[:, :, 8:72] > 12).float()
    torch.testing.assert_close(bright, (batch.truth > 0).float())
    torch.testing.assert_close((batch.made > 0).float(), bright)
