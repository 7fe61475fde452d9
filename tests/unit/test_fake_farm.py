"""The farm that renders nothing keeps what a farm promises."""

import numpy as np
import pytest
from fake_farm import FakeFarm, samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset.build import DatasetPlan
from nlos_cam.dataset.samples import make_samples

PLAN = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
PIECES = [range(2), range(2, 4), range(4, 5)]


def test_its_samples_have_the_names_and_types_of_real_ones() -> None:
    real, fake = make_samples(PLAN, range(1)), samples_of(range(1))
    assert {name: values.dtype for name, values in real.items()} == {
        name: np.dtype(np.float64) if name == "scene" else values.dtype for name, values in fake.items()
    }


def test_a_sample_is_its_seeds_alone() -> None:
    for name, values in samples_of(range(3)).items():
        np.testing.assert_array_equal(values[2:], samples_of([2])[name])


def test_it_makes_every_piece_once_in_the_order_it_is_told() -> None:
    assert [piece for piece, _ in FakeFarm()(PLAN, PIECES)] == PIECES
    shuffled = [piece for piece, _ in FakeFarm(order=2)(PLAN, PIECES)]
    assert shuffled != PIECES
    assert sorted(shuffled, key=lambda piece: piece.start) == PIECES


def test_it_fails_when_it_is_told_and_says_when_it_is_closed() -> None:
    farm = FakeFarm(fails_after=1)
    with pytest.raises(KeyboardInterrupt):
        list(farm(PLAN, PIECES))
    assert (farm.made, farm.closed) == (PIECES[:1], True)
