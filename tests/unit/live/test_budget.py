import json
import re
from itertools import count as count_up
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_wall import RIG
from hypothesis import given
from hypothesis import strategies as st
from nlos_models import shipped_folder
from small_frames import FrameCamera, sheet_network

from nlos_cam.errors import BudgetError, RecordingError
from nlos_cam.live import (
    SHIPPED,
    BudgetChoice,
    available_settings,
    budget,
    choose_within_budget,
    pipeline_timer,
)
from nlos_cam.live.budget import (
    HANDOVER_MS,
    PERIOD_MS,
    Machine,
    Setting,
    Timing,
    choose,
    keeping_pace,
    load_tradeoff,
)
from nlos_cam.reconstruct import CalibratedRig, Pipeline

AS_MEASURED = Machine(slower=1.0, rest_ms=1.0)


def setting(
    rmse_mm: float | None, ms: float, frames: int = 1, threads: int = 1, **others: Any
) -> Setting:
    fixed: dict[str, Any] = {"name": f"{rmse_mm} mm, {ms} ms", "weights": SHIPPED, "runtime": "any"}
    times = {"milliseconds": ms, "milliseconds_p90": ms, "threads": threads, "frames": frames}
    return Setting.model_validate(
        {**fixed, **times, "foreground_rmse_mm": {"value": rmse_mm}, **others}
    )


rmses = st.none() | st.floats(1.0, 99.0)
times = st.floats(0.5, 60.0)
counts = (st.integers(1, 16), st.integers(1, 4))
some_settings = st.lists(st.builds(setting, rmses, times, *counts), min_size=1, max_size=12)


@given(some_settings, st.floats(0.2, 20.0), st.floats(1.0, 500.0))
def test_choose_takes_the_most_accurate_setting_in_budget(
    settings: list[Setting], slower: float, budget_ms: float
) -> None:
    machine = Machine(slower, 1.0)
    kept = [one for one in keeping_pace(settings, machine) if machine.expected_ms(one) <= budget_ms]
    if not kept:
        with pytest.raises(BudgetError, match=r"the least is \d"):
            choose(settings, machine, budget_ms)
        return
    chosen = choose(settings, machine, budget_ms)
    assert machine.expected_ms(chosen) <= budget_ms
    assert chosen.rmse_mm <= min(one.rmse_mm for one in kept) + 0.01


@given(some_settings, st.floats(1.0, 500.0), st.floats(1.0, 10.0))
def test_choose_is_no_less_accurate_with_a_larger_budget(
    settings: list[Setting], budget_ms: float, more: float
) -> None:
    least_ms = min(map(AS_MEASURED.expected_ms, keeping_pace(settings, AS_MEASURED)))
    assert choose(settings, AS_MEASURED, least_ms) in settings
    if budget_ms >= least_ms:
        tight, wide = (
            choose(settings, AS_MEASURED, limit) for limit in (budget_ms, more * budget_ms)
        )
        assert wide.rmse_mm <= tight.rmse_mm + 0.01


def test_choose_weighs_pace_speed_of_the_machine_and_threads() -> None:
    quick = setting(20.0, 4.0)
    slow = setting(10.0, budget.BUSY_SHARE * PERIOD_MS)
    assert choose([slow, quick], AS_MEASURED, 1e6) == quick
    assert choose([slow, setting(20.0, 99.0)], AS_MEASURED, 1e6) == slow
    settings = [setting(10.0, 12.0), setting(20.0, 2.0)]
    assert choose(settings, AS_MEASURED, 20.0).rmse_mm == 10.0
    assert choose(settings, Machine(slower=3.0, rest_ms=1.0), 20.0).rmse_mm == 20.0
    one = setting(20.0, 6.0)
    two = setting(20.0, 3.0, threads=2)
    assert choose([two, one], AS_MEASURED, 20.0) == one
    assert choose([two, one], AS_MEASURED, 8.0) == two
    assert AS_MEASURED.expected_ms(setting(1.0, 5.0, frames=3)) == pytest.approx(
        HANDOVER_MS + 1.0 + 5.0 + PERIOD_MS
    )


def test_shipped_weights_have_a_tradeoff_table() -> None:
    settings = load_tradeoff(shipped_folder())
    assert {one.frames for one in settings} > {1}
    assert choose(settings, Machine(1.0, 2.0), 50.0).rmse_mm <= 1.2 * min(
        one.rmse_mm for one in settings
    )


@pytest.mark.parametrize(
    "content", [None, b"", b"[]", b'{"settings": []}', b'{"settings": [{"name": "x"}]}', b"\xff"]
)
def test_load_tradeoff_refuses_other_files(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "tradeoff.json").write_bytes(content)
    with pytest.raises(RecordingError, match="tradeoff reconstruct"):
        load_tradeoff(tmp_path)
    file = tmp_path / "tradeoff.json"
    file.write_text(json.dumps({"settings": [setting(3.0, 2.0).model_dump()], "machine": "any"}))
    assert load_tradeoff(tmp_path) == load_tradeoff(file) == [setting(3.0, 2.0)]


QUICK = setting(20.0, 2.0, runtime="quick")
GOOD = setting(15.0, 8.0, runtime="good")
MEAN = setting(12.0, 2.0, frames=4, runtime="mean")
ALL = [GOOD, QUICK, MEAN]


def chosen(
    budget_ms: float, slower: float = 1.0, **late_ms: float
) -> tuple[BudgetChoice, list[Setting]]:
    """Choice on a machine `slower` than the table's and, by runtime, later than it first was; and
    what was loaded.
    """
    loaded: list[Any] = []

    def measure(made: Any) -> Timing:
        return Timing(
            slower * made.milliseconds_p90 + late_ms.get(made.runtime, 0.0) * (len(loaded) > 1), 1.0
        )

    building: Any = lambda network, _: network, lambda wanted: loaded.append(wanted) or wanted
    _, choice = choose_within_budget(budget_ms, ALL, *building, measure)  # type: ignore[arg-type]
    return choice, loaded


def test_within_budget_takes_the_most_accurate_that_fits_as_measured_and_names_its_error() -> None:
    for budget_ms, machine, loads, texts in (
        (7.0, {}, [QUICK, QUICK], ()),
        (15.0, {}, [QUICK, GOOD], ("15.0 mm", "3.0 mm", MEAN.name)),
        (60.0, {}, [QUICK, MEAN], ("4 frames", "50 ms", "best")),
        (15.0, {"slower": 4.0}, [QUICK, QUICK], ()),
        (15.0, {"good": 9.0}, [QUICK, GOOD, QUICK], ()),
    ):
        choice, loaded = chosen(budget_ms, **machine)
        assert (loaded, choice.setting, choice.best) == (loads, loads[-1], MEAN)
        assert choice.expected_ms <= budget_ms
        assert all(text in choice.describe() for text in texts)
    for budget_ms, machine, least_ms in (
        (5.0, {"slower": 4.0}, 9),
        (15.0, {"good": 99.0, "quick": 10.0}, 13),
    ):
        with pytest.raises(BudgetError, match=rf"{re.escape(str(HANDOVER_MS + least_ms))} ms"):
            chosen(budget_ms, **machine)


@pytest.mark.parametrize(("p95_ms", "kept"), [(9.9, True), (10.1, False)])
def test_outcome_counts_averaging_towards_the_delay(p95_ms: float, kept: bool) -> None:
    report: Any = SimpleNamespace(latency_ms={"p95": p95_ms})
    choice = BudgetChoice(60.0, MEAN, 55.0, MEAN)
    outcome = choice.outcome(report)
    assert (outcome["kept"], outcome["p95_ms"]) == (kept, pytest.approx(p95_ms + 50.0))
    assert ("NOT" in choice.describe_outcome(report)) != kept


def test_available_settings_leaves_out_what_cannot_run(monkeypatch: pytest.MonkeyPatch) -> None:
    impossible = {"threads": 10_000, "weights": "/no/such/folder", "runtime": "torch float32, cuda"}
    elsewhere = [setting(1.0, 1.0, **{name: value}) for name, value in impossible.items()]
    monkeypatch.setattr(budget, "load_tradeoff", lambda _: [*elsewhere, *ALL])
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert available_settings(None, None) == ALL
    monkeypatch.setattr(budget, "load_tradeoff", lambda _: elsewhere)
    with pytest.raises(BudgetError):
        available_settings(Path("other"), None)


def test_timer_measures_late_calls_without_the_first() -> None:
    ticks = count_up(0.004, 0.004)
    shapes = list[tuple[int, ...]]()
    pipeline = Pipeline(
        CalibratedRig(RIG), lambda depth_m, _: shapes.append(depth_m.shape) or sheet_network()
    )
    timed = pipeline_timer(FrameCamera(0), lambda: next(ticks))(pipeline)
    assert shapes == [(1, 64, 80)] * (budget.CALLS + 1)
    assert (timed.network_ms, timed.rest_ms) == pytest.approx((4.0, 8.0))
