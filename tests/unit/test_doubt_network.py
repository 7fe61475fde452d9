"""The doubt network: what it sees of maps, and that it says something sensible of anything."""

import pytest
import torch
from nlos_models.doubt_network import LEAST_ERROR_V, MOST_ERROR_V, DoubtNetwork, Told
from small_maps import hard_maps


@pytest.fixture
def network() -> DoubtNetwork:
    torch.manual_seed(0)
    return DoubtNetwork().eval().requires_grad_(requires_grad=False)


def test_it_is_small(network: DoubtNetwork) -> None:
    assert sum(p.numel() for p in network.parameters()) < 300_000


def test_the_bare_wall_is_each_cells_median_and_shows_as_nothing(network: DoubtNetwork) -> None:
    generator = torch.Generator().manual_seed(0)
    bare_m, counts = torch.rand(64, 80, generator=generator), 40 * torch.rand(64, 80, generator=generator)
    depth_m = bare_m.repeat(5, 1, 1)
    depth_m[0], depth_m[1, 0, 0] = bare_m + 0.3, torch.nan
    network.learn_bare(depth_m, counts.repeat(5, 1, 1))
    seen = network.features(bare_m[None], counts[None])
    assert float(seen.abs().max()) == 0.0
    assert float(network.features(bare_m[None] + 0.05, counts[None] + 5)[:, :4].min()) > 0.4


def test_a_cell_without_a_return_is_told_as_such_and_by_nothing_else(network: DoubtNetwork) -> None:
    depth_m, intensity = torch.full((1, 64, 80), 0.3), torch.full((1, 64, 80), 9.0)
    depth_m[0, 3, 4] = torch.nan
    assert network.features(depth_m, intensity)[0, :, 3, 4].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("name", ["all zero", "saturated", "half invalid", "all invalid"])
@pytest.mark.parametrize("v", [0.0, 1.0])
def test_what_is_told_is_finite_and_in_range_whatever_is_seen(network: DoubtNetwork, name: str, v: float) -> None:
    told = Told(network, (1.0, 2.0), 3.0).eval()
    nothing, outside, error_v, surface = told(*hard_maps(name), torch.full((1, 64, 64), v))
    for probability in (nothing, outside, surface):
        assert bool(((probability >= 0) & (probability <= 1)).all())
    assert float(error_v.min()) >= LEAST_ERROR_V
    assert float(error_v.max()) <= MOST_ERROR_V
    assert error_v.shape == surface.shape == (1, 64, 64)


def test_calibration_scales_the_error_and_cools_the_verdicts(network: DoubtNetwork) -> None:
    maps, image = hard_maps("saturated"), torch.full((1, 64, 64), 0.5)
    plain, scaled = (Told(network, t, s).eval()(*maps, image) for t, s in (((1.0, 1.0), 1.0), ((2.0, 4.0), 1.5)))
    torch.testing.assert_close(scaled[2], 1.5 * plain[2])
    for one, other, temperature in zip(plain[:2], scaled[:2], (2.0, 4.0), strict=True):
        torch.testing.assert_close(torch.logit(other) * temperature, torch.logit(one))
