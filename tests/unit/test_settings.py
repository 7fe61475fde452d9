"""Laws of settings: training draws all of its intervals and nothing of what is held out; the test set only that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.arrays import Float64

from nlos_cam.objects.generators import CATEGORIES, Category, Setting, category
from nlos_cam.objects.primitives import box

UNIT = st.floats(0, 1)
ENDS = st.integers(-500, 500).map(lambda tenths: tenths / 10)
SETTINGS = {f"{name}.{key}": s for name, kind in CATEGORIES.items() for key, s in kind.settings.items()}


@st.composite
def _settings(draw: st.DrawFn) -> Setting:
    """Any range with an interval held out inside it, across an end, or beside it."""
    low, high = sorted(draw(st.lists(ENDS, min_size=2, max_size=2, unique=True)))
    gap = sorted(draw(st.lists(ENDS, min_size=2, max_size=2, unique=True)))
    if gap[0] <= low and high <= gap[1]:
        return Setting(low, high)
    return Setting(low, high, (gap[0], gap[1]))


@settings(deadline=None)
@given(_settings(), UNIT)
def test_training_never_draws_what_is_held_out(setting: Setting, unit: float) -> None:
    value = setting.drawn(unit)
    assert any(low - 1e-12 <= value <= high + 1e-12 for low, high in setting.trained)
    if setting.held_out and setting.low < setting.held_out[0] and setting.held_out[1] < setting.high:
        low, high = setting.held_out
        assert not low < value < high


@pytest.mark.parametrize("name", SETTINGS)
def test_no_number_makes_a_category_draw_what_it_holds_out(name: str) -> None:
    """A seed reaches a setting through one number in [0, 1] alone, in which it grows: this holds for every seed."""
    setting = SETTINGS[name]
    low, high = setting.held_out or (np.inf, np.inf)
    drawn = [setting.drawn(unit) for unit in np.linspace(0, 1, 501)]
    below = [k for k, value in enumerate(drawn) if value <= low]
    above = [k for k, value in enumerate(drawn) if value >= high]
    assert drawn == sorted(drawn)
    assert below + above == list(range(501))
    if below and above:  # bisect to the very numbers where it steps over what is held out
        under, over = below[-1] / 500, above[0] / 500
        while under < (middle := (under + over) / 2) < over:
            under, over = (middle, over) if setting.drawn(middle) <= low else (under, middle)
        assert setting.drawn(under) <= low < high <= setting.drawn(over)


@settings(max_examples=50, deadline=None)
@given(_settings())
def test_draws_grow_evenly_from_end_to_end(setting: Setting) -> None:
    lows, highs = zip(*setting.trained, strict=True)
    assert setting.drawn(0) == pytest.approx(min(lows), abs=1e-9)
    assert setting.drawn(1) == pytest.approx(max(highs), abs=1e-9)
    total = sum(high - low for low, high in setting.trained)
    steps = np.diff([setting.drawn(u) for u in np.linspace(0, 1, 20)])
    assert (steps >= -1e-12).all()
    assert np.sort(steps)[:-1] == pytest.approx(total / 19, abs=1e-9), "all but the step over the gap"


@settings(max_examples=50, deadline=None)
@given(st.tuples(ENDS, ENDS), st.integers(0, 2**32))
def test_without_a_gap_it_draws_what_numpy_draws(ends: tuple[float, float], seed: int) -> None:
    low, high = sorted(ends)
    drawn = Setting(low, high).drawn(np.random.default_rng(seed).random())
    assert drawn == np.random.default_rng(seed).uniform(low, high)


@pytest.mark.parametrize("kind", CATEGORIES.values(), ids=CATEGORIES)
def test_every_category_holds_out_a_part_worth_seeing_and_trains_on_most(kind: Category) -> None:
    held = {name: s for name, s in kind.settings.items() if s.held_out}
    assert len(held) >= 2
    for setting in held.values():
        low, high = setting.held_out or (0, 0)
        trained = sum(b - a for a, b in setting.trained)
        assert 0.1 < (high - low) / trained < 0.5
        assert all(
            not a < u < b for a, b in setting.trained for u in (np.nextafter(low, high), np.nextafter(high, low))
        )


@settings(max_examples=50, deadline=None)
@given(st.floats(0.01, 0.99))
def test_the_test_set_takes_the_held_out_interval_or_the_range(unit: float) -> None:
    assert 1 < Setting(0, 4, (1, 2)).kept(unit) < 2
    assert Setting(0, 4).kept(unit) == Setting(0, 4).drawn(unit) == 4 * unit


def test_a_category_has_the_functions_name_and_its_settings_in_order() -> None:
    @category(width=Setting(1, 2), height=Setting(3, 5, held_out=(3.5, 4)))
    def crate(width: float, height: float) -> Float64:
        return box(width, height, 1)

    assert crate.name == "crate"
    assert crate.drawn([0.5, 1.0]) == {"width": 1.5, "height": 5}
    assert crate.kept([0.5, 0.5]) == {"width": 1.5, "height": 3.75}
    assert np.ptp(crate.make(**crate.drawn([0.5, 1.0]))[..., 1]) == 5
    with pytest.raises(ValueError, match="shorter"):
        crate.drawn([0.5])
