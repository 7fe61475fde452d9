"""The stages of the sensor, one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.render.sensor.bias import EVEN
from nlos_cam.render.sensor.sensor import (
    Chain,
    Echoes,
    Optics,
    compete,
    noise_counts,
    quantise,
    saturate,
    signal_surety,
)

NO_STAGE = Chain(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOISY = NO_STAGE._replace(read_variance=0.49, shot_variance=0.09)
COUNTS = st.floats(0, 1e4)


@given(st.floats(-1e3, 1e3))
def test_quantising_moves_by_half_a_unit_at_most_within_the_range(value: float) -> None:
    whole = quantise(value, 255)
    assert abs(whole - min(max(value, 0.0), 255.0)) <= 0.5


@pytest.mark.parametrize(("value", "whole"), [(np.nan, 0), (-np.inf, 0), (np.inf, 255), (1e300, 255), (0.5, 1)])
def test_what_is_no_number_is_nothing_and_what_is_too_much_is_the_most(value: float, whole: int) -> None:
    assert quantise(value, 255) == whole


@pytest.mark.parametrize(
    ("own", "peak", "outcome"),
    [
        (2.0, 2.0, (2.0, 0.25, 3.0, 2.0)),
        (2.0, 2.5, (2.5, 0.75, 4.0, 2.0)),
        (0.125, 2.5, (2.5, 0.75, 4.0, 0.5)),
        (2.0, 1.0, (2.0, 0.25, 3.0, 1.0)),
    ],
)
def test_the_stronger_return_wins_and_a_tie_goes_to_the_direct_one(
    own: float, peak: float, outcome: tuple[float, ...]
) -> None:
    optics = Optics(*(np.array([value], np.float32) for value in (own, 0.25, 3.0, 1.0)), np.zeros(0, np.bool_), EVEN)
    echoes = Echoes(*(np.array([0.0, value], np.float32) for value in (peak, 0.75, 0.5, 8.0)))
    assert compete(optics, 0, echoes, 1) == outcome


@given(COUNTS, st.floats(0, 254))
def test_shot_and_read_noise_add_in_squares(counts: float, ambient: float) -> None:
    shot, read = NOISY._replace(read_variance=0.0), NOISY._replace(shot_variance=0.0)
    light = counts + ambient
    squares = noise_counts(light, shot) ** 2 + noise_counts(light, read) ** 2
    assert noise_counts(light, NOISY) ** 2 == pytest.approx(squares)


@given(COUNTS, st.floats(0, 254))
def test_below_full_scale_ambient_light_leaves_no_pedestal(counts: float, ambient: float) -> None:
    left = saturate(counts + ambient, NO_STAGE._replace(ambient_counts=ambient))
    assert left == pytest.approx(min(counts, 255 - ambient))


@given(st.lists(COUNTS, min_size=2, max_size=20), st.floats(0, 254))
def test_surety_is_a_share_that_rises_with_the_signal_and_not_with_ambient_light(
    counts: list[float], ambient: float
) -> None:
    signals = np.sort(np.array(counts, np.float32))
    for chain in (NOISY, NO_STAGE):
        sure = signal_surety(signals, chain._replace(ambient_counts=ambient))
        assert ((sure >= 0) & (sure <= 1)).all()
        assert (np.diff(sure) >= 0).all()
        assert (sure <= signal_surety(signals, chain)).all()
