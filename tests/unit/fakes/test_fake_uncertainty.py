"""The fake says what an uncertainty network says: the same names, shapes and kinds."""

import numpy as np
import torch
from fake_uncertainty import FakeUncertainty
from nlos_models.uncertainty_network import CalibratedUncertainty, UncertaintyNetwork


def test_fake_uncertainty_answers_in_the_shapes_of_a_network() -> None:
    maps = np.full((1, 64, 80), 0.3, np.float32)
    image = np.zeros((1, 64, 64), np.float32)
    network = CalibratedUncertainty(UncertaintyNetwork(), (1.0, 1.0), 1.0).eval()
    real = network(*(torch.from_numpy(part) for part in (maps, maps, image)))

    fake = FakeUncertainty(lambda *_: (0.25, 0.75))(maps, maps, image)

    assert [part.shape for part in fake] == [tuple(part.shape) for part in real]
    assert float(fake.p_empty[0]) == 0.25
    assert float(fake.p_out_of_distribution[0]) == 0.75
