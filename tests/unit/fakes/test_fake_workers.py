"""The worker pool that renders nothing keeps the promises of a real one."""

import numpy as np
from fake_workers import FakeWorkers, samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.samples import make_samples

PLAN = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
PIECES = [range(2), range(2, 4), range(4, 5)]


def test_fake_samples_have_names_and_types_of_real_ones() -> None:
    real = make_samples(PLAN, range(1))
    fake = samples_of(range(1))
    types = {name: values.dtype for name, values in fake.items()}

    assert {name: values.dtype for name, values in real.items()} == types | {
        "scene": np.dtype(np.float64)
    }


def test_fake_workers_deliver_every_piece_once_in_their_order() -> None:
    assert [piece for piece, _ in FakeWorkers()(PLAN, PIECES)] == PIECES

    shuffled = [piece for piece, _ in FakeWorkers(order=2)(PLAN, PIECES)]

    assert shuffled != PIECES
    assert sorted(shuffled, key=lambda piece: piece.start) == PIECES
