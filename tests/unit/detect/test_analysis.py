"""Laws of the test by flipped signs: rate of false alarms, drift, power, sign."""

from math import comb

import numpy as np
import pytest
from made_turns import STD, made_plan, made_turns, patch_effect, swapped
from pydantic import ValidationError

from nlos_cam.detect import Analysis, analyze
from nlos_cam.detect.analysis import lock_weights, sign_patterns
from nlos_cam.detect.report import amount
from nlos_cam.errors import RecordingError

RUNS = 40


def binomial_bounds(runs: int, probability: float, outside: float = 0.001) -> tuple[int, int]:
    """Return counts that a binomial variable leaves with at most this probability on each side."""
    mass = [
        comb(runs, k) * probability**k * (1 - probability) ** (runs - k) for k in range(runs + 1)
    ]
    below = np.cumsum(mass)
    low = int(np.argmax(below > outside))
    return low, int(np.argmax(below >= 1 - outside))


def judged(seed: int, **changes: object) -> Analysis:
    """Return the verdict on made turns, without its power."""
    plan = made_plan(seed, turns=20, alpha=0.1)
    turns = made_turns(plan, seed, **changes)  # pyright: ignore[reportArgumentType]
    return analyze(plan, turns, with_power=False)


@pytest.fixture(scope="module")
def without_effect() -> list[Analysis]:
    """Verdicts on runs without any effect."""
    return [judged(seed) for seed in range(RUNS)]


@pytest.mark.parametrize("rate", [1 / 16, 1 / 4, 1 / 2])  # of 16 patterns
def test_p_values_without_effect_are_evenly_spread(
    without_effect: list[Analysis], rate: float
) -> None:
    low, high = binomial_bounds(RUNS, rate)
    assert low <= sum(each.p_value <= rate for each in without_effect) <= high


def test_false_alarms_are_those_of_the_rate(without_effect: list[Analysis]) -> None:
    for each in without_effect:
        assert each.detected == (each.p_value <= each.plan.alpha)


def test_smallest_rate_of_many_turns_finds_and_knows_its_power() -> None:
    # of 14 blocks 4096 patterns are drawn
    plan = made_plan(turns=56, alpha=1e-3)
    best = analyze(plan, made_turns(plan, effect=patch_effect(1e-2, 3))).findings[0]
    assert best.p_value <= 1e-3
    assert best.smallest < 1e-3
    # the noise of a mean over 14 blocks is some micrometers
    assert best.peak > 100


def test_rate_that_no_pattern_resolves_is_refused() -> None:
    with pytest.raises(ValidationError, match="alpha"):
        made_plan(turns=80, alpha=1e-4)


def test_drift_of_a_hundred_noises_raises_no_more_alarms() -> None:
    cell_m = float(STD[0, 0, 0]) / np.sqrt(30)
    drift = {"drift_m": 100 * cell_m, "gain_drift": 1e-3}
    alarms = sum(judged(seed, **drift).detected for seed in range(RUNS))
    assert alarms <= binomial_bounds(RUNS, 1 / 16)[1]


@pytest.mark.parametrize("direction", [False, True])
def test_lock_cancels_offset_and_linear_drift(direction: bool) -> None:
    times_s = np.array([0.0, 19.0, 43.0, 61.0])
    object_in = np.array([False, True, True, False]) ^ direction
    readings = 3.0 + 0.7 * times_s + 0.25 * object_in
    assert lock_weights(times_s, object_in) @ readings == pytest.approx(0.25)


@pytest.mark.parametrize("side", [1, 9])
def test_effect_of_the_stated_power_is_found_nine_times_in_ten(side: int) -> None:
    plan = made_plan()
    stated = next(
        each
        for each in analyze(plan, made_turns(plan)).findings
        if (each.channel, each.patch) == ("depth", side)
    )
    runs = 12
    found = 0
    for seed in range(1, 1 + runs):
        plan = made_plan(seed)
        turns = made_turns(plan, seed, effect=patch_effect(stated.smallest, side))
        found += analyze(plan, turns, with_power=False).detected
    assert found >= binomial_bounds(runs, 0.9)[0]


def test_half_of_the_stated_power_is_mostly_missed() -> None:
    plan = made_plan()
    stated = next(
        each
        for each in analyze(plan, made_turns(plan)).findings
        if (each.channel, each.patch) == ("depth", 1)
    )
    found = 0
    for seed in range(1, 11):
        plan = made_plan(seed)
        turns = made_turns(plan, seed, effect=patch_effect(stated.smallest / 2, 1))
        found += analyze(plan, turns, with_power=False).detected
    assert found <= 5


def test_strong_effect_is_found_where_it_is() -> None:
    plan = made_plan()
    analysis = analyze(plan, made_turns(plan, effect=patch_effect(1e-3, 3)))
    best = analysis.findings[0]
    assert analysis.detected
    assert best.channel == "depth"
    assert abs(best.cell[0] - 32) <= 5
    assert best.effect > 0
    assert best.smallest < 1e-3


def test_swapped_turns_flip_the_sign() -> None:
    plan = made_plan()
    turns = made_turns(plan, effect=patch_effect(1e-3, 3))
    straight = analyze(plan, turns, with_power=False)
    reverse = analyze(plan, swapped(turns), with_power=False)
    assert reverse.p_value == straight.p_value
    for one, other in zip(straight.findings, reverse.findings, strict=True):
        np.testing.assert_allclose(other.contrast, -one.contrast)


def test_all_patterns_of_few_blocks_differ() -> None:
    signs = sign_patterns(8)
    assert len(np.unique(np.vstack([signs, -signs]), axis=0)) == 2 * len(signs) == 256
    assert (signs[0] == 1).all()


def test_too_few_turns_are_refused() -> None:
    plan = made_plan()
    with pytest.raises(RecordingError, match="too few"):
        analyze(plan, made_turns(plan)[:12])


@pytest.mark.parametrize(
    ("value_m", "words"), [(0.3041, "+300 mm"), (-0.00044, "-0.44 mm"), (1.234, "+1200 mm")]
)
def test_effect_is_written_without_an_exponent(value_m: float, words: str) -> None:
    assert amount("depth", value_m, signed=True) == words
