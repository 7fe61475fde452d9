"""Split-and-stack and what it does to cells without a return."""

import numpy as np
import pytest
import torch
from nlos_models.data import flip_some
from nlos_models.pipeline import Preprocess, channel_statistics, split_and_stack, stacked_channels
from torch import Tensor


def _maps(seed: int = 0, n: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    depth = 0.2 + torch.rand(n, 64, 80, generator=generator)
    intensity = 50 * torch.rand(n, 64, 80, generator=generator)
    depth[torch.rand(depth.shape, generator=generator) < 0.1] = torch.nan
    return depth, intensity


def test_columns_go_where_the_convention_says() -> None:
    column = torch.arange(80.0).expand(1, 64, 80)
    left_depth, right_depth, left_intensity, right_intensity = split_and_stack(column, 100 + column)[0]
    assert torch.equal(left_depth[0], torch.arange(40.0))
    assert torch.equal(right_depth[0], torch.arange(40.0, 80.0))
    assert torch.equal(left_intensity, 100 + left_depth)
    assert torch.equal(right_intensity, 100 + right_depth)


def test_a_cell_without_a_return_is_missing_in_depth_and_intensity() -> None:
    depth, intensity = torch.ones(1, 64, 80), torch.ones(1, 64, 80)
    depth[0, 5, 10], depth[0, 6, 70] = torch.nan, torch.nan
    missing = torch.isnan(split_and_stack(depth, intensity))[0].nonzero().tolist()
    assert missing == [[0, 5, 10], [1, 6, 30], [2, 5, 10], [3, 6, 30]]


def test_mirroring_top_to_bottom_commutes_with_the_stacking() -> None:
    depth, intensity = _maps()
    flips = torch.tensor([True, False, True])
    before = split_and_stack(*flip_some([depth, intensity], flips))
    (after,) = flip_some([split_and_stack(depth, intensity)], flips)
    torch.testing.assert_close(before, after, rtol=0, atol=0, equal_nan=True)


def test_statistics_are_those_of_the_cells_that_returned() -> None:
    stacked = split_and_stack(*_maps())
    mean, spread = channel_statistics(stacked)
    for channel in range(4):
        values = stacked[:, channel].double().numpy()
        assert mean[channel].item() == pytest.approx(np.nanmean(values), rel=1e-6)
        assert spread[channel].item() == pytest.approx(np.nanstd(values), rel=1e-6)


def test_statistics_of_nothing_are_finite() -> None:
    mean, spread = channel_statistics(torch.full((2, 4, 64, 40), torch.nan))
    assert torch.equal(mean, torch.zeros(4))
    assert torch.equal(spread, torch.zeros(4))


def test_training_maps_come_out_with_mean_0_and_spread_1() -> None:
    depth, intensity = _maps()
    preprocess = Preprocess().eval()
    preprocess.learn(split_and_stack(depth, intensity))
    stacked = split_and_stack(depth, intensity)
    scaled = (stacked - preprocess.mean[:, None, None]) / preprocess.spread[:, None, None]
    mean, spread = channel_statistics(scaled)
    torch.testing.assert_close(mean, torch.zeros(4), atol=1e-5, rtol=0)
    torch.testing.assert_close(spread, torch.ones(4), atol=1e-5, rtol=0)


def test_a_cell_without_a_return_takes_the_channels_mean() -> None:
    depth, intensity = _maps()
    preprocess = Preprocess().eval()
    preprocess.learn(split_and_stack(depth, intensity))
    mean, hole = preprocess.mean, torch.isnan(depth)
    depth_mean, intensity_mean = (torch.cat([m.expand(40), n.expand(40)]) for m, n in (mean[:2], mean[2:]))
    filled = torch.where(hole, depth_mean, depth), torch.where(hole, intensity_mean, intensity)
    torch.testing.assert_close(preprocess(depth, intensity), preprocess(*filled), atol=1e-5, rtol=0)


def test_the_intensity_of_a_cell_without_a_return_does_not_matter() -> None:
    depth, intensity = _maps()
    other = torch.where(torch.isnan(depth), 1e6, intensity)
    preprocess = Preprocess().eval()
    assert torch.equal(preprocess(depth, intensity), preprocess(depth, other))


def test_noise_falls_on_the_left_channels_and_only_while_training() -> None:
    torch.manual_seed(0)
    maps, preprocess = _maps(n=8), Preprocess(left_noise=0.2)
    quiet = preprocess.eval()(*maps)
    assert torch.equal(quiet, preprocess(*maps))
    difference = preprocess.train()(*maps) - quiet
    assert (difference[:, [1, 3]] == 0).all()
    near = Preprocess(left_noise=0.0).train()
    assert torch.equal(near(*maps), quiet)
    stacked = torch.zeros(8, 64, 80)
    rows = Preprocess(left_noise=0.2).train()(stacked, stacked)[:, [0, 2]]
    # bilinear weights only average: the noise of 0.2 comes out smaller, never larger
    assert 0.08 < rows.std().item() < 0.2


def test_training_does_not_write_into_the_maps() -> None:
    depth, intensity = _maps()
    kept = depth.clone(), intensity.clone()
    Preprocess().train()(depth, intensity)
    torch.testing.assert_close((depth, intensity), kept, rtol=0, atol=0, equal_nan=True)


def _hard(name: str) -> tuple[Tensor, Tensor]:
    depth, intensity = torch.full((1, 64, 80), 0.3), torch.full((1, 64, 80), 255.0)
    if name == "all zero":
        depth, intensity = torch.zeros_like(depth), torch.zeros_like(intensity)
    if name == "half invalid":
        depth[:, :32] = torch.nan
    if name == "all invalid":
        depth[:] = torch.nan
    return depth, intensity


@pytest.mark.parametrize("name", ["constant and saturated", "all zero", "half invalid", "all invalid"])
@pytest.mark.parametrize("learnt_from", ["itself", "others"])
def test_hard_maps_come_out_finite(name: str, learnt_from: str) -> None:
    preprocess, maps = Preprocess().eval(), _hard(name)
    preprocess.learn(split_and_stack(*(maps if learnt_from == "itself" else _maps())))
    out = preprocess(*maps)
    assert out.shape == (1, 4, 100, 100)
    assert torch.isfinite(out).all()


def test_maps_after_training_on_a_constant_are_finite() -> None:
    preprocess = Preprocess().eval()
    preprocess.learn(split_and_stack(*_hard("constant and saturated")))
    assert torch.isfinite(preprocess(*_maps())).all()


def _colour_maps(n: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    depth, intensity = _maps(n=n)
    return depth, torch.stack([intensity, *(50 * torch.rand(2, n, 64, 80, generator=generator))], dim=1)


def test_three_intensities_follow_the_depth_as_one_does() -> None:
    depth, intensity = _colour_maps()
    stacked = split_and_stack(depth, intensity)
    assert stacked.shape == (3, stacked_channels(3), 64, 40)
    for colour in range(3):
        of_one = split_and_stack(depth, intensity[:, colour])
        chosen = stacked[:, [0, 1, 2 + 2 * colour, 3 + 2 * colour]]
        torch.testing.assert_close(chosen, of_one, rtol=0, atol=0, equal_nan=True)


def test_exchanging_colours_exchanges_their_channels() -> None:
    depth, intensity = _colour_maps()
    before, after = split_and_stack(depth, intensity), split_and_stack(depth, intensity[:, [2, 0, 1]])
    torch.testing.assert_close(after, before[:, [0, 1, 6, 7, 2, 3, 4, 5]], rtol=0, atol=0, equal_nan=True)


def test_mirrored_colours_are_stacked_and_resized_as_mirrored() -> None:
    maps, preprocess = _colour_maps(), Preprocess(intensities=3).eval()
    preprocess.learn(split_and_stack(*maps))
    straight, mirrored = preprocess(*maps), preprocess(*(m.flip(-2) for m in maps))
    torch.testing.assert_close(mirrored, straight.flip(-2), atol=1e-4, rtol=0)


def test_in_colour_noise_falls_on_the_left_of_depth_and_of_every_intensity() -> None:
    torch.manual_seed(0)
    maps, preprocess = _colour_maps(), Preprocess(left_noise=0.2, intensities=3)
    difference = preprocess.train()(*maps) - preprocess.eval()(*maps)
    assert [bool((difference[:, channel] != 0).any()) for channel in range(8)] == [True, False] * 4
    left = difference[:, ::2].transpose(0, 1).flatten(1)
    assert (torch.corrcoef(left) - torch.eye(4)).abs().max() < 0.1  # each has noise of its own
