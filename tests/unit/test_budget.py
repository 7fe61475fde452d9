import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_models.checkpoint import shipped_folder

from nlos_cam.errors import BudgetError, RecordingError
from nlos_cam.live.budget import BUSY_SHARE, HANDOVER_MS, PERIOD_MS, Machine, Option, choose, in_pace, load_tradeoff

AS_MEASURED = Machine(slower=1.0, rest_ms=1.0)


def option(rmse_mm: float | None, ms: float, frames: int = 1, threads: int = 1) -> Option:
    given_: dict[str, Any] = {"name": f"{rmse_mm} mm, {ms} ms", "weights": "shipped", "runtime": "any"}
    times = {"milliseconds": ms, "milliseconds_p90": ms, "threads": threads, "frames": frames}
    return Option.model_validate({**given_, **times, "foreground_rmse_mm": {"value": rmse_mm}})


some_options = st.lists(
    st.builds(
        option,
        st.one_of(st.none(), st.floats(1.0, 99.0)),
        st.floats(0.5, 60.0),
        st.integers(1, 16),
        st.integers(1, 4),
    ),
    min_size=1,
    max_size=12,
)


@given(some_options, st.floats(0.2, 20.0), st.floats(1.0, 500.0))
def test_what_is_chosen_keeps_the_budget_and_nothing_in_pace_that_keeps_it_is_better(
    options: list[Option], slower: float, budget_ms: float
) -> None:
    machine = Machine(slower, 1.0)
    kept = [one for one in in_pace(options, machine) if machine.expected_ms(one) <= budget_ms]
    if not kept:
        with pytest.raises(BudgetError, match=r"the least is \d"):
            choose(options, machine, budget_ms)
        return
    chosen = choose(options, machine, budget_ms)
    assert machine.expected_ms(chosen) <= budget_ms
    assert chosen.rmse_mm <= min(one.rmse_mm for one in kept) + 0.01


@given(some_options, st.floats(1.0, 500.0), st.floats(1.0, 10.0))
def test_a_larger_budget_is_never_less_accurate_and_the_least_that_is_told_is_possible(
    options: list[Option], budget_ms: float, more: float
) -> None:
    least_ms = min(map(AS_MEASURED.expected_ms, in_pace(options, AS_MEASURED)))
    assert choose(options, AS_MEASURED, least_ms) in options
    if budget_ms >= least_ms:
        tight, wide = (choose(options, AS_MEASURED, limit) for limit in (budget_ms, more * budget_ms))
        assert wide.rmse_mm <= tight.rmse_mm + 0.01


def test_the_mean_over_frames_is_as_old_as_their_middle() -> None:
    assert option(1.0, 1.0).averaging_ms == 0.0
    assert option(1.0, 1.0, frames=4).averaging_ms == pytest.approx(1.5 * PERIOD_MS)
    assert AS_MEASURED.expected_ms(option(1.0, 5.0, frames=3)) == pytest.approx(HANDOVER_MS + 1.0 + 5.0 + PERIOD_MS)


def test_what_takes_too_much_of_each_frame_is_not_chosen_however_large_the_budget() -> None:
    quick, slow = option(20.0, 4.0), option(10.0, BUSY_SHARE * PERIOD_MS)
    assert choose([slow, quick], AS_MEASURED, 1e6) == quick
    assert choose([slow, option(20.0, 99.0)], AS_MEASURED, 1e6) == slow


def test_a_slower_machine_chooses_what_is_quicker() -> None:
    options = [option(10.0, 12.0), option(20.0, 2.0)]
    assert choose(options, AS_MEASURED, 20.0).rmse_mm == 10.0
    assert choose(options, Machine(slower=3.0, rest_ms=1.0), 20.0).rmse_mm == 20.0


def test_of_settings_as_accurate_that_of_fewest_threads_is_chosen_where_it_keeps_the_budget() -> None:
    one, two = option(20.0, 6.0), option(20.0, 3.0, threads=2)
    assert choose([two, one], AS_MEASURED, 20.0) == one
    assert choose([two, one], AS_MEASURED, 8.0) == two


def test_the_shipped_weights_have_a_table() -> None:
    options = load_tradeoff(shipped_folder())
    assert {one.frames for one in options} > {1}
    assert choose(options, Machine(1.0, 2.0), 50.0).rmse_mm <= 1.2 * min(one.rmse_mm for one in options)


@pytest.mark.parametrize("content", [None, "", "[]", '{"settings": []}', '{"settings": [{"name": "x"}]}', b"\xff"])
def test_what_is_no_table_is_told(tmp_path: Path, content: str | bytes | None) -> None:
    if content is not None:
        (tmp_path / "tradeoff.json").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError, match="tradeoff reconstruct"):
        load_tradeoff(tmp_path)


def test_a_table_is_read_by_its_folder_or_its_name(tmp_path: Path) -> None:
    file = tmp_path / "tradeoff.json"
    file.write_text(json.dumps({"settings": [option(3.0, 2.0).model_dump()], "machine": "any"}))
    assert load_tradeoff(tmp_path) == load_tradeoff(file) == [option(3.0, 2.0)]
