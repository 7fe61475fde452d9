"""From lidar maps to hidden images: batches of maps, split and stack, normalisation, networks,
silhouettes.
"""

import numpy as np
import pytest
import torch
from nlos_models import (
    MIN_V,
    Preprocess,
    channel_statistics,
    cut_silhouette,
    lift_edges,
    split_and_stack,
)
from nlos_models.compressor import Compressor, ResNet50
from nlos_models.pipeline import (
    KEPT_SHARE,
    WINDOW,
    RemappingNetwork,
    new_pipeline,
    new_vae,
    stacked_channels,
)
from nlos_models.training.data import (
    InMemory,
    first_of,
    flip_some,
    image_batches,
    map_batches,
    shuffled,
    subtract_bare_wall,
)
from small_maps import HARD_MAPS, hard_maps, small_maps
from torch import Tensor

pytestmark = pytest.mark.usefixtures("one_thread")


def _maps(n: int = 3, colors: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    depth = 0.2 + torch.rand(n, 64, 80, generator=generator)
    intensity = 50 * torch.rand((n, colors, 64, 80) if colors else (n, 64, 80), generator=generator)
    depth[torch.rand(depth.shape, generator=generator) < 0.1] = torch.nan
    return depth, intensity


def _fitted(maps: tuple[Tensor, Tensor], intensities: int = 1) -> Preprocess:
    preprocess = Preprocess(intensities=intensities).eval()
    preprocess.learn(split_and_stack(*maps))
    return preprocess


def test_split_and_stack_gives_halves_channels_of_their_own() -> None:
    column = torch.arange(80.0).expand(1, 64, 80)
    left = column[0, :, :40]
    right = column[0, :, 40:]

    assert torch.equal(
        split_and_stack(column, 100 + column)[0],
        torch.stack([left, right, 100 + left, 100 + right]),
    )


def test_split_and_stack_marks_a_missing_return_everywhere() -> None:
    depth = torch.ones(1, 64, 80)
    intensity = torch.ones(1, 64, 80)
    depth[0, 5, 10] = torch.nan
    depth[0, 6, 70] = torch.nan
    missing = torch.isnan(split_and_stack(depth, intensity))[0].nonzero().tolist()

    assert missing == [[0, 5, 10], [1, 6, 30], [2, 5, 10], [3, 6, 30]]


def test_split_and_stack_puts_each_color_behind_the_depth() -> None:
    depth, intensity = _maps(colors=3)
    stacked = split_and_stack(depth, intensity)

    assert stacked.shape == (3, stacked_channels(3), 64, 40)

    for color in range(3):
        chosen = stacked[:, [0, 1, 2 + 2 * color, 3 + 2 * color]]
        of_one = split_and_stack(depth, intensity[:, color])
        torch.testing.assert_close(chosen, of_one, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("colors", [0, 3])
def test_split_and_stack_commutes_with_mirroring(colors: int) -> None:
    maps = _maps(colors=colors)
    flips = torch.tensor([True, False, True])
    before = split_and_stack(*flip_some(list(maps), flips))
    (after,) = flip_some([split_and_stack(*maps)], flips)

    torch.testing.assert_close(before, after, rtol=0, atol=0, equal_nan=True)


def test_channel_statistics_ignore_missing_returns() -> None:
    stacked = split_and_stack(*_maps())
    mean, spread = channel_statistics(stacked)
    values = stacked.double().numpy()

    np.testing.assert_allclose(mean, np.nanmean(values, (0, 2, 3)), rtol=1e-6)
    np.testing.assert_allclose(spread, np.nanstd(values, (0, 2, 3)), rtol=1e-6)

    for statistic in channel_statistics(torch.full((2, 4, 64, 40), torch.nan)):
        assert torch.equal(statistic, torch.zeros(4))


@pytest.mark.parametrize("colors", [0, 3])
def test_preprocess_noise_falls_on_left_channels_in_training(colors: int) -> None:
    torch.manual_seed(0)
    maps = _maps(8, colors)
    preprocess = Preprocess(left_noise=0.2, intensities=max(colors, 1))
    before = [part.clone() for part in maps]
    quiet = preprocess.eval()(*maps)
    noise = preprocess.train()(*maps) - quiet

    assert (noise[:, 1::2] == 0).all()

    left = noise[:, ::2].transpose(0, 1).flatten(1)

    # bilinear weights only average: the noise of 0.2 comes out smaller, never larger
    assert ((left.std(1) > 0.08) & (left.std(1) < 0.2)).all()
    assert (torch.corrcoef(left) - torch.eye(len(left))).abs().max() < 0.1
    assert torch.equal(Preprocess(left_noise=0.0, intensities=max(colors, 1)).train()(*maps), quiet)
    torch.testing.assert_close(list(maps), before, rtol=0, atol=0, equal_nan=True)


def test_preprocess_gives_missing_return_the_channel_mean() -> None:
    depth, intensity = _maps()
    preprocess = _fitted((depth, intensity))
    hole = torch.isnan(depth)
    mean = preprocess.mean
    depth_mean, intensity_mean = (
        torch.cat([m.expand(40), n.expand(40)]) for m, n in (mean[:2], mean[2:])
    )
    filled = torch.where(hole, depth_mean, depth), torch.where(hole, intensity_mean, intensity)

    torch.testing.assert_close(preprocess(depth, intensity), preprocess(*filled), atol=1e-5, rtol=0)
    assert torch.equal(
        preprocess(depth, intensity), preprocess(depth, torch.where(hole, 1e6, intensity))
    )


@pytest.mark.parametrize("name", HARD_MAPS)
@pytest.mark.parametrize("colors", [0, 3])
def test_preprocess_of_hard_maps_is_finite(name: str, colors: int) -> None:
    hard = hard_maps(name, (colors,) if colors else ())
    others = _maps(colors=colors)
    for learnt, maps in ((hard, hard), (others, hard), (hard, others)):
        out = _fitted(learnt, max(colors, 1))(*maps)
        assert out.shape == (len(maps[0]), 8 if colors else 4, 100, 100)
        assert torch.isfinite(out).all()


@pytest.fixture(scope="module")
def pipeline() -> RemappingNetwork:
    torch.manual_seed(0)
    return new_pipeline(color=False).eval()


@torch.inference_mode()
@pytest.mark.parametrize("name", HARD_MAPS)
@pytest.mark.parametrize("bfloat16", [False, True])
def test_pipeline_makes_possible_image_of_hard_maps(
    pipeline: RemappingNetwork, name: str, bfloat16: bool
) -> None:
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        image = pipeline(*hard_maps(name))

    assert image.shape == (1, 64, 64)
    assert ((image == 0) | ((image >= MIN_V) & (image <= 1))).all()


@torch.inference_mode()
def test_pipeline_latent_depends_on_neither_batch_nor_layout(pipeline: RemappingNetwork) -> None:
    depth = torch.rand(3, 64, 80)
    intensity = 50 * torch.rand(3, 64, 80)
    latents = pipeline.latent(depth, intensity)
    alone = torch.cat(
        [pipeline.latent(d[None], i[None]) for d, i in zip(depth, intensity, strict=True)]
    )

    torch.testing.assert_close(latents, alone, atol=1e-4, rtol=1e-3)

    strided = (part.transpose(1, 2).contiguous().transpose(1, 2) for part in (depth, intensity))

    torch.testing.assert_close(pipeline.latent(*strided), latents, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("color", "channels", "latent"), [(False, 4, 256), (True, 8, 512)])
def test_new_pipeline_is_of_depth_or_color(color: bool, channels: int, latent: int) -> None:
    with torch.device("meta"):
        vae = new_vae(color=color)
        made = new_pipeline(vae.decoder, color=color, dropout=0.3, left_noise=0.1)
        own = new_pipeline(color=color)

    assert made.decoder is vae.decoder
    assert own.decoder.state_dict().keys() == vae.decoder.state_dict().keys()
    assert vae.latent == latent
    assert made.preprocess.mean.shape == (channels,)
    assert type(made.compressor) is (ResNet50 if color else Compressor)
    assert [m.p for m in made.compressor.modules() if isinstance(m, torch.nn.Dropout)] == [0.3]
    assert made.preprocess.left_noise == 0.1


def test_cut_silhouette_clears_a_faint_skirt_beside_a_surface() -> None:
    image = torch.zeros(1, 1, 64, 64)
    faint = 0.9 * KEPT_SHARE * 0.9
    image[..., 10:30, 10:20] = 0.9
    image[..., 10:30, 20:23] = faint
    image[..., 50:60, 50:60] = faint
    cut = cut_silhouette(image)

    assert (cut[..., 20:23] == 0).all()
    assert torch.equal(cut[..., 10:20], image[..., 10:20])
    assert (cut[..., 50:60, 50:60] == faint).all()
    assert WINDOW < 30


def test_cut_silhouette_clears_all_of_a_faint_image() -> None:
    for value in (0.0, 0.05, MIN_V, 1.0):
        image = torch.full((1, 1, 64, 64), value)
        assert torch.equal(
            cut_silhouette(image), image if value >= MIN_V else torch.zeros_like(image)
        )


def test_cut_silhouette_goes_by_the_brightest_color() -> None:
    image = torch.zeros(1, 3, 64, 64)
    image[0, :, 10:40, 10:40] = torch.tensor([0.9, 0.02, 0.5])[:, None, None]
    image[0, :, 10:40, 40:43] = torch.tensor([0.3, 0.35, 0.3])[:, None, None]
    cut = cut_silhouette(image)

    assert torch.equal(cut[..., 10:40, 10:40], image[..., 10:40, 10:40])
    assert (cut[..., 40:43] == 0).all()
    assert torch.equal(cut_silhouette(image[:, [1, 2, 0]]), cut[:, [1, 2, 0]])


def test_lift_edges_brightens_blurred_edge_of_plateau() -> None:
    noise = torch.rand(4, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    blurred = torch.nn.functional.avg_pool2d(noise, 9, stride=1, padding=4) * 1.5

    assert (lift_edges(blurred) >= blurred).all()
    assert (lift_edges(blurred) <= blurred.amax((2, 3), keepdim=True) + 1e-6).all()

    image = torch.zeros(1, 1, 64, 64)
    image[..., 10:40, 20:50] = 0.8
    image[..., 10:40, 50:52] = 0.5
    lifted = lift_edges(image)

    torch.testing.assert_close(lifted[..., 10:40, 20:48], image[..., 10:40, 20:48])
    assert (lifted[..., 15:35, 50:52] > 0.7).all()


@pytest.mark.parametrize(("count", "batch"), [(10, 5), (11, 5), (14, 5), (5, 5), (3, 5), (2, 2)])
def test_shuffled_batches_are_whole_and_repeat_no_sample(count: int, batch: int) -> None:
    batches = list(shuffled(count, batch, torch.Generator()))

    assert {len(b) for b in batches} == {min(batch, count)}
    assert len(batches) == max(count // batch, 1)

    drawn = torch.cat(batches).tolist()

    assert len(set(drawn)) == len(drawn)
    assert set(drawn) <= set(range(count))

    generators = (torch.Generator().manual_seed(seed) for seed in (1, 1, 2))
    first, again, other = (torch.cat(list(shuffled(50, 10, generator))) for generator in generators)

    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_flip_some_mirrors_flagged_samples_and_undoes_itself() -> None:
    maps = torch.rand(3, 64, 80)
    images = torch.rand(3, 1, 64, 64)
    flips = torch.tensor([True, False, True])
    mirrored_maps, mirrored_images = flip_some([maps, images], flips)

    assert torch.equal(mirrored_maps[1], maps[1])
    assert torch.equal(mirrored_maps[0], maps[0].flip(0))
    assert torch.equal(mirrored_images[2, 0], images[2, 0].flip(0))
    assert all(map(torch.equal, flip_some([mirrored_maps, mirrored_images], flips), [maps, images]))


def test_image_batches_are_images_or_their_mirrors() -> None:
    images = np.random.default_rng(0).random((6, 64, 64)).astype(np.float16)
    known = {view.tobytes(): k for k, image in enumerate(images) for view in (image, image[::-1])}
    batches = list(image_batches(images, 3, torch.Generator()))

    assert all(b.shape == (3, 1, 64, 64) and b.dtype == torch.float32 for b in batches)

    found = [known[image[0].numpy().astype(np.float16).tobytes()] for b in batches for image in b]

    assert sorted(found) == list(range(6))


def test_map_batches_mirror_maps_with_their_images() -> None:
    maps = small_maps(8, 0)
    batches = list(map_batches(maps, 4, torch.Generator().manual_seed(0)))
    for batch in batches:
        parts = [
            torch.from_numpy(part)[batch.row]
            for part in (maps.depth_m, maps.intensity, maps.image[:, None])
        ]
        depth_m, intensity, image = flip_some(parts, batch.mirrored)
        found = [batch.depth_m, batch.intensity, batch.image]
        wanted = [depth_m, intensity, image.float()]
        torch.testing.assert_close(found, wanted, rtol=0, atol=0, equal_nan=True)

    assert sorted(torch.cat([batch.row for batch in batches]).tolist()) == list(range(8))
    assert 0 < torch.cat([batch.mirrored for batch in batches]).sum() < 8


def test_first_maps_are_at_most_all() -> None:
    maps = small_maps(8, 0)
    for few, every in zip(vars(first_of(maps, 2)).values(), vars(maps).values(), strict=True):
        np.testing.assert_array_equal(few, every[:2])

    assert len(InMemory(maps).first(9).image) == 8


def test_difference_maps_subtract_bare_wall_where_both_return() -> None:
    maps = small_maps(3, 0)
    depth = np.full((64, 80), 0.125, np.float32)
    intensity = np.full((64, 80), 4.0, np.float32)
    depth[30] = np.nan
    difference = subtract_bare_wall(maps, depth, intensity)
    valid = ~np.isnan(maps.depth_m) & ~np.isnan(depth)

    assert 0 < valid.sum() < (~np.isnan(maps.depth_m)).sum()
    np.testing.assert_array_equal(~np.isnan(difference.depth_m), valid)
    np.testing.assert_allclose(difference.depth_m[valid], maps.depth_m[valid] - 0.125)
    np.testing.assert_allclose(difference.intensity[valid], maps.intensity[valid] - 4.0)
    assert not difference.intensity[~valid].any()
    assert difference.image is maps.image
