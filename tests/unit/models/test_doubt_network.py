"""The doubt network: its features, and outputs that stay in range for any maps."""

import pytest
import torch
from nlos_models.doubt_network import MAX_ERROR_V, MIN_ERROR_V, CalibratedDoubt, DoubtNetwork
from small_maps import hard_maps

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def network() -> DoubtNetwork:
    torch.manual_seed(0)
    return DoubtNetwork().eval().requires_grad_(requires_grad=False)


def test_bare_wall_is_median_of_cells_and_gives_zero_features(network: DoubtNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    bare_m, counts = torch.rand(64, 80, generator=generator), 40 * torch.rand(64, 80, generator=generator)
    depth_m = bare_m.repeat(5, 1, 1)
    depth_m[0], depth_m[1, 0, 0] = bare_m + 0.3, torch.nan
    network.learn_bare(depth_m, counts.repeat(5, 1, 1))
    assert float(network.features(bare_m[None], counts[None]).abs().max()) == 0.0
    assert float(network.features(bare_m[None] + 0.05, counts[None] + 5)[:, :4].min()) > 0.4


def test_cell_without_return_sets_its_own_feature_alone(network: DoubtNetwork) -> None:
    depth_m, intensity = torch.full((1, 64, 80), 0.3), torch.full((1, 64, 80), 9.0)
    depth_m[0, 3, 4] = torch.nan
    assert network.features(depth_m, intensity)[0, :, 3, 4].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("name", ["all zero", "saturated", "half invalid", "all invalid"])
@pytest.mark.parametrize("v", [0.0, 1.0])
def test_doubt_of_hard_maps_is_finite_and_in_range(network: DoubtNetwork, name: str, v: float) -> None:
    calibrated = CalibratedDoubt(network, (1.0, 2.0), 3.0).eval()
    nothing, outside, error_v, surface = calibrated(*hard_maps(name), torch.full((1, 64, 64), v))
    for probability in (nothing, outside, surface):
        assert bool(((probability >= 0) & (probability <= 1)).all())
    assert float(error_v.min()) >= MIN_ERROR_V
    assert float(error_v.max()) <= MAX_ERROR_V
    assert error_v.shape == surface.shape == (1, 64, 64)


def test_calibration_scales_error_and_divides_logits(network: DoubtNetwork) -> None:
    maps, image = hard_maps("saturated"), torch.full((1, 64, 64), 0.5)
    plain, scaled = (
        CalibratedDoubt(network, t, s).eval()(*maps, image) for t, s in (((1.0, 1.0), 1.0), ((2.0, 4.0), 1.5))
    )
    torch.testing.assert_close(scaled[2], 1.5 * plain[2])
    for one, other, temperature in zip(plain[:2], scaled[:2], (2.0, 4.0), strict=True):
        torch.testing.assert_close(torch.logit(other) * temperature, torch.logit(one))
