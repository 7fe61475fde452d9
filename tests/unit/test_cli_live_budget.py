import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam.cli import live
from nlos_cam.errors import BudgetError
from nlos_cam.live.budget import CALLS, HANDOVER_MS, SHIPPED, Choice, Option, Timed, options_here, timer, within_budget
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import Pipeline

SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)


def option(name: str, rmse_mm: float, ms: float, frames: int = 1, **others: Any) -> Option:
    fixed: dict[str, Any] = {"name": name, "weights": SHIPPED, "runtime": name, "threads": 1, "frames": frames}
    times = {"milliseconds": ms, "milliseconds_p90": ms}
    return Option.model_validate({**fixed, **times, "foreground_rmse_mm": {"value": rmse_mm}, **others})


QUICK, GOOD, MEAN = option("quick", 20.0, 2.0), option("good", 15.0, 8.0), option("mean", 12.0, 2.0, frames=4)
ALL = [GOOD, QUICK, MEAN]


def chosen(
    budget_ms: float, slower: float = 1.0, surprises: dict[str, float] | None = None
) -> tuple[Choice, list[str]]:
    """What is chosen on a machine that is so much slower, and on which some take longer still; what was loaded."""
    loaded: list[str] = []

    def load(wanted: Option) -> Any:
        loaded.append(wanted.name)
        return wanted

    def measure(made: Any) -> Timed:
        late_ms = (surprises or {}).get(made.name, 0.0) if len(loaded) > 1 else 0.0
        return Timed(slower * made.milliseconds_p90 + late_ms, 1.0)

    _, choice = within_budget(budget_ms, ALL, lambda network, _: network, load, measure)  # type: ignore[arg-type]
    return choice, loaded


@pytest.mark.parametrize(("budget_ms", "name"), [(7.0, "quick"), (15.0, "good"), (60.0, "mean")])
def test_more_budget_buys_accuracy(budget_ms: float, name: str) -> None:
    choice, loaded = chosen(budget_ms)
    assert choice.option.name == loaded[-1] == name
    assert choice.expected_ms <= budget_ms
    assert choice.best is MEAN


def test_a_slow_machine_is_measured_and_not_believed_to_be_as_the_table_says() -> None:
    assert chosen(15.0, slower=4.0)[0].option is QUICK
    with pytest.raises(
        BudgetError, match=rf"no setting keeps a delay of 5 ms .* the least is {re.escape(str(HANDOVER_MS + 9))} ms"
    ):
        chosen(5.0, slower=4.0)


def test_what_turns_out_slower_when_it_is_tried_is_given_up() -> None:
    choice, loaded = chosen(15.0, surprises={"good": 9.0})
    assert (choice.option, loaded) == (QUICK, ["quick", "good", "quick"])
    with pytest.raises(BudgetError, match=rf"when it was tried: the least was {re.escape(str(HANDOVER_MS + 13))} ms"):
        chosen(15.0, surprises={"good": 99.0, "quick": 10.0})


def test_it_is_told_what_was_chosen_and_what_it_costs() -> None:
    assert chosen(15.0)[0].told().endswith("RMSE 15.0 mm, 3.0 mm more than the best, mean")
    line = chosen(60.0)[0].told()
    assert "mean of 4 frames (50 ms)" in line
    assert line.endswith("the best there is")


@pytest.mark.parametrize(("p95_ms", "kept"), [(9.9, True), (10.1, False)])
def test_averaging_counts_when_it_is_judged_whether_the_budget_was_kept(p95_ms: float, kept: bool) -> None:
    report: Any = SimpleNamespace(latency_ms={"p95": p95_ms})
    choice = Choice(60.0, MEAN, 55.0, MEAN)
    outcome = choice.outcome(report)
    assert (outcome["kept"], outcome["p95_ms"]) == (kept, pytest.approx(p95_ms + 50.0))
    assert ("NOT kept" in choice.outcome_told(report)) != kept


def test_only_what_can_run_here_is_considered(monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = [
        option("many", 1.0, 1.0, threads=10_000),
        option("gone", 1.0, 1.0, weights="/no/such/folder"),
        option("torch float32, cuda", 1.0, 1.0),
    ]
    monkeypatch.setattr(live, "load_tradeoff", lambda _: [*elsewhere, *ALL])
    monkeypatch.setattr(live.torch.cuda, "is_available", lambda: False)
    assert options_here(None, None) == ALL
    monkeypatch.setattr(live, "load_tradeoff", lambda _: elsewhere)
    with pytest.raises(BudgetError, match="no setting of this trade-off runs on this machine"):
        options_here(Path("other"), None)


def test_a_machine_is_measured_by_its_late_calls_without_the_first() -> None:
    now_s, calls = [0.0], []

    def network(*_: np.ndarray) -> np.ndarray:
        calls.append(1)
        return np.full((1, 64, 64), 0.5, np.float32)

    def clock() -> float:
        now_s[0] += 0.004
        return now_s[0]

    camera: Any = SimpleNamespace(intrinsics=SMALL)
    timed = timer(camera, clock)(Pipeline(CalibratedRig(load_rig("paper-rig")), network))
    assert len(calls) == CALLS + 1
    assert (timed.network_ms, timed.rest_ms) == pytest.approx((4.0, 8.0))
